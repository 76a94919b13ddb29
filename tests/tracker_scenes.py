"""Scenes in which detectors of the robot tracker are tested, and how far what they find is from the truth."""

from collections.abc import Iterator
from dataclasses import replace
from math import inf, pi
from pathlib import Path

import numpy as np

from coopslam.se2 import Pose2, wrap, xytheta
from tracker.background import Background
from tracker.data_sheet import DataSheet
from tracker.detector import Detection
from tracker.render import RenderSettings, render
from tracker.scene_light import Light
from tracker.sensor import Sensor

SHEETS = Path(__file__).parents[1] / "datasets" / "calibrations"
CLEAN = RenderSettings(sensor=Sensor(electrons_per_level=inf, vignetting=0.0))


def some_scene(rng: np.random.Generator) -> RenderSettings:
    """Some light, background and blur."""
    light = Light(rng.uniform(0.3, 0.6), rng.uniform(0.1, 0.6), rng.uniform(-pi, pi), rng.uniform(0.2, 1.2))
    sensor = Sensor(gain=rng.uniform(120, 230), defocus_px=rng.uniform(0.4, 1.0), motion_px=rng.uniform(0, 1.5))
    return RenderSettings(light, Background(str(rng.choice(["plain", "gradient", "clutter"]))), sensor)


def full_scene(rng: np.random.Generator) -> RenderSettings:
    """Some scene, with a great deal standing and lying about."""
    return replace(some_scene(rng), background=Background("clutter", things=30, marks=25, texture=0.1))


def pictures(
    sheet: DataSheet, range_m: float, bearing_max_rad: float, count: int
) -> Iterator[tuple[Pose2, np.ndarray]]:
    """Random poses at a distance, and their (H, W) uint8 pictures; the same at each call."""
    for seed in range(count):
        rng = np.random.default_rng(seed)
        bearing = rng.uniform(-bearing_max_rad, bearing_max_rad)
        pose = Pose2(range_m * np.cos(bearing), range_m * np.sin(bearing), rng.uniform(-pi, pi))
        yield pose, render(sheet.camera, sheet.target, pose, some_scene(rng), rng)


def error_of(found: Detection, pose: Pose2) -> np.ndarray:
    """(3,) m, m, rad in the axes of the observer."""
    error = xytheta(found.T_observer_target) - xytheta(pose)
    error[2] = wrap(error[2])
    return error


def square_of(found: Detection, pose: Pose2) -> float:
    """Squared Mahalanobis distance of a pose that was found from the true one."""
    error = error_of(found, pose)
    return float(error @ np.linalg.solve(found.cov_observer, error))
