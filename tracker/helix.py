"""The paper's target: a cylinder with a helical stripe, whose height along a generator tells the robot's heading.

From bottom to top the cylinder is: a light collar, a dark ring, the helix, a dark ring, a light collar. The pattern
ends where ring and collar meet (`bottom_m`, `top_m`). These two edges lie on the target itself, light against dark
all the way round, whatever is behind the robot. That makes range well-posed (where are the ends?) apart from heading
(where is the stripe between them?).

Heading and phase. Azimuth phi counts counter-clockwise from the robot's forward axis, seen from above. The lower edge
of stripe k climbs as a right-handed screw:

    z_k(phi) = helix_bottom_m + pitch_m * ((phi - start_rad) / 2 pi + k / stripes)

and the stripe is dark for `duty` of the vertical period pitch_m / stripes above it. An observer that sees the axis at
bearing beta sees the target, turned by the heading theta relative to the observer, along the generator that faces it:
phi = beta + pi - theta. So on the facing generator

    z_k = helix_bottom_m + pitch_m * ((beta + pi - theta - start_rad) / 2 pi + k / stripes)

A target that turns left by dtheta shows its stripes lower by pitch_m * dtheta / 2 pi. The picture repeats when theta
changes by 2 pi / stripes: with one stripe the heading is unique. A longer pitch moves further for the same turn, so it
measures heading better, until no edge is left between the rings; hence a pitch slightly shorter than the helix is high.
"""

from dataclasses import dataclass
from math import pi

import numpy as np

from coopslam.errors import BadInput, require_between, require_positive
from coopslam.se2 import Pose2, wrap
from tracker.target import Drum, Look, require_ends


@dataclass(frozen=True, slots=True)
class Helix:
    """A helix target on a robot. Heights are above the floor. Raises BadInput naming the field."""

    radius_m: float = 0.10
    bottom_m: float = 0.18  # lower end of the pattern: the lower ring's lower edge
    top_m: float = 0.48  # upper end of the pattern: the upper ring's upper edge
    pitch_m: float = 0.20  # rise of a stripe in one turn
    stripes: int = 1  # starts of the screw
    duty: float = 0.5  # dark share of the helix
    start_rad: float = 0.0  # azimuth at which stripe 0 leaves the lower ring
    ring_m: float = 0.04  # height of the dark rings at both ends; zero: none
    lower_collar_m: float = 0.06  # height of the light collar below the pattern; zero: none
    upper_collar_m: float = 0.03  # above it
    dark: float = 0.05  # reflectance
    light: float = 0.85
    forward_m: float = 0.0  # of the axis from the robot's reference point
    body: tuple[Drum, ...] = ()  # what else is seen of the robot

    def __post_init__(self):
        require_positive(10.0, radius_m=self.radius_m, pitch_m=self.pitch_m)
        require_ends(self.bottom_m, self.top_m)
        if not isinstance(self.stripes, int) or isinstance(self.stripes, bool) or not 1 <= self.stripes <= 100:
            raise BadInput(f"stripes: an integer from 1 to 100 expected, got {self.stripes}")
        require_between(0.01, 0.99, duty=self.duty)
        require_between(-2 * pi, 2 * pi, start_rad=self.start_rad)
        require_between(0.0, 10.0, ring_m=self.ring_m, upper_collar_m=self.upper_collar_m)
        if not 2 * self.ring_m < self.top_m - self.bottom_m:
            raise BadInput(f"ring_m: room for a helix between two rings expected, got {self.ring_m}")
        require_between(0.0, self.bottom_m, lower_collar_m=self.lower_collar_m)
        require_between(0.0, 1.0, dark=self.dark, light=self.light)
        if not self.dark < self.light:
            raise BadInput(f"light: more than dark ({self.dark:g}) expected, got {self.light}")
        require_between(-10.0, 10.0, forward_m=self.forward_m)

    @property
    def helix_bottom_m(self) -> float:
        """Where the helix begins."""
        return self.bottom_m + self.ring_m

    @property
    def helix_top_m(self) -> float:
        """Where it ends."""
        return self.top_m - self.ring_m

    @property
    def cylinder(self) -> Drum:
        """The cylinder with its collars, in the light colour."""
        bottom, top = self.bottom_m - self.lower_collar_m, self.top_m + self.upper_collar_m
        return Drum(self.radius_m, bottom, top, self.light, self.forward_m)

    @property
    def solids(self) -> tuple:
        """See Target."""
        return (self, *self.body)

    def phase(self, azimuth_rad, z_m):
        """Position in the vertical period, 0 to 1: zero at the lower edge of a stripe. Vectorised."""
        turns = (np.asarray(z_m) - self.helix_bottom_m) / self.pitch_m
        return (self.stripes * (turns - (np.asarray(azimuth_rad) - self.start_rad) / (2 * pi))) % 1.0

    def is_dark(self, azimuth_rad, z_m):
        """Whether the cylinder is dark at an azimuth (in the robot's body) and a height. Vectorised, exact edges."""
        z = np.asarray(z_m)
        on_helix = (z >= self.helix_bottom_m) & (z < self.helix_top_m)
        pattern = (z >= self.bottom_m) & (z < self.top_m)
        return pattern & (~on_helix | (self.phase(azimuth_rad, z) < self.duty))

    def reflectance(self, azimuth_rad, z_m):
        """Diffuse reflectance at an azimuth and a height. Vectorised."""
        return np.where(self.is_dark(azimuth_rad, z_m), self.dark, self.light)

    def edges(self, azimuth_rad: float) -> list[tuple[float, bool]]:
        """Edges of the helix on a generator, between the rings, from below: (height in metres, dark above it)."""
        period = self.pitch_m / self.stripes
        first = self.helix_bottom_m + self.pitch_m * (azimuth_rad - self.start_rad) / (2 * pi)
        found = []
        for start, dark_above in ((first, True), (first + self.duty * period, False)):
            lowest = start - period * np.floor((start - self.helix_bottom_m) / period)
            heights = np.arange(lowest, self.helix_top_m, period)
            found += [(float(z), dark_above) for z in heights if self.helix_bottom_m < z < self.helix_top_m]
        return sorted(found)

    def facing_azimuth_rad(self, T_observer_target: Pose2, camera_forward_m: float) -> float:
        """Azimuth (target's body) of the generator that faces a camera on the observer's forward axis."""
        camera = T_observer_target.transformTo(np.array([camera_forward_m, 0.0]))
        return float(wrap(np.arctan2(camera[1], camera[0] - self.forward_m)))

    def distances(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """See Solid."""
        return self.cylinder.distances(origin, directions)

    def look(self, points: np.ndarray) -> Look:
        """See Solid.  As the plain cylinder's, and patch 3 for what is dark."""
        plain = self.cylinder.look(points)
        azimuth = np.arctan2(points[1], points[0] - self.forward_m)
        dark = (plain.patch == 0) & self.is_dark(azimuth, points[2])
        return Look(plain.normals, np.where(dark, self.dark, self.light), np.where(dark, 3, plain.patch))

    def extent(self) -> np.ndarray:
        """See Solid."""
        return self.cylinder.extent()
