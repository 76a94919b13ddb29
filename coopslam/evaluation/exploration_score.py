"""What a finished exploration is worth against the truth: its triangulation, its vertices, its trajectories."""

from dataclasses import dataclass

import gtsam
import numpy as np
import shapely

from coopslam.errors import UnderDetermined
from coopslam.estimation.estimate import Estimate, Trajectory
from coopslam.evaluation.bound import bound_rmse_aligned
from coopslam.evaluation.consistency import position_nees, trajectory_nees
from coopslam.evaluation.trajectory_error import interpolate_se2, trajectory_error, vertex_rmse
from coopslam.evaluation.triangulation import judge
from coopslam.exploration.free_map import FreeMap
from coopslam.se2 import Pose2, position


@dataclass(frozen=True, slots=True, eq=False)
class ExplorationTruth:
    """What really was, in the world's frame; the only door through which it reaches evaluation and figures."""

    corners: list[Pose2]  # of the world: position, heading of the wall that leaves
    polygon: shapely.Polygon
    triangles_expected: int
    tracks: dict[str, Trajectory]
    corner_of: dict[int, int]  # map vertex -> index into corners, by its first sighting
    misnamed: int  # sightings that were taken for a vertex which is another corner

    @property
    def points(self) -> np.ndarray:
        """(n, 2) positions of the corners, m."""
        return np.array([position(corner) for corner in self.corners])


def score_triangulation(free_map: FreeMap, truth: ExplorationTruth) -> dict:
    """Figures of the triangulation on the true vertices, which need no estimate.

    A true triangulation names distinct real corners, and each of its triangles is free.
    """
    triangles = [tuple(truth.corner_of[v] for v in vertices) for vertices in free_map.triangles.values()]
    distinct = len(set(truth.corner_of.values())) == len(truth.corner_of) and truth.misnamed == 0
    covered, overlap, free = judge(triangles, truth.points, truth.polygon)
    return {
        "triangles_expected": truth.triangles_expected,
        "true_area_m2": truth.polygon.area,
        "covered_fraction": covered,
        "overlap_fraction": overlap,
        "true_triangulation": bool(distinct and free),
    }


def score_vertices(free_map: FreeMap, estimate: Estimate, truth: ExplorationTruth) -> dict:
    """Errors and honesty of the map's vertices. Raises UnderDetermined when there is none."""
    vertices = list(free_map.fans)
    if not vertices:
        raise UnderDetermined("no vertex was found")
    where = np.array([position(estimate.vertex(v)) for v in vertices])
    really = truth.points[[truth.corner_of[v] for v in vertices]]
    T_start_world = _start(estimate, truth).inverse()
    anchored = np.array([T_start_world.transformFrom(point) for point in really])
    covs = np.array([estimate.vertex_belief(v).position_covariance for v in vertices])
    return {
        "vertex_rmse_m": vertex_rmse(where, really) if len(vertices) > 1 else 0.0,
        "vertex_nees_mean": float(position_nees(where, covs, anchored).mean()),
    }


def score_trajectories(estimate: Estimate, truth: ExplorationTruth, bound_rmse_m: float | None) -> dict:
    """Errors and honesty of one estimator over all its poses of all robots."""
    trajectories = {robot: estimate.trajectory(robot) for robot in estimate.robots}
    error = trajectory_error(trajectories, truth.tracks)
    nees = np.concatenate(list(trajectory_nees(trajectories, truth.tracks, estimate.robots[0]).values()))
    return {
        "ate_rmse_m": error.ate_rmse_m,
        "heading_rmse_rad": error.heading_rmse_rad,
        "nees_mean": float(nees.mean()),
        "crlb_ratio": error.ate_rmse_m / bound_rmse_m if bound_rmse_m else None,
    }


def causal_ate_rmse_m(estimate: Estimate, truth: ExplorationTruth) -> float:
    """Error of every pose as it was known when it was made."""
    causal = {robot: estimate.causal_trajectory(robot) for robot in estimate.robots}
    return trajectory_error(causal, truth.tracks).ate_rmse_m


def bound_on_ate(graph: gtsam.NonlinearFactorGraph, estimate: Estimate, truth: ExplorationTruth) -> float:
    """Cramer-Rao bound on the error of all poses after one alignment, m: the graph linearized at truth."""
    T_start_world = _start(estimate, truth).inverse()
    values, keys = gtsam.Values(), []
    for robot in estimate.robots:
        track = truth.tracks[robot]
        poses = interpolate_se2(track.stamps_s, track.poses, _stamps(estimate, robot))
        for key, pose in zip(estimate.timeline.tracks[robot].keys, poses, strict=True):
            values.insert(key, T_start_world * pose)
            keys.append(key)
    for vertex in estimate.vertices:
        values.insert(estimate.vertex_key(vertex), T_start_world * truth.corners[truth.corner_of[vertex]])
    return bound_rmse_aligned(graph, values, keys)


def _start(estimate: Estimate, truth: ExplorationTruth) -> Pose2:
    """True start pose of the first robot in the world: the origin of the estimate."""
    first = estimate.robots[0]
    track = truth.tracks[first]
    if not estimate.timeline.tracks[first].keys:
        raise UnderDetermined(f"{first} has no pose")
    return interpolate_se2(track.stamps_s, track.poses, _stamps(estimate, first)[:1])[0]


def _stamps(estimate: Estimate, robot: str) -> np.ndarray:
    """(N,) s, of all pose variables of a robot."""
    return np.array([estimate.timeline.stamps[key] for key in estimate.timeline.tracks[robot].keys])
