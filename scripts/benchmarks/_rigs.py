"""A robot tracker as somebody builds it: not as the data sheet says, calibrated by a dozen pictures, then used.

Errors of the workshop are drawn from the tolerances that calibration believes a nominal sheet to have
(`tolerances_of`). They are drawn for what the pictures of a calibration tell: camera height and tilt, the target's
radius, ends and pitch. Bearings and headings of its pictures are not known, so it can tell neither where the camera
looks (yaw) nor where the helix starts; no error is drawn for them, nor for the principal point, the distortion and the
forward offsets. A real rig has such errors, which add a constant to bearing and heading; they are not in the law.

Two errors are drawn that the usual calibration does not estimate, so what they do is assumed, not measured: bearings
err by the share that the focal length errs, and headings by 2 pi / pitch times the error of the lower ring's width,
which is as if the helix started elsewhere.
"""

from dataclasses import dataclass, replace
from math import nan

import numpy as np
from _calibrate_tracker import SUSPICIOUS_PX
from _scenes import RANGES_M, Scene, random_scene, sheet_of

from coopslam.errors import BadInput, UnderDetermined
from coopslam.se2 import Pose2, position, wrap
from tracker.calibration import calibrate_tracker
from tracker.calibration_fit import Shot
from tracker.calibration_parameters import tolerances_of, values_of, with_values
from tracker.data_sheet import DataSheet
from tracker.detectors import make_detector

SIZE = "640x480"
DRAWN = ("height", "tilt", "radius", "bottom", "top", "pitch")
DISTANCE_SIGMA_M = 0.005  # tape measure between two robots' reference points, which are inside of them
CALIBRATION_M = tuple(np.geomspace(0.7, 6.0, 12).tolist())  # near to far, as calibrate_tracker.py asks for
CALIBRATED, PERFECT = "calibrated", "perfect"
ELSEWHERE = 0.2  # of the range: something else was taken for the target
TRUTH, CALIBRATION, USE = range(3)  # streams of random numbers


@dataclass(frozen=True, slots=True)
class BuildErrors:
    """How far from its data sheet a rig is built, standard deviations."""

    tolerance_share: float = 1.0  # of the tolerances of calibration
    focal_sigma: float = 0.007  # share of the focal length, by which lenses of one make differ
    ring_sigma_m: float = 0.001  # paint or tape at the rings' inner edges; the sheet has no tolerance for it


@dataclass(frozen=True, slots=True)
class RigJob:
    """A rig to build, calibrate and use."""

    rig: int
    pictures: int
    seed: int
    perfect: bool  # whether the pictures are measured with the true sheet, too
    estimated: tuple[str, ...]  # parameters of the calibration
    errors: BuildErrors


@dataclass(frozen=True, slots=True)
class Sighting:
    """What came of one picture; NaN where there is nothing to say. A line of the CSV file."""

    rig: int
    sheet: str  # that it was measured with: calibrated or perfect
    bin_m: float
    number: int
    range_m: float
    bearing_rad: float
    heading_rad: float
    detected: bool
    heading_known: bool
    elsewhere: bool = False  # what was detected is not the target
    range_error_m: float = nan
    across_error_m: float = nan  # across the line of sight, to the left
    bearing_error_rad: float = nan
    heading_error_rad: float = nan


@dataclass(frozen=True, slots=True)
class RigResult:
    """All sightings of a rig. Without a calibration those with a calibrated sheet are missing."""

    rig: int
    errors: dict[str, float]  # of the nominal sheet: nominal less true
    left: dict[str, float]  # of the calibrated one
    failure: str | None  # why there is no calibration
    warning: str | None  # that calibrate_tracker.py gives of one that does not fit its pictures
    sightings: tuple[Sighting, ...]


