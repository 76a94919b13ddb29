"""The Cramer-Rao bound: the covariance of the same graph linearized at truth. No unbiased estimator does better."""

from collections.abc import Sequence

import gtsam
import numpy as np

from coopslam.errors import BadInput
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.graph_check import check
from coopslam.estimation.ordering import nested_dissection
from coopslam.se2 import position, rotation


def bound_rmse_aligned(graph: gtsam.NonlinearFactorGraph, truth: gtsam.Values, position_keys: Sequence[int]) -> float:
    """Least root mean squared position error, m, of the keys after one SE(2) alignment.

    truth: the true `Pose2` of all variables, in the frame of the graph's prior.
    To first order the alignment removes the part of the stacked position error e that lies along the three
    rigid motions, so E|e'|^2 = trace((I - P) Sigma) with P their projector: the trace comes from marginals,
    that of P Sigma from one solve for each motion. The joint covariance is never formed.
    """
    if len(position_keys) < 2:
        raise BadInput(f"an alignment of {len(position_keys)} positions leaves no error to bound; 2 or more expected")
    check(graph, truth)
    covariances = Covariances(graph, truth)
    total = sum(np.trace(covariances.marginal(key)[:2, :2]) for key in position_keys)
    linear = graph.linearize(truth)
    factor = linear.eliminateSequential(nested_dissection(linear), gtsam.EliminateQR)
    removed = sum(_variance_along(factor, truth, motion) for motion in _rigid_motions(truth, position_keys))
    return float(np.sqrt(max(total - removed, 0.0) / len(position_keys)))


def _rigid_motions(truth: gtsam.Values, keys: Sequence[int]) -> list[dict[int, np.ndarray]]:
    """Three orthonormal directions of the stacked positions: key -> (3,) in the axes of its own pose."""
    poses = [truth.atPose2(key) for key in keys]
    points = np.array([position(pose) for pose in poses])
    arms = points - points.mean(axis=0)
    turn = np.stack([-arms[:, 1], arms[:, 0]], axis=1)
    directions = [np.tile([1.0, 0.0], (len(keys), 1)), np.tile([0.0, 1.0], (len(keys), 1)), turn]
    if not turn.any():
        directions.pop()
    motions = []
    for direction in directions:
        world = direction / np.linalg.norm(direction)
        body = [np.append(rotation(-pose.theta()) @ w, 0.0) for pose, w in zip(poses, world, strict=True)]
        motions.append(dict(zip(keys, body, strict=True)))
    return motions


def _variance_along(factor: gtsam.GaussianBayesNet, truth: gtsam.Values, motion: dict[int, np.ndarray]) -> float:
    """u' Sigma u = |R'^-1 u|^2, from the triangular factor R of the information matrix R' R."""
    u = gtsam.VectorValues()
    for key in truth.keys():  # noqa: SIM118 - Values is no dict
        u.insert(key, motion.get(key, np.zeros(3)))
    solution = factor.backSubstituteTranspose(u)
    return solution.dot(solution)
