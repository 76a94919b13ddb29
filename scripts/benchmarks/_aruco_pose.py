"""What people do with a tag cube and a library: the largest tag's pose by cv2.aruco and IPPE, laid on the floor."""

import cv2
import numpy as np

from coopslam.se2 import Pose2
from tracker.data_sheet import DataSheet
from tracker.tag_cube import FAMILY

REFINEMENTS = {
    "none": cv2.aruco.CORNER_REFINE_NONE,
    "subpix": cv2.aruco.CORNER_REFINE_SUBPIX,  # the tag detector's
    "apriltag": cv2.aruco.CORNER_REFINE_APRILTAG,
}


def aruco_detector(refinement: str) -> cv2.aruco.ArucoDetector:
    """The library's detector of the cube's family with its default parameters, but for the corners."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = REFINEMENTS[refinement]
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(FAMILY), parameters)


class ArucoPose:
    """The library's pose of a robot that carries a tag cube, without a covariance and without doubts."""

    def __init__(self, sheet: DataSheet):
        self.camera, self.cube = sheet.camera, sheet.tag_cube
        self._aruco = aruco_detector("subpix")
        half = self.cube.tag_m / 2
        self._square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])

    def pose(self, image: np.ndarray) -> Pose2 | None:
        """T_observer_target from a (H, W) uint8 picture; None without a tag of the cube."""
        corners, ids, _ = self._aruco.detectMarkers(image)
        own = [] if ids is None else [k for k, tag in enumerate(ids.ravel()) if tag in self.cube.ids]
        if not own:
            return None
        largest = max(own, key=lambda k: cv2.contourArea(corners[k]))
        lens = self.camera.lens
        found, turn, shift = cv2.solvePnP(
            self._square, corners[largest], lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        if not found:
            return None
        T_camera_tag = np.eye(4)
        T_camera_tag[:3, :3], T_camera_tag[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        face = self.cube.ids.index(int(ids.ravel()[largest]))
        T_target_tag = np.eye(4)
        axes = self.cube.face_axes(face)
        T_target_tag[:3, :3], T_target_tag[:3, 3] = axes.T, self.cube.centre_body + self.cube.face_m / 2 * axes[2]
        T = self.camera.T_body_camera @ T_camera_tag @ np.linalg.inv(T_target_tag)
        return Pose2(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0]))
