import numpy as np
import pytest
from leapfrog import ROBOTS, leapfrog

from coopslam.errors import BadInput
from coopslam.estimation.batch import Batch
from coopslam.estimation.estimate import Trajectory
from coopslam.evaluation.consistency import chi_square_band, pose_nees, position_nees, trajectory_nees
from coopslam.se2 import Pose2, rotation


def test_the_band_is_the_textbook_s():
    """Bar-Shalom, Li and Kirubarajan (2001), section 5.4: 50 runs of 2 states, 95 %: [74.2, 129.6] / 50."""
    assert chi_square_band(2, 50) == pytest.approx((1.484, 2.591), abs=1e-3)


@pytest.mark.parametrize(("belief", "honest"), [(1.0, True), (0.8, False), (1.25, False)])
def test_a_wrong_covariance_leaves_the_band_on_either_side(belief, honest):
    rng = np.random.default_rng(0)
    cov = np.array([[0.04, 0.01, 0.002], [0.01, 0.01, -0.003], [0.002, -0.003, 0.01]]) * 1e-2
    truth = [Pose2(*state) for state in rng.normal(size=(400, 3))]
    poses = [
        pose * Pose2(*error) for pose, error in zip(truth, rng.multivariate_normal(np.zeros(3), cov, 400), strict=True)
    ]
    low, high = chi_square_band(3, 400)
    assert (low < pose_nees(poses, np.tile(cov * belief, (400, 1, 1)), truth).mean() < high) == honest


def test_position_nees_is_the_mahalanobis_distance():
    cov = np.diag([4.0, 0.25])
    assert position_nees([[2.0, 0.0], [0.0, 1.0]], [cov, cov], [[0.0, 0.0], [0.0, 0.0]]) == pytest.approx([1.0, 4.0])


def test_truth_may_live_in_any_frame_and_the_anchored_pose_is_left_out():
    world = leapfrog(np.random.default_rng(11), legs=6)
    estimate = Batch(ROBOTS).update(world.records)
    estimated = {robot: estimate.trajectory(robot) for robot in ROBOTS}
    here = trajectory_nees(estimated, world.truth, "robot0")
    T = Pose2(30.0, -20.0, 2.0)
    moved = {robot: Trajectory(t.stamps_s, [T * pose for pose in t.poses]) for robot, t in world.truth.items()}
    there = trajectory_nees(estimated, moved, "robot0")
    for robot in ROBOTS:
        np.testing.assert_allclose(here[robot], there[robot], rtol=1e-6)
        assert len(here[robot]) == len(estimated[robot].poses) - (robot == "robot0")
    by_hand = pose_nees(estimated["robot1"].poses, estimated["robot1"].covariances, world.truth["robot1"].poses)
    np.testing.assert_allclose(here["robot1"], by_hand, rtol=1e-6)
    with pytest.raises(BadInput, match="no covariances"):
        trajectory_nees({"robot0": estimate.causal_trajectory("robot0")}, world.truth, "robot0")


def test_covariances_in_the_axes_of_the_world_would_be_noticed():
    cov_body = np.diag([0.01, 1.0, 0.01])
    pose, truth = Pose2(0.0, 0.0, np.pi / 2), Pose2(1.0, 0.0, np.pi / 2)  # 1 m off to its side
    assert pose_nees([pose], cov_body[None], [truth]) == pytest.approx([1.0])
    turn = np.eye(3)
    turn[:2, :2] = rotation(np.pi / 2)
    assert pose_nees([pose], (turn @ cov_body @ turn.T)[None], [truth])[0] == pytest.approx(100.0)
