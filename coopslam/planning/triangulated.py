"""Free space cut into triangles: where a point lies, what is next to what, which corners a path can turn at.

A triangulation stands on the very corners of the polygon, so it adds no error of its own. Whether a point lies left
of a line is decided exactly: every coordinate is a fraction, and rounded arithmetic is used only where it cannot err
(Shewchuk, Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates, 1997).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import ceil, pi, sqrt

import numpy as np
import shapely

Point = tuple[float, float]

ROUNDING = 3.3306690738754716e-16  # Shewchuk's bound (3 + 16 e) e of the error of `orientation`, e = 2^-53
ON_A_WALL_M = 1e-9  # a point so little outside was put on a wall by rounding
ARC_ERROR_M = 1e-3  # by how much a chord of a rounded corner may come nearer to it than the robot's radius
GEOS_CHORD = 1.5  # a chord of its rounded corners turns by up to so many of the steps asked for


def orientation(a: Point, b: Point, c: Point) -> float:
    """More than zero when c lies left of a -> b, less when right, zero when on the line: the sign is exact."""
    left, right = (a[0] - c[0]) * (b[1] - c[1]), (a[1] - c[1]) * (b[0] - c[0])
    twice_area = left - right
    if abs(twice_area) > ROUNDING * (abs(left) + abs(right)):
        return twice_area
    (ax, ay), (bx, by), (cx, cy) = ((Fraction(x), Fraction(y)) for x, y in (a, b, c))
    exact = (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)
    return float((exact > 0) - (exact < 0))


@dataclass(frozen=True, slots=True)
class Fan:
    """The free angle at a corner: from the wall that leads to `next`, counter-clockwise, to the one from `previous`."""

    previous: int
    next: int


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """A conforming triangulation of n points and m triangles; triangles run counter-clockwise."""

    points: Sequence[Point]  # n; m
    triangles: Sequence[tuple[int, int, int]]  # m
    neighbours: Sequence[tuple[int | None, int | None, int | None]]  # m; across edges 01, 12, 20; None: a wall
    fans: Mapping[int, Sequence[Fan]]  # of each corner that has walls; obstacles that touch in it give it several
    boxes: np.ndarray  # (m, 4) least x, least y, greatest x, greatest y

    def triangles_at(self, point: Point) -> list[int]:
        """All triangles that hold a point, their edges included; without any, those not 1e-9 m away from it."""
        x, y = point
        close = (self.boxes[:, :2] <= np.add(point, ON_A_WALL_M)) & (self.boxes[:, 2:] >= np.add(point, -ON_A_WALL_M))
        candidates = np.flatnonzero(close.all(axis=1)).tolist()
        holding = [t for t in candidates if all(orientation(a, b, (x, y)) >= 0 for a, b in self.edges(t))]
        if holding or not candidates:
            return holding
        apart_m = shapely.distance(self.shapes(candidates), shapely.Point(point))
        return [t for t, distance in zip(candidates, apart_m, strict=True) if distance <= ON_A_WALL_M]

    def edges(self, triangle: int) -> list[tuple[Point, Point]]:
        """Its three edges, counter-clockwise."""
        a, b, c = (self.points[v] for v in self.triangles[triangle])
        return [(a, b), (b, c), (c, a)]

    def shapes(self, triangles: Sequence[int]) -> np.ndarray:
        """Polygons of some triangles."""
        return shapely.polygons(np.array(self.points)[np.array(self.triangles)[triangles]])

    def turns(self, vertex: int) -> bool:
        """Whether a shortest path can touch a corner: not when it is convex, unless obstacles meet in it."""
        fans = self.fans.get(vertex, ())
        if len(fans) != 1:
            return len(fans) > 1
        before, after = self.points[fans[0].previous], self.points[fans[0].next]
        return orientation(before, self.points[vertex], after) <= 0

    def tangent(self, origin: Point, vertex: int) -> bool:
        """Whether the line from a point to a corner leaves both of the corner's walls on one side (touching allowed).

        A shortest path touches corners in no other way: it could be cut short. Where obstacles meet, all is allowed.
        """
        fans, here = self.fans[vertex], self.points[vertex]
        if len(fans) > 1:
            return True
        before = orientation(origin, here, self.points[fans[0].previous])
        after = orientation(origin, here, self.points[fans[0].next])
        return (before >= 0 and after >= 0) or (before <= 0 and after <= 0)


def triangulated(free_space: shapely.Polygon | shapely.MultiPolygon) -> Triangulated:
    """Constrained Delaunay triangulation of a valid polygon or several, on their own corners."""
    cut = shapely.get_parts(shapely.constrained_delaunay_triangles(free_space))
    corners = shapely.get_coordinates(shapely.orient_polygons(cut)).reshape(-1, 4, 2)[:, :3]
    numbers: dict[Point, int] = {}
    triangles = [tuple(numbers.setdefault((x, y), len(numbers)) for x, y in triangle) for triangle in corners.tolist()]
    behind = {(a, b): t for t, (u, v, w) in enumerate(triangles) for a, b in ((u, v), (v, w), (w, u))}
    neighbours = [tuple(behind.get((b, a)) for a, b in ((u, v), (v, w), (w, u))) for u, v, w in triangles]
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    return Triangulated(list(numbers), triangles, neighbours, _fans(triangles, behind), boxes)


def eroded(free_space: shapely.Polygon | shapely.MultiPolygon, robot_radius_m: float):
    """Where the centre of a round robot may be; empty when it fits nowhere.

    Rounded corners are chords between points that keep the radius; a chord comes less than 1 mm nearer to the corner.
    """
    if robot_radius_m == 0:
        return free_space
    step = 2 * sqrt(2 * ARC_ERROR_M / robot_radius_m) / GEOS_CHORD  # a chord that turns by a has the sagitta r a^2 / 8
    return free_space.buffer(-robot_radius_m, quad_segs=max(ceil(pi / 2 / step), 4))


def _fans(triangles: Sequence[tuple[int, int, int]], behind: Mapping[tuple[int, int], int]) -> dict[int, list[Fan]]:
    """Around each corner counter-clockwise from every wall that leaves it to the wall that ends its free angle."""
    fans: dict[int, list[Fan]] = {}
    for a, b in behind:
        if (b, a) in behind:
            continue
        last = b
        while (a, last) in behind:
            triangle = triangles[behind[a, last]]
            last = triangle[triangle.index(a) - 1]
        fans.setdefault(a, []).append(Fan(previous=last, next=b))
    return fans
