"""From radiance to grey levels: blur of lens and motion, vignetting, gain, noise of the photons and of the read-out.

    grey = round(black_level + gain * vignette * mean(blur * radiance) + noise), clipped to 0 .. 255
    variance of the noise = (signal in electrons + read_noise_electrons^2) / electrons_per_level^2

The blur is applied to cells finer than pixels, the mean is over the cells of a pixel: light is blurred before it falls
on pixels. Linear, without gamma (the photon transfer model of Janesick 2007 and of the EMVA 1288 standard).
"""

from dataclasses import dataclass, field
from functools import lru_cache
from math import inf, pi

import cv2
import numpy as np

from coopslam.errors import BadInput, require_between
from tracker.antialias import CELLS

MOTION_STEPS_PER_CELL = 8  # of the line that a point draws while it moves


@dataclass(frozen=True, slots=True)
class Sensor:
    """How the picture is taken. Raises BadInput naming the field."""

    gain: float = 230.0  # grey levels of radiance 1
    black_level: float = 8.0  # grey level of darkness, so that its noise is not cut off
    electrons_per_level: float = field(default=40.0, metadata={"infinite": True})  # inf: no noise
    read_noise_electrons: float = 12.0
    vignetting: float = 0.15  # share of the light that is lost in the corners; grows with the square of the radius
    defocus_px: float = 0.6  # sigma of the point spread
    motion_px: float = 0.0  # length of the line that a point draws
    motion_rad: float = 0.0  # direction of that line in the picture, from right towards down

    def __post_init__(self):
        require_between(0.0, 1e4, gain=self.gain)
        require_between(0.0, 255.0, black_level=self.black_level)
        if not 0 < self.electrons_per_level <= inf:
            raise BadInput(f"electrons_per_level: more than zero expected, got {self.electrons_per_level}")
        require_between(0.0, 1e4, read_noise_electrons=self.read_noise_electrons)
        require_between(0.0, 1.0, vignetting=self.vignetting)
        require_between(0.0, 50.0, defocus_px=self.defocus_px)
        require_between(0.0, 200.0, motion_px=self.motion_px)
        require_between(-2 * pi, 2 * pi, motion_rad=self.motion_rad)

    def picture(self, radiance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(H, W) uint8 from (2 H, 2 W) float32 radiance of cells."""
        grey = self.exposed(radiance)
        if self.electrons_per_level < inf:
            signal = np.maximum(grey - np.float32(self.black_level), 0)
            read = (self.read_noise_electrons / self.electrons_per_level) ** 2
            sigma = np.sqrt(signal / np.float32(self.electrons_per_level) + np.float32(read))
            grey += sigma * rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(grey, out=grey), 0, 255, out=grey).astype(np.uint8)

    def exposed(self, radiance: np.ndarray) -> np.ndarray:
        """(H, W) float32 grey levels before noise, rounding and clipping; radiance as for `picture`."""
        blurred = radiance.astype(np.float32)
        if self.defocus_px > 0:
            sigma = CELLS * self.defocus_px
            kernel = cv2.getGaussianKernel(2 * int(np.ceil(4 * sigma)) + 1, sigma)
            blurred = cv2.sepFilter2D(blurred, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)
        if self.motion_px > 0:
            kernel = _line(CELLS * self.motion_px, self.motion_rad)
            blurred = cv2.filter2D(blurred, -1, kernel, borderType=cv2.BORDER_REFLECT)
        blurred = sum(blurred[i::CELLS, j::CELLS] for i in range(CELLS) for j in range(CELLS)) / np.float32(CELLS**2)
        if self.vignetting > 0:
            blurred = blurred * _vignette(blurred.shape, self.vignetting)
        return blurred * np.float32(self.gain) + np.float32(self.black_level)


def _line(length: float, direction_rad: float) -> np.ndarray:
    """Kernel of a centred line, in cells: each of its points is shared bilinearly between the four around it."""
    reach = int(np.ceil(length / 2)) + 1
    steps = max(2, int(np.ceil(length * MOTION_STEPS_PER_CELL)))
    along = ((np.arange(steps) + 0.5) / steps - 0.5) * length
    u, v = along * np.cos(direction_rad) + reach, along * np.sin(direction_rad) + reach
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    left, upper = np.floor(u).astype(int), np.floor(v).astype(int)
    for du, dv in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (1 - np.abs(u - left - du)) * (1 - np.abs(v - upper - dv))
        np.add.at(kernel, (upper + dv, left + du), share / steps)
    return kernel


@lru_cache(maxsize=4)
def _vignette(shape: tuple[int, int], loss: float) -> np.ndarray:
    """(H, W) float32 share of the light that arrives."""
    v, u = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
    aspect = (shape[0] / shape[1]) ** 2
    return (1 - loss * (u * u + v * v * aspect) / (1 + aspect)).astype(np.float32)
