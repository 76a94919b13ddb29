"""Where did the team wake up? Real explorations with typical noise; which corner is which, the simulator knows."""

from dataclasses import replace

import numpy as np
import pytest
from explorations import run
from scipy.stats import chi2
from surveys import same_pose, survey, triangulated
from wake_ups import stored_map, wake_up

from coopslam.errors import BadInput
from coopslam.exploration.mission import Budget
from coopslam.planning.place_recognition import PlaceRecognition, PlaceSettings, Verdict
from coopslam.se2 import Pose2, xytheta
from sim.world import load_world

T_SMALL_WORLD = Pose2(3.0, -2.0, 2.5)
L_SHAPE = np.array([[0, 0], [6, 0], [6, 4], [4, 4], [4, 5], [0, 5]], float)


def surveys(ring, seed, corners=(1, 2, 3), scale=0.2):
    rng = np.random.default_rng(seed)
    return survey(ring, rng, scale=scale), survey(ring, rng, T_SMALL_WORLD, list(corners), scale=scale)


@pytest.mark.parametrize("corner", [0, 3, 8, 11])
def test_a_known_world_is_recognized(corner):
    world, old = load_world("paper_one_obstacle"), run("paper_one_obstacle", "typical", seed=10)
    awake = wake_up(world, corner, 50 + corner, stored_map(old))
    answer = awake.answers[-1]
    assert answer.verdict is Verdict.RECOGNIZED and answer.alternatives == 0 and awake.is_right(old)
    true = old.team.truth.origin.between(awake.team.truth.pose_at("robot0", awake.team.time_s))
    error = xytheta(answer.belief.T_world_body.between(true))
    assert error @ np.linalg.solve(answer.belief.cov_body, error) < chi2.isf(1e-4, 3)


def test_a_symmetric_world_stays_ambiguous_to_the_end():
    world, old = load_world("symmetric_cross"), run("symmetric_cross", "typical", seed=11)
    awake = wake_up(world, 7, 60, stored_map(old))
    assert len(awake.answers) == world.triangles_expected + 1  # and once more when all walls are known
    assert {(answer.verdict, answer.alternatives) for answer in awake.answers} == {(Verdict.AMBIGUOUS, 3)}
    assert awake.answers[-1].belief is None
    true = old.team.truth.origin.between(awake.team.truth.pose_at("robot0", awake.team.time_s))
    assert any(same_pose(one.T_stored_small, true, 0.3, 0.1) for one in awake.answers[-1].places)


def test_another_world_is_none():
    stored = stored_map(run("paper_two_occluders", "typical", seed=12))
    awake = wake_up(load_world("paper_one_obstacle"), 0, 70, stored)
    assert {answer.verdict for answer in awake.answers} == {Verdict.NONE}


@pytest.mark.parametrize("corner", [pytest.param(2, marks=pytest.mark.slow), 25])
def test_in_a_map_that_ended_early(corner):
    """Outside of what is known nothing is recognized; when the team comes to it, the right corners are."""
    world, old = load_world("rooms_with_doors"), run("rooms_with_doors", "typical", seed=13, budget=Budget(moves=40))
    stored, known = stored_map(old), set(old.corner_of().values())
    assert not stored.is_complete
    awake = wake_up(world, corner, 80 + corner, stored)
    assert awake.answers[-1].verdict is Verdict.RECOGNIZED and awake.is_right(old)
    assert len(awake.answers[-1].pairs) >= 3
    for answer, small in zip(awake.answers, awake.maps, strict=True):
        overlap = sum(awake.corner_of[vertex] in known for vertex in small.ids)
        assert overlap >= 3 or answer.verdict is not Verdict.RECOGNIZED


def test_an_early_end_is_found_in_a_complete_small_map():
    """Five stored corners are too few to be beyond chance; once the whole world is explored, they are certain."""
    world, old = load_world("paper_one_obstacle"), run("paper_one_obstacle", "typical", seed=14, budget=Budget(moves=6))
    awake = wake_up(world, 6, 90, stored_map(old))
    assert awake.answers[-1].verdict is Verdict.RECOGNIZED and awake.is_right(old)
    assert len(old.free_map.fans) == 5 and awake.maps[-1].is_complete and not awake.maps[-2].is_complete
    assert {answer.verdict for answer in awake.answers[:-1]} == {Verdict.NOT_YET}


def test_without_a_triangle_there_is_no_answer():
    stored, small = surveys(L_SHAPE, 0)
    answer = PlaceRecognition(stored).recognize(replace(small, triangles=np.empty((0, 3), int)))
    assert answer.verdict is Verdict.NOT_YET and answer.belief is None


def test_sides_that_differ_by_less_than_noise_are_alike():
    """A rectangle has two places for three of its corners; when it is nearly a square, four."""
    for width, places in ((4.0, 4), (4.02, 4), (6.0, 2)):
        ring = np.array([[0, 0], [width, 0], [width, 4], [0, 4]], float)
        answer = PlaceRecognition(surveys(ring, 1)[0]).recognize(surveys(ring, 1)[1])
        assert (answer.verdict, len(answer.places)) == (Verdict.AMBIGUOUS, places)


def test_an_improbable_place_is_not_accepted():
    stored, small = surveys(L_SHAPE, 2)
    for shift in np.linspace(0.0, 0.3, 31):  # one corner moves away, until nothing fits any more
        moved = replace(small, poses=small.poses + shift * np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0]]))
        answer = PlaceRecognition(stored).recognize(moved)
        if answer.verdict is Verdict.NOT_YET:
            assert 1e-9 <= answer.places[0].probability < 1e-3
            break
        assert answer.verdict is Verdict.RECOGNIZED
    else:
        pytest.fail("a corner may be anywhere")
    assert (
        PlaceRecognition(stored).recognize(replace(small, poses=small.poses * [1.2, 1.2, 1.0])).verdict is Verdict.NONE
    )


def test_settings_are_checked():
    with pytest.raises(BadInput, match="acceptance"):
        PlaceSettings(acceptance=2.0)


@pytest.mark.slow
def test_no_false_recognition_in_500_random_polygons():
    """Star-shaped polygons, with a turned copy of themselves in a quarter of all draws: two-fold symmetric."""
    recognized = 0
    for seed in range(500):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(6, 14))
        angles = (np.arange(n) + rng.uniform(0.1, 0.9, n)) * (np.pi if seed % 4 == 0 else 2 * np.pi) / n
        ring = rng.uniform(2, 6, n)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        ring = np.vstack([ring, -ring]) if seed % 4 == 0 else ring
        triangles = triangulated(ring)[:2]  # somewhere, and not always neighbours
        corners = sorted(set(triangles.ravel().tolist()))
        stored = survey(ring, rng, scale=0.2)
        small = survey(ring, rng, T_SMALL_WORLD, corners, 0.2, triangles)
        answer = PlaceRecognition(stored).recognize(small)
        if answer.verdict is Verdict.RECOGNIZED:
            recognized += 1
            assert seed % 4 and all(j == corners[i] for i, j in answer.pairs)
    assert recognized > 300
