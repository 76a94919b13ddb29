"""How a run with vision takes its pictures, and from where to where its camera is meant to see a robot."""

from dataclasses import dataclass, field, replace
from math import pi
from pathlib import Path
from typing import Literal

import numpy as np

from coopslam.errors import BadInput, require_between, require_positive
from coopslam.se2 import planar_rotation
from tracker.background import Background
from tracker.camera import Camera
from tracker.data_sheet import DataSheet
from tracker.helix_detector import HelixDetectorSettings
from tracker.sensor import Sensor
from tracker.sheets import load_sheet, sheet_names

NEAREST_STEP_M = 0.01
# Height of the pattern up to which a tracker is used. At 14 pixels half of all tags are read; a helix is still found in
# every picture, but the demands on its accuracy end there (10 m with 640 x 480 pixels).
SMALLEST_PX = {"helix": 14.0, "apriltag": 14.0}


@dataclass(frozen=True, slots=True)
class VisionSettings:
    """How pictures are taken during a run. Raises BadInput naming the field."""

    helix_sheet: str = "helix_640x480"  # a name in datasets/calibrations or a path
    apriltag_sheet: str = "tag_cube_640x480"
    pan_step_rad: float = pi / 6  # between the directions in which the camera can look
    exposure_s: float = 0.01
    backgrounds: int = 8  # drawn once for each distance (in steps of 1.4), then picked at random
    background: Background = field(default_factory=lambda: Background("clutter"))
    sensor: Sensor = field(default_factory=Sensor)  # its motion blur is that of the robots instead
    smallest_px: float | None = None  # height of the pattern in pixels that is the tracker's reach; None: measured

    def __post_init__(self):
        require_between(0.01, pi, pan_step_rad=self.pan_step_rad)
        require_between(0.0, 1.0, exposure_s=self.exposure_s)
        require_between(1, 1000, backgrounds=self.backgrounds)
        if self.smallest_px is not None:
            require_positive(1e3, smallest_px=self.smallest_px)

    def load(self, tracker: Literal["helix", "apriltag"]) -> DataSheet:
        """The data sheet of a tracker. Raises BadInput when its target is another."""
        name = self.helix_sheet if tracker == "helix" else self.apriltag_sheet
        sheet = load_sheet(name)
        if (sheet.helix is not None) != (tracker == "helix"):
            table = "helix" if tracker == "helix" else "tag_cube"
            raise BadInput(f"{name}: a data sheet with a table [{table}] expected")
        return sheet

    def placed(self) -> "VisionSettings":
        """The same with absolute paths, to be read from anywhere."""
        paths = {key: getattr(self, key) for key in ("helix_sheet", "apriltag_sheet")}
        paths = {key: str(Path(path).absolute()) for key, path in paths.items() if path not in sheet_names()}
        return replace(self, **paths)


def limits_m(sheet: DataSheet, settings: VisionSettings) -> tuple[float, float]:
    """(nearest, farthest) distance of robots at which a camera in its directions is meant to see the target.

    Nearest: all of the target is in the picture from there on, whichever way it stands, half a pan step off the axis.
    Farthest: its pattern is `smallest_px` high; for a helix at most what its detector looks for.
    """
    camera, target = sheet.camera, sheet.target
    kind, height_m = ("apriltag", target.tag_m) if sheet.helix is None else ("helix", target.top_m - target.bottom_m)
    smallest_px = settings.smallest_px or SMALLEST_PX[kind]
    farthest = camera.lens.fy_px * height_m / smallest_px
    if sheet.helix is not None:
        farthest = min(farthest, HelixDetectorSettings().farthest_m)
    points = target.extent()
    headings = np.linspace(-pi, pi, 8, endpoint=False)
    for range_m in np.arange(NEAREST_STEP_M, farthest, NEAREST_STEP_M):
        offs = [camera.mount.yaw_rad + side * settings.pan_step_rad / 2 for side in (-1, 0, 1)]
        if all(_is_in_picture(camera, points, range_m, off, heading) for off in offs for heading in headings):
            return float(range_m), float(farthest)
    raise BadInput("pan_step_rad: directions from which all of the target is seen expected; this lens is too narrow")


def _is_in_picture(camera: Camera, points: np.ndarray, range_m: float, bearing_rad: float, heading_rad: float) -> bool:
    foot = camera.mount.position_body[:2] + range_m * np.array([np.cos(bearing_rad), np.sin(bearing_rad)])
    turned = points @ planar_rotation(heading_rad).T + [*foot, 0.0]
    return bool(camera.project(turned)[1].all())
