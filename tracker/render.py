"""What the camera of one robot sees of the other: exact perspective, Lambert's law, a sensor with blur and noise.

radiance = reflectance * (ambient + direct * max(0, normal . light)),  area-sampled over cells of half a pixel
picture  = Sensor.picture(radiance over background, under what is in front);  the background is sampled over pixels
"""

from dataclasses import dataclass, field

import numpy as np

from coopslam.errors import require_between
from coopslam.se2 import Pose2, position, rotation
from tracker.antialias import CELLS, Patch, sampled
from tracker.background import Background
from tracker.camera import Camera
from tracker.lens import pixel_corners
from tracker.scene_light import Light
from tracker.sensor import Sensor
from tracker.target import Solid, Target

PATCHES = 16  # of a solid, at most
MARGIN_PX = 2  # around the target's box
BEHIND_M = 0.5  # background things stand at least so far behind the target


@dataclass(frozen=True, slots=True)
class Occluder:
    """A rectangle of one radiance in front of everything, in pixels."""

    left_px: float
    upper_px: float
    width_px: float
    height_px: float
    radiance: float = 0.3

    def __post_init__(self):
        require_between(-1e4, 1e5, left_px=self.left_px, upper_px=self.upper_px)
        require_between(0.0, 1e5, width_px=self.width_px, height_px=self.height_px)
        require_between(0.0, 10.0, radiance=self.radiance)

    def drawn_over(self, radiance: np.ndarray) -> None:
        """Covers what is in a picture of (2 H, 2 W) cells, in place; cells at its border in part."""

        def covered(first_px: float, length_px: float, count: int) -> np.ndarray:
            ends = (first_px + length_px + 0.5) * CELLS, (first_px + 0.5) * CELLS
            upper, lower = (np.clip(end - np.arange(count), 0, 1) for end in ends)
            return upper - lower

        down = covered(self.upper_px, self.height_px, radiance.shape[0])
        across = covered(self.left_px, self.width_px, radiance.shape[1])
        radiance += (np.outer(down, across) * (self.radiance - radiance)).astype(radiance.dtype)


@dataclass(frozen=True, slots=True)
class RenderSettings:
    """Everything about a picture that is neither camera nor target."""

    light: Light = field(default_factory=Light)
    background: Background = field(default_factory=Background)
    sensor: Sensor = field(default_factory=Sensor)
    occluders: tuple[Occluder, ...] = ()


def render(
    camera: Camera,
    target: Target,
    T_observer_target: Pose2,
    settings: RenderSettings,
    rng: np.random.Generator,
    background: np.ndarray | None = None,
) -> np.ndarray:
    """(H, W) uint8 picture of a target robot at a pose in the observer robot's body.

    background: (H, W) float32 radiance instead of the settings' own (e.g. from Background.radiance, drawn once).
    """
    if background is None:
        apart_m = float(np.hypot(*(position(T_observer_target) - camera.mount.position_body[:2])))
        background = settings.background.radiance(camera, rng, apart_m + BEHIND_M)
    radiance = in_cells(background)
    box = target_box(camera, target.solids, T_observer_target)
    if box is not None:
        rows, columns = box
        corners = pixel_corners(camera.lens)[rows.start : rows.stop + 1, columns.start : columns.stop + 1]
        seen = _seen(camera, target.solids, T_observer_target, settings.light, corners)
        cells = tuple(slice(CELLS * side.start, CELLS * side.stop) for side in box)
        radiance[cells] = seen.radiance + (1 - seen.coverage) * radiance[cells]
    return _taken(radiance, settings, rng)


def render_background(camera: Camera, settings: RenderSettings, rng: np.random.Generator) -> np.ndarray:
    """(H, W) uint8 picture without a target."""
    return _taken(in_cells(settings.background.radiance(camera, rng)), settings, rng)


def in_cells(radiance: np.ndarray) -> np.ndarray:
    """(2 H, 2 W) float32 radiance of the cells of (H, W) pixels, all four the same."""
    return np.repeat(np.repeat(radiance.astype(np.float32), CELLS, axis=1), CELLS, axis=0)


def target_box(camera: Camera, solids: tuple[Solid, ...], T_observer_target: Pose2) -> tuple[slice, slice] | None:
    """Rows and columns of the picture that hold all of the solids (of a target); None: they are not in it."""
    points = np.concatenate([solid.extent() for solid in solids])
    turned = points[:, :2] @ rotation(T_observer_target.theta()).T + position(T_observer_target)
    pixels, _ = camera.project(np.column_stack([turned, points[:, 2]]))
    known = np.isfinite(pixels).all(axis=1)
    if not known.any():
        return None
    size = np.array([camera.lens.width_px, camera.lens.height_px])
    if known.all():
        first = np.floor(np.clip(pixels.min(axis=0) - MARGIN_PX, 0, size)).astype(int)
        last = np.ceil(np.clip(pixels.max(axis=0) + MARGIN_PX + 1, 0, size)).astype(int)
    else:  # some of it is beside or behind the camera: its outline cannot be bounded by these points
        first, last = np.zeros(2, int), size
    return None if (first >= last).any() else (slice(first[1], last[1]), slice(first[0], last[0]))


def _seen(camera: Camera, solids, T_observer_target: Pose2, light: Light, corners: np.ndarray) -> Patch:
    """Area-sampled picture of the solids, in the target's body."""
    R_target_observer = np.eye(3)
    R_target_observer[:2, :2] = rotation(-T_observer_target.theta())
    away = camera.mount.position_body - [*position(T_observer_target), 0.0]
    origin = R_target_observer @ away
    R_target_camera = R_target_observer @ camera.mount.R_body_camera

    def shade(normalised: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        directions = R_target_camera[:, :2] @ normalised + R_target_camera[:, 2:]
        return _shaded(solids, origin, directions, light, T_observer_target.theta())

    return sampled(corners, shade)


def _shaded(solids, origin, directions, light: Light, heading_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,) radiance and label along (3, N) rays: of the first surface that each meets; zero and -1 without any."""
    distances = np.stack([solid.distances(origin, directions) for solid in solids])
    first = distances.argmin(axis=0)
    nearest = distances.min(axis=0)
    radiance, label = np.zeros(len(nearest)), np.full(len(nearest), -1)
    for number, solid in enumerate(solids):
        met = np.flatnonzero((first == number) & (nearest < np.inf))
        if len(met):
            look = solid.look(origin[:, None] + nearest[met] * directions[:, met])
            radiance[met] = look.reflectance * light.irradiance(look.normals, heading_rad)
            label[met] = PATCHES * number + look.patch
    return radiance, label


def _taken(radiance: np.ndarray, settings: RenderSettings, rng) -> np.ndarray:
    for occluder in settings.occluders:
        occluder.drawn_over(radiance)
    return settings.sensor.picture(radiance, rng)
