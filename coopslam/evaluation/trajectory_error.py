"""Estimated poses and vertices against truth, after one SE(2) alignment without scale."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Protocol

import numpy as np

from coopslam.errors import BadInput
from coopslam.se2 import Pose2, fit_pose, position, rotation, wrap

STAMP_TOLERANCE_S = 1e-6  # a stamp so little outside the truth's time is taken as its end


class Track(Protocol):
    """Poses by time: a `Trajectory`, or the true track of a log."""

    stamps_s: np.ndarray  # (N,) ascending
    poses: Sequence[Pose2]  # N


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryError:
    """Over all poses of all robots after the alignment: root mean square, median, and largest absolute value."""

    ate_rmse_m: float
    heading_rmse_rad: float
    T_truth_estimate: Pose2
    poses: int  # compared
    left_out: int  # outside the time that the truth covers
    ate_median_m: float
    ate_max_m: float
    heading_median_rad: float
    heading_max_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """Errors of one or more poses, by time; figures draw them, the properties sum them up."""

    stamps_s: np.ndarray  # (N,)
    position_errors_m: np.ndarray  # (N,) distances
    heading_errors_rad: np.ndarray  # (N,) estimated less true, in (-pi, pi]

    @property
    def ate_rmse_m(self) -> float:
        """Root mean square of the distances: the absolute trajectory error."""
        return rms(self.position_errors_m)

    @property
    def ate_median_m(self) -> float:
        """Median of the distances."""
        return float(np.median(self.position_errors_m))

    @property
    def ate_max_m(self) -> float:
        """Largest distance."""
        return float(self.position_errors_m.max())

    @property
    def heading_rmse_rad(self) -> float:
        """Root mean square of the heading errors."""
        return rms(self.heading_errors_rad)

    @property
    def heading_median_rad(self) -> float:
        """Median of the absolute heading errors."""
        return float(np.median(np.abs(self.heading_errors_rad)))

    @property
    def heading_max_rad(self) -> float:
        """Largest absolute heading error."""
        return float(np.abs(self.heading_errors_rad).max())


@dataclass(frozen=True, slots=True, eq=False)
class TeamErrors:
    """Errors of each robot after the one alignment of all robots joined."""

    robots: dict[str, PoseErrors]  # those with truth for at least one pose
    T_truth_estimate: Pose2
    left_out: dict[str, int]  # of each robot with truth: poses outside the time that it covers
    without_truth: tuple[str, ...]  # robots with no truth at all, or none at the time of any pose

    @property
    def joined(self) -> PoseErrors:
        """All robots, one after the other."""
        names = ("stamps_s", "position_errors_m", "heading_errors_rad")
        return PoseErrors(*(np.concatenate([getattr(e, name) for e in self.robots.values()]) for name in names))


def align_se2(estimated: np.ndarray, truth: np.ndarray) -> Pose2:
    """T_truth_estimate that brings (N, 2) points closest to (N, 2) points in the sense of least squares.

    Closed form in the plane (Horn 1987; Umeyama 1991, without scale). Points that all coincide leave the
    rotation open; it is zero then.
    """
    estimated, truth = np.asarray(estimated, float), np.asarray(truth, float)
    if estimated.shape != truth.shape or estimated.ndim != 2 or estimated.shape[1:] != (2,) or not len(truth):
        raise BadInput(f"cannot align points of shape {estimated.shape} with {truth.shape}; (N, 2) each expected")
    return fit_pose(estimated, truth)


def interpolate_se2(stamps_s: np.ndarray, poses: Sequence[Pose2], at_s: np.ndarray) -> list[Pose2]:
    """Poses at other times: translation linear, heading along the shorter arc.

    stamps_s: (N,) ascending.  Raises BadInput for a time outside of them.
    """
    return [Pose2(*state) for state in interpolate_states(stamps_s, poses, np.atleast_1d(at_s))]


def trajectory_error(estimated: Mapping[str, Track], truth: Mapping[str, Track]) -> TrajectoryError:
    """One alignment over all robots' trajectories joined; truth is interpolated at the estimate's times.

    Raises BadInput when a robot has no truth, or none of the poses has.
    """
    for robot in estimated:
        if robot not in truth:
            raise BadInput(f"there is no truth for {robot}; there is for {', '.join(truth)}")
    team = team_errors(estimated, truth)
    joined = team.joined
    return TrajectoryError(
        joined.ate_rmse_m,
        joined.heading_rmse_rad,
        team.T_truth_estimate,
        len(joined.stamps_s),
        sum(team.left_out.values()),
        joined.ate_median_m,
        joined.ate_max_m,
        joined.heading_median_rad,
        joined.heading_max_rad,
    )


def team_errors(
    estimated: Mapping[str, Track],
    truth: Mapping[str, Track],
    gap_max_s: float = inf,
    T_truth_estimate: Pose2 | None = None,
) -> TeamErrors:
    """Each robot's errors over time, after one alignment over all robots' trajectories joined.

    Robots without truth take no part, and are named.  gap_max_s: as in `is_covered`.
    T_truth_estimate: instead of the alignment; the first robot's true start gives errors to compare with covariances.
    Raises BadInput when no pose has a truth.
    """
    matches = {robot: matched(estimated[robot], truth[robot], gap_max_s) for robot in estimated if robot in truth}
    left_out = {robot: len(estimated[robot].poses) - len(stamps_s) for robot, (stamps_s, _, _) in matches.items()}
    matches = {robot: match for robot, match in matches.items() if len(match[0])}
    if not matches:
        raise BadInput("the truth covers none of the estimated poses")
    if T_truth_estimate is None:
        e, t = (np.concatenate([match[i] for match in matches.values()]) for i in (1, 2))
        T_truth_estimate = align_se2(e[:, :2], t[:, :2])
    robots = {robot: _errors(T_truth_estimate, *match) for robot, match in matches.items()}
    return TeamErrors(robots, T_truth_estimate, left_out, tuple(robot for robot in estimated if robot not in robots))


def vertex_rmse(estimated: np.ndarray, truth: np.ndarray) -> float:
    """Of (N, 2) map vertices against the true ones, m, after an alignment of their own."""
    estimated, truth = np.asarray(estimated, float), np.asarray(truth, float)
    return rms(_distances(align_se2(estimated, truth), estimated, truth))


def is_covered(at_s: np.ndarray, stamps_s: np.ndarray, gap_max_s: float = inf) -> np.ndarray:
    """(N,) whether each time lies within ascending stamps.

    gap_max_s: a time between two stamps that are further apart than this is not covered, unless it is one of them.
    """
    at_s, stamps_s = np.asarray(at_s, float), np.asarray(stamps_s, float)
    if not len(stamps_s):
        return np.zeros(len(at_s), bool)
    covered = (at_s >= stamps_s[0] - STAMP_TOLERANCE_S) & (at_s <= stamps_s[-1] + STAMP_TOLERANCE_S)
    if gap_max_s == inf:
        return covered
    before = np.searchsorted(stamps_s, at_s + STAMP_TOLERANCE_S, side="right") - 1
    after = np.searchsorted(stamps_s, at_s - STAMP_TOLERANCE_S, side="left")
    gaps_s = stamps_s[np.minimum(after, len(stamps_s) - 1)] - stamps_s[np.maximum(before, 0)]
    return covered & (gaps_s <= gap_max_s)


def matched(trajectory: Track, truth: Track, gap_max_s: float = inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (N,) of the poses that the truth covers, and their estimated and true states (N, 3).

    gap_max_s: as in `is_covered`.
    """
    stamps_s = np.asarray(trajectory.stamps_s, float)
    chosen = np.flatnonzero(is_covered(stamps_s, truth.stamps_s, gap_max_s))
    estimated = states_of(trajectory.poses[i] for i in chosen)
    return stamps_s[chosen], estimated, interpolate_states(truth.stamps_s, truth.poses, stamps_s[chosen])


