"""The pose of one map in another from corners that are said to be the same, and how well they agree.

For pairs (small corner V_i, stored corner V_j) the difference V_j^-1 T V_i is the identity when they are one corner.
T is the best linear unbiased estimate with the joint covariance of both maps: weighted least squares over all
differences together. What the corners of a map have in common (its drift as a whole) goes into T, and only what they
disagree on relative to each other counts against the match.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from coopslam.planning.corner_map import CornerMap, inverse_adjoints, rotations, turned
from coopslam.se2 import Pose2, fit_pose, inverse_covariance, wrap, xytheta

# Of a difference between two maps, beside their covariances: what linearizing leaves out where a wall ties the heading
# of a corner to its neighbour within 1e-4 rad. With a corner off by d over a wall of length L that is (d / L)^2 rad.
FLOOR_SIGMAS = np.array([0.003, 0.003, 0.01])  # m, m, rad
ITERATIONS = 6
SETTLED = 1e-6  # m and rad


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One way to lay a small map onto a stored one."""

    pairs: tuple[tuple[int, int], ...]  # (small, stored) indices of corners
    T_stored_small: Pose2
    cov_small: np.ndarray  # (3, 3); axes of the small map's frame; m, m, rad
    squares: float  # sum of squared normalized differences
    dof: int

    @property
    def probability(self) -> float:
        """Of differences as large as these or larger, when all pairs are right and both covariances are."""
        return float(chdtrc(self.dof, self.squares))

    def inverted(self) -> "Fit":
        """The stored map laid onto the small one."""
        T = self.T_stored_small
        pairs = tuple(sorted((j, i) for i, j in self.pairs))
        return Fit(pairs, T.inverse(), inverse_covariance(T, self.cov_small), self.squares, self.dof)


def fit(stored: CornerMap, small: CornerMap, pairs: Sequence[tuple[int, int]]) -> Fit:
    """Gauss-Newton over the pose, and the chi-square of what is left: 4 numbers a pair less the 3 of the pose."""
    i, j = np.array(pairs, dtype=int).T
    pose = _start(stored, small, i, j)
    for _ in range(ITERATIONS):
        difference, by_pose, cov = _linearized(stored, small, i, j, pose)
        weighted = np.linalg.solve(cov, np.column_stack([by_pose, difference]))
        information = by_pose.T @ weighted[:, :3]
        step = -np.linalg.solve(information, by_pose.T @ weighted[:, 3])
        pose = pose * Pose2(*step)
        if np.abs(step).max() < SETTLED:
            break
    left = difference + by_pose @ step
    angle_variance = small.angle_sigma_rad**2 + stored.angle_sigma_rad**2
    angles = small.interior_angles[i] - stored.interior_angles[j]
    squares = left @ np.linalg.solve(cov, left) + angles @ angles / angle_variance
    return Fit(tuple(pairs), pose, np.linalg.inv(information), float(squares), 4 * len(i) - 3)


def _start(stored: CornerMap, small: CornerMap, i: np.ndarray, j: np.ndarray) -> Pose2:
    """From the positions of far apart pairs, or else from the first pair's oriented corners."""
    if np.ptp(small.places[i], axis=0).max(initial=0.0) > 0.5:
        return fit_pose(small.places[i], stored.places[j])
    return Pose2(*stored.poses[j[0]]) * Pose2(*small.poses[i[0]]).inverse()


def _linearized(
    stored: CornerMap, small: CornerMap, i: np.ndarray, j: np.ndarray, pose: Pose2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(3k,) differences (x, y, heading of V_j^-1 T V_i), their (3k, 3) derivative by T and their (3k, 3k) covariance.

    With right perturbations A = V_j^-1 T V_i changes by Ad(V_i^-1) dT + dV_i - Ad(A^-1) dV_j, in its own axes.
    """
    k = len(i)
    here, there = small.poses[i], stored.poses[j]
    x, y, turn = xytheta(pose)
    apart = turned(turn, here[:, :2]) + (x, y) - there[:, :2]
    differences = np.column_stack([turned(-there[:, 2], apart), wrap(turn + here[:, 2] - there[:, 2])])
    own = rotations(differences[:, 2])
    by_pose = own @ inverse_adjoints(here)
    by_stored = -own @ inverse_adjoints(differences)
    cov = np.einsum("aij,ajbk,blk->aibl", own, small.covariance[i][:, :, i], own)
    cov += np.einsum("aij,ajbk,blk->aibl", by_stored, stored.covariance[j][:, :, j], by_stored)
    cov = cov.reshape(3 * k, 3 * k) + np.diag(np.tile(FLOOR_SIGMAS**2, k))
    return differences.ravel(), by_pose.reshape(3 * k, 3), cov
