"""What the sensors get wrong: true noise and the robots' belief about it are two objects of one kind.

Odometry noise is a random walk, so it does not depend on the sampling rate. Its values in `TYPICAL`
are those of the paper's section 4: 3 cm after 1 m, 2 degrees of drift after 1 m, 3 degrees after a full turn.
"""

from dataclasses import dataclass, field, fields, replace
from math import inf, radians

import numpy as np

from coopslam.errors import BadInput
from coopslam.se2 import Pose2

MOST = 1e3  # m or rad, of any sigma
MOST_FALSE = 0.5  # share of sightings; beyond, there is no saying which half is true


class _Sigmas:
    """Refuses sigmas that are negative, not finite or beyond all measure."""

    __slots__ = ()

    def __post_init__(self):
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not 0 <= value <= MOST:
                raise BadInput(f"{entry.name}: zero or more expected, at most {MOST:g}, got {value}")


@dataclass(frozen=True, slots=True)
class OdometryNoise(_Sigmas):
    """Random walk of a robot that turns on the spot and drives straight."""

    translation_sigma_m: float = 0.03  # after 1 m
    drift_sigma_rad: float = radians(2.0)  # of heading, after 1 m
    rotation_sigma_rad: float = radians(3.0)  # after 360 degrees
    floor_sigma: float = 1e-6  # m and rad, of each step: regular after a pure turn; too small to depend on the rate

    def covariance(self, turn_rad: float, distance_m: float) -> np.ndarray:
        """(3, 3) covariance of one small step, axes of its end.

        Heading drifts along the way, so the sideways error is its integral: var(y) = q d^3 / 3,
        cov(y, theta) = q d^2 / 2 with q the drift variance per metre; steps compose to any leg.
        """
        d = abs(distance_m)
        q = self.drift_sigma_rad**2
        theta = q * d + self.rotation_sigma_rad**2 * abs(turn_rad) / (2 * np.pi)
        x, y = self.translation_sigma_m**2 * d, q * d**3 / 3
        floor, y_theta = self.floor_sigma**2, q * d**2 / 2
        return np.array([[x + floor, 0, 0], [0, y + floor, y_theta], [0, y_theta, theta + floor]])


@dataclass(frozen=True, slots=True)
class TrackerNoise(_Sigmas):
    """The robot tracker: range along the line of sight, bearing across it, heading of the target.

    The defaults are those measured for the helix (scripts/benchmarks/tracker_law.py): mostly what is left of the
    rig's errors after a calibration with twelve pictures; what pixels add is far less.
    """

    range_sigma_m: float = 0.0014  # at range zero
    range_sigma_per_m: float = 0.0023
    lateral_sigma_m: float = 0.0003  # at range zero
    bearing_sigma_rad: float = radians(0.08)
    heading_sigma_rad: float = radians(1.9)

    def line_covariance(self, range_m: float) -> np.ndarray:
        """(3, 3) covariance of (along, across, heading), axes of the line of sight."""
        along = self.range_sigma_m**2 + (self.range_sigma_per_m * range_m) ** 2
        across = self.lateral_sigma_m**2 + (self.bearing_sigma_rad * range_m) ** 2
        return np.diag([along, across, self.heading_sigma_rad**2])


@dataclass(frozen=True, slots=True)
class TrackerLimits:
    """What the robot tracker cannot do, however well it measures."""

    max_range_m: float = field(default=inf, metadata={"infinite": True})  # farther away it sees nobody
    has_heading: bool = True  # without, a sighting is a bearing and a range
    min_range_m: float = 0.0  # nearer it sees nobody either

    def __post_init__(self):
        if not self.max_range_m > 0:
            raise BadInput(f"max_range_m: more than zero expected, got {self.max_range_m}")
        if not 0 <= self.min_range_m < self.max_range_m:
            raise BadInput(f"min_range_m: zero or more, less than max_range_m expected, got {self.min_range_m}")


@dataclass(frozen=True, slots=True)
class FinderNoise(_Sigmas):
    """The short-range corner finder."""

    position_sigma_m: float = 0.005
    direction_sigma_rad: float = radians(0.5)
    interior_angle_sigma_rad: float = radians(0.7)

    def line_covariance(self, distance_m: float) -> np.ndarray:
        """(3, 3) covariance of (along, across, direction), axes of the line of sight to the corner."""
        across = self.position_sigma_m**2 + (self.direction_sigma_rad * distance_m) ** 2
        return np.diag([self.position_sigma_m**2, across, self.direction_sigma_rad**2])


