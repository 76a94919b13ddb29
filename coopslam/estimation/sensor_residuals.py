"""What sensors miss of given trajectories, before and after a calibration, and the noise that these residuals show.

The trajectories are the truth, or what was solved from the log itself. All sizes are robust: 1.4826 times the median
absolute value, which is the standard deviation when errors are normal.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from coopslam.estimation.calibration import PARAMETERS, Calibration, CameraNoise, RobotCalibration
from coopslam.estimation.driven_path import DrivenPath, between, interpolated, residual_twists
from coopslam.odometry_noise import CommandNoise, Walk
from coopslam.records import BearingFix, BearingRangeFix, RangeFix, Record, RelativePoseFix
from coopslam.se2 import wrap

FEWEST = 200  # residuals from which a size of noise is read
WINDOWS_S = (2.0, 5.0, 10.0, 20.0)  # over which odometry is held against the trajectory
_DELAY = PARAMETERS.index("delay_s")
_BINS = 12
_MOST_LOST_S = 0.2  # a longer part of a window without odometry, and it says nothing
_DEPTH_SHARE = 0.4  # of the bend that depths have
_DOUBT_SIGMAS = 5.0
_SIDEWAYS = CommandNoise().sideways  # too small to be read beside what a turning heading does


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Where a robot was, by time; between two stamps on the straight line."""

    stamps_s: np.ndarray  # (N,) ascending
    states: np.ndarray  # (N, 3) x, y, heading

    def at(self, stamps_s: np.ndarray) -> np.ndarray:
        """(M, 3) states; NaN outside of the course."""
        states = interpolated(self.stamps_s, self.states, stamps_s)
        states[(stamps_s < self.stamps_s[0] - 1e-6) | (stamps_s > self.stamps_s[-1] + 1e-6)] = np.nan
        return states


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """What one robot saw of others and of landmarks, as measured, and where these really were."""

    raw_range_m: np.ndarray  # (N,); NaN where only the bearing was measured
    raw_bearing_rad: np.ndarray  # (N,); NaN where only the range was
    may_be_depth: np.ndarray  # (N,) bool: a bearing and a range, not a pose
    range_m: np.ndarray  # (N,) true
    bearing_rad: np.ndarray  # (N,) true

    def range_residuals(self, of: RobotCalibration, is_depth: bool) -> np.ndarray:
        """(M,) calibrated less true ranges, m, of those that have one."""
        return (self.undepthed(is_depth) - of.range_offset_m) / of.range_scale - self.range_m

    def bearing_residuals(self, of: RobotCalibration) -> np.ndarray:
        """(N,) calibrated less true bearings, rad."""
        return wrap(self.raw_bearing_rad - of.bearing_offset_rad - self.bearing_rad)

    def undepthed(self, is_depth: bool) -> np.ndarray:
        """(N,) measured ranges; of a depth along the axis of the camera the range."""
        cosine = np.where(self.may_be_depth & is_depth, np.cos(self.raw_bearing_rad), 1.0)
        return self.raw_range_m / np.where(cosine > 0, cosine, np.nan)


def sightings_of(
    records: Iterable[Record], courses: Mapping[str, Course], landmarks: Mapping[str, np.ndarray]
) -> dict[str, Sightings]:
    """Observer -> its sightings, in order of the records, of whatever has a known place at the time."""
    rows: dict[tuple[str, str], list[tuple]] = {}
    for record in records:
        row = _row(record)
        if row is not None and record.observer in courses and (record.target in courses or record.target in landmarks):
            rows.setdefault((record.observer, record.target), []).append(row)
    parts: dict[str, list[np.ndarray]] = {}
    for (observer, target), measured in rows.items():
        measured = np.array(measured)
        eye = courses[observer].at(measured[:, 0])
        goal = courses[target].at(measured[:, 0])[:, :2] if target in courses else landmarks[target]
        dx, dy = (goal - eye[:, :2]).T
        true = np.column_stack([np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - eye[:, 2])])
        parts.setdefault(observer, []).append(np.hstack([measured, true])[np.isfinite(true).all(axis=1)])
    stacked = {observer: np.vstack(own) for observer, own in parts.items()}
    return {
        observer: Sightings(own[:, 1], own[:, 2], own[:, 3] > 0, own[:, 4], own[:, 5])
        for observer, own in stacked.items()
        if len(own)
    }


