"""What robots measure: truth plus true noise, with the covariance that the robots believe in."""

from dataclasses import dataclass

import numpy as np

from coopslam.records import CornerSighting, Odometry, RelativePoseFix
from coopslam.se2 import Pose2, planar_rotation
from sim.noise import Noise


@dataclass(frozen=True, slots=True)
class Sensors:
    """Statistical models of odometry, robot tracker and corner finder. Noise is drawn from `rng`."""

    true: Noise
    believed: Noise
    rng: np.random.Generator

    def odometry(
        self, robot: str, times_s: np.ndarray, turns_rad: np.ndarray, distances_m: np.ndarray
    ) -> list[Odometry]:
        """One record per step; each step turns on the spot, or drives straight. times_s is (N+1,), the others (N,)."""
        records = []
        for k, (turn, distance) in enumerate(zip(turns_rad.tolist(), distances_m.tolist(), strict=True)):
            error = self._draw(self.true.odometry.covariance(turn, distance))
            measured = Pose2(distance, 0.0, turn) * Pose2(*error)
            belief = self.believed.odometry.covariance(measured.theta(), measured.x())
            records.append(Odometry(float(times_s[k]), float(times_s[k + 1]), robot, measured, belief))
        return records

    def relative_pose(self, stamp_s: float, observer: str, target: str, T_observer_target: Pose2) -> RelativePoseFix:
        """What the tracker of `observer` says of `target`."""
        true_range = T_observer_target.range(np.zeros(2))
        line = np.arctan2(T_observer_target.y(), T_observer_target.x()) if true_range > 0 else 0.0
        along, across, heading = self._draw(self.true.tracker.line_covariance(true_range))
        c, s = np.cos(line), np.sin(line)
        x = T_observer_target.x() + c * along - s * across
        y = T_observer_target.y() + s * along + c * across
        turn = planar_rotation(np.arctan2(y, x))
        cov = turn @ self.believed.tracker.line_covariance(np.hypot(x, y)) @ turn.T
        return RelativePoseFix(stamp_s, observer, target, Pose2(x, y, T_observer_target.theta() + heading), cov)

    def corner(
        self, stamp_s: float, observer: str, T_observer_corner: Pose2, interior_angle_rad: float
    ) -> CornerSighting:
        """What the finder of `observer` says of the corner in which it stands."""
        x, y, theta = self._draw(self.true.finder.covariance())
        angle = interior_angle_rad + self.rng.standard_normal() * self.true.finder.interior_angle_sigma_rad
        return CornerSighting(
            stamp_s,
            observer,
            Pose2(T_observer_corner.x() + x, T_observer_corner.y() + y, T_observer_corner.theta() + theta),
            self.believed.finder.covariance(),
            float(np.clip(angle, 1e-6, 2 * np.pi - 1e-6)),
            self.believed.finder.interior_angle_sigma_rad,
        )

    def bearing_error(self) -> float:
        """Of a bearing that the tracker watches for, rad."""
        return float(self.rng.standard_normal()) * self.true.tracker.bearing_sigma_rad

    def _draw(self, cov: np.ndarray) -> np.ndarray:
        """(3,) zero-mean normal vector; an exact sensor draws too, so that the stream does not depend on the noise."""
        white = self.rng.standard_normal(3)
        if not cov.any():
            return np.zeros(3)
        x = np.sqrt(cov[0, 0])
        y = np.sqrt(cov[1, 1])
        slope = cov[1, 2] / y if y > 0 else 0.0
        rest = np.sqrt(max(cov[2, 2] - slope**2, 0.0))
        return np.array([x * white[0], y * white[1], slope * white[1] + rest * white[2]])
