import time

import numpy as np
import pytest
import shapely
from shapely import Polygon

from coopslam.errors import BadInput
from coopslam.evaluation.triangulation import judge

SQUARE = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
WORLD = Polygon(
    [(0, 0), (6, 0), (6, 5), (3, 4), (0, 5)], [[(2, 1), (2, 2), (3, 2), (3, 1)], [(4, 2), (4, 3), (5, 2.5)]]
)


def vertices_of(polygon):
    return np.vstack([np.array(ring.coords)[:-1] for ring in (polygon.exterior, *polygon.interiors)])


def delaunay(polygon):
    """Counter-clockwise index triples from shapely's own triangulation."""
    points = vertices_of(polygon)
    index = {tuple(point): i for i, point in enumerate(points)}
    found = shapely.constrained_delaunay_triangles(polygon).geoms
    return points, [tuple(index[c] for c in shapely.orient_polygons(t).exterior.coords[:3]) for t in found]


def test_a_true_triangulation_is_complete_and_free():
    points, triangles = delaunay(WORLD)
    assert len(triangles) == len(points) + 2 * 2 - 2
    covered, overlap, all_free = judge(triangles, points, WORLD)
    assert covered == pytest.approx(1.0, abs=1e-12) and overlap == pytest.approx(0.0, abs=1e-12) and all_free


def test_a_missing_triangle_and_a_double_one_are_measured():
    points, triangles = delaunay(WORLD)
    area = Polygon(points[list(triangles[0])]).area / WORLD.area
    assert judge(triangles[1:], points, WORLD) == (pytest.approx(1 - area), pytest.approx(0, abs=1e-12), True)
    assert judge([*triangles, triangles[0]], points, WORLD) == (pytest.approx(1), pytest.approx(area), True)


def test_a_partial_overlap_counts_once():
    square = Polygon(SQUARE)
    covered, overlap, all_free = judge([(0, 1, 2), (0, 1, 3)], SQUARE, square)
    assert (covered, overlap, all_free) == (pytest.approx(0.75), pytest.approx(0.25), True)


def test_what_leaves_free_space_is_covered_only_inside_it():
    corner = np.array([[0, 0], [4, 0], [1, 1], [0, 4]], float)  # reflex at 2
    covered, overlap, all_free = judge([(0, 1, 3)], corner, Polygon(corner))
    assert covered == pytest.approx(1.0) and overlap == pytest.approx(0.0) and not all_free


def test_orientation_and_triangles_of_no_area():
    square = Polygon(SQUARE)
    assert not judge([(0, 2, 1)], SQUARE, square)[2]
    points = np.vstack([SQUARE, [1.0, 0.0]])
    flat = Polygon(points[[0, 4, 1, 2, 3]])
    assert judge([(0, 4, 1), (0, 1, 2), (0, 2, 3)], points, flat) == (pytest.approx(1.0), pytest.approx(0.0), True)
    assert judge([(0, 4, 1)], points, flat) == (0.0, 0.0, True)
    assert judge([], points, flat) == (0.0, 0.0, True)
    with pytest.raises(BadInput, match="the world has 4"):
        judge([(0, 1, 4)], SQUARE, square)


def test_a_large_world_is_judged_quickly():
    angles = np.linspace(0, 2 * np.pi, 1400, endpoint=False)
    radii = 10.0 + np.random.default_rng(0).uniform(-2.0, 2.0, 1400)
    points, triangles = delaunay(Polygon(np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])))
    began = time.perf_counter()
    covered, overlap, all_free = judge(triangles, points, Polygon(points))
    assert len(triangles) == 1398 and all_free
    assert covered == pytest.approx(1.0, abs=1e-9) and overlap == pytest.approx(0.0, abs=1e-9)
    assert time.perf_counter() - began < 2.0
