"""What speaks against a fit: walls and corners where the other map is free. A room of 6 x 5 m, by hand."""

import numpy as np
import pytest
from surveys import survey

from coopslam.planning.corner_map import UNKNOWN, CornerMap
from coopslam.planning.free_agreement import FreeSpace, free_polygon
from coopslam.planning.map_fit import Fit
from coopslam.se2 import Pose2

ROOM = np.array([[0, 0], [6, 0], [6, 5], [0, 5]], float)


def small_map(places, walls=(), triangles=((0, 1, 2),)):
    """Exact corners; their headings do not matter here."""
    n = len(places)
    leaving, arriving = np.full((2, n), UNKNOWN)
    for start, end in walls:
        leaving[start], arriving[end] = end, start
    poses = np.column_stack([places, np.zeros(n)])
    no_gates, free = np.empty((0, 2), int), np.array(triangles)
    cov = np.zeros((n, 3, n, 3))
    return CornerMap(tuple(range(n)), poses, cov, np.full(n, 1.5), 0.01, leaving, arriving, free, no_gates, False)


def fit(*pairs):
    return Fit(pairs, Pose2(), np.zeros((3, 3)), 0.0, 1)


@pytest.fixture
def room():
    return FreeSpace(survey(ROOM, np.random.default_rng(0), scale=1e-6))


def test_the_same_room_agrees(room):
    same = small_map(ROOM, [(0, 1), (1, 2), (2, 3), (3, 0)], [(0, 1, 2), (0, 2, 3)])
    assert room.contradiction(same, fit((0, 0), (1, 1), (2, 2), (3, 3))) == ""


def test_a_corner_in_free_space(room):
    small = small_map([[0, 0], [6, 0], [3, 2]])
    assert "a corner would stand" in room.contradiction(small, fit((0, 0), (1, 1)))
    beside = small_map([[0, 0], [6, 0], [6, 4.9]])  # on the wall, within what is left open
    assert room.contradiction(beside, fit((0, 0), (1, 1))) == ""


def test_a_wall_of_the_stored_map_in_free_space(room):
    through = small_map([[0, 0], [6, 0], [9, 5]])
    assert "a wall of the stored map" in room.contradiction(through, fit((0, 0), (1, 1)))


def test_a_wall_through_the_free_space_of_the_stored_map(room):
    across = small_map([[0, 0], [6, 0], [6, 5]], [(2, 0)])
    assert "a wall would stand in the free space" in room.contradiction(across, fit((0, 0), (1, 1), (2, 2)))


def test_a_stored_corner_in_free_space():
    """Of walls that were not walked only the corners are known: here one stands in the middle of the small map."""
    stored = small_map([[0, 0], [6, 0], [0, 5], [1.5, 1]], triangles=((0, 1, 3),))
    small = small_map([[0, 0], [6, 0], [0, 5]])
    assert "corner of the stored map" in FreeSpace(stored).contradiction(small, fit((0, 0), (1, 1), (2, 2)))


def test_what_is_uncertain_contradicts_nothing(room):
    small = small_map([[0, 0], [6, 0], [3, 2]])
    small.covariance[2, :2, 2, :2] = 0.25 * np.eye(2)
    assert room.contradiction(small, fit((0, 0), (1, 1))) == ""


def test_inverted_triangles_are_area_too():
    places = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
    assert free_polygon(places, np.array([[0, 1, 2], [0, 3, 2]])).area == pytest.approx(4.0)