def interpolate_states(stamps_s: np.ndarray, poses: Sequence[Pose2], at_s: np.ndarray) -> np.ndarray:
    """(M, 3) x, y, theta at (M,) times, as `interpolate_se2`; of long tracks only the poses needed are looked at."""
    stamps_s, at_s = np.asarray(stamps_s, float), np.asarray(at_s, float)
    if len(stamps_s) != len(poses) or (np.diff(stamps_s) < 0).any():
        raise BadInput(f"{len(stamps_s)} stamps, {len(poses)} poses: one ascending stamp per pose expected")
    covered = is_covered(at_s, stamps_s)
    if not covered.all():
        raise BadInput(f"no pose at t = {at_s[~covered][0]:.3f} s: there are {len(poses)} poses, and none beyond")
    right = np.clip(np.searchsorted(stamps_s, at_s, side="right"), 1, max(len(stamps_s) - 1, 1))
    left, right = right - 1, np.minimum(right, len(stamps_s) - 1)
    needed, place = np.unique(np.concatenate([left, right]), return_inverse=True)
    start, end = states_of(poses[i] for i in needed)[place].reshape(2, -1, 3)
    span = stamps_s[right] - stamps_s[left]
    part = np.clip(np.divide(at_s - stamps_s[left], span, out=np.zeros_like(at_s), where=span > 0), 0.0, 1.0)
    step = end - start
    step[:, 2] = wrap(step[:, 2])
    return start + part[:, None] * step


def states_of(poses: Iterable[Pose2]) -> np.ndarray:
    """(N, 3) x, y, theta."""
    return np.array([(pose.x(), pose.y(), pose.theta()) for pose in poses], float).reshape(-1, 3)


def rms(errors: np.ndarray) -> float:
    """Root mean square of one or more numbers."""
    return float(np.sqrt((errors**2).mean()))


def _errors(T_truth_estimate: Pose2, stamps_s: np.ndarray, estimated: np.ndarray, truth: np.ndarray) -> PoseErrors:
    headings = wrap(estimated[:, 2] + T_truth_estimate.theta() - truth[:, 2])
    return PoseErrors(stamps_s, _distances(T_truth_estimate, estimated[:, :2], truth[:, :2]), headings)


def _distances(T_truth_estimate: Pose2, estimated: np.ndarray, truth: np.ndarray) -> np.ndarray:
    aligned = estimated @ rotation(T_truth_estimate.theta()).T + position(T_truth_estimate)
    return np.hypot(*(aligned - truth).T)
