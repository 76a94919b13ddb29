"""What a place is recognized by: a map's corners with their joint covariance, its walls and its free triangles.

The covariance has to be the joint one of all corners: far apart they are known badly one by one and well relative to
each other, and that is what a match stands on. `dual_graph.json` holds it, up to some hundreds of corners.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from coopslam.estimation.estimate import Estimate
from coopslam.exploration.free_map import FreeMap
from coopslam.planning.map_graph import MapGraph
from coopslam.se2 import adjoint, wrap, xytheta

UNKNOWN = -1  # the other end of a wall that was not walked to it


@dataclass(frozen=True, slots=True, eq=False)
class CornerMap:
    """A map by index: corner k is vertex `ids[k]`. Its frame is that of an estimate, or that of a robot.

    Interior angles are as the finder measured them, all with the same sigma.
    """

    ids: tuple[int, ...]
    poses: np.ndarray  # (n, 3) x, y, heading of the leaving wall
    covariance: np.ndarray  # (n, 3, n, 3) joint; each corner in its own axes; m, m, rad
    interior_angles: np.ndarray  # (n,) rad
    angle_sigma_rad: float
    leaving: np.ndarray  # (n,) index of the corner at the end of the leaving wall, or UNKNOWN
    arriving: np.ndarray  # (n,) the same of the arriving wall's start
    triangles: np.ndarray  # (t, 3) indices, counter-clockwise
    gates: np.ndarray  # (g, 2) indices; unexplored space on their left
    is_complete: bool  # no gate is open: every corner of its world is in it

    @property
    def places(self) -> np.ndarray:
        """(n, 2) positions of the corners, m."""
        return self.poses[:, :2]

    def index(self, vertex: int) -> int:
        """Index of a vertex. Raises ValueError when there is none."""
        return self.ids.index(vertex)


def stored_corner_map(graph: MapGraph, angle_sigma_rad: float) -> CornerMap:
    """The map that a `dual_graph.json` holds, in its own frame.

    angle_sigma_rad: of an interior angle.  Raises BadInput when the file is without the joint covariance.
    """
    ids = tuple(graph.vertices)
    index = {vertex: k for k, vertex in enumerate(ids)}
    poses = np.array([graph.vertices[vertex].pose for vertex in ids]).reshape(-1, 3)
    to_body = rotations(-poses[:, 2])
    joint = graph.joint_covariance(ids).reshape(len(ids), 3, len(ids), 3)
    leaving, arriving = _wall_ends(index, graph.walls)
    return CornerMap(
        ids,
        poses,
        np.einsum("aij,ajbk,blk->aibl", to_body, joint, to_body),
        np.array([graph.vertices[vertex].interior_angle_rad for vertex in ids]),
        angle_sigma_rad,
        leaving,
        arriving,
        _indices(index, graph.triangles.values(), 3),
        _indices(index, graph.gates, 2),
        bool(graph.triangles) and not graph.gates,
    )


def corner_map(free_map: FreeMap, estimate: Estimate, angle_sigma_rad: float, robot: str | None = None) -> CornerMap:
    """The map as an estimate sees it, in the frame of the estimate, or of a robot's latest pose variable.

    In a robot's frame the covariance is relative to it: what the corners tell of where that robot is.
    angle_sigma_rad: of an interior angle.  Raises UnderDetermined when a corner has no estimate.
    """
    ids = tuple(free_map.fans)
    index = {vertex: k for k, vertex in enumerate(ids)}
    keys = [estimate.vertex_key(vertex) for vertex in ids]
    if robot is None:
        poses = [estimate.value(key) for key in keys]
        joint = estimate.joint_covariance(keys) if keys else np.zeros((0, 0))
    else:
        origin = estimate.pose_key(robot)
        poses = [estimate.value(origin).between(estimate.value(key)) for key in keys]
        by_origin = -np.vstack([adjoint(pose.inverse()) for pose in poses])
        jacobian = np.hstack([by_origin, np.eye(3 * len(keys))])
        joint = jacobian @ estimate.joint_covariance([origin, *keys]) @ jacobian.T
    leaving, arriving = _wall_ends(index, free_map.walls())
    return CornerMap(
        ids,
        np.array([xytheta(pose) for pose in poses]).reshape(-1, 3),
        joint.reshape(len(ids), 3, len(ids), 3),
        np.array([free_map.interior_angles[vertex] for vertex in ids]),
        angle_sigma_rad,
        leaving,
        arriving,
        _indices(index, free_map.triangles.values(), 3),
        _indices(index, sorted(free_map.gates), 2),
        bool(free_map.triangles) and not free_map.gates,
    )


def _wall_ends(index: Mapping[int, int], walls: Iterable[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    leaving, arriving = np.full((2, len(index)), UNKNOWN)
    for start, end in walls:
        leaving[index[start]], arriving[index[end]] = index[end], index[start]
    return leaving, arriving


def _indices(index: Mapping[int, int], groups: Iterable[tuple[int, ...]], size: int) -> np.ndarray:
    return np.array([[index[vertex] for vertex in group] for group in groups], dtype=int).reshape(-1, size)


def relative_poses(corners: CornerMap, origin: int, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k, 3) poses of corners in the axes of one of them, and their (k, 3, 3) covariances, each in its own axes."""
    here, there = corners.poses[origin], corners.poses[others]
    T = np.column_stack([turned(-here[2], there[:, :2] - here[:2]), wrap(there[:, 2] - here[2])])
    back = -inverse_adjoints(T)
    own = corners.covariance[others, :, others]
    cross = corners.covariance[origin][:, others].transpose(1, 0, 2)  # (k, 3 of the origin, 3 of each)
    mixed = back @ cross
    cov = back @ corners.covariance[origin, :, origin] @ back.transpose(0, 2, 1)
    return T, cov + mixed + mixed.transpose(0, 2, 1) + own


def turned(angles, vectors: np.ndarray) -> np.ndarray:
    """(k, 2) vectors turned counter-clockwise by one angle, or by one each."""
    c, s = np.cos(angles), np.sin(angles)
    return np.column_stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]])


def rotations(angles: np.ndarray) -> np.ndarray:
    """(k, 3, 3) `planar_rotation` of each angle."""
    matrices = np.zeros((len(angles), 3, 3))
    matrices[:, 0, 0] = matrices[:, 1, 1] = np.cos(angles)
    matrices[:, 1, 0] = np.sin(angles)
    matrices[:, 0, 1] = -matrices[:, 1, 0]
    matrices[:, 2, 2] = 1.0
    return matrices


def inverse_adjoints(poses: np.ndarray) -> np.ndarray:
    """(k, 3, 3) `adjoint` of the inverse of each (k, 3) pose: Ad(T^-1) = Ad(T)^-1."""
    matrices = rotations(-poses[:, 2])
    back = turned(-poses[:, 2], poses[:, :2])
    matrices[:, 0, 2], matrices[:, 1, 2] = -back[:, 1], back[:, 0]
    return matrices
