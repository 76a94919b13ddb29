"""SE(2) poses and their covariances; the only place where covariances change axes.

Poses are `gtsam.Pose2`. A pose error is a right perturbation, `T_estimated = T_true * Pose2(error)`, so a
covariance lives in the axes of the pose itself (order x, y, theta; metres and radians) unless its name
says otherwise. Composition to first order is the compounding of Smith, Self and Cheeseman (1990).
"""

from dataclasses import dataclass

import numpy as np
from gtsam import Pose2

__all__ = [
    "Pose2",
    "PoseBelief",
    "adjoint",
    "chain_covariance",
    "is_covariance",
    "position",
    "rotation",
    "wrap",
    "xytheta",
]


@dataclass(frozen=True, slots=True, eq=False)
class PoseBelief:
    """A pose and how well it is known."""

    T_world_body: Pose2
    cov_body: np.ndarray  # (3, 3); axes of the body; m, m, rad

    @property
    def position_covariance(self) -> np.ndarray:
        """(2, 2) covariance of the position in the axes of the world, m^2."""
        return position_covariance_in_parent(self.T_world_body, self.cov_body)

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation along the worst direction."""
        return largest_sigma(self.position_covariance)


def wrap(angle_rad):
    """The same angle in (-pi, pi]; scalars and arrays."""
    return -((np.pi - np.asarray(angle_rad)) % (2 * np.pi) - np.pi)


def xytheta(pose: Pose2) -> np.ndarray:
    """(3,) x, y, theta."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def position(pose: Pose2) -> np.ndarray:
    """(2,) x, y in the parent frame."""
    return np.array([pose.x(), pose.y()])


def rotation(angle_rad: float) -> np.ndarray:
    """(2, 2) matrix that turns vectors counter-clockwise."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def planar_rotation(angle_rad: float) -> np.ndarray:
    """(3, 3) matrix that turns the x, y part of (x, y, theta) and leaves theta."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def adjoint(pose: Pose2) -> np.ndarray:
    """(3, 3) Ad_T, with T * Pose2(e) = Pose2(Ad_T e) * T to first order in e."""
    c, s = np.cos(pose.theta()), np.sin(pose.theta())
    return np.array([[c, -s, pose.y()], [s, c, -pose.x()], [0.0, 0.0, 1.0]])


def position_covariance_in_parent(pose: Pose2, cov_body: np.ndarray) -> np.ndarray:
    """(2, 2) position covariance in the axes of the frame in which `pose` is given."""
    turn = rotation(pose.theta())
    return turn @ cov_body[:2, :2] @ turn.T


def observer_to_target_axes(T_observer_target: Pose2, cov_observer: np.ndarray) -> np.ndarray:
    """A relative pose's (3, 3) covariance from the observer's axes to the target's own axes.

    `BetweenFactorPose2` wants the latter: its error is a right perturbation of the second pose.
    """
    turn = planar_rotation(-T_observer_target.theta())
    return turn @ cov_observer @ turn.T


def chain_covariance(delta: Pose2, cov_start: np.ndarray, cov_delta: np.ndarray) -> np.ndarray:
    """Covariance of `T * delta` in its own axes, from that of T (its axes) and of delta (axes of its end)."""
    carry = adjoint(delta.inverse())
    return carry @ cov_start @ carry.T + cov_delta


def inverse_covariance(T_a_b: Pose2, cov_b: np.ndarray) -> np.ndarray:
    """Covariance of the inverse of T_a_b, in the axes of a, from that of T_a_b in the axes of b."""
    carry = adjoint(T_a_b)
    return carry @ cov_b @ carry.T


def relative_covariance(T_a_b: Pose2, joint: np.ndarray) -> np.ndarray:
    """Covariance of T_a_b in the axes of b from the joint (6, 6) one of both poses, each in its own axes."""
    jacobian = np.hstack([-adjoint(T_a_b.inverse()), np.eye(3)])
    return jacobian @ joint @ jacobian.T


def compose_leg(deltas, covariances) -> tuple[Pose2, np.ndarray]:
    """A chain of increments as one: its pose and its (3, 3) covariance, in the axes of its last pose.

    deltas: poses T_k_k+1.  covariances: (3, 3) each, in the axes of its own second pose.
    """
    total, cov = Pose2(), np.zeros((3, 3))
    for delta, cov_delta in zip(deltas, covariances, strict=True):
        cov = chain_covariance(delta, cov, cov_delta)
        total = total * delta
    return total, cov


def fit_pose(points_b: np.ndarray, points_a: np.ndarray, weights: np.ndarray | None = None) -> Pose2:
    """T_a_b that brings (N, 2) points of frame b closest to their partners in frame a, least squares without scale.

    weights: (N,) of the squares; equal without.  Closed form in the plane (Horn 1987; Umeyama 1991).  Points that
    all coincide leave the rotation open; it is zero then.
    """
    weights = np.ones(len(points_a)) if weights is None else np.asarray(weights)
    weights = (weights / weights.sum())[:, None]
    centre_a, centre_b = (weights * points_a).sum(axis=0), (weights * points_b).sum(axis=0)
    a, b = points_a - centre_a, points_b - centre_b
    angle = np.arctan2((weights[:, 0] * (b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0])).sum(), (weights * a * b).sum())
    shift = centre_a - rotation(angle) @ centre_b
    return Pose2(shift[0], shift[1], angle)


def largest_sigma(cov: np.ndarray) -> float:
    """Square root of the largest eigenvalue of a covariance."""
    return float(np.sqrt(max(np.linalg.eigvalsh(cov)[-1], 0.0)))


def is_covariance(matrix: np.ndarray, size: int) -> bool:
    """Whether it is a finite, symmetric, positive semi-definite (size, size) matrix, to a billionth of its scale.

    Every record asks that at its birth, so it is plain Python: for so few numbers several times as fast as numpy.
    """
    matrix = np.asarray(matrix, dtype=float)
    if matrix.shape != (size, size):
        return False
    rows = matrix.tolist()
    scale = max(abs(entry) for row in rows for entry in row)
    if not scale < np.inf:
        return False
    for i in range(size):
        for j in range(i):
            if not abs(rows[i][j] - rows[j][i]) <= 1e-9 * scale:
                return False
    return scale == 0.0 or _is_positive(rows, 1e-9 * scale)


def _is_positive(rows: list[list[float]], jitter: float) -> bool:
    """Whether a symmetric matrix is positive definite when so much is added to its diagonal: its pivots tell."""
    rows = [row[:] for row in rows]
    for k in range(len(rows)):
        pivot = rows[k][k] + jitter
        if not pivot > 0.0:
            return False
        for i in range(k + 1, len(rows)):
            factor = rows[i][k] / pivot
            for j in range(k + 1, len(rows)):
                rows[i][j] -= factor * rows[k][j]
    return True
