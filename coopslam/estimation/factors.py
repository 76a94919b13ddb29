"""One measurement, one native GTSAM factor. Pure functions of keys and records.

`BetweenFactorPose2` takes its covariance in the axes of its second pose; observers measure in their own.
"""

import gtsam
import numpy as np

from coopslam.estimation.loss import SQUARES, Loss
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerSighting,
    LandmarkPrior,
    LoopClosure,
    PosePrior,
    RangeFix,
    RelativePoseFix,
    WallDecision,
)
from coopslam.se2 import Pose2, observer_to_target_axes

GAUGE_SIGMA = 1e-6  # m, m, rad: the first robot's first pose is the origin
FLOOR_SIGMA = 1e-6  # m or rad: no measurement tells any direction better than this


def gauge_prior(key: int):
    """Fixes the frame: the first pose of the first robot is the identity."""
    return gtsam.PriorFactorPose2(key, Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, GAUGE_SIGMA))


def odometry_leg(key_start: int, key_end: int, T_start_end: Pose2, cov_end: np.ndarray):
    """cov_end: (3, 3) in the axes of the end pose; m, m, rad."""
    return gtsam.BetweenFactorPose2(key_start, key_end, T_start_end, gaussian(cov_end))


def relative_pose(key_observer: int, key_target: int, fix: RelativePoseFix):
    """The tracker's range, bearing and heading of another robot."""
    cov_target = observer_to_target_axes(fix.T_observer_target, fix.cov_observer)
    return gtsam.BetweenFactorPose2(key_observer, key_target, fix.T_observer_target, gaussian(cov_target))


def corner(key_observer: int, key_vertex: int, sighting: CornerSighting):
    """A map vertex as the short-range finder sees it: an oriented corner."""
    cov_corner = observer_to_target_axes(sighting.T_observer_corner, sighting.cov_observer)
    return gtsam.BetweenFactorPose2(key_observer, key_vertex, sighting.T_observer_corner, gaussian(cov_corner))


def wall(key_start: int, key_end: int, decision: WallDecision):
    """The wall that leaves the start vertex leads to the end vertex: a bearing of zero."""
    noise = gtsam.noiseModel.Isotropic.Sigma(1, max(decision.straightness_sigma_rad, FLOOR_SIGMA))
    return gtsam.BearingFactorPose2(key_start, key_end, gtsam.Rot2(0.0), noise)


def loop_closure(key_earlier: int, key_now: int, closure: LoopClosure):
    """A pose in the frame of an earlier one."""
    return gtsam.BetweenFactorPose2(key_earlier, key_now, closure.T_earlier_now, gaussian(closure.cov_now))


def pose_prior(key: int, prior: PosePrior):
    """A surveyed pose."""
    return gtsam.PriorFactorPose2(key, prior.T_start_robot, gaussian(prior.cov_robot))


def landmark_prior(key: int, prior: LandmarkPrior):
    """A surveyed point."""
    return gtsam.PriorFactorPoint2(key, np.asarray(prior.xy, float), gaussian(prior.cov))


def bearing_range(
    key_observer: int, key_target: int, fix: BearingRangeFix, is_point: bool = False, loss: Loss = SQUARES
):
    """Singular at range zero. Noise order: bearing, range.  is_point: the target is a landmark, not a robot."""
    kind = gtsam.BearingRangeFactor2D if is_point else gtsam.BearingRangeFactorPose2
    noise = loss.applied(gaussian(fix.cov))
    return kind(key_observer, key_target, gtsam.Rot2(fix.bearing_rad), fix.range_m, noise)


def distance(key_observer: int, key_target: int, fix: RangeFix, is_point: bool = False, loss: Loss = SQUARES):
    """Singular at range zero."""
    kind = gtsam.RangeFactor2D if is_point else gtsam.RangeFactorPose2
    return kind(key_observer, key_target, fix.range_m, loss.applied(gtsam.noiseModel.Isotropic.Sigma(1, fix.sigma_m)))


def bearing(key_observer: int, key_target: int, fix: BearingFix, is_point: bool = False, loss: Loss = SQUARES):
    """Singular where observer and target coincide."""
    kind = gtsam.BearingFactor2D if is_point else gtsam.BearingFactorPose2
    noise = loss.applied(gtsam.noiseModel.Isotropic.Sigma(1, fix.sigma_rad))
    return kind(key_observer, key_target, gtsam.Rot2(fix.bearing_rad), noise)


def gaussian(cov: np.ndarray):
    """Noise model of an (n, n) covariance, no direction of which is better than `FLOOR_SIGMA`."""
    return gtsam.noiseModel.Gaussian.Covariance(floored(cov))


def floored(cov: np.ndarray) -> np.ndarray:
    """The covariance with its eigenvalues raised to `FLOOR_SIGMA` squared where they are smaller.

    A pure turn says that the robot stayed exactly where it was, which no solver can weigh.
    """
    variances, axes = np.linalg.eigh(cov)
    if variances[0] >= FLOOR_SIGMA**2:
        return cov
    return axes * np.maximum(variances, FLOOR_SIGMA**2) @ axes.T
