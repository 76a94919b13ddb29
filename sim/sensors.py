"""What robots measure: truth plus true noise, with the covariance that the robots believe in."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from coopslam.records import BearingRangeFix, CornerSighting, Odometry, PosePrior, RelativePoseFix
from coopslam.se2 import Pose2, planar_rotation, xytheta
from sim.noise import FalseSightings, FinderNoise, Noise, OdometryBias, TrackerLimits, TrackerNoise

DETOUR_M = 0.3  # by so much at least the way over a mirror is longer than the straight one
LONGEST_DETOUR = 3.0  # times the straight way
IN_PLACE_M = 1e-6  # nearer than this the line of sight has no direction but that of rounding


@dataclass(frozen=True, slots=True, eq=False)
class Circumstances:
    """What a sighting may depend on besides where the target is."""

    observer_heading_rad: float = 0.0  # in the world
    velocity_m_per_s: np.ndarray = field(default_factory=lambda: np.zeros(2))  # of the target, observer's axes


AT_REST = Circumstances()


@dataclass(frozen=True, slots=True)
class Sensors:
    """Statistical models of odometry, robot tracker and corner finder. Noise is drawn from `rng`."""

    true: Noise
    believed: Noise
    rng: np.random.Generator
    bias: OdometryBias = field(default_factory=OdometryBias)
    false_sightings: FalseSightings = field(default_factory=FalseSightings)
    tracker_limits: TrackerLimits = field(default_factory=TrackerLimits)
    tally: Counter[str] = field(default_factory=Counter)  # what the tracker was asked and what came of it

    @property
    def may_withhold_headings(self) -> bool:
        """Whether a look may miss the target, or its heading, although the tracker measures headings."""
        return False

    def odometry(
        self,
        robot: str,
        times_s: np.ndarray,
        turns_rad: np.ndarray,
        distances_m: np.ndarray,
        noise_factors: np.ndarray | None = None,
    ) -> list[Odometry]:
        """One record per step; each step turns on the spot, or drives straight. times_s is (N+1,), the others (N,).

        noise_factors: of the ground under each step, on the true sigmas; 1 when None. The belief knows none of them: it
        is the covariance of the motion that was commanded. (That of the measured one would call a step sure whenever
        it happens to be measured too short.)
        """
        factors = np.ones(len(turns_rad)) if noise_factors is None else noise_factors
        steps = zip(turns_rad.tolist(), distances_m.tolist(), factors.tolist(), strict=True)
        records = []
        for k, (turn, distance, factor) in enumerate(steps):
            error = self._draw(factor**2 * self.true.odometry.covariance(turn, distance))
            measured = self.bias.measured(turn, distance) * Pose2(*error)
            belief = self.believed.odometry.covariance(turn, distance)
            records.append(Odometry(float(times_s[k]), float(times_s[k + 1]), robot, measured, belief))
        return records

    def relative_pose(
        self, stamp_s: float, observer: str, target: str, T_observer_target: Pose2, seen: Circumstances = AT_REST
    ) -> RelativePoseFix | BearingRangeFix | None:
        """What the tracker of `observer` says of `target`; None when it drops out. It may be a reflection.

        A tracker without heading says where the target is and not how it stands; beyond its range it says nothing.
        """
        shown, false, limits = T_observer_target, self.false_sightings, self.tracker_limits
        self.tally["looks"] += 1
        if false.share > 0:
            chance = self.rng.random()
            if chance < false.dropouts:
                return None
            if chance < false.share:
                shown = self._reflection(T_observer_target)
        if not limits.min_range_m <= shown.range(np.zeros(2)) <= limits.max_range_m:
            return None
        return self._fix(stamp_s, observer, target, shown, seen)

    def _fix(
        self, stamp_s: float, observer: str, target: str, shown: Pose2, seen: Circumstances
    ) -> RelativePoseFix | BearingRangeFix | None:
        """What the tracker says of a target that is within its limits, or of the mirror image of one."""
        measured, cov = self._sighted(shown, self.true.tracker, self.believed.tracker)
        if self.tracker_limits.has_heading:
            return RelativePoseFix(stamp_s, observer, target, measured, cov)
        x, y, _ = xytheta(measured)
        range_m = float(np.hypot(x, y))
        if range_m <= IN_PLACE_M:
            return None
        along, across, _ = np.diag(self.believed.tracker.line_covariance(range_m))
        cov = np.diag([across / range_m**2, along])
        return BearingRangeFix(stamp_s, observer, target, float(np.arctan2(y, x)), range_m, cov)

    def placing(self, stamp_s: float, robot: str, T_start_robot: Pose2) -> PosePrior:
        """How the team was set up: where a robot was put, as seen from the start pose of the first robot."""
        put = T_start_robot * Pose2(*self._draw(self.true.placing.covariance()))
        return PosePrior(stamp_s, robot, put, self.believed.placing.covariance())

    def corner(
        self, stamp_s: float, observer: str, T_observer_corner: Pose2, interior_angle_rad: float
    ) -> CornerSighting:
        """What the finder of `observer` says of a corner within its reach; usually it stands in that corner."""
        measured, cov = self._sighted(T_observer_corner, self.true.finder, self.believed.finder)
        angle = interior_angle_rad + self.rng.standard_normal() * self.true.finder.interior_angle_sigma_rad
        return CornerSighting(
            stamp_s,
            observer,
            measured,
            cov,
            float(np.clip(angle, 1e-6, 2 * np.pi - 1e-6)),
            self.believed.finder.interior_angle_sigma_rad,
        )

    def bearing_error(self, T_observer_target: Pose2 | None = None, seen: Circumstances = AT_REST) -> float | None:
        """Of a bearing that the tracker watches for, rad; None when it does not see the target there.

        T_observer_target: where the target would be seen at that bearing; None: nowhere on its way.
        """
        return float(self.rng.standard_normal()) * self.true.tracker.bearing_sigma_rad

    def contact_seems_lost(self, confirmations: int, seen_again: Callable[[], bool] | None = None) -> bool:
        """Whether so many consecutive sightings of a robot in plain view were all false.

        seen_again: looks once more, for sensors whose looks are not chance alone.
        """
        share = self.false_sightings.share
        return share > 0 and bool(self.rng.random() < share**confirmations)

    def _sighted(
        self, T_observer_target: Pose2, true: TrackerNoise | FinderNoise, believed: TrackerNoise | FinderNoise
    ) -> tuple[Pose2, np.ndarray]:
        """A pose measured along a line of sight, and its believed (3, 3) covariance in the axes of the observer."""
        x, y, theta = xytheta(T_observer_target)
        distance = np.hypot(x, y)
        along, across, heading = self._draw(true.line_covariance(distance))
        c, s = (x / distance, y / distance) if distance > IN_PLACE_M else (1.0, 0.0)
        x, y = x + c * along - s * across, y + s * along + c * across
        turn = planar_rotation(np.arctan2(y, x))
        cov = turn @ believed.line_covariance(np.hypot(x, y)) @ turn.T
        return Pose2(x, y, theta + heading), cov

    def _reflection(self, T_observer_target: Pose2) -> Pose2:
        """A mirror image: anywhere, but farther away than the target itself."""
        straight_m = T_observer_target.range(np.zeros(2))
        range_m = max(straight_m * self.rng.uniform(1.0, LONGEST_DETOUR), straight_m + DETOUR_M)
        bearing, heading = -self.rng.uniform(-np.pi, np.pi, 2)  # in (-pi, pi]
        return Pose2(range_m * np.cos(bearing), range_m * np.sin(bearing), heading)

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
