import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from coopslam.errors import BadInput
from coopslam.estimation.estimate import Trajectory
from coopslam.evaluation.trajectory_error import align_se2, interpolate_se2, trajectory_error, vertex_rmse
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
