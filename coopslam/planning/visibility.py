"""What can be seen from a point of free space, by triangular expansion.

The view starts in the triangle of the eye and goes on through every edge that it can see a part of, the cone narrowed
to that part (Bungiu, Hemmer, Hershberger, Huang, Kroeller: Efficient Computation of Visibility Polygons, 2014). Walls
belong to free space: sight may touch corners and run along walls.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from coopslam.planning.triangulated import Point, Triangulated, orientation


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Corners and parts of triangles seen from one point.

    Of three or more corners on one line of sight that touches obstacles on both sides, only the first that do are
    sure to be found: each of them sees the next, so paths along the line are none the longer.
    """

    eye: Point
    near: frozenset[int]  # triangles that hold the eye
    vertices: frozenset[int]
    cones: dict[int, list[tuple[Point, Point]]]  # triangle -> (right, left) limits of what is seen of it

    def holds(self, point: Point, at: Sequence[int]) -> bool:
        """Whether the eye sees a point. at: the triangles that hold it."""
        return any(
            t in self.near
            or any(
                orientation(self.eye, right, point) >= 0 and orientation(self.eye, left, point) <= 0
                for right, left in self.cones.get(t, ())
            )
            for t in at
        )


def view_from(mesh: Triangulated, eye: Point, at: Sequence[int]) -> View:
    """at: all triangles that hold the eye, their edges included."""
    points, triangles, neighbours = mesh.points, mesh.triangles, mesh.neighbours
    vertices = {vertex for t in at for vertex in triangles[t]}
    cones: dict[int, list[tuple[Point, Point]]] = {}
    ahead = []  # (triangle, the one before it, right and left limit of the cone that enters it)
    for t in at:
        for (a, b), beyond in zip(mesh.edges(t), neighbours[t], strict=True):
            if beyond is not None and orientation(eye, a, b) > 0:  # not an edge on which the eye lies
                ahead.append((beyond, t, a, b))
    while ahead:
        t, before, right, left = ahead.pop()
        cones.setdefault(t, []).append((right, left))
        entered = neighbours[t].index(before)
        apex = triangles[t][entered - 1]
        tip = points[apex]
        after_right, before_left = orientation(eye, right, tip), orientation(eye, left, tip)
        if after_right >= 0 and before_left <= 0:
            vertices.add(apex)
        beyond = neighbours[t][(entered + 1) % 3]  # the edge at the right of the apex
        if beyond is not None and after_right > 0:
            ahead.append((beyond, t, right, tip if before_left < 0 else left))
        beyond = neighbours[t][entered - 1]
        if beyond is not None and before_left < 0:
            ahead.append((beyond, t, tip if after_right > 0 else right, left))
    return View(eye, frozenset(at), frozenset(vertices), cones)
