"""How bright a surface is: one distant light and ambient light on diffuse surfaces (Lambert's law)."""

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np

from coopslam.errors import require_between


@dataclass(frozen=True, slots=True)
class Light:
    """Light on the scene. Irradiance 1 on a reflectance of 1 is radiance 1. Raises BadInput naming the field."""

    ambient: float = 0.5  # irradiance from everywhere
    direct: float = 0.5  # irradiance from the light on a surface that faces it
    azimuth_rad: float = 2.5  # towards the light, counter-clockwise from the observer's forward axis; pi: behind it
    elevation_rad: float = 0.7  # of the light above the horizontal

    def __post_init__(self):
        require_between(0.0, 100.0, ambient=self.ambient, direct=self.direct)
        require_between(-2 * pi, 2 * pi, azimuth_rad=self.azimuth_rad)
        require_between(-pi / 2, pi / 2, elevation_rad=self.elevation_rad)

    def direction(self, frame_heading_rad: float = 0.0) -> np.ndarray:
        """(3,) unit vector towards the light, in axes turned by that heading against the observer's body."""
        azimuth = self.azimuth_rad - frame_heading_rad
        level = cos(self.elevation_rad)
        return np.array([level * cos(azimuth), level * sin(azimuth), sin(self.elevation_rad)])

    def irradiance(self, normals: np.ndarray, frame_heading_rad: float = 0.0) -> np.ndarray:
        """(N,) irradiance of surfaces with (3, N) unit normals, in axes turned by it: E = a + d max(0, n l)."""
        return self.ambient + self.direct * np.maximum(self.direction(frame_heading_rad) @ normals, 0.0)
