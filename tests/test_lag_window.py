import gtsam
import numpy as np
import pytest

from coopslam.errors import UnderDetermined
from coopslam.estimation.keys import landmark_key, pose_key
from coopslam.estimation.lag_window import LagWindow
from coopslam.se2 import Pose2

R0, R1 = "robot0", "robot1"


def test_covariances_are_exact_where_cholesky_gives_up():
    """A chain that is stiff in itself and loosely held: variances add up."""
    window = LagWindow((R0,), ())
    keys, sigmas = [pose_key(0, k) for k in range(4)], [100.0, 1e-6, 1e-6, 1e-6]
    for k, (key, sigma) in enumerate(zip(keys, sigmas, strict=True)):
        noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
        still = Pose2()
        window.values.insert(key, still)
        window.add(gtsam.BetweenFactorPose2(keys[k - 1], key, still, noise) if k else _prior(key, noise))
    window.descend(rounds=3, step_threshold=1e-3)
    assert window._tree.marginalCovariance(keys[0])[0, 0] < 0.5 * sigmas[0] ** 2  # GTSAM's own
    variances = np.cumsum(np.square(sigmas))
    for key, variance in zip(keys, variances, strict=True):
        np.testing.assert_allclose(window.covariance(key), np.eye(3) * variance, rtol=1e-6, atol=1e-15 * variance)
    joint = window.joint_covariance([keys[3], keys[1]])
    expected = np.block([[np.eye(3) * variances[i] for i in row] for row in ((3, 1), (1, 1))])
    np.testing.assert_allclose(joint, expected, rtol=1e-6, atol=1e-9)


def _prior(key, noise):
    return gtsam.PriorFactorPose2(key, Pose2(), noise)


def test_an_open_direction_that_elimination_passes_over_is_found():
    """Poses that see one post in bearing and range can turn around it."""
    window, noise = LagWindow((R0, R1), ("post",)), gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    post, points = landmark_key(0), gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
    window.values.insert(post, np.array([3.0, 1.0]))
    window.add(gtsam.PriorFactorPoint2(post, np.array([3.0, 1.0]), points))
    poses = [Pose2(0.3 * k, 0.1 * k, 0.2 * k) for k in range(6)]
    for k, pose in enumerate(poses):
        key = pose_key(1, k)
        window.values.insert(key, pose)
        there = pose.transformTo(np.array([3.0, 1.0]))
        bearing = gtsam.Rot2(float(np.arctan2(there[1], there[0])))
        window.add(gtsam.BearingRangeFactor2D(key, post, bearing, float(np.hypot(*there)), points))
        if k:
            window.add(gtsam.BetweenFactorPose2(pose_key(1, k - 1), key, poses[k - 1].between(pose), noise))
    with pytest.raises(UnderDetermined, match="robot1"):
        window.require_tied_down()
    window.add(gtsam.PriorFactorPose2(pose_key(1, 0), Pose2(), noise))
    window.require_tied_down()