def _row(record: Record) -> tuple | None:
    """Stamp, range, bearing, whether the range may be a depth."""
    if isinstance(record, BearingRangeFix):
        return record.stamp_s, record.range_m, record.bearing_rad, 1.0
    if isinstance(record, RangeFix):
        return record.stamp_s, record.range_m, np.nan, 0.0
    if isinstance(record, BearingFix):
        return record.stamp_s, np.nan, record.bearing_rad, 0.0
    if isinstance(record, RelativePoseFix):
        x, y = record.T_observer_target.x(), record.T_observer_target.y()
        return record.stamp_s, np.hypot(x, y), np.arctan2(y, x), 0.0
    return None


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Stretches of one robot's way: what it really did in them, and the instants between which it did."""

    starts_s: np.ndarray  # (N,)
    ends_s: np.ndarray  # (N,)
    true: np.ndarray  # (N, 3) relative poses

    def odometry(self, path: DrivenPath, constants: np.ndarray) -> np.ndarray:
        """(N, 3) relative poses by dead reckoning."""
        return between(path.at(self.starts_s, constants), path.at(self.ends_s, constants))

    def residuals(self, path: DrivenPath, constants: np.ndarray) -> np.ndarray:
        """(N, 3) true less odometry, in the axes of each end: along, across, heading."""
        return residual_twists(self.odometry(path, constants), self.true)

    def done(self, path: DrivenPath, constants: np.ndarray) -> np.ndarray:
        """(N, 5) as `DrivenPath.done`, within each window."""
        return path.done(self.ends_s, constants) - path.done(self.starts_s, constants)


def windows_of(path: DrivenPath, course: Course, length_s: float, constants: np.ndarray) -> Windows:
    """Windows one after the other in which the robot was asked to move, and its odometry is complete.

    They begin and end with stamps of the course, between which it may be a chord of a long way.
    """
    first = max(course.stamps_s[0], path.start_s[0] + constants[_DELAY])
    last = min(course.stamps_s[-1], path.end_s[-1] + constants[_DELAY])
    edges = np.searchsorted(course.stamps_s, np.arange(first, last + 1e-9, length_s) - 1e-6)
    edges = course.stamps_s[np.unique(np.minimum(edges, len(course.stamps_s) - 1))]
    edges = edges[edges <= last + 1e-6]
    starts, ends = edges[:-1], edges[1:]
    if not len(starts):
        return Windows(starts, ends, np.zeros((0, 3)))
    moving = path.done(ends, constants)[:, 4] - path.done(starts, constants)[:, 4] > 0
    lost = path.lost_s(ends, constants) - path.lost_s(starts, constants)
    kept = moving & (lost < _MOST_LOST_S) & (ends - starts < 2 * length_s)
    starts, ends = starts[kept], ends[kept]
    true = between(course.at(starts), course.at(ends))
    return Windows(starts, ends, true)


def constants_of(one: RobotCalibration) -> np.ndarray:
    """(9,) constants in the order of `PARAMETERS`."""
    return np.array([getattr(one, name) for name in PARAMETERS])


# ---- sizes ----


def size(residuals: np.ndarray) -> float | None:
    """Robust standard deviation about zero; None of nothing."""
    residuals = residuals[np.isfinite(residuals)]
    return float(1.4826 * np.median(np.abs(residuals))) if len(residuals) else None


def sizes(
    sightings: Mapping[str, Sightings],
    paths: Mapping[str, DrivenPath],
    courses: Mapping[str, Course],
    calibration: Calibration,
    window_s: float = 5.0,
) -> dict[str, dict[str, float]]:
    """Robot -> range_m, bearing_rad, and of odometry over `window_s` forward_m and turn_rad; what it has of these."""
    result = {}
    for robot in courses:
        of, found = calibration.of(robot), {}
        if robot in sightings:
            found["range_m"] = size(sightings[robot].range_residuals(of, calibration.range_is_depth))
            found["bearing_rad"] = size(sightings[robot].bearing_residuals(of))
        if robot in paths:
            windows = windows_of(paths[robot], courses[robot], window_s, constants_of(of))
            residuals = windows.residuals(paths[robot], constants_of(of))
            found["forward_m"], found["turn_rad"] = size(residuals[:, 0]), size(residuals[:, 2])
        result[robot] = {name: value for name, value in found.items() if value is not None}
    return result


