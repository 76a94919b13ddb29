"""The map as decisions: vertices, walls, gates and triangles, without a single coordinate.

Every vertex keeps a fan: its spokes (known edges to other vertices) counter-clockwise from the wall that
leaves it to the wall that arrives at it (free space lies left of a wall), with a sector between neighbours that
is either a triangle or unexplored. The fans alone say what bounds the unexplored space, so the topology never
depends on how well a position is known.
"""

from dataclasses import dataclass, field
from math import pi

from coopslam.errors import CoopSlamError


class MapConflict(CoopSlamError):
    """A decision contradicts what the map already holds."""

    exit_code = 3


@dataclass(slots=True)
class Fan:
    """The free angle around a vertex. The first and last spokes are its walls; None: other end not yet known."""

    spokes: list[int | None] = field(default_factory=lambda: [None, None])
    sectors: list[int | None] = field(default_factory=lambda: [None])  # sector k lies between spokes k and k + 1

    def spoke_to(self, other: int, unexplored_after: bool) -> int:
        """Index of the spoke to `other` whose next (or else previous) sector is unexplored.

        A vertex can stand on a fan twice, when an edge to it was a wall on one side of an obstacle only.
        """
        for k, spoke in enumerate(self.spokes):
            sector = k if unexplored_after else k - 1
            if spoke == other and 0 <= sector < len(self.sectors) and self.sectors[sector] is None:
                return k
        raise MapConflict(f"no unexplored space next to the edge to vertex {other}")

    @property
    def complete(self) -> bool:
        """Both walls known, no unexplored sector."""
        return None not in self.spokes and None not in self.sectors


@dataclass(frozen=True, slots=True)
class Boundary:
    """What bounds the unexplored space next to a gate's end: a wall or another open gate."""

    is_wall: bool
    other: int | None  # the vertex at its other end; None: a wall not yet walked


@dataclass(frozen=True, slots=True)
class Sector:
    """An unexplored sector of a fan: the spokes on its clockwise and counter-clockwise side."""

    index: int
    clockwise: Boundary
    counter_clockwise: Boundary


