"""Outer edges of the tags on a cube, where they should be in a picture; `tracker.edges.measure` finds where they are.

A tag has a black border one module wide on a white border of one module. Its four outer edges are straight, long and
without gaps, so they say more than the four corners, where every corner finder rounds off a little.
"""

import numpy as np

from coopslam.se2 import Pose2, position, rotation
from tracker.camera import Camera
from tracker.edges import ModelEdges, projected
from tracker.tag_cube import MODULES, SIDES, TagCube

KIND = 3  # beside tracker.edges.Kind: the side of a tag
POINTS = 16  # on a side
LEAST_COSINE = 0.25  # of the angle at which a face is seen


def tag_edges(camera: Camera, cube: TagCube, T: Pose2) -> ModelEdges:
    """Edges of the side faces' tags in view when the cube is at the pose T in the observer's body; maybe none.

    Names are 100 000 (face + 1) + 100 side + point.
    """
    R = np.eye(3)
    R[:2, :2] = rotation(T.theta())
    origin = np.array([*position(T), 0.0])
    parts = [_face(camera, cube, face, R, origin) for face in range(SIDES)]
    names, points, tangents, lights = (np.concatenate(each) for each in zip(*parts, strict=True))
    pixels, by_point = projected(camera, points)
    along, towards = (np.einsum("nij,nj->ni", by_point, each) for each in (tangents, lights))
    normals = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
    normals *= np.where(np.sum(towards * normals, axis=1) < 0, -1.0, 1.0)[:, None]
    moved = np.zeros((len(points), 3, 3))
    moved[:, 0, 0] = moved[:, 1, 1] = 1.0
    moved[:, 0, 2], moved[:, 1, 2] = T.y() - points[:, 1], points[:, 0] - T.x()
    by_pose = np.einsum("ni,nij,njk->nk", normals, by_point, moved)
    room = np.abs(np.sum(normals * towards, axis=1)) * cube.tag_m / MODULES
    kinds = np.full(len(names), KIND)
    every = ModelEdges(names, points, pixels, normals, by_pose, room, kinds, np.ones(len(names), bool))
    ahead = np.isfinite(pixels).all(axis=1)
    return every.where(ahead & camera.lens.contains(np.where(ahead[:, None], pixels, -1.0)))


def _face(camera: Camera, cube: TagCube, face: int, R: np.ndarray, origin: np.ndarray):
    """Names, points, tangents and directions to the light side of a face, in the observer's body; none from behind."""
    axes = cube.face_axes(face) @ R.T
    right, up, out = axes
    middle = R @ (cube.centre_body + cube.face_m / 2 * cube.face_axes(face)[2]) + origin
    away = camera.mount.position_body - middle
    if out @ away < LEAST_COSINE * np.linalg.norm(away):
        return np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3))
    share = (np.arange(POINTS) + 0.5) / POINTS - 0.5
    share = share * (1 - 2 / MODULES)  # a module away from the corners, which blur rounds off
    parts = []
    for side, (across, along) in enumerate(((up, right), (right, up), (-up, right), (-right, up))):
        points = middle + cube.tag_m * (0.5 * across + share[:, None] * along)
        names = 100_000 * (face + 1) + 100 * side + np.arange(POINTS)
        parts.append((names, points, np.tile(along, (POINTS, 1)), np.tile(across, (POINTS, 1))))
    return tuple(np.concatenate(each) for each in zip(*parts, strict=True))
