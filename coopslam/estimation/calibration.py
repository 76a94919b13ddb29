"""What is known of sensors that measure wrongly, and records set right by it.

A robot's camera, or whatever ranges and takes bearings, reads z at the bearing b; its odometry says that the robot
drove d forward and turned by a. With the constants of `RobotCalibration`

    range    = (z / cos b - range_offset_m) / range_scale       (z itself unless `range_is_depth`)
    bearing  = b - bearing_offset_rad
    forward  = odometry_scale d + creep_m_per_rad |a|
    turn     = turn_scale a + drift_rad_per_m d
    stamp    = stamp of the odometry + delay_s

A tracker that gives relative poses has a range and a bearing too, which are those of its target's position, and

    heading  = h - bearing_offset_rad of who looks - heading_offset_rad of who is seen

since the camera turns all that it sees, and a target that is mounted askew misleads everybody.

What a tracker's data sheet says wrongly comes out as these constants. Range R is read off the row of a pattern that is
H under (or over) the camera, at the elevation e with tan e = H / R. A camera that really looks dt further down, and is
really dh lower over the pattern, than the sheet says, measures too far by

    dR = dh R / H + dt (R^2 + H^2) / H            (first order: dR/dH = R / H, dR/de = -H / sin^2 e)

So a wrong height is a range scale of 1 + dh / H. A wrong tilt is quadratic: over ranges about R0 it looks like the
scale 1 + 2 dt R0 / H with the offset dt (H^2 - R0^2) / H, and what these two do not explain, dt (R - R0)^2 / H, calls
for pictures at known distances (scripts/calibrate_tracker.py). A wrong yaw of the camera is a bearing offset, a helix
that starts elsewhere a heading offset.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from dataclasses import replace as changed
from functools import cache

import numpy as np

from coopslam.errors import require_between, require_positive
from coopslam.odometry_noise import CommandNoise
from coopslam.records import BearingFix, BearingRangeFix, Odometry, RangeFix, Record, RelativePoseFix
from coopslam.se2 import Pose2


@dataclass(frozen=True, slots=True)
class RobotCalibration:
    """What the sensors of one robot do wrongly; the defaults say: nothing."""

    range_offset_m: float = 0.0  # the camera measures this much too far
    range_scale: float = 1.0  # and so many times the range
    bearing_offset_rad: float = 0.0  # the camera looks this much to the right of straight ahead
    odometry_scale: float = 1.0  # metres driven for each that odometry says
    turn_scale: float = 1.0  # radians turned for each that odometry says
    creep_m_per_rad: float = 0.0  # forward motion when it turns, to either side
    drift_rad_per_m: float = 0.0  # to the left, when odometry says straight ahead
    delay_s: float = 0.0  # the robot moves this much later than the stamps of its odometry say; < 0: earlier
    heading_offset_rad: float = 0.0  # others see this robot turned so much too far to the left

    def __post_init__(self):
        require_between(-100.0, 100.0, range_offset_m=self.range_offset_m, delay_s=self.delay_s)
        angles = ("bearing_offset_rad", "heading_offset_rad")
        require_between(-np.pi, np.pi, **{name: getattr(self, name) for name in angles})
        scales = ("range_scale", "odometry_scale", "turn_scale")
        require_between(0.01, 100.0, **{name: getattr(self, name) for name in scales})
        require_between(-10.0, 10.0, creep_m_per_rad=self.creep_m_per_rad, drift_rad_per_m=self.drift_rad_per_m)


PARAMETERS = tuple(entry.name for entry in fields(RobotCalibration))


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """Noise of bearings and ranges once they are calibrated."""

    range_sigma_m: float  # at range zero
    range_sigma_per_m2: float  # what the square of the range adds
    bearing_sigma_rad: float

    def __post_init__(self):
        require_positive(1e3, range_sigma_m=self.range_sigma_m, bearing_sigma_rad=self.bearing_sigma_rad)
        require_between(0.0, 1e3, range_sigma_per_m2=self.range_sigma_per_m2)

    def range_sigma(self, range_m):
        """Standard deviation of a calibrated range, m; scalars and arrays."""
        return self.range_sigma_m + self.range_sigma_per_m2 * range_m**2


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a calibration comes from, and how well it is known."""

    log: str = ""
    with_truth: bool = False
    from_s: float = 0.0  # the part of the log that was used, s after its first record
    to_s: float | None = None  # None: to its end
    sigmas: dict[str, dict[str, float]] = field(default_factory=dict)  # robot -> parameter -> standard deviation
    # robot -> "range_m", "bearing_rad", "forward_m", "turn_rad" -> robust size without and with the calibration
    residuals_before: dict[str, dict[str, float]] = field(default_factory=dict)
    residuals_after: dict[str, dict[str, float]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Constants of all robots, and the noise that is left; what is None stays as the records say."""

    robots: dict[str, RobotCalibration]
    range_is_depth: bool = False  # bearing-and-range sensors give the depth along their axis for the range
    camera: CameraNoise | None = None
    odometry: CommandNoise | None = None
    provenance: Provenance = field(default_factory=Provenance)

    def of(self, robot: str) -> RobotCalibration:
        """Constants of a robot; of one that is not known the mean of the others."""
        if robot in self.robots or not self.robots:
            return self.robots.get(robot, RobotCalibration())
        known = [[getattr(one, name) for name in PARAMETERS] for one in self.robots.values()]
        return RobotCalibration(*np.mean(known, axis=0).tolist())


def calibrated(
    records: Iterable[Record], calibration: Calibration, dropped: Counter[str] | None = None
) -> list[Record]:
    """The same records, set right one by one; not yet `synchronized`, since the stamps of odometry have moved.

    Covariances follow the calibration's noise where it has one, or else are carried through the equations above.
    Odometry of a robot that stands, and motion that nobody knows (no step, but a covariance), stay what they are.
    dropped: counts fixes whose range would be less than zero, which are left out, and robots without constants.
    """
    dropped = Counter() if dropped is None else dropped
    records = list(records)
    set_right = {position: record for position, record in _odometry(records, calibration)}
    robots = {record.robot for record in set_right.values()}
    constants = cache(calibration.of)
    done = []
    for position, record in enumerate(records):
        mend = _FIXES.get(type(record))
        if mend is None:
            done.append(set_right.get(position, record))
            continue
        robots.add(record.observer)
        fix = mend(record, constants(record.observer), calibration)
        if fix is None:
            dropped[f"{type(record).__name__}: range less than zero after calibration"] += 1
        else:
            done.append(fix)
    for robot in sorted(robots - calibration.robots.keys()) if calibration.robots else ():
        dropped[f"{robot}: not in the calibration, the mean of the others is used"] += 1
    return done


# ---- odometry ----


def _odometry(records: Sequence[Record], calibration: Calibration) -> Iterable[tuple[int, Odometry]]:
    """Position and what becomes of each record of odometry."""
    positions = [k for k, record in enumerate(records) if isinstance(record, Odometry)]
    if not positions:
        return
    raw = [records[k] for k in positions]
    constants = {robot: calibration.of(robot) for robot in {record.robot for record in raw}}
    each = np.array([[getattr(constants[record.robot], name) for name in PARAMETERS] for record in raw])
    twists = calibrated_twists(twists_of(raw), each)
    covs = _odometry_covariances(raw, twists, each, calibration.odometry)
    steps = poses_of(twists)
    delays = each[:, PARAMETERS.index("delay_s")].tolist()
    for position, record, delay, step, cov in zip(positions, raw, delays, steps.tolist(), covs, strict=True):
        pose = record.T_start_now if step == [0.0, 0.0, 0.0] else Pose2(*step)
        yield position, Odometry(record.start_s + delay, record.stamp_s + delay, record.robot, pose, cov)


def twists_of(records: Sequence[Odometry]) -> np.ndarray:
    """(N, 3) forward, sideways, turn of each record's arc: the logarithm of its pose; m, m, rad."""
    steps = [record.T_start_now for record in records]
    x, y, turn = np.array([(step.x(), step.y(), step.theta()) for step in steps], dtype=float).reshape(-1, 3).T
    half = turn / 2
    scale = 1.0 / np.sinc(half / np.pi)  # arc over chord: half / sin(half)
    c, s = np.cos(half), np.sin(half)
    return np.column_stack([scale * (c * x + s * y), scale * (c * y - s * x), turn])


def poses_of(twists: np.ndarray) -> np.ndarray:
    """(N, 3) x, y, theta of the ends of arcs: the exponential of (N, 3) twists."""
    half = twists[:, 2] / 2
    chord = np.sinc(half / np.pi)
    c, s = np.cos(half), np.sin(half)
    forward, sideways = chord * twists[:, 0], chord * twists[:, 1]
    return np.column_stack([c * forward - s * sideways, s * forward + c * sideways, twists[:, 2]])


def calibrated_twists(twists: np.ndarray, constants: np.ndarray) -> np.ndarray:
    """(N, 3) twists set right. constants: (N, 9), or (9,) for all, in the order of `PARAMETERS`."""
    scale, turn_scale, creep, drift = np.atleast_2d(constants)[:, 3:7].T
    forward, sideways, turn = twists.T
    return np.column_stack(
        [scale * forward + creep * np.abs(turn), scale * sideways, turn_scale * turn + drift * forward]
    )


def _odometry_covariances(
    raw: Sequence[Odometry], twists: np.ndarray, constants: np.ndarray, noise: CommandNoise | None
) -> np.ndarray:
    """(N, 3, 3), axes of each record's end; twists: (N, 3) calibrated."""
    covs = np.array([record.cov_now for record in raw], dtype=float)
    moved = twists.any(axis=1)
    if noise is not None:
        moving = np.array([record.stamp_s - record.start_s for record in raw])[moved]
        length = np.copysign(np.hypot(twists[moved, 0], twists[moved, 1]), twists[moved, 0])
        covs[moved] = noise.of_arcs(length, twists[moved, 2], moving)
        return covs
    scale, turn_scale = constants[:, 3][moved], constants[:, 4][moved]
    sizes = np.column_stack([scale, scale, turn_scale])
    covs[moved] *= sizes[:, :, None] * sizes[:, None, :]
    return covs


# ---- fixes ----


def _bearing_range(fix: BearingRangeFix, of: RobotCalibration, calibration: Calibration) -> BearingRangeFix | None:
    cosine = np.cos(fix.bearing_rad) if calibration.range_is_depth else 1.0
    range_m = _range(fix.range_m / cosine, of) if cosine > 0 else -1.0
    if range_m < 0:
        return None
    if calibration.camera is not None:
        sigmas = np.array([calibration.camera.bearing_sigma_rad, calibration.camera.range_sigma(range_m)])
        cov = np.diag(sigmas**2)
    else:
        tangent = np.tan(fix.bearing_rad) if calibration.range_is_depth else 0.0
        bend = fix.range_m / cosine * tangent / of.range_scale
        jacobian = np.array([[1.0, 0.0], [bend, 1.0 / (cosine * of.range_scale)]])
        cov = jacobian @ fix.cov @ jacobian.T
    bearing = fix.bearing_rad - of.bearing_offset_rad
    return BearingRangeFix(fix.stamp_s, fix.observer, fix.target, bearing, float(range_m), cov)


def _range_only(fix: RangeFix, of: RobotCalibration, calibration: Calibration) -> RangeFix | None:
    range_m = _range(fix.range_m, of)
    if range_m < 0:
        return None
    noise = calibration.camera
    return changed(fix, range_m=range_m, sigma_m=noise.range_sigma(range_m) if noise else fix.sigma_m / of.range_scale)


def _bearing_only(fix: BearingFix, of: RobotCalibration, calibration: Calibration) -> BearingFix:
    sigma = calibration.camera.bearing_sigma_rad if calibration.camera else fix.sigma_rad
    return changed(fix, bearing_rad=fix.bearing_rad - of.bearing_offset_rad, sigma_rad=sigma)


def _relative_pose(fix: RelativePoseFix, of: RobotCalibration, calibration: Calibration) -> RelativePoseFix | None:
    """The tracker is turned by the bearing offset, so the target's heading turns with it. Its noise is its own."""
    askew = calibration.of(fix.target).heading_offset_rad
    pose, offset = fix.T_observer_target, of.bearing_offset_rad
    raw_m = float(np.hypot(pose.x(), pose.y()))
    ratio = _range(raw_m, of) / raw_m if raw_m > 0 else 1.0
    if ratio < 0:
        return None
    bearing = float(np.arctan2(pose.y(), pose.x()))
    turned = Pose2(0.0, 0.0, -offset) * Pose2(pose.x() * ratio, pose.y() * ratio, pose.theta() - askew)
    along, across = np.array([np.cos(bearing), np.sin(bearing)]), np.array([-np.sin(bearing), np.cos(bearing)])
    stretch = np.eye(3)
    stretch[:2, :2] = np.outer(along, along) / of.range_scale + np.outer(across, across) * ratio
    c, s = np.cos(offset), np.sin(offset)
    jacobian = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ stretch
    return changed(fix, T_observer_target=turned, cov_observer=jacobian @ fix.cov_observer @ jacobian.T)


def _range(raw_m: float, of: RobotCalibration) -> float:
    return (raw_m - of.range_offset_m) / of.range_scale


_FIXES = {
    BearingRangeFix: _bearing_range,
    RangeFix: _range_only,
    BearingFix: _bearing_only,
    RelativePoseFix: _relative_pose,
}
