"""What an estimator's replay of a log is worth: errors against truth where there is one, honesty, and time."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from coopslam.errors import CoopSlamError
from coopslam.estimation.batch import BatchEstimate
from coopslam.estimation.estimate import Estimate, Trajectory
from coopslam.estimation.replay import Replay
from coopslam.evaluation.consistency import landmark_nees, start_of, trajectory_nees
from coopslam.evaluation.innovation import innovation_statistics, residual_statistics
from coopslam.evaluation.relative_error import joined, path_errors, robot_pair_errors
from coopslam.evaluation.trajectory_error import TeamErrors, Track, team_errors, vertex_rmse

DISTANCES_M = (1.0, 5.0, 10.0)  # over which relative pose errors are taken


@dataclass(frozen=True, slots=True, eq=False)
class ReplayScore:
    """Figures for summary.json, and what they were taken from."""

    scores: dict  # keys that need truth are absent without it
    final: dict[str, Trajectory]  # with covariances, where the estimator has them
    causal: dict[str, Trajectory]
    errors: TeamErrors | None
    causal_errors: TeamErrors | None
    anchored: TeamErrors | None = None  # in the frame of the first robot's true start: what sigmas speak of
    nees: dict[str, np.ndarray] = field(default_factory=dict)


def score_replay(
    replay: Replay, robots: Mapping[str, Track] | None = None, landmarks: Mapping[str, np.ndarray] | None = None
) -> ReplayScore:
    """robots: truth by name, in any one frame; None when there is none.  landmarks: (2,) each, in the same frame."""
    estimate = replay.estimate
    placed = [robot for robot in estimate.robots if estimate.timeline.is_placed(robot)]
    final = {robot: estimate.trajectory(robot) for robot in placed}
    causal = {robot: estimate.causal_trajectory(robot) for robot in placed}
    causal = {robot: trajectory for robot, trajectory in causal.items() if len(trajectory.poses)}
    scores = {"wall_seconds": replay.seconds, "pose_variables": int(replay.poses[-1]), "updates": len(replay.poses)}
    if len(replay.poses) > 1:
        for share in (50, 99):
            scores[f"latency_p{share}_seconds"] = float(np.percentile(replay.latencies_s, share))
    scores["dropped"] = dict(estimate.timeline.dropped)
    scores["nis"] = _nis(estimate)
    if not robots or not set(robots) & set(final):
        return ReplayScore(scores, final, causal, None, None)
    errors = team_errors(final, robots)
    causal_errors = team_errors(causal, robots) if causal else None
    nees = _nees(final, robots, estimate.robots[0])
    scores = {
        **_accuracy(errors, causal_errors),
        **_relative(final, robots),
        **_honesty(nees),
        **_landmarks(estimate, final, robots, landmarks or {}),
        **scores,
    }
    return ReplayScore(scores, final, causal, errors, causal_errors, _anchored(final, robots, estimate.robots[0]), nees)


def _accuracy(errors: TeamErrors, causal: TeamErrors | None) -> dict:
    all_poses = errors.joined
    scores = {
        "ate_rmse_m": all_poses.ate_rmse_m,
        "ate_median_m": all_poses.ate_median_m,
        "ate_max_m": all_poses.ate_max_m,
        "heading_rmse_rad": all_poses.heading_rmse_rad,
        "poses_without_truth": sum(errors.left_out.values()),
        "robots": {
            robot: {"ate_rmse_m": own.ate_rmse_m, "heading_rmse_rad": own.heading_rmse_rad}
            for robot, own in errors.robots.items()
            if len(own.stamps_s)
        },
    }
    if causal is not None:
        scores["causal_ate_rmse_m"] = causal.joined.ate_rmse_m
        scores["causal_heading_rmse_rad"] = causal.joined.heading_rmse_rad
    return scores


def _relative(final: Mapping[str, Trajectory], robots: Mapping[str, Track]) -> dict:
    """Relative pose errors over driven distances, and of robots to each other at the same times."""
    by_robot = path_errors(final, robots, DISTANCES_M)
    over = {}
    for distance in DISTANCES_M:
        both = joined(errors[distance] for errors in by_robot.values() if distance in errors)
        if both is not None:
            over[f"{distance:g} m"] = _as_scores(both)
    scores = {"rpe": over} if over else {}
    pairs = {pair: errors for pair, errors in robot_pair_errors(final, robots).items() if errors.count}
    if pairs:
        scores["robot_to_robot"] = {
            **_as_scores(joined(pairs.values())),
            "pairs": {f"{a} {b}": _as_scores(errors) for (a, b), errors in pairs.items()},
        }
    return scores


def _as_scores(errors) -> dict:
    return {"translation_rmse_m": errors.translation_rmse_m, "rotation_rmse_rad": errors.rotation_rmse_rad}


def _nees(final: Mapping[str, Trajectory], robots: Mapping[str, Track], first: str) -> dict[str, np.ndarray]:
    """By robot; empty when there are no covariances, or no truth of the pose that all are relative to."""
    known = {robot: trajectory for robot, trajectory in final.items() if trajectory.covariances is not None}
    try:
        return trajectory_nees(known, robots, first) if first in known else {}
    except (CoopSlamError, np.linalg.LinAlgError):
        return {}


def _anchored(final: Mapping[str, Trajectory], robots: Mapping[str, Track], first: str) -> TeamErrors | None:
    """None when the truth does not cover the first robot's start."""
    try:
        return team_errors(final, robots, T_truth_estimate=start_of(final[first], robots[first]))
    except (KeyError, CoopSlamError):
        return None


def _honesty(nees: Mapping[str, np.ndarray]) -> dict:
    values = np.concatenate(list(nees.values())) if nees else np.zeros(0)
    return {"nees_mean": float(values.mean()), "nees_median": float(np.median(values))} if len(values) else {}


def _landmarks(
    estimate: Estimate, final: Mapping[str, Trajectory], robots: Mapping[str, Track], truth: Mapping[str, np.ndarray]
) -> dict:
    names = [name for name in estimate.landmarks if name in truth]
    first = estimate.robots[0]
    if len(names) < 2:
        return {}
    points = np.array([estimate.landmark(name) for name in names])
    scores = {"landmarks": len(names), "landmark_rmse_m": vertex_rmse(points, np.array([truth[n] for n in names]))}
    try:
        T_world_start = start_of(final[first], robots[first])
        beliefs = {name: estimate.landmark_belief(name) for name in names}
        nees = landmark_nees({name: (b.xy, b.cov) for name, b in beliefs.items()}, truth, T_world_start)
    except (KeyError, CoopSlamError):
        return scores
    return {**scores, "landmark_nees_mean": float(np.mean(list(nees.values())))}


def _nis(estimate: Estimate) -> dict:
    """Normalized squares by kind of measurement: of innovations for a filter, of residuals for a smoothed graph.

    Innovations are 1 per degree of freedom when all is honest; residuals less, because the solution follows them.
    """
    innovations = getattr(estimate, "innovations", None)
    if innovations:
        return {
            kind: {"count": one.count, "mean_per_dof": one.mean_per_dof, "beyond_95": one.beyond_95}
            for kind, one in innovation_statistics(innovations).items()
        }
    if isinstance(estimate, BatchEstimate):
        found = residual_statistics(estimate.graph, estimate.values)
        return {kind: {"count": one.count, "mean_per_dof": one.mean_per_dim} for kind, one in found.items()}
    return {}
