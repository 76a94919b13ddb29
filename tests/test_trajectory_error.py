import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from coopslam.errors import BadInput
from coopslam.estimation.estimate import Trajectory
from coopslam.evaluation.trajectory_error import (
    align_se2,
    interpolate_se2,
    is_covered,
    team_errors,
    trajectory_error,
    vertex_rmse,
)
from coopslam.se2 import Pose2, wrap, xytheta


def random_trajectory(rng, n, start_s=0.0):
    states = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    return Trajectory(start_s + np.arange(n, dtype=float), [Pose2(*state) for state in states])


@given(st.integers(0, 10_000))
def test_the_alignment_is_that_of_scipy(seed):
    rng = np.random.default_rng(seed)
    estimated, truth = rng.normal(size=(2, 12, 2))
    truth = estimated @ [[0.0, 1.0], [-1.0, 0.0]] + [3.0, -2.0] + 0.3 * truth
    pad = lambda points: np.column_stack([points - points.mean(axis=0), np.zeros(len(points))])  # noqa: E731
    # the in-plane optimum of Kabsch's problem; z is pinned by a heavy pair of points on the axis
    axis = 1e6 * np.array([[0.0, 0.0, 1.0]])
    found, _ = Rotation.align_vectors(np.vstack([pad(truth), axis]), np.vstack([pad(estimated), axis]))
    T = align_se2(estimated, truth)
    assert abs(wrap(found.as_rotvec()[2] - T.theta())) < 1e-6
    np.testing.assert_allclose(T.transformFrom(estimated.mean(axis=0)), truth.mean(axis=0), atol=1e-12)


def test_interpolation_takes_the_shorter_arc():
    stamps, poses = np.array([0.0, 2.0, 3.0]), [Pose2(0, 0, 3.1), Pose2(2, 4, -3.1), Pose2(2, 5, -2.0)]
    middle, exact, last = interpolate_se2(stamps, poses, [1.0, 2.0, 3.0])
    assert abs(wrap(middle.theta() - np.pi)) < 1e-12
    np.testing.assert_allclose([middle.x(), middle.y()], [1.0, 2.0])
    assert exact.equals(poses[1], 1e-12) and last.equals(poses[2], 1e-12)
    with pytest.raises(BadInput, match="t = 3.500 s"):
        interpolate_se2(stamps, poses, [3.5])


@given(st.integers(0, 1000))
def test_headings_are_those_of_a_slerp(seed):
    rng = np.random.default_rng(seed)
    trajectory = random_trajectory(rng, 8)
    at = np.sort(rng.uniform(0.0, 7.0, 20))
    slerp = Slerp(trajectory.stamps_s, Rotation.from_euler("z", [[pose.theta()] for pose in trajectory.poses]))
    ours = [pose.theta() for pose in interpolate_se2(trajectory.stamps_s, trajectory.poses, at)]
    assert np.abs(wrap(np.array(ours) - slerp(at).as_euler("xyz")[:, 2])).max() < 1e-9


def test_one_alignment_serves_all_robots():
    rng = np.random.default_rng(1)
    truth = {"a": random_trajectory(rng, 30), "b": random_trajectory(rng, 20, start_s=3.0)}
    T = Pose2(4.0, -1.0, 2.5)
    moved = {name: Trajectory(t.stamps_s, [T * pose for pose in t.poses]) for name, t in truth.items()}
    error = trajectory_error(moved, truth)
    assert error.ate_rmse_m < 1e-9 and error.heading_rmse_rad < 1e-9 and (error.poses, error.left_out) == (50, 0)
    assert (error.T_truth_estimate * T).equals(Pose2(), 1e-9)
    moved["b"] = Trajectory(truth["b"].stamps_s, [Pose2(5.0, 5.0, 1.0) * pose for pose in truth["b"].poses])
    assert trajectory_error(moved, truth).ate_rmse_m > 0.5  # each robot alone would align