@dataclass(frozen=True, slots=True)
class PlacingNoise(_Sigmas):
    """How well people set the robots up at the start: one in a corner, the others a step along its wall."""

    position_sigma_m: float = 0.02
    heading_sigma_rad: float = radians(2.0)

    def covariance(self) -> np.ndarray:
        """(3, 3) covariance of (x, y, heading) of one robot relative to the first."""
        return np.diag([self.position_sigma_m**2, self.position_sigma_m**2, self.heading_sigma_rad**2])


@dataclass(frozen=True, slots=True)
class Noise:
    """One law for every sensor."""

    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    tracker: TrackerNoise = field(default_factory=TrackerNoise)
    finder: FinderNoise = field(default_factory=FinderNoise)
    placing: PlacingNoise = field(default_factory=PlacingNoise)  # matters only to a tracker without heading


@dataclass(frozen=True, slots=True)
class OdometryBias:
    """What odometry gets wrong in the same way every time. The robots do not know of it."""

    scale: float = 0.0  # measured metres are (1 + scale) times the true ones
    turn_scale: float = 0.0  # measured angles of turns on the spot are (1 + turn_scale) times the true ones
    drift_rad_per_m: float = 0.0  # so far the measured heading drifts to the left in each true metre

    def __post_init__(self):
        for name, most in (("scale", 0.5), ("turn_scale", 0.5), ("drift_rad_per_m", 1.0)):
            value = getattr(self, name)
            if not abs(value) <= most:
                raise BadInput(f"{name}: between -{most:g} and {most:g} expected, got {value}")

    def measured(self, turn_rad: float, distance_m: float) -> Pose2:
        """What odometry without noise says of a step: the start's frame of where it believes to be then.

        With drift a straight drive is measured as an arc of a circle, so steps compose to the same at any rate.
        """
        length = (1 + self.scale) * distance_m
        bend = self.drift_rad_per_m * distance_m
        chord = length * np.sinc(bend / (2 * np.pi))  # numpy's sinc: sin(bend / 2) / (bend / 2)
        return Pose2(chord * np.cos(bend / 2), chord * np.sin(bend / 2), bend + (1 + self.turn_scale) * turn_rad)


@dataclass(frozen=True, slots=True)
class FalseSightings:
    """Shares of the robot tracker's sightings that are none; it cannot tell."""

    outliers: float = 0.0  # reflections: the target is reported where its mirror image is
    dropouts: float = 0.0  # nothing is reported

    def __post_init__(self):
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not 0 <= value <= MOST_FALSE:
                raise BadInput(f"{entry.name}: 0 to {MOST_FALSE:g} expected, got {value}")

    @property
    def share(self) -> float:
        """Of all sightings, those that do not show the target where it is."""
        return self.outliers + self.dropouts


TYPICAL = Noise()
EXACT = Noise(OdometryNoise(0, 0, 0, 0), TrackerNoise(0, 0, 0, 0, 0), FinderNoise(0, 0, 0), PlacingNoise(0, 0))
NEARLY_EXACT = Noise(
    OdometryNoise(1e-6, 1e-6, 1e-6, 1e-6),
    TrackerNoise(1e-6, 1e-6, 1e-6, 1e-6, 1e-6),
    FinderNoise(1e-6, 1e-6, 1e-6),
    PlacingNoise(1e-6, 1e-6),
)
LEGGED = Noise(odometry=OdometryNoise(0.30, radians(10.0), radians(20.0)))

PRESETS = {"none": (EXACT, NEARLY_EXACT), "typical": (TYPICAL, TYPICAL), "legged": (LEGGED, LEGGED)}  # (true, believed)

# The paper's section 2.1 names these three. The values of the last two are typical of such devices, not measured ones:
# a range finder that turns and meets a retroreflector; a laser stripe that a camera of the same robot looks at, whose
# range error would grow with the square of the range beyond its limit.
TRACKERS = {
    "helix": (TrackerNoise(), TrackerLimits()),
    "retroreflector": (TrackerNoise(0.01, 0.001, 0.005, radians(0.25)), TrackerLimits(30.0, has_heading=False)),
    "laser-stripe": (TrackerNoise(0.001, 0.001, 0.001, radians(0.05), radians(1.0)), TrackerLimits(4.0)),
}


def preset(noise: str, tracker: str = "helix") -> tuple[Noise, Noise]:
    """(true, believed) noise of a preset with one of the trackers; without noise every tracker is exact."""
    true, believed = PRESETS[noise]
    if noise == "none":
        return true, believed
    sigmas, _ = TRACKERS[tracker]
    return replace(true, tracker=sigmas), replace(believed, tracker=sigmas)
