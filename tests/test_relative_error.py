import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from leapfrog import ROBOTS, leapfrog

from coopslam.errors import BadInput
from coopslam.estimation.batch import Batch
from coopslam.estimation.estimate import Trajectory
from coopslam.evaluation.relative_error import joined, path_errors, path_pairs, robot_pair_errors
from coopslam.se2 import Pose2, rotation, wrap


def straight(n, step_m=0.5, scale=1.0, turn_rad_per_m=0.0):
    """Along the x axis; the path of the estimate is longer by a scale, and its heading drifts."""
    x = step_m * np.arange(n)
    return Trajectory(np.arange(n, dtype=float), [Pose2(scale * s, 0.0, turn_rad_per_m * s) for s in x])


def matrix(pose):
    result = np.eye(3)
    result[:2, :2], result[:2, 2] = rotation(pose.theta()), [pose.x(), pose.y()]
    return result


def error_of(estimated_i, estimated_j, true_i, true_j):
    """(distance, angle) of T_i_j(true)^-1 T_i_j(estimated), with matrices."""
    T = np.linalg.inv(np.linalg.inv(matrix(true_i)) @ matrix(true_j))
    E = T @ np.linalg.inv(matrix(estimated_i)) @ matrix(estimated_j)
    return np.hypot(*E[:2, 2]), np.arctan2(E[1, 0], E[0, 0])


def test_a_known_drift_has_a_known_error():
    """2 % too long: 2 cm after 1 m and 20 cm after 10 m, whatever the stretch."""
    errors = path_errors({"a": straight(41, scale=1.02)}, {"a": straight(41)}, tolerance=0.01)["a"]
    assert list(errors) == [1.0, 5.0, 10.0] and [e.count for e in errors.values()] == [39, 31, 21]
    assert [e.translation_rmse_m for e in errors.values()] == pytest.approx([0.02, 0.1, 0.2])
    assert [e.rotation_rmse_rad for e in errors.values()] == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    turning = path_errors({"a": straight(41, turn_rad_per_m=0.01)}, {"a": straight(41)}, tolerance=0.01)["a"]
    assert [e.rotation_rmse_rad for e in turning.values()] == pytest.approx([0.01, 0.05, 0.1])


def test_a_drift_that_passes_pi_does_not_jump():
    estimated, truth = straight(5), straight(5)
    truth = Trajectory(truth.stamps_s, [pose * Pose2(0, 0, 3.1) for pose in truth.poses])
    estimated = Trajectory(
        estimated.stamps_s, [T * Pose2(0, 0, 0.1 * (i % 2)) for i, T in enumerate(truth.poses)]
    )  # headings 3.1 and -3.08
    errors = path_errors({"a": estimated}, {"a": truth}, [0.5])["a"][0.5]
    assert np.abs(errors.rotation_errors_rad) == pytest.approx(np.full(4, 0.1))


def nearest_by_search(positions, distance_m, tolerance_m):
    path_m = [0.0]
    for a, b in zip(positions, positions[1:], strict=False):
        path_m.append(path_m[-1] + float(np.linalg.norm(b - a)))
    pairs = []
    for i in range(len(positions) - 1):
        misses = [abs(path_m[j] - path_m[i] - distance_m) for j in range(i + 1, len(positions))]
        if min(misses) <= tolerance_m:
            pairs.append((i, i + 1 + misses.index(min(misses))))
    return pairs


@given(st.integers(0, 10_000), st.sampled_from([0.3, 1.0, 4.0]))
def test_pairs_are_the_nearest_along_the_path(seed, distance_m):
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(25, 2)) * 0.4 * (rng.random((25, 1)) < 0.7)  # a robot that stands still now and then
    positions = np.cumsum(steps, axis=0)
    found = path_pairs(positions, distance_m, 0.3 * distance_m)
    assert [tuple(pair) for pair in found.tolist()] == nearest_by_search(positions, distance_m, 0.3 * distance_m)


