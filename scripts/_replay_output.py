"""What replays leave behind: a summary, trajectories, a pose graph, and what their figures show."""

from collections.abc import Sequence
from math import isfinite
from pathlib import Path

import numpy as np
from _calibration import write_calibration
from _replay import Outcome, Recording

from coopslam.errors import CoopSlamError, UnderDetermined
from coopslam.estimation.estimate import Trajectory
from coopslam.estimation.pose_variables import STAMP_TOLERANCE_S
from coopslam.estimation.replay import Replay
from coopslam.evaluation.replay_score import ReplayScore, score_replay
from coopslam.evaluation.trajectory_error import PoseErrors, TeamErrors, states_of
from coopslam.io.geojson import feature, write_feature_collection
from coopslam.io.tum import write_tum
from coopslam.records import MoveNote
from coopslam.report.comparison_view import ComparisonView, EstimatorView, RobotErrors
from coopslam.se2 import Pose2, largest_sigma, position, rotation


def judged(outcome: Outcome, recording: Recording) -> tuple[Outcome, ReplayScore | None]:
    """The outcome and its score; an estimate without covariances, or that is not finite, is a failure."""
    try:
        result = score(outcome, recording)
        if result is not None:
            _require_usable(result)
    except (CoopSlamError, np.linalg.LinAlgError) as error:
        return Outcome.failed(outcome.name, error), None
    return outcome, result


def _require_usable(result: ReplayScore) -> None:
    """Raises UnderDetermined for an estimate that cannot be written."""
    if not any(len(trajectory.poses) for trajectory in result.final.values()):
        raise UnderDetermined("no robot has a pose; the records are of none of the log's robots")
    for robot, trajectory in result.final.items():
        lost = np.flatnonzero(~np.isfinite(states_of(trajectory.poses)).all(axis=1))
        if len(lost):
            raise UnderDetermined(f"the pose of {robot} at t = {trajectory.stamps_s[lost[0]]:.3f} s is not finite")
    for key in result.scores:
        if not _is_finite(result.scores[key]):
            raise UnderDetermined(f"the estimate is out of all bounds: {key} is not finite")


def _is_finite(value) -> bool:
    if isinstance(value, dict):
        return all(map(_is_finite, value.values()))
    if isinstance(value, list):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or isfinite(value)


def score(outcome: Outcome, recording: Recording) -> ReplayScore | None:
    """Errors and times of an estimator that came to an estimate."""
    if outcome.replay is None:
        return None
    truth = recording.truth
    return score_replay(outcome.replay, truth and truth.robots, truth and truth.landmarks)


def summarize(recording: Recording, outcomes: Sequence[Outcome], scored: Sequence[ReplayScore | None]) -> dict:
    """The figures of CONTRACT; everything but keys that end in _seconds is the same for the same settings."""
    header = recording.header
    estimators = {}
    for outcome, result in zip(outcomes, scored, strict=True):
        estimators[outcome.name] = {"failed": outcome.failure} if result is None else result.scores
    return {
        "log": str(recording.path),
        "robots": list(header.robots),
        "landmarks": list(header.landmarks),
        "duration_s": recording.records[-1].stamp_s - recording.start_s,
        "records": recording.counts(),
        "truth": sorted(recording.truth.robots) if recording.truth else [],
        "estimators": estimators,
        "load_seconds": recording.load_seconds,
        **_calibration(recording),
    }


def _calibration(recording: Recording) -> dict:
    """What the records were calibrated with, and how long that took when the log did it by itself."""
    calibration, seconds = recording.calibration, recording.calibration_seconds
    if calibration is None:
        return {}
    result = {"calibration": "self" if seconds is not None else calibration.provenance.log or "unknown"}
    return result if seconds is None else {**result, "calibration_seconds": seconds}


def spread(summaries: Sequence[dict]) -> dict:
    """Median and quartiles of every number that an estimator has in several summaries, and in how many of them."""
    result = {}
    for name in dict.fromkeys(name for summary in summaries for name in summary["estimators"]):
        all_scores = [summary["estimators"].get(name, {}) for summary in summaries]
        result[name] = {"logs": sum("failed" not in scores for scores in all_scores)}
        for key in dict.fromkeys(key for scores in all_scores for key in scores):
            numbers = [scores[key] for scores in all_scores if isinstance(scores.get(key), int | float)]
            if numbers:
                low, middle, high = np.percentile(numbers, [25, 50, 75]).tolist()
                result[name][key] = {"median": middle, "q25": low, "q75": high, "count": len(numbers)}
    return result


def write_trajectories(directory: Path, score: ReplayScore) -> None:
    """ROBOT.tum, final, and ROBOT.causal.tum, as known at each moment; stamps on the log's own clock."""
    directory.mkdir(parents=True, exist_ok=True)
    for robot, trajectory in score.final.items():
        write_tum(directory / f"{robot}.tum", trajectory.stamps_s, trajectory.poses)
    for robot, trajectory in score.causal.items():
        write_tum(directory / f"{robot}.causal.tum", trajectory.stamps_s, trajectory.poses)