def camera_noise(sightings: Mapping[str, Sightings], calibration: Calibration) -> CameraNoise | None:
    """Noise that is left after the calibration; None when too little was seen to tell."""
    every = [(one, calibration.of(robot)) for robot, one in sightings.items()]
    bearings = np.concatenate([np.zeros(0), *(one.bearing_residuals(of) for one, of in every)])
    bearings = bearings[np.isfinite(bearings)]
    errors = np.concatenate([np.zeros(0), *(one.range_residuals(of, calibration.range_is_depth) for one, of in every)])
    ranges = np.concatenate([np.zeros(0), *(one.range_m for one, _ in every)])[np.isfinite(errors)]
    errors = errors[np.isfinite(errors)]
    if min(len(bearings), len(errors)) < FEWEST:
        return None
    bins = np.array_split(np.argsort(ranges), _BINS)
    found = np.array([size(errors[own]) for own in bins])
    columns = np.array([[1.0, np.mean(ranges[own] ** 2)] for own in bins])
    weights = 1.0 / np.maximum(found, 1e-9)  # the sigma of a sigma is in proportion to it
    (at_zero, per_m2), _ = nnls(columns * weights[:, None], found * weights)
    least = max(0.1 * float(found.min()), 1e-6)
    return CameraNoise(max(float(at_zero), least), float(per_m2), max(size(bearings), 1e-6))


def odometry_noise(
    paths: Mapping[str, DrivenPath], courses: Mapping[str, Course], calibration: Calibration
) -> CommandNoise | None:
    """Random walks that explain what calibrated odometry misses over seconds; None when too little was driven."""
    along, heading, done = [], [], []
    for robot in paths.keys() & courses.keys():
        constants = constants_of(calibration.of(robot))
        for window_s in WINDOWS_S:
            windows = windows_of(paths[robot], courses[robot], window_s, constants)
            residuals = windows.residuals(paths[robot], constants)
            along.append(residuals[:, 0])
            heading.append(residuals[:, 2])
            done.append(windows.done(paths[robot], constants))
    if sum(map(len, along)) < FEWEST:
        return None
    done = np.vstack(done)
    return CommandNoise(
        forward=_walk(np.concatenate(along), done), sideways=_SIDEWAYS, heading=_walk(np.concatenate(heading), done)
    )


def _walk(errors: np.ndarray, done: np.ndarray) -> Walk:
    """The random walk whose variance fits robust ones of groups of windows in which about as much was done."""
    found, columns = [], []
    for nearly in np.array_split(np.argsort(done[:, 2]), 5):
        for own in np.array_split(nearly[np.argsort(done[nearly, 3])], 5):
            found.append(size(errors[own]) ** 2)
            columns.append(done[own, 2:4].mean(axis=0))
    weights = 1.0 / np.maximum(found, 1e-12)
    (per_m, per_rad), _ = nnls(np.array(columns) * weights[:, None], np.array(found) * weights)
    return Walk(float(np.sqrt(per_m)), float(np.sqrt(per_rad)), 0.001)


def looks_like_depth(sightings: Sequence[Sightings]) -> bool:
    """Whether what is called a range is the depth along the axis of the camera, by how it depends on the bearing.

    A reading z = offset + scale R + k R (cos b - 1) has k = scale when it is a depth and k = 0 when it is a range. A
    trajectory that was solved from depths taken for ranges bends to them: k then comes out as 0.5 to 0.9 times that.
    The median over the robots decides; where no robot shows it beyond doubt they are ranges.
    """
    shares = []
    for one in sightings:
        own = np.isfinite(one.raw_range_m) & one.may_be_depth
        if own.sum() < FEWEST // 4:
            continue
        range_m, bend = one.range_m[own], np.cos(one.raw_bearing_rad[own]) - 1.0
        columns = np.column_stack([np.ones(len(range_m)), range_m, range_m * bend])
        found, sigmas = robust_fit(columns, one.raw_range_m[own])
        shares.append(found[2] / found[1] if found[2] > _DOUBT_SIGMAS * sigmas[2] else 0.0)
    return bool(shares) and bool(np.median(shares) > _DEPTH_SHARE)


def robust_fit(columns: np.ndarray, y: np.ndarray, rounds: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of y over (N, k) columns and their standard deviations: reweighted least squares, Cauchy's loss."""
    weights = np.ones(len(y))
    for _ in range(rounds):
        root = np.sqrt(weights)
        found = np.linalg.lstsq(columns * root[:, None], y * root, rcond=None)[0]
        deviations = y - columns @ found
        spread = max(size(deviations), 1e-12)
        weights = 1.0 / (1.0 + (deviations / (2.385 * spread)) ** 2)
    information = (columns * weights[:, None]).T @ columns
    return found, spread * np.sqrt(np.diag(np.linalg.pinv(information)))
