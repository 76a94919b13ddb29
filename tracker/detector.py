"""What every detector of a robot in a picture has in common: what it returns, and as which record that is logged."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from coopslam.errors import BadInput
from coopslam.records import BearingRangeFix, RelativePoseFix
from coopslam.se2 import Pose2, position
from tracker.lens import Lens


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """The target robot as one picture shows it."""

    T_observer_target: Pose2  # in the body of the robot that carries the camera
    cov_observer: np.ndarray  # (3, 3); x, y, theta; x and y in the observer's axes
    heading_known: bool  # without, theta is a guess; x, y and their covariance hold whichever heading is true
    features_px: tuple[np.ndarray, ...] = ()  # polylines (N, 2) in pixels of what was found, for drawing

    def record(self, stamp_s: float, observer: str, target: str) -> RelativePoseFix | BearingRangeFix:
        """As a measurement; bearing and range alone where the heading is withheld."""
        if self.heading_known:
            return RelativePoseFix(stamp_s, observer, target, self.T_observer_target, self.cov_observer)
        x, y = position(self.T_observer_target)
        range_m = float(np.hypot(x, y))
        jacobian = np.array([[-y / range_m**2, x / range_m**2], [x / range_m, y / range_m]])
        cov = jacobian @ self.cov_observer[:2, :2] @ jacobian.T
        return BearingRangeFix(stamp_s, observer, target, float(np.arctan2(y, x)), range_m, (cov + cov.T) / 2)


class Detector(Protocol):
    """Finds one kind of target in the pictures of one camera."""

    def detect(self, image: np.ndarray) -> Detection | None:
        """The target in a (H, W) uint8 picture, None without any. Raises BadInput for another size or type."""


def require_picture(image: np.ndarray, lens: Lens) -> None:
    """Raises BadInput unless it is a grey picture of the lens's size."""
    size = (lens.height_px, lens.width_px)
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != size:
        got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise BadInput(f"image: a picture of uint8 {size} (rows, columns) expected, got {got}")