@dataclass(slots=True)
class FreeMap:
    """Triangles of free space over vertex ids, and the open gates between them and the unexplored.

    A gate (a, b) has unexplored space on the left of a -> b.
    """

    fans: dict[int, Fan] = field(default_factory=dict)
    triangles: dict[int, tuple[int, int, int]] = field(default_factory=dict)
    gates: dict[tuple[int, int], int | None] = field(default_factory=dict)  # -> triangle on its right; None: a wall
    interior_angles: dict[int, float] = field(default_factory=dict)  # measured, rad
    _edges: dict[tuple[int, int], list[int]] = field(default_factory=dict)

    def add_vertex(self, vertex: int, interior_angle_rad: float) -> None:
        """A corner seen for the first time."""
        self.fans[vertex] = Fan()
        self.interior_angles[vertex] = interior_angle_rad

    def add_first_wall(self, start: int, end: int) -> None:
        """The wall that was walked first is the first gate."""
        self._wall(start, end)
        self.gates[start, end] = None

    def wall_leaving(self, vertex: int) -> int | None:
        """The vertex at the end of the wall that leaves this one, if it was walked."""
        return self.fans[vertex].spokes[0]

    def wall_arriving(self, vertex: int) -> int | None:
        """The vertex at the start of the wall that arrives at this one, if it was walked."""
        return self.fans[vertex].spokes[-1]

    def walls(self) -> list[tuple[int, int]]:
        """All walls that were walked, (start, end) with free space on the left."""
        return [(v, fan.spokes[0]) for v, fan in self.fans.items() if fan.spokes[0] is not None]

    def rings(self) -> list[list[int]]:
        """Closed walks along the walls that are known so far, each from vertex to vertex."""
        rings, seen = [], set()
        for vertex in self.fans:
            ring = []
            while vertex is not None and vertex not in seen:
                seen.add(vertex)
                ring.append(vertex)
                vertex = self.wall_leaving(vertex)
            if ring and vertex == ring[0]:
                rings.append(ring)
        return rings

    def turning(self, ring: list[int]) -> float:
        """Sum of a ring's exterior angles as they were measured, rad: a full turn, backwards around a hole."""
        return sum(pi - self.interior_angles[vertex] for vertex in ring)

    @property
    def holes(self) -> int:
        """Obstacles whose walls are all known."""
        return sum(self.turning(ring) < 0 for ring in self.rings())

    def boundary_at_end(self, gate: tuple[int, int]) -> Boundary:
        """What bounds the unexplored space of gate (a, b) at b: the next edge clockwise from b -> a."""
        a, b = gate
        fan = self.fans[b]
        k = fan.spoke_to(a, unexplored_after=False)
        return Boundary(k == 1, fan.spokes[k - 1])

    def boundary_at_start(self, gate: tuple[int, int]) -> Boundary:
        """What bounds the unexplored space of gate (a, b) at a: the next edge counter-clockwise from a -> b."""
        a, b = gate
        fan = self.fans[a]
        k = fan.spoke_to(b, unexplored_after=True)
        return Boundary(k + 2 == len(fan.spokes), fan.spokes[k + 1])

    def unexplored_sectors(self, vertex: int) -> list[Sector]:
        """Where space around a vertex is still unexplored."""
        fan, last = self.fans[vertex], len(self.fans[vertex].spokes) - 1
        return [
            Sector(k, Boundary(k == 0, fan.spokes[k]), Boundary(k + 1 == last, fan.spokes[k + 1]))
            for k, sector in enumerate(fan.sectors)
            if sector is None
        ]

    def triangles_at(self, a: int, b: int) -> list[int]:
        """Triangles that have the edge between two vertices."""
        return self._edges.get((min(a, b), max(a, b)), [])

    def joined(self, a: int, b: int) -> bool:
        """Whether two vertices are the ends of a known edge."""
        return bool(self.triangles_at(a, b)) or b in (self.wall_leaving(a), self.wall_arriving(a))

    def adjacent_triangles(self) -> list[tuple[int, int, tuple[int, int]]]:
        """(triangle, triangle, shared edge) for every diagonal with a triangle on both sides."""
        return [(*triangles, edge) for edge, triangles in self._edges.items() if len(triangles) == 2]

    def close_as_wall(self, gate: tuple[int, int]) -> tuple[int, int]:
        """Gate (a, b) turned out to be a wall from b to a: nothing lies behind it. Returns (b, a)."""
        a, b = gate
        at_end, at_start = self.boundary_at_end(gate), self.boundary_at_start(gate)
        if not (at_end.is_wall and at_start.is_wall and at_end.other in (None, a) and at_start.other in (None, b)):
            raise MapConflict(f"gate {gate} cannot be a wall: other edges lie between it and the walls at its ends")
        fan = self.fans[b]
        k = fan.spoke_to(a, unexplored_after=False)
        del fan.spokes[k - 1], fan.sectors[k - 1]
        fan = self.fans[a]
        k = fan.spoke_to(b, unexplored_after=True)
        del fan.spokes[k + 1], fan.sectors[k]
        del self.gates[gate]
        return b, a

    def add_triangle(
        self, gate: tuple[int, int], apex: int, wall_at_end: bool, wall_at_start: bool, sector: int | None = None
    ) -> int:
        """Triangle (a, b, apex) behind gate (a, b); returns its id.

        wall_at_end / wall_at_start: the edge b - apex / apex - a was walked as a wall.
        sector: which unexplored sector of a known apex it lies in; not needed for a new one.
        """
        a, b = gate
        if wall_at_end:
            self._check_wall(b, apex)
        if wall_at_start:
            self._check_wall(apex, a)
        for u, v in ((b, apex), (apex, a)):
            known = self.triangles_at(u, v)
            if known and (u, v) not in self.gates:
                raise MapConflict(f"triangle ({a}, {b}, {apex}) would lie on triangle {known[-1]}")
        triangle = len(self.triangles)
        near_a, near_b, near_c = self.fans[a], self.fans[b], self.fans[apex]
        k_a = near_a.spoke_to(b, unexplored_after=True)
        k_b = near_b.spoke_to(a, unexplored_after=False)
        k_c = (near_c.sectors.index(None) if sector is None else sector) if None in near_c.sectors else None
        if k_c is None or near_c.sectors[k_c] is not None:
            raise MapConflict(f"vertex {apex} has no unexplored space left for a triangle behind gate {gate}")
        if wall_at_end:
            self._wall(b, apex)
        if wall_at_start:
            self._wall(apex, a)
        if near_a.spokes[k_a + 1] != apex:
            near_a.spokes.insert(k_a + 1, apex)
            near_a.sectors.insert(k_a + 1, None)
        near_a.sectors[k_a] = triangle
        if near_b.spokes[k_b - 1] != apex:
            near_b.spokes.insert(k_b, apex)
            near_b.sectors.insert(k_b - 1, None)
            near_b.sectors[k_b] = triangle
        else:
            near_b.sectors[k_b - 1] = triangle
        self._fill_sector(near_c, k_c, a, b, triangle)

        self.triangles[triangle] = (a, b, apex)
        for u, v in ((a, b), (b, apex), (apex, a)):
            self._edges.setdefault((min(u, v), max(u, v)), []).append(triangle)
        del self.gates[gate]
        for edge in ((a, apex), (apex, b)):
            self._open_or_close(edge, triangle)
        return triangle

    @staticmethod
    def _fill_sector(fan: Fan, k: int, clockwise: int, counter_clockwise: int, triangle: int) -> None:
        """Place a triangle in sector k of a fan: its edges become spokes unless they bound the sector already."""
        fits_before = fan.spokes[k] == clockwise
        fits_after = fan.spokes[k + 1] == counter_clockwise
        if not fits_after:
            fan.spokes.insert(k + 1, counter_clockwise)
            fan.sectors.insert(k + 1, None)
        if not fits_before:
            fan.spokes.insert(k + 1, clockwise)
            fan.sectors.insert(k, None)
            k += 1
        fan.sectors[k] = triangle

    def _open_or_close(self, edge: tuple[int, int], triangle: int) -> None:
        """A new triangle's edge is a wall, closes the gate on its other side, or becomes a gate."""
        u, v = edge
        if self.gates.pop((v, u), None) is not None:
            return
        if self.fans[v].spokes[0] == u and self.fans[u].spokes[-1] == v:
            return
        self.gates[edge] = triangle

    def _check_wall(self, start: int, end: int) -> None:
        if self.fans[start].spokes[0] not in (None, end) or self.fans[end].spokes[-1] not in (None, start):
            raise MapConflict(f"a wall from vertex {start} to {end} contradicts walls walked before")

    def _wall(self, start: int, end: int) -> None:
        self._check_wall(start, end)
        self.fans[start].spokes[0] = end
        self.fans[end].spokes[-1] = start
