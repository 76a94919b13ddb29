"""Ways through a map, cut into straight stretches in one triangle each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely

from coopslam.errors import BadInput
from coopslam.planning.map_graph import MapGraph

FARTHEST_APART_M = 0.2  # stations of a way
SAME_M = 1e-6


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
        x, y = path.difference(map_graph.grown).coords[0]
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
