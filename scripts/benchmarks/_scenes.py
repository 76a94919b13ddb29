"""Random scenes for the benchmarks of the robot tracker: poses, lights, surroundings, blur, noise, occluders.

The helix and the tag cube get the same scenes for the same random numbers: only the target differs.
"""

from dataclasses import dataclass
from math import pi
from pathlib import Path

import numpy as np

from coopslam.se2 import Pose2, position
from tracker.background import Background
from tracker.camera import Camera
from tracker.data_sheet import DataSheet, load_data_sheet
from tracker.render import BEHIND_M, Occluder, RenderSettings, render, target_box
from tracker.scene_light import Light
from tracker.sensor import Sensor
from tracker.target import Target

SHEETS = Path(__file__).parents[2] / "datasets" / "calibrations"
TARGETS = ("helix", "tag_cube")
SIZES = ("640x480", "1280x960")
RANGES_M = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0)
WITHIN = 0.05  # of such a range
BACKGROUNDS = ("plain", "gradient", "clutter")
HALF_VIEW_RAD = 0.55  # of the data sheets' cameras, a little less
HALF_WIDTH_M = 0.22  # of what should be in the picture: the cube seen over an edge
LEAST_BEARING_RAD = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A target robot somewhere; what is behind it is drawn once."""

    T_observer_target: Pose2
    settings: RenderSettings
    background: np.ndarray  # (H, W) float32 radiance

    def picture(self, camera: Camera, target: Target, rng: np.random.Generator) -> np.ndarray:
        """(H, W) uint8, with new noise."""
        return render(camera, target, self.T_observer_target, self.settings, rng, self.background)


def sheet_of(target: str, size: str) -> DataSheet:
    """The shipped data sheet. Helix and cube are equally high."""
    return load_data_sheet(SHEETS / f"{target}_{size}.toml")


def random_scene(sheet: DataSheet, range_m: float, occluded: bool, rng: np.random.Generator) -> Scene:
    """A scene with the target at about that range, all of its width in the picture.

    occluded: a bar hides a tenth to four tenths of the marked solid.
    """
    range_m *= rng.uniform(1 - WITHIN, 1 + WITHIN)
    reach = max(HALF_VIEW_RAD - np.arcsin(min(HALF_WIDTH_M / range_m, 1.0)), LEAST_BEARING_RAD)
    bearing = rng.uniform(-reach, reach)
    pose = Pose2(range_m * np.cos(bearing), range_m * np.sin(bearing), rng.uniform(-pi, pi))
    settings = RenderSettings(random_light(rng), random_background(rng), random_sensor(rng))
    apart_m = float(np.hypot(*(position(pose) - sheet.camera.mount.position_body[:2])))
    background = settings.background.radiance(sheet.camera, rng, apart_m + BEHIND_M)
    if occluded:
        bar = _bar(target_box(sheet.camera, sheet.target.solids[:1], pose), rng)
        settings = RenderSettings(settings.light, settings.background, settings.sensor, (bar,))
    return Scene(pose, settings, background)


def random_light(rng: np.random.Generator) -> Light:
    """From any side."""
    return Light(rng.uniform(0.3, 0.6), rng.uniform(0.0, 0.6), rng.uniform(-pi, pi), rng.uniform(0.1, 1.3))


def random_background(rng: np.random.Generator, kind: str | None = None) -> Background:
    """Of a kind, or of one of the three with equal chance."""
    return Background(
        kind or str(rng.choice(BACKGROUNDS)),
        wall=rng.uniform(0.1, 0.8),
        floor=rng.uniform(0.1, 0.6),
        wall_m=rng.uniform(11.0, 20.0),
        slope=rng.uniform(-0.4, 0.4),
        things=int(rng.integers(5, 30)),
        marks=int(rng.integers(5, 25)),
        texture=rng.uniform(0.0, 0.1),
    )


def random_sensor(rng: np.random.Generator) -> Sensor:
    """Exposure, noise of a good and of a poor sensor, defocus up to a pixel, motion up to two."""
    return Sensor(
        gain=rng.uniform(140.0, 230.0),
        electrons_per_level=float(np.exp(rng.uniform(np.log(8.0), np.log(60.0)))),
        read_noise_electrons=rng.uniform(4.0, 20.0),
        defocus_px=rng.uniform(0.4, 1.0),
        motion_px=rng.uniform(0.0, 2.0),
        motion_rad=rng.uniform(-pi, pi),
    )


def _bar(box: tuple[slice, slice], rng: np.random.Generator) -> Occluder:
    """From one side over a part of a box of the picture: something that stands, hangs or lies before the target."""
    rows, columns = box
    wide, high = columns.stop - columns.start, rows.stop - rows.start
    share, radiance = rng.uniform(0.1, 0.4), rng.uniform(0.05, 0.7)
    side = rng.integers(4)
    if side < 2:  # left, right
        left = columns.start - wide if side == 0 else columns.stop - share * wide
        return Occluder(left, rows.start - high, wide * (1 + share * (side == 0)), 3 * high, radiance)
    upper = rows.start - high if side == 2 else rows.stop - share * high
    return Occluder(columns.start - wide, upper, 3 * wide, high * (1 + share * (side == 2)), radiance)
