"""A camera on a robot: where it is mounted, which pixel sees what.

Robot body: x forward, y left, z up, origin on the floor under the robot's reference point. Camera axes as OpenCV.
"""

from dataclasses import dataclass, replace
from math import cos, pi, sin

import numpy as np

from coopslam.errors import require_between, require_positive
from tracker.lens import Lens

NEAREST_M = 1e-6  # in front of the camera, along its axis; what is closer has no picture


@dataclass(frozen=True, slots=True)
class Mount:
    """Where the camera sits and looks. The floor is level and so is the picture's horizontal."""

    height_m: float  # of the optical centre above the floor
    tilt_rad: float = 0.0  # of the optical axis below the horizontal
    forward_m: float = 0.0  # of the optical centre from the robot's reference point
    yaw_rad: float = 0.0  # of the optical axis to the left of the robot's forward axis

    def __post_init__(self):
        require_positive(100.0, height_m=self.height_m)
        require_between(-0.49 * pi, 0.49 * pi, tilt_rad=self.tilt_rad)
        require_between(-10.0, 10.0, forward_m=self.forward_m)
        require_between(-2 * pi, 2 * pi, yaw_rad=self.yaw_rad)

    @property
    def position_body(self) -> np.ndarray:
        """(3,) optical centre in the robot's body, m."""
        return np.array([self.forward_m, 0.0, self.height_m])

    @property
    def R_body_camera(self) -> np.ndarray:
        """(3, 3) camera axes (right, down, along the axis) as columns in the robot's body."""
        ct, st, cy, sy = cos(self.tilt_rad), sin(self.tilt_rad), cos(self.yaw_rad), sin(self.yaw_rad)
        return np.array([[sy, -st * cy, ct * cy], [-cy, -st * sy, ct * sy], [0.0, -ct, -st]])


@dataclass(frozen=True, slots=True)
class Camera:
    """A lens on its mount."""

    lens: Lens
    mount: Mount

    @property
    def T_body_camera(self) -> np.ndarray:
        """(4, 4) rigid transform from camera axes to the robot's body."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.mount.R_body_camera, self.mount.position_body
        return T

    def panned(self, yaw_rad: float) -> "Camera":
        """The same camera, looking that far to the left of the robot's forward axis."""
        return replace(self, mount=replace(self.mount, yaw_rad=yaw_rad))

    def project(self, points_body: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2) pixels of (N, 3) points in the body, and (N,) which of them lie in the picture.

        Pixels are NaN for what is behind the camera or beyond the radius at which the distortion folds back.
        """
        points = (np.asarray(points_body, dtype=float).reshape(-1, 3) - self.mount.position_body) @ (
            self.mount.R_body_camera
        )
        ahead = points[:, 2] > NEAREST_M
        depth = np.where(ahead, points[:, 2], np.nan)
        pixels = self.lens.pixels(points[:, :2] / depth[:, None])
        return pixels, ahead & self.lens.contains(pixels)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """(N, 3) unit directions in the body that (N, 2) pixels see, undistorted; NaN where the lens images nothing."""
        normalised = self.lens.normalised(np.asarray(pixels, dtype=float).reshape(-1, 2))
        directions = np.column_stack([normalised, np.ones(len(normalised))])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return directions @ self.mount.R_body_camera.T
