"""Where one robot is in the frame of another: a small filter on SE(2).

Errors are right perturbations in exponential coordinates, `T_a_b = T_true * Pose2.Expmap(error)`, so a covariance is in
the axes of b. In these coordinates what odometry with a wide heading knows, a banana in the plane, is nearly normal
(Long, Wolfe, Mashner, Chirikjian, The Banana Distribution Is Gaussian, RSS 2012).
"""

from dataclasses import dataclass

import numpy as np

from coopslam.estimation.estimate import Estimate
from coopslam.records import RelativePoseFix
from coopslam.se2 import (
    Pose2,
    chain_covariance,
    inverse_covariance,
    observer_to_target_axes,
    relative_covariance,
)

_IDENTITY = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class RelativeBelief:
    """The pose of robot b in the frame of robot a, predicted or measured."""

    T_a_b: Pose2
    cov_b: np.ndarray  # (3, 3); axes of b; m, m, rad

    def inverse(self) -> "RelativeBelief":
        """The pose of a in the frame of b."""
        return RelativeBelief(self.T_a_b.inverse(), inverse_covariance(self.T_a_b, self.cov_b))

    def after_b(self, T_start_now: Pose2, cov_now: np.ndarray) -> "RelativeBelief":
        """When b has driven; cov_now: (3, 3) in the axes of b now."""
        return RelativeBelief(self.T_a_b * T_start_now, chain_covariance(T_start_now, self.cov_b, cov_now))

    def after_a(self, T_start_now: Pose2, cov_now: np.ndarray) -> "RelativeBelief":
        """When a has driven; cov_now: (3, 3) in the axes of a now."""
        T_b_a = self.T_a_b.inverse() * T_start_now
        return RelativeBelief(T_b_a.inverse(), self.cov_b + inverse_covariance(T_b_a, cov_now))

    def distance_sq(self, seen: "RelativeBelief") -> float:
        """Squared Mahalanobis distance of an independent measurement; chi-square with 3 degrees of freedom."""
        beyond, cov_seen = self._innovation(seen)
        return float(beyond @ np.linalg.solve(self.cov_b + cov_seen, beyond))

    def updated(self, seen: "RelativeBelief") -> tuple["RelativeBelief", float]:
        """With an independent measurement (a Kalman update), and the measurement's squared distance before it.

        The covariance P - P (P + R)^-1 P is computed as P (P + R)^-1 R, which subtracts nothing.
        """
        beyond, cov_seen = self._innovation(seen)
        information = np.linalg.inv(self.cov_b + cov_seen)
        gain = self.cov_b @ information
        step, cov = gain @ beyond, gain @ cov_seen
        turn = Pose2.ExpmapDerivative(step)  # to the axes of b as believed now
        belief = RelativeBelief(self.T_a_b * Pose2.Expmap(step), turn @ (cov + cov.T) @ turn.T / 2)
        return belief, float(beyond @ information @ beyond)

    def _innovation(self, seen: "RelativeBelief") -> tuple[np.ndarray, np.ndarray]:
        """What a measurement says beyond this belief: (3,), and its own (3, 3) covariance in these coordinates.

        The measurement's covariance is carried to the axes of b as believed here, which may be turned far.
        """
        beyond = self.T_a_b.between(seen.T_a_b)
        carry = Pose2.LogmapDerivative(beyond)
        return Pose2.Logmap(beyond), carry @ seen.cov_b @ carry.T


def seen_by_tracker(fix: RelativePoseFix, floor_sigma: float) -> RelativeBelief:
    """A fix as a belief on the target in the observer's frame; floor_sigma: m and rad, added in every direction."""
    cov = observer_to_target_axes(fix.T_observer_target, fix.cov_observer)
    return RelativeBelief(fix.T_observer_target, cov + floor_sigma**2 * _IDENTITY)


def predicted(estimate: Estimate, key_a: int, key_b: int) -> RelativeBelief:
    """One pose variable in the frame of another, from an estimate."""
    T_a_b = estimate.value(key_a).between(estimate.value(key_b))
    return RelativeBelief(T_a_b, relative_covariance(T_a_b, estimate.joint_covariance([key_a, key_b])))


def relative_now(estimate: Estimate, robot: str, vertex: int) -> RelativeBelief:
    """A map vertex in the frame of a robot now: its latest variable, and what it has driven since."""
    belief = predicted(estimate, estimate.pose_key(robot), estimate.vertex_key(vertex))
    track = estimate.timeline.tracks[robot]
    return belief.after_a(track.T_last_now, track.cov_now) if track.moved else belief


def predicted_now(estimate: Estimate, a: str, b: str) -> RelativeBelief:
    """Robot b in the frame of robot a now: latest variables, and what both have driven since."""
    belief = predicted(estimate, estimate.pose_key(a), estimate.pose_key(b))
    track_a, track_b = estimate.timeline.tracks[a], estimate.timeline.tracks[b]
    if track_a.moved:
        belief = belief.after_a(track_a.T_last_now, track_a.cov_now)
    if track_b.moved:
        belief = belief.after_b(track_b.T_last_now, track_b.cov_now)
    return belief
