"""Shortest paths against a visibility graph by brute force, and on cases with a closed form."""

from math import acos, dist, hypot, pi, sqrt

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from visibility_graph import OWN_WORLDS, SHARED_WORLDS, VisibilityGraph, length_m, load_polygon, points_inside

from coopslam.errors import BadInput
from coopslam.planning.shortest import ShortestPaths, Unreachable

LARGE = {"earcut_earcut", "earcut_issue35"}  # 548 and 790 corners: seconds for the brute force alone
WORLDS = [pytest.param(p, marks=[pytest.mark.slow] * (p.stem in LARGE), id=p.stem) for p in SHARED_WORLDS + OWN_WORLDS]
SQUARE = [(0, 0), (10, 0), (10, 10), (0, 10)]


def test_there_are_shared_worlds():
    if not SHARED_WORLDS:
        pytest.skip("the shared worlds are not beside the repository")
    assert len(SHARED_WORLDS) * 9 >= 200  # random pairs in the next test, the two large worlds among them


@pytest.mark.parametrize("path", WORLDS)
def test_as_short_as_brute_force(path):
    """Nine random pairs and eight of corners in each world; every path inside the polygon."""
    polygon = load_polygon(path)
    brute, paths, rng = VisibilityGraph(polygon), ShortestPaths(polygon), np.random.default_rng(len(path.stem))
    pairs = [
        *points_inside(polygon, 18, rng).reshape(9, 2, 2),
        *brute.corners[rng.integers(len(brute.corners), size=(8, 2))],
    ]
    for start, goal in pairs:
        path = paths.path(start, goal)
        assert path[0].tolist() == start.tolist() and path[-1].tolist() == goal.tolist()
        assert abs(length_m(path) - brute.length_m(start, goal)) < 1e-9
        assert len(path) == 1 or shapely.LineString(path).difference(polygon).length < 1e-9


CELLS = st.sets(st.tuples(st.integers(0, 5), st.integers(0, 4)), min_size=2, max_size=22)
HALVES = st.tuples(st.integers(0, 12), st.integers(0, 10))


@given(CELLS, st.lists(HALVES, min_size=2, max_size=6))
def test_on_squares_where_everything_touches(cells, halves):
    """Unions of unit squares: collinear corners, sights along walls, obstacles and rooms that meet in a corner."""
    free = shapely.union_all([shapely.box(x, y, x + 1, y + 1) for x, y in sorted(cells)])
    brute, paths = VisibilityGraph(free), ShortestPaths(free)
    points = [(x / 2, y / 2) for x, y in halves if free.covers(shapely.Point(x / 2, y / 2))]
    for start, goal in zip(points, points[1:], strict=False):
        expected = brute.length_m(start, goal)
        if expected == np.inf:
            with pytest.raises(Unreachable):
                paths.path(start, goal)
        else:
            assert abs(length_m(paths.path(start, goal)) - expected) < 1e-9


def test_around_an_obstacle_the_other_way_is_shorter():
    """A funnel inside one channel would not find it: both ways around a square, by hand."""
    paths = ShortestPaths(shapely.Polygon(SQUARE, [[(3, 3), (3, 7), (7, 7), (7, 3)]]))
    assert paths.path((1, 4.9), (9, 4.9)).tolist() == [[1, 4.9], [3, 3], [7, 3], [9, 4.9]]
    assert paths.path((1, 5.1), (9, 5.1)).tolist() == [[1, 5.1], [3, 7], [7, 7], [9, 5.1]]


def test_a_robot_goes_around_a_corner_in_an_arc():
    """Closed form: tangent, arc of the radius, tangent. The chords of the arc are shorter by less than 1 mm."""
    wall = shapely.Polygon([(0, 0), (10, 0), (10, 8), (0, 8)], [[(4.99, 1), (4.99, 4), (5, 4), (5, 1)]])
    radius, start, goal = 0.5, (1.0, 3.0), (9.0, 3.0)
    path = ShortestPaths(wall, radius).path(start, goal)
    corner_m = (dist(start, (4.99, 4)), dist(goal, (5, 4)))
    below = [acos((4.99 - 1) / corner_m[0]), acos((9 - 5) / corner_m[1])]  # of the ends, seen from the corners
    arcs = [pi / 2 + b - acos(radius / m) for b, m in zip(below, corner_m, strict=True)]
    exact = sum(sqrt(m * m - radius**2) for m in corner_m) + 0.01 + radius * sum(arcs)
    assert exact - 1e-3 < length_m(path) <= exact + 1e-6
    assert radius - 1e-3 < shapely.LineString(path).distance(wall.boundary) < radius + 1e-9


def test_a_robot_does_not_fit_through_a_narrow_door():
    rooms = shapely.Polygon(
        [(0, 0), (4, 0), (4, 1.7), (5, 1.7), (5, 0), (9, 0), (9, 4), (5, 4), (5, 2.3), (4, 2.3), (4, 4), (0, 4)]
    )
    assert len(ShortestPaths(rooms, 0.29).path((1, 1), (8, 1))) > 2
    with pytest.raises(Unreachable, match="0.31 m radius"):
        ShortestPaths(rooms, 0.31).path((1, 1), (8, 1))


def test_rooms_that_meet_in_a_corner_are_joined():
    """The corner belongs to free space; a robot with a size does not fit through."""
    rooms = shapely.MultiPolygon([shapely.box(0, 0, 2, 2), shapely.box(2, 2, 4, 4)])
    assert ShortestPaths(rooms).path((1, 0.5), (3, 3.5)).tolist() == [[1, 0.5], [2, 2], [3, 3.5]]
    assert length_m(ShortestPaths(rooms).path((0.5, 0.5), (3, 3))) == pytest.approx(hypot(2.5, 2.5), abs=1e-12)
    with pytest.raises(Unreachable):
        ShortestPaths(rooms, 0.1).path((1, 0.5), (3, 3.5))


@pytest.mark.parametrize(
    ("start", "goal", "said"),
    [
        ((-1.0, 1.0), (1.0, 1.0), r"^start: .*expected, \(-1.000, 1.000\) is 1.000 m outside$"),
        ((1.0, 1.0), (5.0, 5.0), r"^goal: .*outside$"),
        ((1.0, 1.0), (float("nan"), 5.0), r"^goal: two finite numbers"),
        ((float("inf"), 1.0), (1.0, 1.0), r"^start: two finite numbers"),
        ((0.1, 1.0), (1.0, 1.0), r"^start: a place at least 0.25 m from walls expected, .* is 0.100 m$"),
    ],
)
def test_ends_that_cannot_be(start, goal, said):
    paths = ShortestPaths(shapely.Polygon(SQUARE, [[(3, 3), (3, 7), (7, 7), (7, 3)]]), 0.25)
    with pytest.raises(BadInput, match=said):
        paths.path(start, goal)


def test_from_a_place_to_itself_and_nothing_mapped():
    assert ShortestPaths(shapely.box(0, 0, 1, 1)).path((0.5, 0.5), (0.5, 0.5)).tolist() == [[0.5, 0.5]]
    with pytest.raises(BadInput, match="nothing is mapped"):
        ShortestPaths(shapely.Polygon()).path((0, 0), (1, 1))


def test_corners_are_joined_once():
    """Preparing everything changes no path."""
    polygon = load_polygon(OWN_WORLDS[0])
    lazy, eager = ShortestPaths(polygon), ShortestPaths(polygon)
    assert eager.prepare() > 0
    for start, goal in points_inside(polygon, 20, np.random.default_rng(5)).reshape(10, 2, 2):
        assert lazy.path(start, goal).tolist() == eager.path(start, goal).tolist()