def test_a_robot_that_never_moves_has_no_pairs():
    still = Trajectory(np.arange(5.0), [Pose2(1, 2, 0.3)] * 5)
    assert path_errors({"a": still}, {"a": still}) == {"a": {}}
    assert path_pairs(np.zeros((1, 2)), 1.0, 0.1).shape == (0, 2) == path_pairs(np.zeros((0, 2)), 1.0, 0.1).shape
    with pytest.raises(BadInput, match=r"distances_m\[1\]"):
        path_errors({"a": still}, {"a": still}, [1.0, 0.0])


def test_robots_without_truth_are_not_in_the_result():
    both = {"a": straight(9), "b": straight(9), "c": straight(9)}
    truth = {robot: both[robot] for robot in ("a", "c")}
    assert set(path_errors(both, truth)) == {"a", "c"} and set(robot_pair_errors(both, truth)) == {("a", "c")}
    assert robot_pair_errors(both, {"a": straight(9)}) == {}


def test_relative_poses_of_robots_are_free_of_the_frame_and_blind_to_a_common_error():
    rng = np.random.default_rng(4)
    truth = {r: Trajectory(np.arange(20.0), [Pose2(*s) for s in rng.normal(size=(20, 3))]) for r in "ab"}
    wrong = [Pose2(*s) for s in rng.normal(size=(20, 3))]  # another one at each instant, for both robots
    moved = {r: Trajectory(t.stamps_s, [T * p for T, p in zip(wrong, t.poses, strict=True)]) for r, t in truth.items()}
    errors = robot_pair_errors(moved, truth)["a", "b"]
    assert errors.count == 20 and errors.translation_rmse_m < 1e-9 and errors.rotation_rmse_rad < 1e-9


def test_relative_poses_of_an_estimate_are_those_of_matrices():
    world = leapfrog(np.random.default_rng(3), legs=8)
    estimate = Batch(ROBOTS).update(world.records)
    estimated = {robot: estimate.trajectory(robot) for robot in ROBOTS}
    found = robot_pair_errors(estimated, world.truth, gap_max_s=np.inf)["robot0", "robot1"]

    def at(track, t):
        """Both coordinates linear, the heading along the shorter arc."""
        k = max(np.searchsorted(track.stamps_s, t, side="right") - 1, 0)
        if k + 1 == len(track.stamps_s):
            return track.poses[k]
        a, b = track.poses[k], track.poses[k + 1]
        part = (t - track.stamps_s[k]) / (track.stamps_s[k + 1] - track.stamps_s[k])
        turn = float(wrap(b.theta() - a.theta()))
        return Pose2(a.x() + part * (b.x() - a.x()), a.y() + part * (b.y() - a.y()), a.theta() + part * turn)

    expected = [
        error_of(*(at(tracks[robot], t) for tracks in (estimated, world.truth) for robot in ROBOTS))
        for t in found.stamps_s
    ]
    assert found.count == 10
    np.testing.assert_allclose(found.translation_errors_m, [d for d, _ in expected], atol=1e-9)
    np.testing.assert_allclose(wrap(found.rotation_errors_rad - [a for _, a in expected]), 0.0, atol=1e-9)


def test_long_gaps_are_not_bridged_but_their_ends_count():
    a = straight(11)
    b = Trajectory(np.array([0.0, 1.0, 8.0, 9.0]), [Pose2(0, 1, 0)] * 4)
    errors = robot_pair_errors({"a": a, "b": b}, {"a": a, "b": b})["a", "b"]
    assert errors.stamps_s.tolist() == [0.0, 1.0, 8.0, 9.0] and errors.translation_rmse_m < 1e-12


def test_errors_of_several_are_joined():
    one = path_errors({"a": straight(11, scale=1.1)}, {"a": straight(11)}, [1.0])["a"][1.0]
    other = path_errors({"a": straight(31, scale=1.3)}, {"a": straight(31)}, [1.0])["a"][1.0]
    both = joined([one, other])
    assert both.translation_rmse_m == pytest.approx(np.sqrt((9 * 0.1**2 + 29 * 0.3**2) / 38))
    assert joined([]) is None
