"""What happens behind the lens: a pinhole with OpenCV's distortion, between directions and pixels.

Camera axes as OpenCV: z along the optical axis, x right, y down. A normalised point is (x, y) of the direction
(x, y, 1). Pixel centres have integer coordinates, so the picture covers [-0.5, width - 0.5] x [-0.5, height - 0.5].
Distortion is the model of Brown (1971) with OpenCV's names: radial k1, k2, k3, tangential p1, p2.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import inf

import numpy as np

from coopslam.errors import BadInput, require_between, require_positive

MOST_PX = 20_000  # of a side of the picture
NEWTON_STEPS = 20
CONVERGED = 1e-12  # of a normalised coordinate; 1e-9 pixels


@dataclass(frozen=True, slots=True)
class Lens:
    """Size of the picture, focal lengths, principal point (pixels) and distortion. Raises BadInput naming the field."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self):
        for name in ("width_px", "height_px"):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or not 2 <= value <= MOST_PX:
                raise BadInput(f"{name}: an integer from 2 to {MOST_PX} expected, got {value}")
        require_positive(1e6, fx_px=self.fx_px, fy_px=self.fy_px)
        require_between(-0.5, self.width_px - 0.5, cx_px=self.cx_px)
        require_between(-0.5, self.height_px - 0.5, cy_px=self.cy_px)
        require_between(-10.0, 10.0, k1=self.k1, k2=self.k2, p1=self.p1, p2=self.p2, k3=self.k3)
        if not np.isfinite(self.normalised(self._border())).all():
            raise BadInput("k1: a distortion that can be undone in the whole picture expected; it folds at the border")

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) camera matrix K, as cv2 wants it."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1]])

    @property
    def distortion(self) -> np.ndarray:
        """(5,) k1, k2, p1, p2, k3, as cv2 wants it."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def pixels(self, normalised: np.ndarray) -> np.ndarray:
        """(..., 2) pixels of (..., 2) normalised points; NaN beyond the radius at which the distortion folds back."""
        x, y = np.moveaxis(np.asarray(normalised, dtype=float), -1, 0)
        xd, yd = self._distorted(x, y)
        pixels = np.stack([self.fx_px * xd + self.cx_px, self.fy_px * yd + self.cy_px], axis=-1)
        pixels[x * x + y * y >= _fold(self)] = np.nan
        return pixels

    def normalised(self, pixels: np.ndarray) -> np.ndarray:
        """(..., 2) normalised points of (..., 2) pixels, by Newton's method; NaN where no direction is imaged."""
        pixels = np.asarray(pixels, dtype=float)
        xd = (pixels[..., 0] - self.cx_px) / self.fx_px
        yd = (pixels[..., 1] - self.cy_px) / self.fy_px
        x, y, step = xd.copy(), yd.copy(), inf
        with np.errstate(all="ignore"):  # what diverges becomes NaN below
            for _ in range(NEWTON_STEPS):
                dx, dy = self._newton_step(x, y, xd, yd)
                x, y = x - dx, y - dy
                step = np.maximum(np.abs(dx), np.abs(dy))
                if not (step > CONVERGED).any():
                    break
            lost = ~((step <= CONVERGED) & (x * x + y * y < _fold(self)))
        x[lost], y[lost] = np.nan, np.nan
        return np.stack([x, y], axis=-1)

    def contains(self, pixels: np.ndarray) -> np.ndarray:
        """(...,) whether (..., 2) pixels lie in the picture."""
        u, v = np.moveaxis(np.asarray(pixels), -1, 0)
        return (u >= -0.5) & (u <= self.width_px - 0.5) & (v >= -0.5) & (v <= self.height_px - 0.5)

    def _distorted(self, x, y):
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        xd = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return xd, yd

    def _newton_step(self, x, y, xd, yd):
        """The step that the linearized distortion asks for; its (2, 2) Jacobian is symmetric."""
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2 * (self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3))
        xx = radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x
        yy = radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x
        xy = slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y
        x_now, y_now = self._distorted(x, y)
        ex, ey = x_now - xd, y_now - yd
        determinant = xx * yy - xy * xy
        return (yy * ex - xy * ey) / determinant, (xx * ey - xy * ex) / determinant

    def _border(self) -> np.ndarray:
        """(N, 2) pixels around the picture."""
        u, v = np.linspace(-0.5, self.width_px - 0.5, 33), np.linspace(-0.5, self.height_px - 0.5, 33)
        sides = [(u, v[0]), (u, v[-1]), (u[0], v), (u[-1], v)]
        return np.concatenate([np.stack(np.broadcast_arrays(*side), axis=-1) for side in sides])


@lru_cache(maxsize=64)
def _fold(lens: Lens) -> float:
    """Square of the normalised radius up to which the radial distortion grows."""
    roots = np.roots([7 * lens.k3, 5 * lens.k2, 3 * lens.k1, 1.0])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min()) if len(real) else inf


@lru_cache(maxsize=4)
def pixel_corners(lens: Lens) -> np.ndarray:
    """(height + 1, width + 1, 2) normalised points of the corners of all pixels; computed once for a lens.

    Within a pixel the inverse distortion is bilinear to 2e-4 pixels for a lens that bends no more than those of the
    data sheets (tested), so this array is all that a renderer needs to know of the lens.
    """
    u, v = np.meshgrid(np.arange(lens.width_px + 1) - 0.5, np.arange(lens.height_px + 1) - 0.5)
    corners = lens.normalised(np.stack([u, v], axis=-1))
    corners.setflags(write=False)
    return corners
