"""Triangulations against shapely: area, neighbours, location of points; the exact predicate against fractions."""

from fractions import Fraction

import numpy as np
import pytest
import shapely
from visibility_graph import OWN_WORLDS, SHARED_WORLDS, load_polygon, points_inside

from coopslam.planning.triangulated import eroded, orientation, triangulated

WORLDS = OWN_WORLDS + SHARED_WORLDS
SQUARE = [(0, 0), (10, 0), (10, 10), (0, 10)]
TOUCHING = shapely.Polygon(SQUARE, [[(2, 2), (5, 5), (2, 5)], [(5, 5), (8, 5), (8, 8)]])  # obstacles meet in (5, 5)


def test_orientation_is_exact_next_to_a_line():
    """Where rounded arithmetic says nothing: points a few roundings away from the line through two others."""
    b, c = (12.0, 12.0), (24.0, 24.0)
    naive_wrong = 0
    for i in range(40):
        for j in range(40):
            a = (0.5 + i * 2.0**-53, 0.5 + j * 2.0**-53)
            (ax, ay), (bx, by), (cx, cy) = (tuple(map(Fraction, p)) for p in (a, b, c))
            exact = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            assert np.sign(orientation(a, b, c)) == (exact > 0) - (exact < 0)
            naive = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            naive_wrong += np.sign(naive) != (exact > 0) - (exact < 0)
    assert naive_wrong > 100  # the test reaches where it matters


@pytest.mark.parametrize("path", WORLDS, ids=lambda path: path.stem)
def test_triangles_fill_the_polygon_and_know_their_neighbours(path):
    polygon = load_polygon(path)
    mesh = triangulated(polygon)
    rings = [polygon.exterior, *polygon.interiors]
    n, h = sum(len(ring.coords) - 1 for ring in rings), len(rings) - 1
    assert len(mesh.triangles) == n + 2 * h - 2
    assert set(mesh.points) == {corner for ring in rings for corner in ring.coords}
    shapes = mesh.shapes(range(len(mesh.triangles)))
    assert all(shape.exterior.is_ccw for shape in shapes)
    assert shapely.area(shapes).sum() == pytest.approx(polygon.area, rel=1e-12)
    assert shapely.area(shapely.difference(shapes, polygon)).max() < 1e-9
    walls = {frozenset(edge) for ring in rings for edge in zip(ring.coords[:-1], ring.coords[1:], strict=True)}
    for t, beyond in enumerate(mesh.neighbours):
        for (a, b), other in zip(mesh.edges(t), beyond, strict=True):
            assert (other is None) == (frozenset((a, b)) in walls)
            if other is not None:
                assert (b, a) in mesh.edges(other) and t in mesh.neighbours[other]


def test_where_points_lie():
    polygon = load_polygon(OWN_WORLDS[0])
    mesh = triangulated(polygon)
    shapes = mesh.shapes(range(len(mesh.triangles)))
    for point in points_inside(polygon, 50, np.random.default_rng(1)).tolist():
        assert mesh.triangles_at(point) == np.flatnonzero(shapely.covers(shapes, shapely.Point(point))).tolist()
    for k, corner in enumerate(mesh.points):
        assert mesh.triangles_at(corner) == [t for t, vertices in enumerate(mesh.triangles) if k in vertices]
    low_x, low_y, _, _ = polygon.bounds
    assert mesh.triangles_at((low_x - 1.0, low_y)) == []


def test_a_point_on_a_slanted_wall_is_inside_in_spite_of_rounding():
    mesh = triangulated(shapely.Polygon([(0, 0), (3, 1), (1, 3)]))
    outside = 0
    for part in np.linspace(0.01, 0.99, 99):
        on_wall = (3 * part, 1 * part)
        outside += orientation((0, 0), (3, 1), on_wall) < 0
        assert mesh.triangles_at(on_wall) == [0]
    assert outside > 5
    assert mesh.triangles_at((1.5, 0.5 - 1e-6)) == []


def test_obstacles_that_meet_give_a_corner_two_fans():
    mesh = triangulated(TOUCHING)
    meeting = mesh.points.index((5.0, 5.0))
    assert {(mesh.points[f.next], mesh.points[f.previous]) for f in mesh.fans[meeting]} == {
        ((8.0, 8.0), (2.0, 5.0)),
        ((2.0, 2.0), (8.0, 5.0)),
    }
    assert [len(mesh.fans[v]) for v in range(len(mesh.points)) if v != meeting] == [1] * (len(mesh.points) - 1)
    turning = {point for v, point in enumerate(mesh.points) if mesh.turns(v)}
    assert turning == {(2.0, 2.0), (2.0, 5.0), (5.0, 5.0), (8.0, 5.0), (8.0, 8.0)}


def test_a_corner_on_another_wall_is_a_corner_of_both():
    """A hole whose corner lies inside an outer edge."""
    mesh = triangulated(shapely.Polygon(SQUARE, [[(5, 0), (7, 4), (3, 4)]]))
    assert sorted(len(fans) for fans in mesh.fans.values()) == [1] * 6 + [2]
    assert len(mesh.fans[mesh.points.index((5.0, 0.0))]) == 2


@pytest.mark.parametrize("robot_radius_m", [0.05, 0.1, 0.3, 1.0])
def test_eroded_space_keeps_the_radius_to_a_millimetre(robot_radius_m):
    """Against the distance to the walls, and against the area of shapely's erosion with hardly any chords."""
    for path in WORLDS:
        polygon = load_polygon(path)
        left = eroded(polygon, robot_radius_m)
        if not left.is_empty:
            assert robot_radius_m - 1e-3 < left.boundary.distance(polygon.boundary) < robot_radius_m + 1e-9
            fine = polygon.buffer(-robot_radius_m, quad_segs=100)
            assert -1e-9 <= left.area - fine.area < 1e-3 * polygon.length


def test_nothing_is_left_of_a_narrow_corridor():
    assert eroded(shapely.box(0, 0, 5, 0.3), 0.2).is_empty
    assert triangulated(eroded(shapely.box(0, 0, 5, 0.3), 0.2)).triangles == []
