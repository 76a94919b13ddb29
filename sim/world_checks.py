"""What a world's rings must satisfy, each violation said in one line: file, ring, vertex, what was expected."""

from math import isfinite

import numpy as np
import shapely

from coopslam.errors import BadInput

CLEARANCE_M = 1e-6  # walls that come closer than this touch
SHORTEST_WALL_M = 1e-3
SMALLEST_EXTENT_M = 0.05
LARGEST_EXTENT_M = 1e5
FARTHEST_M = 1e8  # beyond, double precision no longer resolves CLEARANCE_M comfortably


def signed_area(corners: np.ndarray) -> float:
    """Area of an unclosed (n, 2) ring, positive when it runs counter-clockwise."""
    x, y = (corners - corners[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


def parse_rings(coordinates, where: str) -> list[np.ndarray]:
    """Unclosed (n_i, 2) rings of a GeoJSON polygon's coordinates, in the file's order and direction."""
    if not isinstance(coordinates, list) or not coordinates:
        raise BadInput(f"{where}: the polygon has no rings; a list of closed rings expected")
    return [_parse_ring(ring, positions, where) for ring, positions in enumerate(coordinates)]


def require_world_scale(rings: list[np.ndarray], units, where: str) -> None:
    """Refuse coordinates that are not metres of a place where robots could be."""
    if units is not None and units != "m":
        raise BadInput(f'{where}: properties.units is {units!r}; "m" (metres) expected')
    points = np.vstack(rings)
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    extent_m = max(high[0] - low[0], high[1] - low[1])
    size = f"the world is {extent_m:.6g} m across"
    if extent_m > LARGEST_EXTENT_M:
        raise BadInput(f"{where}: {size}; at most {LARGEST_EXTENT_M:g} m expected: are the coordinates metres?")
    if np.abs(points).max() > FARTHEST_M:
        raise BadInput(f"{where}: coordinates reach {np.abs(points).max():.6g} m; at most {FARTHEST_M:g} m expected")
    if extent_m < SMALLEST_EXTENT_M:
        is_lon_lat = max(abs(low[0]), abs(high[0])) <= 180 and max(abs(low[1]), abs(high[1])) <= 90
        if units is None and is_lon_lat:
            raise BadInput(f"{where}: coordinates look like degrees ({extent_m:.6g} across); metres expected")
        raise BadInput(f"{where}: {size}; at least {SMALLEST_EXTENT_M:g} m expected")


def require_simple_rings(rings: list[np.ndarray], where: str) -> None:
    """Refuse rings that do not bound one connected free space with unambiguous corners."""
    for ring, corners in enumerate(rings):
        _require_long_walls(ring, corners, where)
        _require_no_spikes(ring, corners, where)
    _require_clear_walls(rings, where)
    _require_holes_inside(rings, where)


def short(value) -> str:
    """A value as it is quoted in a message: in one line, of at most 60 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def _parse_ring(ring: int, positions, where: str) -> np.ndarray:
    if not isinstance(positions, list):
        raise BadInput(f"{where}: {_ring(ring)} is not a list of positions")
    points = [_parse_position(f"{where}: {_ring(ring)}, vertex {i}", p) for i, p in enumerate(positions)]
    if len(set(points)) < 3:
        raise BadInput(f"{where}: {_ring(ring)} has {len(set(points))} distinct points; at least 3 expected")
    if points[0] != points[-1]:
        first, last = _vertex(ring, 0, points[0]), f"vertex {len(points) - 1} {_point(points[-1])}"
        raise BadInput(
            f"{where}: ring is not closed: {first} and {last} differ; the first point repeated at the end expected"
        )
    return np.array(points[:-1])


def _parse_position(what: str, position) -> tuple[float, float]:
    if not isinstance(position, list) or len(position) != 2:
        dimensions = f"{len(position)} coordinates" if isinstance(position, list) else "no list of coordinates"
        raise BadInput(f"{what} has {dimensions}; two (x, y) in metres expected")
    return _parse_number(what, position[0]), _parse_number(what, position[1])


def _parse_number(what: str, value) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInput(f"{what} has a coordinate that is no number ({type(value).__name__}); metres expected")
    try:
        number = float(value)
    except OverflowError:
        number = float("inf")
    if not isfinite(number):
        raise BadInput(f"{what} has the coordinate {number:g}; finite metres expected")
    return number


def _require_long_walls(ring: int, corners: np.ndarray, where: str) -> None:
    lengths = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    i = int(np.argmin(lengths))
    if lengths[i] >= SHORTEST_WALL_M:
        return
    start, end = _vertex(ring, i, corners[i]), f"vertex {(i + 1) % len(corners)}"
    if lengths[i] == 0.0:
        raise BadInput(f"{where}: {start} and {end} are the same point; walls longer than zero expected")
    raise BadInput(
        f"{where}: the wall from {start} to {end} is {lengths[i]:.3g} m long, "
        "shorter than the smallest wall that the robots can follow (1 mm)"
    )


def _require_no_spikes(ring: int, corners: np.ndarray, where: str) -> None:
    """At a spike the far end of the shorter wall lies on the other wall."""
    before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
    arriving = shapely.linestrings(np.stack([before, corners], axis=1))
    leaving = shapely.linestrings(np.stack([corners, after], axis=1))
    gaps = np.minimum(
        shapely.distance(shapely.points(before), leaving), shapely.distance(shapely.points(after), arriving)
    )
    i = int(np.argmin(gaps))
    if gaps[i] < CLEARANCE_M:
        raise BadInput(f"{where}: the walls at {_vertex(ring, i, corners[i])} fold back on each other (a spike)")


def _require_clear_walls(rings: list[np.ndarray], where: str) -> None:
    """No two walls that are not neighbours may cross, touch or come closer than CLEARANCE_M."""
    ring_of = np.repeat(np.arange(len(rings)), [len(corners) for corners in rings])
    index_of = np.concatenate([np.arange(len(corners)) for corners in rings])
    following = np.arange(len(ring_of)) + np.concatenate([np.r_[np.ones(len(c) - 1, int), 1 - len(c)] for c in rings])
    walls = shapely.linestrings(np.concatenate([np.stack([r, np.roll(r, -1, axis=0)], axis=1) for r in rings]))
    first, second = shapely.STRtree(walls).query(walls, predicate="dwithin", distance=CLEARANCE_M)
    apart = (first < second) & (following[first] != second) & (following[second] != first)
    first, second = first[apart], second[apart]
    if not len(first):
        return
    crossing = shapely.crosses(walls[first], walls[second])
    k = int(np.argmax(crossing))
    at = shapely.get_coordinates(shapely.shortest_line(walls[first[k]], walls[second[k]]))[0]
    ring_a, ring_b = ring_of[first[k]], ring_of[second[k]]
    verb = "crosses" if crossing[k] else "touches"
    whom = "itself" if ring_a == ring_b else _ring(ring_b)
    edges = f"edge {_edge(index_of[first[k]], rings[ring_a])} and edge {_edge(index_of[second[k]], rings[ring_b])}"
    why = "" if crossing[k] else " (a corner would be ambiguous)"
    raise BadInput(f"{where}: {_ring(ring_a)} {verb} {whom} at {_point(at)}, {edges}; walls apart expected{why}")


def _require_holes_inside(rings: list[np.ndarray], where: str) -> None:
    """Given that no walls touch: one corner of each hole tells where the hole is."""
    if len(rings) == 1:
        return
    regions = shapely.polygons([shapely.linearrings(ring) for ring in rings])
    corners = shapely.points([ring[0] for ring in rings])
    holes = np.arange(1, len(rings))
    outside = holes[~shapely.contains(regions[0], corners[1:])]
    if len(outside):
        ring = int(outside[0])
        raise BadInput(
            f"{where}: {_vertex(ring, 0, rings[ring][0])} lies outside ring 0 (outer); holes inside it expected"
        )
    inner, outer = shapely.STRtree(regions[1:]).query(corners[1:], predicate="within")
    nested = inner != outer
    if nested.any():
        inner, outer = int(inner[nested][0]) + 1, int(outer[nested][0]) + 1
        raise BadInput(
            f"{where}: {_vertex(inner, 0, rings[inner][0])} lies inside ring {outer} (hole); no nested holes expected"
        )


def _ring(ring: int) -> str:
    return f"ring {ring} ({'hole' if ring else 'outer'})"


def _edge(i: int, corners: np.ndarray) -> str:
    return f"{i}-{(i + 1) % len(corners)}"


def _vertex(ring: int, i: int, point) -> str:
    return f"{_ring(ring)}, vertex {i} {_point(point)}"


def _point(point) -> str:
    return f"({point[0]:.6g}, {point[1]:.6g})"
