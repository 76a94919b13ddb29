"""The line of sight of every pixel, level by level of an image pyramid, in the observer's body."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from tracker.camera import Camera

BLUR_PX = 0.9  # of lens and motion, before it is seen
PIXEL_VARIANCE = 1 / 12  # of a pixel's square


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Lines of sight of the pixels of one level; (H, W) float32 each. A ray climbs `climb` per metre over the floor."""

    azimuth: np.ndarray  # rad, in the observer's body
    climb: np.ndarray  # tangent of the elevation
    forward: np.ndarray  # cosine of the azimuth
    left: np.ndarray  # its sine
    turn_sq: np.ndarray  # squared length of the azimuth's gradient, rad^2 / px^2
    climb_sq: np.ndarray  # of the climb's
    cross: np.ndarray  # product of the two gradients


@lru_cache(maxsize=16)
def sight_of(camera: Camera, level: int) -> Sight:
    """Pixel (u, v) of level l lies at (u, v) 2^l in the picture. NaN where nothing is imaged.

    A smeared edge lies where the mean over the blur along the edge is: lines of one azimuth run down the picture,
    lines of one climb across it, and to second order that mean is in these fields.
    """
    width, height = (-(-size // 2**level) for size in (camera.lens.width_px, camera.lens.height_px))
    u, v = (np.arange(size) * 2.0**level for size in (width, height))
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1)).reshape(height, width, 3)
    level_length = np.hypot(rays[..., 0], rays[..., 1])
    forward, left, climb = rays[..., 0] / level_length, rays[..., 1] / level_length, rays[..., 2] / level_length
    azimuth = np.unwrap(np.unwrap(np.arctan2(left, forward), axis=1), axis=0)
    turns, climbs = np.gradient(azimuth), np.gradient(climb)
    turn_sq, climb_sq = turns[0] ** 2 + turns[1] ** 2, climbs[0] ** 2 + climbs[1] ** 2
    cross = turns[0] * climbs[0] + turns[1] * climbs[1]
    azimuth, climb = (each + _bend(each, axis) * usual_blur(level) / 2 for each, axis in ((azimuth, 0), (climb, 1)))
    fields = azimuth, climb, forward, left, turn_sq, climb_sq, cross
    return Sight(*(np.ascontiguousarray(field, dtype=np.float32) for field in fields))


def _bend(field: np.ndarray, axis: int) -> np.ndarray:
    """(H, W) second derivative down (0) or across (1) the picture."""
    return np.gradient(np.gradient(field, axis=axis), axis=axis)


def usual_blur(level: int) -> float:
    """Variance of all blur at a level, of lens, motion, pixels and pyramid; in pixels of the level."""
    return (BLUR_PX**2 + PIXEL_VARIANCE) / 4**level + pyramid_variance(level)


def pyramid_of(image: np.ndarray, levels: int) -> list[np.ndarray]:
    """A picture, and each time half of it (Burt and Adelson 1983): smoothed by (1 4 6 4 1) / 16, every second pixel."""
    found = [image]
    for _ in range(levels - 1):
        found.append(cv2.pyrDown(found[-1]))
    return found


def pyramid_variance(level: int) -> float:
    """Variance of the smoothing that a level's pixel has undergone, in its own pixels: 1 px^2 at each halving."""
    return (1 - 0.25**level) / 3


@lru_cache(maxsize=16)
def pyramid_noise(level: int) -> float:
    """Variance of the mean of many pixels of a level, over that of as many independent ones; 1 at level 0.

    The picture's noise is independent; smoothing keeps the mean of many pixels, but takes most of their scatter.
    """
    kernel, row = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16, np.ones(1)
    for step in range(level):
        spread = np.zeros(4 * 2**step + 1)
        spread[:: 2**step] = kernel
        row = np.convolve(row, spread)
    return float((0.5**level / np.sum(row**2)) ** 2)
