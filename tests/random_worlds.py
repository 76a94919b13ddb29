"""Seeded random worlds of several kinds; all of them pass the checks of `sim.world`.

Coordinates of all kinds but stars are multiples of 1/8 m, so walls that look collinear are exactly collinear.
"""

import json
from collections.abc import Callable

import numpy as np
import shapely
from shapely import Polygon, box

from coopslam.errors import BadInput
from sim.world import World, world_from_geojson


def random_world(kind: str, seed: int, corners: tuple[int, int] = (10, 50)) -> World:
    """The first draw with an acceptable number of corners that is a world."""
    rng = np.random.default_rng([sorted(KINDS).index(kind), seed])
    for _ in range(1000):
        polygon = KINDS[kind](rng)
        if kind != "straight":  # which it would undo
            polygon = shapely.set_precision(polygon, 1 / 4 if kind != "stars" else 1e-4)
        if polygon.geom_type != "Polygon" or polygon.is_empty:
            continue
        n = sum(len(ring.coords) - 1 for ring in (polygon.exterior, *polygon.interiors))
        if not corners[0] <= n <= corners[1]:
            continue
        try:
            return world_from_geojson(json.loads(shapely.to_geojson(polygon)), f"{kind} {seed}", f"{kind}_{seed}")
        except BadInput:
            continue
    raise AssertionError(f"no world of kind {kind} with {corners} corners from seed {seed}")


def _grid(rng: np.random.Generator):
    """Rooms of 2 m: a union of grid cells, drawn in from the cells that are missing."""
    w, h = rng.integers(4, 8, 2)
    filled = [(i, j) for i in range(w) for j in range(h) if rng.random() < 0.75]
    return _largest(shapely.union_all([box(2 * i, 2 * j, 2 * i + 2, 2 * j + 2) for i, j in filled])).buffer(
        -0.25, join_style="mitre"
    )


def _maze(rng: np.random.Generator):
    """Corridors of 1 m on the edges of a random spanning tree, and a few more that make loops."""
    w, h = (int(k) for k in rng.integers(2, 5, 2))
    seen, stack, edges = {(0, 0)}, [(0, 0)], []
    while stack:
        x, y = stack[-1]
        around = [(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]
        free = [c for c in around if 0 <= c[0] < w and 0 <= c[1] < h and c not in seen]
        if not free:
            stack.pop()
            continue
        after = free[rng.integers(len(free))]
        seen.add(after)
        edges.append(((x, y), after))
        stack.append(after)
    for _ in range(2):
        x, y = int(rng.integers(w - 1)), int(rng.integers(h - 1))
        edges.append(((x, y), (x + 1, y) if rng.random() < 0.5 else (x, y + 1)))
    boxes = [
        box(2 * min(a[0], b[0]) - 0.5, 2 * min(a[1], b[1]) - 0.5, 2 * max(a[0], b[0]) + 0.5, 2 * max(a[1], b[1]) + 0.5)
        for a, b in edges
    ]
    return shapely.union_all(boxes)


def _stars(rng: np.random.Generator):
    """A star-shaped outline with a few small star-shaped holes."""
    angles = np.sort(rng.random(int(rng.integers(8, 35)))) * 2 * np.pi
    radii = 3 + 7 * rng.random(len(angles))
    polygon = _largest(Polygon(np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])).buffer(0))
    for _ in range(4):
        angles = np.sort(rng.random(int(rng.integers(3, 7)))) * 2 * np.pi
        around = rng.uniform(-6, 6, 2) + rng.uniform(0.3, 1.0) * np.column_stack([np.cos(angles), np.sin(angles)])
        hole = Polygon(around).buffer(0)
        if hole.area > 0.05 and polygon.buffer(-0.1).contains(hole):
            polygon = polygon.difference(hole)
    return polygon


def _halls(rng: np.random.Generator):
    """A rectangular hall with rectangular pillars, many of them aligned with each other or standing at a wall."""
    polygon = box(0, 0, 12, 9)
    for _ in range(int(rng.integers(3, 10))):
        x, y = rng.integers(0, 11), rng.integers(0, 8)
        w, h = rng.integers(1, 5, 2) * 0.5
        cut = polygon.difference(box(x, y, x + w, y + h))
        if cut.geom_type == "Polygon" and cut.is_valid:
            polygon = cut
    return polygon


def _largest(geometry):
    return max(shapely.get_parts(geometry), key=shapely.area)


def _straight(rng: np.random.Generator):
    """A hall in which every other wall has a corner of exactly 180 degrees in its middle."""
    hall = _halls(rng)

    def split(ring):
        corners = np.array(ring.coords)[:-1]
        extra = np.where(np.arange(len(corners)) % 2 == 0, 0.5, np.nan)[:, None]
        middles = corners + extra * (np.roll(corners, -1, axis=0) - corners)
        both = np.stack([corners, middles], axis=1).reshape(-1, 2)
        return both[~np.isnan(both[:, 0])]

    return Polygon(split(hall.exterior), [split(ring) for ring in hall.interiors])


KINDS: dict[str, Callable] = {"grid": _grid, "maze": _maze, "stars": _stars, "halls": _halls, "straight": _straight}
