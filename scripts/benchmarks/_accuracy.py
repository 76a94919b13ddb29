"""One picture of a robot tracker's benchmark: rendered, measured, compared with the truth and with the bound."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import nan

import numpy as np
from _aruco_pose import ArucoPose
from _scenes import RANGES_M, SIZES, Scene, random_scene, sheet_of

from coopslam.se2 import Pose2, wrap, xytheta
from tracker.data_sheet import DataSheet
from tracker.detector import Detection
from tracker.detectors import make_detector
from tracker.information import pose_bound, sighting_sigmas

POSITION, POSE = 2, 3  # degrees of freedom
ARUCO = "aruco"  # the library's pose from the pictures of the tag cube


@dataclass(frozen=True, slots=True)
class Job:
    """A picture to take."""

    target: str
    size: str
    bin: int  # of RANGES_M
    number: int  # within the bin
    seed: int
    occluded: bool
    bounded: bool  # whether the bound is worked out, too


@dataclass(frozen=True, slots=True)
class Sample:
    """What one method made of one picture; NaN where there is nothing to say. A line of the CSV file."""

    method: str  # helix, tag_cube, aruco
    size: str
    occluded: bool
    bin_m: float
    number: int
    range_m: float
    bearing_rad: float
    heading_rad: float
    background: str
    detected: bool
    heading_known: bool
    range_error_m: float = nan
    bearing_error_rad: float = nan
    heading_error_rad: float = nan
    heading_sigma_rad: float = nan  # as the detector says
    nees: float = nan
    dof: int = 0
    range_bound_m: float = nan  # Cramer-Rao, one sigma
    bearing_bound_rad: float = nan
    heading_bound_rad: float = nan
    process_s: float = nan


def sampled(job: Job) -> list[Sample]:
    """The detector's sample of a picture, and the library's where there is one."""
    sheet, detect, library = _methods(job.target, job.size)
    rng = np.random.default_rng([job.seed, SIZES.index(job.size), job.bin, job.number])
    scene = random_scene(sheet, RANGES_M[job.bin], job.occluded, rng)
    image = scene.picture(sheet.camera, sheet.target, rng)
    began = time.process_time()
    found = detect(image)
    spent_s = time.process_time() - began
    bounds = _bounds(sheet, scene) if job.bounded else {}
    samples = [Sample(job.target, **_scene(job, scene), **_compared(found, scene), **bounds, process_s=spent_s)]
    if library is not None:
        pose = library(image)
        found = None if pose is None else Detection(pose, np.full((3, 3), nan), True)
        samples.append(Sample(ARUCO, **_scene(job, scene), **_compared(found, scene), **bounds))
    return samples


@lru_cache(maxsize=8)
def _methods(target: str, size: str) -> tuple[DataSheet, Callable, Callable | None]:
    sheet = sheet_of(target, size)
    return sheet, make_detector(sheet).detect, ArucoPose(sheet).pose if target == "tag_cube" else None


def _scene(job: Job, scene: Scene) -> dict:
    x, y, heading = xytheta(scene.T_observer_target)
    return {
        "size": job.size,
        "occluded": job.occluded,
        "bin_m": RANGES_M[job.bin],
        "number": job.number,
        "range_m": float(np.hypot(x, y)),
        "bearing_rad": float(np.arctan2(y, x)),
        "heading_rad": float(heading),
        "background": scene.settings.background.kind,
    }


def _bounds(sheet: DataSheet, scene: Scene) -> dict:
    """One sigma of range, bearing and heading that pixel noise allows; nothing where it ties nothing down."""
    T = scene.T_observer_target
    cov = pose_bound(sheet.camera, sheet.target, T, scene.settings, scene.background)
    if cov is None:
        return {}
    sigmas = sighting_sigmas(T, cov).tolist()
    return dict(zip(("range_bound_m", "bearing_bound_rad", "heading_bound_rad"), sigmas, strict=True))


def _compared(found: Detection | None, scene: Scene) -> dict:
    if found is None:
        return {"detected": False, "heading_known": False}
    error = _error(found.T_observer_target, scene.T_observer_target)
    seen, true = (xytheta(pose)[:2] for pose in (found.T_observer_target, scene.T_observer_target))
    known = found.heading_known
    dof = POSE if known else POSITION
    cov = found.cov_observer[:dof, :dof]
    honest = bool(np.isfinite(cov).all())
    return {
        "detected": True,
        "heading_known": known,
        "range_error_m": float(np.hypot(*seen) - np.hypot(*true)),
        "bearing_error_rad": float(wrap(np.arctan2(seen[1], seen[0]) - np.arctan2(true[1], true[0]))),
        "heading_error_rad": float(error[2]) if known else nan,
        "heading_sigma_rad": float(np.sqrt(found.cov_observer[2, 2])) if known else nan,
        "nees": float(error[:dof] @ np.linalg.solve(cov, error[:dof])) if honest else nan,
        "dof": dof if honest else 0,
    }


def _error(seen: Pose2, true: Pose2) -> np.ndarray:
    """(3,) x, y, theta in the observer's axes."""
    error = xytheta(seen) - xytheta(true)
    error[2] = wrap(error[2])
    return error
