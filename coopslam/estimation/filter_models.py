"""Native factors as a filter sees them: by how much they miss, how that depends on the state, and where to begin.

Jacobians are taken with respect to differences in the axes of the frame (`filter_state`): (x, y, heading) of poses,
(x, y) of points. The sign of an innovation is measured - predicted, its coordinates those of the factor's noise: the
axes of the measured second pose of a `BetweenFactorPose2`, bearing before range.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, remainder, sin, tau

import gtsam
import numpy as np

from coopslam.estimation.alignment import AlignmentSettings
from coopslam.se2 import Pose2, chain_covariance, rotation

COINCIDE_M = 1e-9  # bearing and range have no derivative where observer and target are closer than this
_GUESSED_RANGE_SHARE = 0.3  # sigma of a range that only crossing bearings tell; the timeline takes them below 0.2

Means = Sequence[np.ndarray]  # of the factor's variables, in the order of its keys


@dataclass(frozen=True, slots=True, eq=False)
class Linearized:
    """A measurement at the current state."""

    miss: np.ndarray  # (m,) measured - predicted
    jacobians: tuple[np.ndarray, ...]  # (m, d) each: of the prediction, by the variables in the order of the keys


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Where something new is in the axes of the pose that saw it: a pose, or a point (2,)."""

    relative: Pose2 | np.ndarray
    cov: np.ndarray  # (3, 3) axes of the new pose; (2, 2) axes of the observer

    def carried(self, T_base_observer: Pose2, cov_observer: np.ndarray) -> "Sighting":
        """The same as seen from another pose. cov_observer: (3, 3) of the way there, in the axes of the observer."""
        if isinstance(self.relative, Pose2):
            return Sighting(T_base_observer * self.relative, chain_covariance(self.relative, cov_observer, self.cov))
        x, y = self.relative
        carry = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
        turn = rotation(T_base_observer.theta())
        cov = turn @ (carry @ cov_observer @ carry.T + self.cov) @ turn.T
        return Sighting(T_base_observer.transformFrom(self.relative), cov)


def linearized(factor: gtsam.NoiseModelFactor, means: Means) -> Linearized | None:
    """The factor at these means; None where it is singular.  Raises KeyError for a factor that no record makes."""
    return _MODELS[type(factor)](factor, means)


def noise_covariance(factor: gtsam.NoiseModelFactor) -> np.ndarray:
    """(m, m); of a robust noise model that of the normal distribution beneath the loss."""
    noise = factor.noiseModel()
    return (noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise).covariance()


def sighting(
    factor: gtsam.NoiseModelFactor, observer: Pose2, guess: np.ndarray | None, settings: AlignmentSettings
) -> Sighting | None:
    """What a factor between a pose and something new says about the new; None when it does not say where it is.

    guess: (2,) of a landmark, from which comes what a bearing or a range alone leaves open: a guess that many of them
    made together, used once, with a generous sigma.
    """
    cov, kind = noise_covariance(factor), type(factor)
    if kind is gtsam.BetweenFactorPose2:
        return Sighting(factor.measured(), cov)
    if guess is None:
        return None
    if kind is gtsam.BearingRangeFactor2D:
        measured = factor.measured()
        return _from_polar(measured.bearing().theta(), measured.range(), cov)
    towards = observer.transformTo(guess)
    if kind is gtsam.BearingFactor2D:
        distance = hypot(*towards)
        return _from_polar(factor.measured().theta(), distance, _diagonal(cov[0, 0], _GUESSED_RANGE_SHARE * distance))
    if kind is gtsam.RangeFactor2D:
        distance = max(factor.measured(), COINCIDE_M)
        across = settings.gate_sigmas * hypot(cov[0, 0] ** 0.5, settings.drift_sigma_m) / distance
        return _from_polar(atan2(towards[1], towards[0]), distance, np.diag([across**2, cov[0, 0]]))
    return None


def prior_mean(factor: gtsam.NoiseModelFactor) -> np.ndarray:
    """(3,) or (2,) what a prior says."""
    prior = factor.prior()
    return np.array([prior.x(), prior.y(), prior.theta()]) if isinstance(prior, Pose2) else np.asarray(prior)


def is_prior(factor: gtsam.NoiseModelFactor) -> bool:
    """Whether it measures one variable in the frame itself."""
    return type(factor) in (gtsam.PriorFactorPose2, gtsam.PriorFactorPoint2)


# ---- one function for each kind of factor ----