def write_own_calibration(directory: Path, recording: Recording) -> None:
    """calibration.toml when the log calibrated itself."""
    if recording.calibration_seconds is not None:
        write_calibration(directory / "calibration.toml", recording.calibration)


def write_landmarks(path: Path, replay: Replay) -> None:
    """map.geojson with a Point of kind landmark for each: name and covariance, m^2, axes of the map."""
    estimate = replay.estimate
    features = []
    for name in estimate.landmarks:
        belief = estimate.landmark_belief(name)
        point = [float(belief.xy[0]), float(belief.xy[1])]
        features.append(feature("landmark", "Point", point, name=name, covariance=belief.cov.tolist()))
    write_feature_collection(path, features)


def view_of(
    recording: Recording, summary: dict, outcomes: Sequence[Outcome], scored: Sequence[ReplayScore | None]
) -> ComparisonView:
    """What figures and report show; paths are in the frame of the truth where there is one."""
    truth = recording.truth
    paths = {robot: _points(track.poses) for robot, track in truth.robots.items()} if truth else {}
    views = [_estimator(recording, *pair) for pair in zip(outcomes, scored, strict=True)]
    return ComparisonView(recording.log.name, summary, views, paths, dict(truth.landmarks) if truth else {})


def _estimator(recording: Recording, outcome: Outcome, score: ReplayScore | None) -> EstimatorView:
    if score is None:
        empty = np.zeros(0)
        return EstimatorView(outcome.name, {}, {}, {}, {}, {}, empty, empty, note=outcome.failure)
    estimate, causal_updates = outcome.replay.estimate, len(outcome.replay.poses) > 1
    to_truth = score.errors.T_truth_estimate if score.errors else Pose2()
    turn = rotation(to_truth.theta())
    beliefs = {name: estimate.landmark_belief(name) for name in estimate.landmarks}
    return EstimatorView(
        outcome.name,
        score.scores,
        _robots(score.final, score.errors, score.anchored, score.nees, to_truth, recording.start_s),
        _robots(score.causal, score.causal_errors, None, {}, to_truth, recording.start_s),
        {name: to_truth.transformFrom(belief.xy) for name, belief in beliefs.items()},
        {name: turn @ belief.cov @ turn.T for name, belief in beliefs.items()},
        outcome.replay.latencies_s if causal_updates else np.zeros(0),
        outcome.replay.poses if causal_updates else np.zeros(0),
        _exchange_errors(recording, score.anchored),
    )


def _exchange_errors(recording: Recording, errors: TeamErrors | None) -> np.ndarray:
    """(E,) m, relative to the first start: of the robot that drove, at the end of the last leg before each exchange."""
    found, last = [], None
    for move in (record for record in recording.records if isinstance(record, MoveNote)):
        if errors is not None and last is not None and move.robot != last.robot and last.robot in errors.robots:
            own = errors.robots[last.robot]
            number = int(np.searchsorted(own.stamps_s, last.stamp_s + STAMP_TOLERANCE_S)) - 1
            if number >= 0:
                found.append(own.position_errors_m[number])
        last = move
    return np.array(found)


def _robots(
    trajectories: dict[str, Trajectory],
    errors: TeamErrors | None,
    anchored: TeamErrors | None,
    nees: dict[str, np.ndarray],
    to_truth: Pose2,
    start_s: float,
) -> dict[str, RobotErrors]:
    result, nobody = {}, PoseErrors(*(np.zeros(0),) * 3)
    for robot, trajectory in trajectories.items():
        own = errors.robots.get(robot, nobody) if errors else nobody
        at_start = anchored.robots.get(robot, nobody) if anchored else nobody
        matched = np.isin(trajectory.stamps_s, own.stamps_s)
        sigmas, heading_sigmas = _sigmas(trajectory)
        known = len(sigmas) > 0
        judged = nees.get(robot, np.zeros(0))
        result[robot] = RobotErrors(
            trajectory.stamps_s - start_s,
            _points([to_truth * pose for pose in trajectory.poses]),
            own.stamps_s - start_s,
            own.position_errors_m,
            own.heading_errors_rad,
            sigmas[matched] if known else sigmas,
            heading_sigmas[matched] if known else heading_sigmas,
            # the anchored pose has none
            np.concatenate([np.full(len(own.stamps_s) - len(judged), np.nan), judged]) if len(judged) else judged,
            at_start.position_errors_m,
            at_start.heading_errors_rad,
        )
    return result


def _sigmas(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """(N,) of the position along its worst direction, m, and of the heading, rad; empty without covariances."""
    if trajectory.covariances is None:
        return np.zeros(0), np.zeros(0)
    positions = np.array([largest_sigma(cov[:2, :2]) for cov in trajectory.covariances])
    return positions, np.sqrt(trajectory.covariances[:, 2, 2])


def _points(poses) -> np.ndarray:
    return np.array([position(pose) for pose in poses]).reshape(-1, 2)
