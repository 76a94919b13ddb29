"""What is behind the target: floor, wall and, if wanted, clutter that stands on the floor and lies about on it."""

from dataclasses import dataclass
from functools import lru_cache
from math import pi
from typing import Literal

import numpy as np

from coopslam.errors import require_between, require_positive
from tracker.camera import Camera
from tracker.clutter import draw_clutter
from tracker.lens import Lens, pixel_corners

FLOOR_FADES_M = 6.0  # distance over which the floor's brightness goes half way to the wall's


@dataclass(frozen=True, slots=True)
class Background:
    """Radiance of the surroundings. Raises BadInput naming the field."""

    kind: Literal["plain", "gradient", "clutter"] = "gradient"  # plain: `wall` everywhere
    wall: float = 0.45  # radiance
    floor: float = 0.30  # radiance at the observer's feet
    wall_m: float = 14.0  # distance of the wall from the camera
    slope: float = 0.15  # how much brighter (1 = doubled) the left border is than the middle; clutter and gradient
    things: int = 14  # upright things: people, furniture, posters
    marks: int = 12  # flat things on the floor: rugs, papers, shadows, tape
    texture: float = 0.04  # sigma of blotches, radiance; clutter only

    def __post_init__(self):
        require_between(0.0, 10.0, wall=self.wall, floor=self.floor, texture=self.texture)
        require_positive(1e3, wall_m=self.wall_m)
        require_between(-1.0, 1.0, slope=self.slope)
        require_between(0, 1000, things=self.things, marks=self.marks)

    def radiance(self, camera: Camera, rng: np.random.Generator, nearest_m: float = 0.0) -> np.ndarray:
        """(H, W) float32 picture of the surroundings; nothing upright stands nearer than `nearest_m`."""
        shape = camera.lens.height_px, camera.lens.width_px
        if self.kind == "plain":
            return np.full(shape, self.wall, dtype=np.float32)
        room = _room(camera.lens, camera.mount.height_m, camera.mount.tilt_rad, self.wall, self.floor, self.wall_m)
        room = room * np.linspace(1 + self.slope, 1 - self.slope, shape[1], dtype=np.float32)
        if self.kind == "gradient":
            return room
        return draw_clutter(camera, room, self, max(nearest_m, 1.5), rng)


@lru_cache(maxsize=4)
def _room(lens: Lens, height_m: float, tilt_rad: float, wall: float, floor: float, wall_m: float) -> np.ndarray:
    """(H, W) float32 a round room: floor that fades with distance, and the wall where it ends."""
    corners = pixel_corners(lens)
    x, y = np.moveaxis((corners[1:, 1:] + corners[:-1, :-1]) / 2, -1, 0)
    forward = np.cos(tilt_rad) - np.sin(tilt_rad) * y
    up = -np.sin(tilt_rad) - np.cos(tilt_rad) * y
    slope = up / np.hypot(forward, x)  # tangent of the elevation
    pixel = 1.0 / lens.fy_px
    on_floor = np.clip((-height_m / wall_m - slope) / pixel + 0.5, 0, 1)  # one pixel wide at the wall's foot
    distance = height_m / np.maximum(-slope, height_m / wall_m)
    below = floor + (wall - floor) * distance / (distance + FLOOR_FADES_M)
    above = wall * (0.85 + 0.15 * np.cos(np.minimum(np.abs(slope) * 3, pi / 2)))
    room = (on_floor * below + (1 - on_floor) * above).astype(np.float32)
    room.setflags(write=False)
    return room
