"""Sensors calibrated against the truth: robust regressions, each robot for itself, and the noise that is left.

Ranges and bearings are held against where observer and target really were, odometry against what the robot really did
in windows of a few seconds: shorter ones drown in the truth's own noise, longer ones in the drift of the heading. Each
fit has Cauchy's loss and the prior of `PriorSigmas`, which what the log does not excite goes back to.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from typing import Protocol

import numpy as np
from scipy.optimize import least_squares

from coopslam.errors import BadInput, require_between
from coopslam.estimation.calibration import PARAMETERS, Calibration, CameraNoise, Provenance, RobotCalibration
from coopslam.estimation.driven_path import DrivenPath, driven_paths
from coopslam.estimation.parameter_step import DEFAULTS
from coopslam.estimation.self_calibration import CALIBRATED_CAMERA, PriorSigmas
from coopslam.estimation.sensor_residuals import (
    Course,
    Sightings,
    camera_noise,
    looks_like_depth,
    odometry_noise,
    robust_fit,
    sightings_of,
    sizes,
    windows_of,
)
from coopslam.odometry_noise import CommandNoise, Walk
from coopslam.records import Record, RelativePoseFix
from coopslam.se2 import Pose2, wrap

_CAUCHY_SIGMAS = 2.385  # 95 % efficiency for normal errors (Holland and Welsch 1977)
# Of odometry's fit: a delay moves the windows in which the robot drives; Cauchy's loss has minima of its own far off.
_LOSSES = ("soft_l1", "cauchy", "cauchy")
FEWEST_HEADINGS = 3
_DERIVATIVE_STEP = 0.01
_CAMERA, _ODOMETRY = slice(0, 3), slice(3, 8)
_ASSUMED = CommandNoise(Walk(0.02, 0.03, 0.001), Walk(0.005, 0.005, 0.0007), Walk(0.03, 0.09, 0.001))


class TrueTrack(Protocol):
    """Where a robot really was."""

    stamps_s: np.ndarray  # (N,) ascending
    poses: Sequence[Pose2]  # N, in a frame common to the log


@dataclass(frozen=True, slots=True)
class TruthCalibrationSettings:
    """How sensors are held against the truth."""

    window_s: float = 3.0  # of odometry
    truth_sigma_m: float = 0.003  # of positions, in windows
    truth_sigma_rad: float = 0.003
    prior: PriorSigmas = field(default_factory=PriorSigmas)
    excited: float = 0.5  # as in `SelfCalibrationSettings`
    camera: CameraNoise = CALIBRATED_CAMERA  # weights of sightings in the fit, whose residuals then tell the noise

    def __post_init__(self):
        require_between(0.05, 1e3, window_s=self.window_s)
        require_between(1e-9, 1e3, truth_sigma_m=self.truth_sigma_m, truth_sigma_rad=self.truth_sigma_rad)
        require_between(0.0, 1.0, excited=self.excited)


def truth_calibrate(
    records: Iterable[Record],
    robots: Sequence[str],
    truth: Mapping[str, TrueTrack],
    landmarks: Mapping[str, np.ndarray],
    settings: TruthCalibrationSettings | None = None,
    log: str = "",
) -> Calibration:
    """Constants of the robots that have a truth, and the noise of all of them.

    records: raw.  truth, landmarks: by name; poses and (2,) points in one common frame.
    Raises BadInput when no robot has a truth, or nothing can be held against it.
    """
    settings, records = settings or TruthCalibrationSettings(), list(records)
    courses = {robot: course_of(truth[robot]) for robot in robots if robot in truth and len(truth[robot].stamps_s) > 1}
    if not courses:
        raise BadInput(f"{log or 'the log'}: no truth of any robot; expected one to calibrate against")
    sightings, paths = sightings_of(records, courses, landmarks), driven_paths(records)
    is_depth = looks_like_depth(list(sightings.values()))
    robots_done, sigmas = {}, {}
    for robot, course in courses.items():
        constants, own_sigmas = DEFAULTS.copy(), np.array(astuple(settings.prior))
        if robot in sightings:
            _fit_camera(sightings[robot], is_depth, settings, constants, own_sigmas)
        if robot in paths:
            _fit_odometry(paths[robot], course, settings, constants, own_sigmas)
        robots_done[robot] = RobotCalibration(*constants.tolist())
        sigmas[robot] = dict(zip(PARAMETERS, own_sigmas.tolist(), strict=True))
    _fit_headings(records, courses, settings, robots_done, sigmas)
    if not sightings and not paths.keys() & courses.keys():
        raise BadInput(f"{log or 'the log'}: no odometry nor sighting of a robot with truth; nothing to calibrate")
    calibration = Calibration(robots_done, is_depth)
    camera = camera_noise(sightings, calibration)
    calibration = replace(calibration, camera=camera, odometry=odometry_noise(paths, courses, calibration))
    provenance = Provenance(
        log,
        with_truth=True,
        sigmas=sigmas,
        residuals_before=sizes(sightings, paths, courses, Calibration({})),
        residuals_after=sizes(sightings, paths, courses, calibration),
    )
    return replace(calibration, provenance=provenance)


def course_of(track: TrueTrack) -> Course:
    """The truth in arrays, its heading without jumps."""
    states = np.array([(pose.x(), pose.y(), pose.theta()) for pose in track.poses])
    states[:, 2] = np.unwrap(states[:, 2])
    return Course(np.asarray(track.stamps_s, dtype=float), states)


def _fit_camera(
    sightings: Sightings, is_depth: bool, settings: TruthCalibrationSettings, constants: np.ndarray, sigmas: np.ndarray
) -> None:
    """Offset and scale of ranges and offset of bearings, into (9,) constants and sigmas."""
    noise = settings.camera
    range_sigmas = noise.range_sigma(sightings.range_m)
    measured = sightings.undepthed(is_depth)

    def residuals(values: np.ndarray) -> np.ndarray:
        offset, scale, bearing_offset = values
        ranges = (measured - offset - scale * sightings.range_m) / range_sigmas
        one = RobotCalibration(bearing_offset_rad=bearing_offset)
        every = np.concatenate([ranges, sightings.bearing_residuals(one) / noise.bearing_sigma_rad])
        return every[np.isfinite(every)]

    _fit(residuals, _CAMERA, settings, constants, sigmas)


def _fit_odometry(
    path: DrivenPath, course: Course, settings: TruthCalibrationSettings, constants: np.ndarray, sigmas: np.ndarray
) -> None:
    """Scales, creep, drift and delay, into (9,) constants and sigmas."""
    for loss in _LOSSES:
        windows = windows_of(path, course, settings.window_s, constants)
        if not len(windows.starts_s):
            return
        length, turn, _, _, moving = windows.done(path, constants).T
        along, across, _, heading = _ASSUMED.of_chords(length, turn, moving)
        # the heading may have drifted all at once, early in the window
        across = across + heading * length**2
        floor = np.array([settings.truth_sigma_m, settings.truth_sigma_m, settings.truth_sigma_rad]) ** 2
        scale = np.sqrt(np.column_stack([along, across, heading]) + floor)

        def residuals(values: np.ndarray, windows=windows, scale=scale) -> np.ndarray:
            trial = np.concatenate([constants[_CAMERA], values])
            every = (windows.residuals(path, trial) / scale).ravel()
            return every[np.isfinite(every)]

        _fit(residuals, _ODOMETRY, settings, constants, sigmas, loss)


def _fit_headings(
    records: Sequence[Record],
    courses: Mapping[str, Course],
    settings: TruthCalibrationSettings,
    done: dict[str, RobotCalibration],
    sigmas: dict[str, dict[str, float]],
) -> None:
    """Offsets of the headings that robots are seen with, once the bearing offsets of those who look are known."""
    seen: dict[str, list[tuple[float, float]]] = {}
    for fix in records:
        if isinstance(fix, RelativePoseFix) and fix.observer in courses and fix.target in courses:
            eye, goal = (courses[robot].at(np.array([fix.stamp_s]))[0, 2] for robot in (fix.observer, fix.target))
            error = wrap(fix.T_observer_target.theta() - (goal - eye) - done[fix.observer].bearing_offset_rad)
            if np.isfinite(error):
                seen.setdefault(fix.target, []).append((float(error), sigmas[fix.observer]["bearing_offset_rad"]))
    for robot, rows in seen.items():
        errors, of_bearings = np.array(rows).T
        if len(errors) < FEWEST_HEADINGS:
            continue
        (offset,), (sigma,) = robust_fit(np.ones((len(errors), 1)), errors)
        total, prior = float(np.hypot(sigma, of_bearings.max())), settings.prior.heading_offset_rad
        if total < settings.excited * prior:
            done[robot] = replace(done[robot], heading_offset_rad=float(offset))
            sigmas[robot]["heading_offset_rad"] = total


def _fit(
    residuals: Callable[[np.ndarray], np.ndarray],
    which: slice,
    settings: TruthCalibrationSettings,
    constants: np.ndarray,
    sigmas: np.ndarray,
    loss: str = "cauchy",
) -> None:
    """Robust fit of some of a robot's constants in place, from where they are.

    What is not excited goes to its default.
    """
    prior, default = np.array(astuple(settings.prior))[which], DEFAULTS[which]

    def everything(values: np.ndarray) -> np.ndarray:
        return np.concatenate([residuals(values), (values - default) / prior])

    start = constants[which].copy()
    # shifted to one, because numeric derivatives take steps in proportion to the values
    result = least_squares(
        lambda shifted: everything(start + shifted - 1.0),
        np.ones(len(start)),
        loss=loss,
        f_scale=_CAUCHY_SIGMAS,
        x_scale=0.1 * np.ones(len(start)),
        diff_step=_DERIVATIVE_STEP,
    )
    best = start + result.x - 1.0
    found = np.sqrt(np.diag(_sandwich(residuals, best, prior)))
    excited = found < settings.excited * prior
    constants[which] = np.where(excited, best, default)
    sigmas[which] = np.where(excited, found, prior)


def _sandwich(residuals: Callable[[np.ndarray], np.ndarray], best: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """(k, k) covariance of a robust fit by the size that the residuals have where they are, whatever was assumed.

    The estimator of Huber (1967) and White (1980): A^-1 B A^-1, with A = J' w J and B = J' (w r)^2 J.
    """
    at_best = residuals(best)
    jacobian = np.empty((len(at_best), len(best)))
    for k, step in enumerate(_DERIVATIVE_STEP * np.eye(len(best))):
        jacobian[:, k] = (residuals(best + step) - residuals(best - step)) / (2 * _DERIVATIVE_STEP)
    weights = 1.0 / (1.0 + (at_best / _CAUCHY_SIGMAS) ** 2)
    spare = len(at_best) / max(len(at_best) - len(best), 1)
    bread = np.linalg.inv((jacobian * weights[:, None]).T @ jacobian + np.diag(prior**-2.0))
    filling = spare * (jacobian * ((weights * at_best) ** 2)[:, None]).T @ jacobian + np.diag(prior**-2.0)
    return bread @ filling @ bread
