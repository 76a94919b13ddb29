"""What a camera can look at: solids on a robot, which rays meet them, how their surface looks.

Everything is in the target robot's body: x forward, y left, z up, origin on the floor under its reference point.
Arrays of points and directions are (3, N), so that each coordinate is contiguous.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from coopslam.errors import BadInput, require_between, require_positive

RIM_SIDES = 64  # of the polygon that stands for a circle when a target's extent is asked
ON_SURFACE = 1e-9  # relative; nearer to the surface than that is on it


class Look(NamedTuple):
    """How a surface looks at N points."""

    normals: np.ndarray  # (3, N) outward unit normals
    reflectance: np.ndarray  # (N,) diffuse, 0 to 1
    patch: np.ndarray  # (N,) 0 to 15: which smooth patch; two of them have an edge between them


class Solid(Protocol):
    """A convex solid."""

    def distances(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(N,) multiples of the (3, N) directions at which rays from the (3,) origin enter; inf for a miss."""

    def look(self, points: np.ndarray) -> Look:
        """How it looks at (3, N) points of its surface."""

    def extent(self) -> np.ndarray:
        """(M, 3) points whose convex hull holds the solid."""


class Target(Protocol):
    """What the tracker looks for on the other robot."""

    @property
    def solids(self) -> tuple[Solid, ...]:
        """Everything that is seen of the robot; the marked solid comes first."""


@dataclass(frozen=True, slots=True)
class Drum:
    """An upright cylinder in one colour: base, mast or housing of a robot."""

    radius_m: float
    bottom_m: float  # above the floor
    top_m: float
    reflectance: float
    forward_m: float = 0.0  # of its axis from the robot's reference point

    def __post_init__(self):
        require_positive(10.0, radius_m=self.radius_m)
        require_ends(self.bottom_m, self.top_m)
        require_between(0.0, 1.0, reflectance=self.reflectance)
        require_between(-10.0, 10.0, forward_m=self.forward_m)

    def distances(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """See Solid.  Quadratic equation of the mantle, plane of the end that faces the origin."""
        ox, oy, oz = origin[0] - self.forward_m, origin[1], origin[2]
        dx, dy, dz = directions
        with np.errstate(divide="ignore", invalid="ignore"):  # a ray along the axis misses the mantle
            a, b = dx * dx + dy * dy, ox * dx + oy * dy
            discriminant = b * b - a * (ox * ox + oy * oy - self.radius_m**2)
            mantle = (-b - np.sqrt(discriminant)) / a
            z = oz + mantle * dz
            best = np.where((mantle > 0) & (z >= self.bottom_m) & (z <= self.top_m), mantle, np.inf)
            if self.bottom_m <= oz <= self.top_m:
                return best
            end = ((self.top_m if oz > self.top_m else self.bottom_m) - oz) / dz
            inside = (ox + end * dx) ** 2 + (oy + end * dy) ** 2 <= self.radius_m**2
        return np.where((end > 0) & inside, np.minimum(end, best), best)

    def look(self, points: np.ndarray) -> Look:
        """See Solid.  Patch 0 is the mantle, 1 and 2 are the lower and upper end."""
        x, y, z = (points[0] - self.forward_m) / self.radius_m, points[1] / self.radius_m, points[2]
        mantle = x * x + y * y > 1 - ON_SURFACE
        upper = z > (self.bottom_m + self.top_m) / 2
        normals = np.where(mantle, np.stack([x, y, np.zeros_like(z)]), 0.0)
        normals[2] = np.where(mantle, 0.0, np.where(upper, 1.0, -1.0))
        return Look(normals, np.full(len(z), self.reflectance), np.where(mantle, 0, np.where(upper, 2, 1)))

    def extent(self) -> np.ndarray:
        """See Solid: two polygons around its ends."""
        angle = np.arange(RIM_SIDES) * (2 * np.pi / RIM_SIDES)
        radius = self.radius_m / np.cos(np.pi / RIM_SIDES)
        x, y = self.forward_m + radius * np.cos(angle), radius * np.sin(angle)
        return np.concatenate([np.column_stack([x, y, np.full(RIM_SIDES, z)]) for z in (self.bottom_m, self.top_m)])


def require_ends(bottom_m: float, top_m: float) -> None:
    """Raises BadInput unless zero <= bottom_m < top_m."""
    require_between(0.0, 100.0, bottom_m=bottom_m)
    if not bottom_m < top_m <= 100.0:
        raise BadInput(f"top_m: more than bottom_m ({bottom_m:g}) expected, and at most 100, got {top_m}")