def used_rig(job: RigJob) -> RigResult:
    """Build, calibrate, take pictures of random scenes and measure them."""
    nominal = sheet_of("helix", SIZE)
    rngs = [np.random.default_rng([job.seed, job.rig, stream]) for stream in (TRUTH, CALIBRATION, USE)]
    true = true_sheet(nominal, job.errors, rngs[TRUTH])
    sheets, failure, warning, left = {}, None, None, {}
    try:
        calibrated = calibrate_tracker(nominal, job.estimated, *calibration_pictures(true, rngs[CALIBRATION]))
        sheets[CALIBRATED], left = calibrated.sheet, differences(calibrated.sheet, true)
        if calibrated.fit.residual_rms_px > SUSPICIOUS_PX:
            warning = f"edges are left {calibrated.fit.residual_rms_px:.1f} px off"
    except (BadInput, UnderDetermined) as error:
        failure = str(error)
    if job.perfect:
        sheets[PERFECT] = true
    detectors = {name: make_detector(sheet) for name, sheet in sheets.items()}
    sightings = []
    for k in range(job.pictures):
        number, place = divmod(k, len(RANGES_M))
        scene = random_scene(true, RANGES_M[place], False, rngs[USE])
        image = scene.picture(true.camera, true.target, rngs[USE])
        for name, detector in detectors.items():
            found = detector.detect(image)
            where = _where(scene.T_observer_target)
            seen = {"detected": False, "heading_known": False}
            if found is not None:
                seen = errors_of(found.T_observer_target, scene.T_observer_target, found.heading_known)
            sightings.append(Sighting(job.rig, name, RANGES_M[place], number, **where, **seen))
    return RigResult(job.rig, differences(nominal, true), left, failure, warning, tuple(sightings))


def true_sheet(nominal: DataSheet, errors: BuildErrors, rng: np.random.Generator) -> DataSheet:
    """What somebody built by a sheet. Pixels are square, so both focal lengths err alike."""
    sigmas = errors.tolerance_share * tolerances_of(nominal, DRAWN)
    sheet = with_values(nominal, DRAWN, values_of(nominal, DRAWN) + sigmas * rng.standard_normal(len(DRAWN)))
    focal = values_of(nominal, ("fx", "fy")) * (1 + errors.focal_sigma * rng.standard_normal())
    sheet = with_values(sheet, ("fx", "fy"), focal)
    ring_m = sheet.helix.ring_m + errors.ring_sigma_m * rng.standard_normal()
    return replace(sheet, helix=replace(sheet.helix, ring_m=ring_m))


def calibration_pictures(true: DataSheet, rng: np.random.Generator) -> tuple[list[Shot], list[np.ndarray]]:
    """Of robots that stand still, so that nothing is smeared by motion; distances as a tape measure says."""
    shots, images = [], []
    for k, range_m in enumerate(CALIBRATION_M):
        scene = _still(random_scene(true, range_m, False, rng))
        distance_m = float(np.hypot(*position(scene.T_observer_target))) + DISTANCE_SIGMA_M * rng.standard_normal()
        shots.append(Shot(f"picture {k}", distance_m, distance_sigma_m=DISTANCE_SIGMA_M))
        images.append(scene.picture(true.camera, true.target, rng))
    return shots, images


def differences(sheet: DataSheet, true: DataSheet) -> dict[str, float]:
    """Of numbers that a picture tells apart: heights above the pattern's lower end, focal length as a share."""
    names = ("height", "tilt", "radius", "top", "pitch", "fx", "fy")
    (bottom, *own), (true_bottom, *others) = (values_of(each, ("bottom", *names)) for each in (sheet, true))
    away = dict(zip(names, np.subtract(own, others).tolist(), strict=True))
    lifted = bottom - true_bottom
    away |= {"height": away["height"] - lifted, "top": away["top"] - lifted}
    return away | {name: away[name] / others[names.index(name)] for name in ("fx", "fy")}


def errors_of(seen: Pose2, true: Pose2, heading_known: bool) -> dict:
    """Errors in the axes of the true line of sight, in fields of a Sighting."""
    at, where = position(seen), position(true)
    line = where / np.hypot(*where)
    return {
        "detected": True,
        "heading_known": heading_known,
        "elsewhere": bool(np.hypot(*(at - where)) > ELSEWHERE * np.hypot(*where)),
        "range_error_m": float(np.hypot(*at) - np.hypot(*where)),
        "across_error_m": float(np.array([-line[1], line[0]]) @ (at - where)),
        "bearing_error_rad": float(wrap(np.arctan2(at[1], at[0]) - np.arctan2(where[1], where[0]))),
        "heading_error_rad": float(wrap(seen.theta() - true.theta())) if heading_known else nan,
    }


def _still(scene: Scene) -> Scene:
    sensor = replace(scene.settings.sensor, motion_px=0.0)
    return replace(scene, settings=replace(scene.settings, sensor=sensor))


def _where(pose: Pose2) -> dict[str, float]:
    x, y = position(pose)
    return {
        "range_m": float(np.hypot(x, y)),
        "bearing_rad": float(np.arctan2(y, x)),
        "heading_rad": float(pose.theta()),
    }
