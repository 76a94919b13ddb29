"""Ways through a map, cut into straight stretches in one triangle each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely

from coopslam.errors import BadInput
from coopslam.planning.map_graph import MapGraph
from coopslam.se2 import wrap

FARTHEST_APART_M = 0.2  # stations of a way
SAME_M = 1e-6
SAME_DIRECTION_RAD = 1e-6
AIM_M = 0.3  # who is so near the end of a leg keeps its direction, and is off it as before


@dataclass(frozen=True, slots=True)
class Stop:
    """A place on the way where something is sensed."""

    leg: int
    along: float  # 0 to 1 of the leg
    vertex: int


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """A way in straight stretches, each in one triangle; k stations."""

    points: np.ndarray  # (k, 2) m
    triangles: Sequence[int]  # k - 1, of the stretches
    home: int  # the triangle in which it starts
    stops: Mapping[int, Sequence[int]] = field(default_factory=dict)  # station -> vertices sensed there

    @property
    def last(self) -> int:
        """The station where it ends."""
        return len(self.points) - 1

    @property
    def driven_m(self) -> np.ndarray:
        """(k,) how far each station is from the start, along the way."""
        return np.append(0.0, np.cumsum(np.hypot(*np.diff(self.points, axis=0).T)))

    def triangle(self, station: int) -> int:
        """That in which a robot arrives at a station."""
        return self.triangles[station - 1] if station else self.home


def walk_along(map_graph: MapGraph, points: np.ndarray, stops: Sequence[Stop] = ()) -> Walk:
    """A way through (k, 2) points in stretches. Raises BadInput where it leaves the map."""
    path = shapely.LineString(points) if len(points) > 1 else shapely.Point(points[0])
    if not map_graph.grown.covers(path):
        outside = shapely.get_coordinates(path.difference(map_graph.grown)).tolist()  # of one part or of many
        x, y = outside[0] if len(points) == 1 else min(outside, key=lambda place: path.project(shapely.Point(place)))
        raise BadInput(f"the way leaves the map at ({x:.3f}, {y:.3f})")
    stations, triangles, sensed = [points[0]], [], {}
    for leg, (start, end) in enumerate(zip(points[:-1], points[1:], strict=True)):
        way = end - start
        length = float(np.hypot(*way))
        marks: dict[float, list[int]] = {0.0: [], 1.0: []}
        for stop in stops:
            if stop.leg == leg:
                marks.setdefault(stop.along, []).append(stop.vertex)
        for t in _crossings(map_graph, start, way):
            if all(abs(t - other) * length > SAME_M for other in marks):
                marks[t] = []
        sensed.setdefault(len(stations) - 1, []).extend(marks[0.0])
        cuts = sorted(marks)
        for a, b in zip(cuts[:-1], cuts[1:], strict=True):
            if (b - a) * length > SAME_M:
                parts = int(np.ceil((b - a) * length / FARTHEST_APART_M))
                stations += [start + (a + (b - a) * part / parts) * way for part in range(1, parts + 1)]
                triangles += [map_graph.nearest_triangle(*(start + (a + b) / 2 * way))] * parts
            sensed.setdefault(len(stations) - 1, []).extend(marks[b])
    home = triangles[0] if triangles else map_graph.nearest_triangle(*points[0])
    return Walk(np.array(stations), triangles, home, {station: found for station, found in sensed.items() if found})


def left_astray(walk: Walk) -> np.ndarray:
    """(k - 1,) which share of what a robot believes to be off its way is left after each stretch.

    It heads for the end of its leg from wherever it is, until that is AIM_M away.
    """
    ways = np.diff(walk.points, axis=0)
    lengths, headings = np.hypot(*ways.T), np.arctan2(ways[:, 1], ways[:, 0])
    shares, left_m = np.ones(len(ways)), 0.0
    for k in reversed(range(len(ways))):
        if k + 1 < len(ways) and abs(wrap(headings[k + 1] - headings[k])) > SAME_DIRECTION_RAD:
            left_m = 0.0  # a bend
        shares[k] = max(left_m, AIM_M) / max(left_m + lengths[k], AIM_M)
        left_m += lengths[k]
    return shares


def nearest_on_segment(start: np.ndarray, end: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where on a segment it is nearest to each of (n, 2) points, (n,) from 0 to 1, and (n,) how near, m."""
    way = end - start
    along = np.clip((points - start) @ way / max(way @ way, SAME_M**2), 0.0, 1.0)
    return along, np.hypot(*(start + along[:, None] * way - points).T)


def _crossings(map_graph: MapGraph, start: np.ndarray, way: np.ndarray) -> list[float]:
    """Where a leg crosses diagonals, strictly between 0 and 1 of it."""
    gates = np.array([edge["gate"] for *_, edge in map_graph.graph.edges(data=True)], int).reshape(-1, 2)
    if not len(gates):
        return []
    ends = np.array([[map_graph.vertices[v].xy for v in gate] for gate in gates.tolist()])
    side, off = ends[:, 1] - ends[:, 0], ends[:, 0] - start
    across = way[0] * side[:, 1] - way[1] * side[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (off[:, 0] * side[:, 1] - off[:, 1] * side[:, 0]) / across
        beside = (off[:, 0] * way[1] - off[:, 1] * way[0]) / across
    hit = (along > 0) & (along < 1) & (beside >= 0) & (beside <= 1)  # False where they are parallel: NaN
    return along[hit].tolist()
