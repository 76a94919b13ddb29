"""Where a robot may be by the corners of its tags alone: every minimum of the reprojection error over x, y, heading.

The robot stands on the floor, so height, roll and pitch are known. What is left of the two poses of a single square
(Schweighofer and Pinz 2006) are two headings, mirrored about the line of sight; several starts find both.
"""

from dataclasses import dataclass

import numpy as np

from coopslam.se2 import rotation, wrap
from tracker.camera import Camera
from tracker.tag_cube import TOP, TagCube

SLANTS_RAD = np.radians([-70.0, -45.0, -20.0, 0.0, 20.0, 45.0, 70.0])  # of a face against the line of sight, to start
STEPS = 12  # of Levenberg-Marquardt; from the nearest start five are enough
SAME_RAD = 0.01  # headings closer than this are one minimum


@dataclass(frozen=True, slots=True, eq=False)
class Tag:
    """One tag in a picture."""

    face: int
    corners_px: np.ndarray  # (4, 2) in cv2.aruco's order: clockwise from the upper left
    corners: np.ndarray  # (4, 2) the same as normalised points


@dataclass(frozen=True, slots=True, eq=False)
class CornerFit:
    """A minimum of the reprojection error."""

    pose: np.ndarray  # (3,) x, y, theta of the target in the observer's body
    cost_px: float  # sum of squares over all corners, pixels^2


def corner_minima(camera: Camera, cube: TagCube, tags: list[Tag]) -> list[CornerFit]:
    """All minima that some start leads to, the best first."""
    points = np.concatenate([_corners_of(cube, tag.face) for tag in tags])
    seen = np.concatenate([tag.corners for tag in tags])
    largest = max(tags, key=lambda tag: np.ptp(tag.corners[:, 1]))
    poses, costs = _descend(camera, points, seen, _starts(camera, cube, largest))
    found: list[CornerFit] = []
    for k in np.argsort(costs):
        if np.isfinite(costs[k]) and all(abs(wrap(poses[k, 2] - other.pose[2])) > SAME_RAD for other in found):
            found.append(CornerFit(poses[k], float(costs[k])))
    return found


def _corners_of(cube: TagCube, face: int) -> np.ndarray:
    return cube.corners()[cube.ids[face]]


def _starts(camera: Camera, cube: TagCube, tag: Tag) -> np.ndarray:
    """(S, 3) poses that show the tag's middle where it is, at the distance at which its sides are so long.

    A side face looks towards the camera; the top face may be turned by any angle.
    """
    sides = [np.hypot(*(tag.corners[i] - tag.corners[j])) for i, j in ((0, 3), (1, 2))]
    lengths = sides if tag.face != TOP else [np.hypot(*(tag.corners[i] - tag.corners[i - 1])) for i in range(4)]
    depth = cube.tag_m / max(lengths)
    ray = camera.mount.R_body_camera @ [*tag.corners.mean(axis=0), 1.0]
    middle = (camera.mount.position_body + depth * ray)[:2]
    if tag.face == TOP:
        headings = np.arange(8) * (np.pi / 4)
    else:
        out = cube.face_axes(tag.face)[2]
        headings = np.arctan2(-ray[1], -ray[0]) + SLANTS_RAD - np.arctan2(out[1], out[0])
    face_middle = _corners_of(cube, tag.face).mean(axis=0)[:2]
    return np.array([[*(middle - rotation(heading) @ face_middle), heading] for heading in headings])


def _descend(camera: Camera, points: np.ndarray, seen: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S, 3) poses and (S,) costs after Levenberg-Marquardt from each of the starts, all at once."""
    damping = np.full(len(poses), 1e-3)
    residual, jacobian = reprojection(camera, points, seen, poses)
    cost = np.sum(residual**2, axis=1)
    for _ in range(STEPS):
        normal = np.einsum("sni,snj->sij", jacobian, jacobian)
        gradient = np.einsum("sni,sn->si", jacobian, residual)
        diagonal = np.einsum("sii->si", normal)
        normal = normal + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(3)
        tried = poses - np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        residual_tried, jacobian_tried = reprojection(camera, points, seen, tried)
        cost_tried = np.sum(residual_tried**2, axis=1)
        better = cost_tried < cost
        poses = np.where(better[:, None], tried, poses)
        residual = np.where(better[:, None], residual_tried, residual)
        jacobian = np.where(better[:, None, None], jacobian_tried, jacobian)
        cost = np.where(better, cost_tried, cost)
        damping = np.where(better, damping / 10, damping * 10)
    return poses, cost


def reprojection(camera: Camera, points, seen, poses) -> tuple[np.ndarray, np.ndarray]:
    """(S, 2 N) reprojection errors in undistorted pixels, and their (S, 2 N, 3) derivative; huge behind the camera."""
    lens, R = camera.lens, camera.mount.R_body_camera
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]  # (S, N)
    away = [poses[:, :1] - camera.mount.position_body[0], poses[:, 1:2] - camera.mount.position_body[1]]
    body = np.stack([x + away[0], y + away[1], np.broadcast_to(points[:, 2] - camera.mount.height_m, x.shape)], axis=-1)
    right, down, depth = np.moveaxis(body @ R, -1, 0)
    behind = depth < 1e-3
    depth = np.where(behind, 1e-3, depth)
    u, v = right / depth, down / depth
    moved = np.zeros((*x.shape, 3, 3))  # derivative of the point in the body by x, y, theta
    moved[..., 0, 0] = moved[..., 1, 1] = 1.0
    moved[..., 0, 2], moved[..., 1, 2] = -y, x
    camera_moved = np.einsum("ij,snik->snjk", R, moved)
    du = lens.fx_px * (camera_moved[..., 0, :] - u[..., None] * camera_moved[..., 2, :]) / depth[..., None]
    dv = lens.fy_px * (camera_moved[..., 1, :] - v[..., None] * camera_moved[..., 2, :]) / depth[..., None]
    residual = np.concatenate([lens.fx_px * (u - seen[:, 0]), lens.fy_px * (v - seen[:, 1])], axis=1)
    residual = np.where(np.concatenate([behind, behind], axis=1), 1e4, residual)
    return residual, np.concatenate([du, dv], axis=1)