def _between(factor: gtsam.BetweenFactorPose2, means: Means) -> Linearized:
    """Right perturbation of the measured relative pose, in the axes of its second pose."""
    (xa, ya, ta), (xb, yb, tb) = means[0].tolist(), means[1].tolist()
    measured = factor.measured()
    zx, zy, zt = measured.x(), measured.y(), measured.theta()
    dx, dy = xb - xa, yb - ya
    c, s = cos(ta), sin(ta)
    ahead, left = zx - (c * dx + s * dy), zy - (c * dy - s * dx)
    cz, sz = cos(zt), sin(zt)
    miss = np.array([cz * ahead + sz * left, cz * left - sz * ahead, remainder(zt - (tb - ta), tau)])
    c, s = cos(ta + zt), sin(ta + zt)
    by_heading = c * dy - s * dx, -(c * dx + s * dy)
    by_a = np.array([[-c, -s, by_heading[0]], [s, -c, by_heading[1]], [0.0, 0.0, -1.0]])
    by_b = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return Linearized(miss, (by_a, by_b))


def _bearing_range(factor, means: Means) -> Linearized | None:
    line = _line_of_sight(means)
    if line is None:
        return None
    bearing, distance, (across, along) = line
    measured = factor.measured()
    miss = np.array([_turn_between(bearing, measured.bearing().theta()), measured.range() - distance])
    by_a = np.array([[-across[0], -across[1], -1.0], [-along[0], -along[1], 0.0]])
    return Linearized(miss, (by_a, _by_target([across, along], means[1])))


def _bearing(factor, means: Means) -> Linearized | None:
    line = _line_of_sight(means)
    if line is None:
        return None
    bearing, _, (across, _) = line
    miss = np.array([_turn_between(bearing, factor.measured().theta())])
    return Linearized(miss, (np.array([[-across[0], -across[1], -1.0]]), _by_target([across], means[1])))


def _range(factor, means: Means) -> Linearized | None:
    line = _line_of_sight(means)
    if line is None:
        return None
    _, distance, (_, along) = line
    miss = np.array([factor.measured() - distance])
    return Linearized(miss, (np.array([[-along[0], -along[1], 0.0]]), _by_target([along], means[1])))


def _pose_prior(factor: gtsam.PriorFactorPose2, means: Means) -> Linearized:
    """In the axes of the measured pose."""
    x, y, heading = means[0].tolist()
    measured = factor.prior()
    dx, dy = measured.x() - x, measured.y() - y
    c, s = cos(measured.theta()), sin(measured.theta())
    miss = np.array([c * dx + s * dy, c * dy - s * dx, remainder(measured.theta() - heading, tau)])
    return Linearized(miss, (np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]),))


def _landmark_prior(factor: gtsam.PriorFactorPoint2, means: Means) -> Linearized:
    return Linearized(np.asarray(factor.prior()) - means[0], (np.eye(2),))


def _line_of_sight(means: Means) -> tuple[float, float, tuple[tuple[float, float], tuple[float, float]]] | None:
    """Bearing, range, and the derivatives of both by the position of the target; None where there is no line."""
    xa, ya, heading = means[0].tolist()
    xb, yb = means[1].tolist()[:2]
    dx, dy = xb - xa, yb - ya
    distance = hypot(dx, dy)
    if distance < COINCIDE_M:
        return None
    across = -dy / distance**2, dx / distance**2
    return atan2(dy, dx) - heading, distance, (across, (dx / distance, dy / distance))


def _by_target(rows: Sequence[tuple[float, float]], target: np.ndarray) -> np.ndarray:
    """Derivatives by the target, whose heading takes no part when it has one."""
    return np.array([(*row, 0.0) for row in rows] if len(target) == 3 else rows)


def _turn_between(start_rad: float, end_rad: float) -> float:
    """In [-pi, pi]."""
    return remainder(end_rad - start_rad, 2 * pi)


def _from_polar(bearing_rad: float, range_m: float, cov: np.ndarray) -> Sighting:
    """cov: (2, 2), order bearing, range."""
    c, s = cos(bearing_rad), sin(bearing_rad)
    carry = np.array([[-range_m * s, c], [range_m * c, s]])
    return Sighting(np.array([range_m * c, range_m * s]), carry @ cov @ carry.T)


def _diagonal(bearing_variance: float, range_sigma_m: float) -> np.ndarray:
    return np.diag([bearing_variance, range_sigma_m**2])


_MODELS: dict[type, Callable[..., Linearized | None]] = {
    gtsam.BetweenFactorPose2: _between,
    gtsam.BearingRangeFactor2D: _bearing_range,
    gtsam.BearingRangeFactorPose2: _bearing_range,
    gtsam.BearingFactor2D: _bearing,
    gtsam.BearingFactorPose2: _bearing,
    gtsam.RangeFactor2D: _range,
    gtsam.RangeFactorPose2: _range,
    gtsam.PriorFactorPose2: _pose_prior,
    gtsam.PriorFactorPoint2: _landmark_prior,
}