def test_a_known_error_has_a_known_rmse():
    """Four corners of a square pushed outwards by 0.1 m: nothing that an alignment can take back."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / np.sqrt(2.0)
    headings = [0.1, -0.1, 0.1, -0.1]
    truth = Trajectory(np.arange(4.0), [Pose2(*c, 0.0) for c in corners])
    estimated = Trajectory(np.arange(4.0), [Pose2(*(1.1 * c), h) for c, h in zip(corners, headings, strict=True)])
    error = trajectory_error({"a": estimated}, {"a": truth})
    assert error.ate_rmse_m == pytest.approx(0.1) and error.heading_rmse_rad == pytest.approx(0.1)
    assert vertex_rmse(1.1 * corners, corners) == pytest.approx(0.1)


def test_poses_beyond_the_truth_are_left_out_and_counted():
    truth = random_trajectory(np.random.default_rng(2), 10)
    longer = Trajectory(np.arange(12.0), [*truth.poses, Pose2(99, 99, 0), Pose2(99, 99, 0)])
    error = trajectory_error({"a": longer}, {"a": truth})
    assert (error.poses, error.left_out) == (10, 2) and error.ate_rmse_m < 1e-9
    with pytest.raises(BadInput, match="no truth for b"):
        trajectory_error({"b": longer}, {"a": truth})


def test_what_cannot_be_aligned_is_refused():
    with pytest.raises(BadInput, match="shape"):
        align_se2(np.zeros((3, 2)), np.zeros((4, 2)))
    assert xytheta(align_se2(np.ones((1, 2)), np.zeros((1, 2)))).tolist() == [-1.0, -1.0, 0.0]


class CountingPoses(list):
    """Poses that count how many of them are looked at."""

    looked_at = 0

    def __getitem__(self, index):
        self.looked_at += 1
        return super().__getitem__(index)

    def __iter__(self):
        raise AssertionError("all poses are looked at")


def test_of_a_long_truth_only_the_neighbours_are_looked_at():
    rng = np.random.default_rng(3)
    truth = random_trajectory(rng, 5000)
    at_s = np.sort(rng.uniform(0.0, 4999.0, 40))
    counting = CountingPoses(truth.poses)
    found = interpolate_se2(truth.stamps_s, counting, at_s)
    assert counting.looked_at <= 80
    x = np.interp(at_s, truth.stamps_s, [pose.x() for pose in truth.poses])
    np.testing.assert_allclose([pose.x() for pose in found], x, atol=1e-9)


def test_errors_of_each_robot_after_the_one_alignment():
    """Two robots on a square, one pushed outwards by 0.1 m, the other inwards by 0.3 m: nothing to align."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / np.sqrt(2.0)
    T = Pose2(3.0, 5.0, 1.0)
    truth = {name: Trajectory(np.arange(4.0), [T * Pose2(*c, 0.0) for c in corners]) for name in "abc"}
    pushed = {"a": (1.1, 0.2), "b": (0.7, -0.2)}
    estimated = {
        name: Trajectory(np.arange(4.0) + 0.0, [Pose2(*(scale * c), h) for c in corners])
        for name, (scale, h) in pushed.items()
    }
    team = team_errors(estimated, truth)
    assert team.T_truth_estimate.equals(T, 1e-9) and set(team.robots) == {"a", "b"} and team.without_truth == ()
    np.testing.assert_allclose(team.robots["a"].position_errors_m, 0.1)
    np.testing.assert_allclose(team.robots["b"].position_errors_m, 0.3)
    np.testing.assert_allclose(team.robots["b"].heading_errors_rad, -0.2)
    assert team.robots["a"].stamps_s.tolist() == [0.0, 1.0, 2.0, 3.0]
    joined = trajectory_error(estimated, truth)
    assert joined.ate_rmse_m == pytest.approx(np.sqrt((0.1**2 + 0.3**2) / 2))
    assert (joined.ate_median_m, joined.ate_max_m) == pytest.approx((0.2, 0.3))
    assert (joined.heading_median_rad, joined.heading_max_rad) == pytest.approx((0.2, 0.2))


def test_robots_without_truth_are_named_and_take_no_part():
    rng = np.random.default_rng(5)
    truth = {name: random_trajectory(rng, 10) for name in "abc"}
    later = Trajectory(truth["c"].stamps_s + 100.0, truth["c"].poses)
    estimated = {"a": truth["a"], "b": random_trajectory(rng, 10), "c": later}
    del truth["b"]
    team = team_errors(estimated, truth)
    assert set(team.robots) == {"a"} and team.without_truth == ("b", "c") and team.left_out == {"a": 0, "c": 10}
    assert team.joined.ate_rmse_m < 1e-9
    with pytest.raises(BadInput, match="none of the estimated poses"):
        team_errors({"c": later}, truth)


def test_gaps_in_the_truth_may_be_left_out():
    stamps = np.array([0.0, 1.0, 5.0, 6.0])
    at = [0.0, 0.5, 1.0, 1.5, 4.9, 5.0, 5.0 + 5e-7, 6.0, 6.5]
    everything = [True] * 8 + [False]
    assert is_covered(at, stamps).tolist() == everything
    assert is_covered(at, stamps, gap_max_s=2.0).tolist() == [True, True, True, False, False, True, True, True, False]
    assert is_covered(at, stamps, gap_max_s=4.0).tolist() == everything
    truth = Trajectory(stamps, [Pose2(s, 0, 0) for s in stamps])
    curved = Trajectory(np.arange(7.0), [Pose2(s, 9.0 * (1 < s < 5), 0) for s in range(7)])
    team = team_errors({"a": curved}, {"a": truth}, gap_max_s=2.0)
    assert team.left_out == {"a": 3} and team.joined.ate_max_m < 1e-9
