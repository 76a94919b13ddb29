"""Estimated poses and vertices against truth, after one SE(2) alignment without scale."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coopslam.errors import BadInput
from coopslam.estimation.estimate import Trajectory
from coopslam.se2 import Pose2, position, rotation, wrap, xytheta

STAMP_TOLERANCE_S = 1e-6  # a stamp so little outside the truth's time is taken as its end


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryError:
    """Root mean squares over all poses of all robots after the alignment."""

    ate_rmse_m: float
    heading_rmse_rad: float
    T_truth_estimate: Pose2
    poses: int  # compared
    left_out: int  # outside the time that the truth covers


def align_se2(estimated: np.ndarray, truth: np.ndarray) -> Pose2:
    """T_truth_estimate that brings (N, 2) points closest to (N, 2) points in the sense of least squares.

    Closed form in the plane (Horn 1987; Umeyama 1991, without scale). Points that all coincide leave the
    rotation open; it is zero then.
    """
    estimated, truth = np.asarray(estimated, float), np.asarray(truth, float)
    if estimated.shape != truth.shape or estimated.ndim != 2 or estimated.shape[1:] != (2,) or not len(truth):
        raise BadInput(f"cannot align points of shape {estimated.shape} with {truth.shape}; (N, 2) each expected")
    centre_estimated, centre_truth = estimated.mean(axis=0), truth.mean(axis=0)
    a, b = estimated - centre_estimated, truth - centre_truth
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    shift = centre_truth - rotation(angle) @ centre_estimated
    return Pose2(shift[0], shift[1], angle)


def interpolate_se2(stamps_s: np.ndarray, poses: Sequence[Pose2], at_s: np.ndarray) -> list[Pose2]:
    """Poses at other times: translation linear, heading along the shorter arc.

    stamps_s: (N,) ascending.  Raises BadInput for a time outside of them.
    """
    states = _interpolated(np.asarray(stamps_s, float), poses, np.atleast_1d(np.asarray(at_s, float)))
    return [Pose2(*state) for state in states]


def trajectory_error(estimated: Mapping[str, Trajectory], truth: Mapping[str, Trajectory]) -> TrajectoryError:
    """One alignment over all robots' trajectories joined; truth is interpolated at the estimate's times."""
    states_estimated, states_truth, left_out = [], [], 0
    for robot, trajectory in estimated.items():
        if robot not in truth:
            raise BadInput(f"there is no truth for {robot}; there is for {', '.join(truth)}")
        covered = is_covered(trajectory.stamps_s, truth[robot].stamps_s)
        left_out += int((~covered).sum())
        stamps_truth = np.asarray(truth[robot].stamps_s, float)
        states_truth.append(_interpolated(stamps_truth, truth[robot].poses, np.asarray(trajectory.stamps_s)[covered]))
        states_estimated.append(_states(trajectory.poses)[covered])
    e, t = np.concatenate(states_estimated), np.concatenate(states_truth)
    if not len(e):
        raise BadInput("the truth covers none of the estimated poses")
    T_truth_estimate = align_se2(e[:, :2], t[:, :2])
    distances_sq = _residuals_sq(T_truth_estimate, e[:, :2], t[:, :2])
    headings = wrap(e[:, 2] + T_truth_estimate.theta() - t[:, 2])
    rmse, heading_rmse = float(np.sqrt(distances_sq.mean())), float(np.sqrt((headings**2).mean()))
    return TrajectoryError(rmse, heading_rmse, T_truth_estimate, len(e), left_out)


def vertex_rmse(estimated: np.ndarray, truth: np.ndarray) -> float:
    """Of (N, 2) map vertices against the true ones, m, after an alignment of their own."""
    estimated, truth = np.asarray(estimated, float), np.asarray(truth, float)
    return float(np.sqrt(_residuals_sq(align_se2(estimated, truth), estimated, truth).mean()))


def is_covered(at_s: np.ndarray, stamps_s: np.ndarray) -> np.ndarray:
    """(N,) whether each time lies within ascending stamps."""
    at_s, stamps_s = np.asarray(at_s, float), np.asarray(stamps_s, float)
    if not len(stamps_s):
        return np.zeros(len(at_s), bool)
    return (at_s >= stamps_s[0] - STAMP_TOLERANCE_S) & (at_s <= stamps_s[-1] + STAMP_TOLERANCE_S)


def _interpolated(stamps_s: np.ndarray, poses: Sequence[Pose2], at_s: np.ndarray) -> np.ndarray:
    """(M, 3) x, y, theta at (M,) times."""
    if len(stamps_s) != len(poses) or (np.diff(stamps_s) < 0).any():
        raise BadInput(f"{len(stamps_s)} stamps, {len(poses)} poses: one ascending stamp per pose expected")
    if not is_covered(at_s, stamps_s).all():
        outside = at_s[~is_covered(at_s, stamps_s)][0]
        raise BadInput(f"no pose at t = {outside:.3f} s: there are {len(poses)} poses, and none beyond")
    states = _states(poses)
    right = np.clip(np.searchsorted(stamps_s, at_s, side="right"), 1, max(len(stamps_s) - 1, 1))
    left, right = right - 1, np.minimum(right, len(stamps_s) - 1)
    span = stamps_s[right] - stamps_s[left]
    part = np.clip(np.divide(at_s - stamps_s[left], span, out=np.zeros_like(at_s), where=span > 0), 0.0, 1.0)
    step = states[right] - states[left]
    step[:, 2] = wrap(step[:, 2])
    return states[left] + part[:, None] * step


def _states(poses: Sequence[Pose2]) -> np.ndarray:
    return np.array([xytheta(pose) for pose in poses]).reshape(-1, 3)


def _residuals_sq(T_truth_estimate: Pose2, estimated: np.ndarray, truth: np.ndarray) -> np.ndarray:
    aligned = estimated @ rotation(T_truth_estimate.theta()).T + position(T_truth_estimate)
    return ((aligned - truth) ** 2).sum(axis=1)
