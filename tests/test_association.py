"""Which ways of laying a map onto another there are: as many as the polygon has symmetries."""

import numpy as np
import pytest
from surveys import survey

from coopslam.planning.association import Association, AssociationSettings, TooMany
from coopslam.planning.corner_map import UNKNOWN
from coopslam.se2 import Pose2

T_SMALL_WORLD = Pose2(3.0, -2.0, 2.5)
L_SHAPE = [[0, 0], [6, 0], [6, 4], [4, 4], [4, 5], [0, 5]]


def regular(n):
    angles = 2 * np.pi * np.arange(n) / n
    return 5 * np.column_stack([np.cos(angles), np.sin(angles)])


@pytest.mark.parametrize(
    ("ring", "symmetries"),
    [(regular(4), 4), (regular(5), 5), (regular(12), 12), ([[0, 0], [6, 0], [6, 4], [0, 4]], 2), (L_SHAPE, 1)],
)
@pytest.mark.parametrize("corners", [None, [1, 2, 3]])
def test_there_are_as_many_fits_as_symmetries(ring, symmetries, corners):
    rng = np.random.default_rng(0)
    stored, small = survey(ring, rng, scale=0.2), survey(ring, rng, T_SMALL_WORLD, corners, scale=0.2)
    fits = Association(stored, small).fits()
    n, chosen = len(ring), corners or list(range(len(ring)))
    turns = {frozenset((i, (k + turn) % n) for i, k in enumerate(chosen)) for turn in range(0, n, n // symmetries)}
    assert {frozenset(one.pairs) for one in fits} == turns and len(fits) == symmetries


def test_corners_without_a_common_wall_are_paired_over_open_space():
    rng = np.random.default_rng(1)
    stored, small = survey(L_SHAPE, rng, scale=0.2), survey(L_SHAPE, rng, T_SMALL_WORLD, [0, 2, 4], scale=0.2)
    assert (small.leaving == UNKNOWN).all()
    assert [one.pairs for one in Association(stored, small).fits()] == [((0, 0), (1, 2), (2, 4))]


def test_walls_that_contradict_each_other_make_no_pairs():
    rng = np.random.default_rng(2)
    association = Association(survey(L_SHAPE, rng, scale=0.2), survey(L_SHAPE, rng, T_SMALL_WORLD, scale=0.2))
    assert association.walked({}, 0, 0) == {k: k for k in range(6)}
    assert association.walked({}, 0, 1) is None  # the reflex corner would come a wall too early
    assert association.walked({3: 4}, 0, 0) is None


def test_what_is_expected_by_accident():
    """In a regular polygon every corner leads on like every other: 3 x 12 pairs to begin with, and no step tells more.

    In the L from no other corner a step along its long wall leads to a like corner; 1 of 6 is the least it can say.
    """
    rng = np.random.default_rng(3)
    stored, small = survey(regular(12), rng, scale=0.2), survey(regular(12), rng, T_SMALL_WORLD, [1, 2, 3], scale=0.2)
    assert Association(stored, small).accidental([(0, 1), (1, 2), (2, 3)]) == pytest.approx(3 * 12)
    stored, small = survey(L_SHAPE, rng, scale=0.2), survey(L_SHAPE, rng, T_SMALL_WORLD, [0, 1, 2], scale=0.2)
    assert Association(stored, small).accidental([(0, 0), (1, 1)]) == pytest.approx(3 * 5 / 6)


def test_an_endless_search_is_given_up():
    rng = np.random.default_rng(4)
    stored, small = survey(regular(12), rng, scale=0.2), survey(regular(12), rng, T_SMALL_WORLD, [1, 2, 3], scale=0.2)
    with pytest.raises(TooMany):
        Association(stored, small, AssociationSettings(most_fits=11)).fits()
