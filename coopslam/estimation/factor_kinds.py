"""What a factor measures, in words, and the kind of record that it came from."""

from bisect import bisect_left

import gtsam

from coopslam.estimation.keys import is_landmark, is_vertex, robot_index
from coopslam.estimation.timeline import STAMP_TOLERANCE_S, Timeline

_SIGHTINGS = {
    gtsam.BearingRangeFactor2D: "bearing-range",
    gtsam.BearingRangeFactorPose2: "bearing-range",
    gtsam.RangeFactor2D: "range",
    gtsam.RangeFactorPose2: "range",
    gtsam.BearingFactor2D: "bearing",
    gtsam.BearingFactorPose2: "bearing",
}
_RECORDS = {
    "bearing-range": "BearingRangeFix",
    "range": "RangeFix",
    "bearing": "BearingFix",
    "corner": "CornerDecision",
    "wall": "WallDecision",
    "pose prior": "PosePrior",
    "landmark prior": "LandmarkPrior",
    "loop closure": "LoopClosure",
    "odometry": "LoopClosure",
}


def kind_of(factor: gtsam.NonlinearFactor) -> str | None:
    """What a factor measures, read off its type and its keys; None: no measurement of ours, as a marginalized past.

    Two things look the same: a loop closure with another robot counts as `relative pose`, and one of a robot with its
    last pose but one variable as `odometry`.  `pose prior` includes the one that fixes the gauge.
    """
    keys, kind = factor.keys(), type(factor)
    if kind is gtsam.BetweenFactorPose2:
        return _kind_of_relative_pose(*keys)
    if kind is gtsam.PriorFactorPose2:
        return "pose prior"
    if kind is gtsam.PriorFactorPoint2:
        return "landmark prior"
    if kind not in _SIGHTINGS:
        return None
    if is_vertex(keys[0]):
        return "wall"
    return f"{_SIGHTINGS[kind]} of a {'landmark' if is_landmark(keys[1]) else 'robot'}"


def record_kind(factor: gtsam.NonlinearFactor, timeline: Timeline) -> str:
    """Name of the kind of record that a measurement of the timeline comes from; its own odometry apart.

    Poses of two robots that were never there at the same time were compared by a loop closure, as far as anybody can
    tell: where only the other kind has been used it was that.
    """
    kind = kind_of(factor)
    if kind != "relative pose":
        return _RECORDS[kind.partition(" of a ")[0]]
    first, second = factor.keys()
    (since_a, until_a), (since_b, until_b) = _stay(first, timeline), _stay(second, timeline)
    likely, other = "RelativePoseFix", "LoopClosure"
    if max(since_a, since_b) > min(until_a, until_b) + STAMP_TOLERANCE_S:
        likely, other = other, likely
    return likely if timeline.used[likely] > 0 else other


def drop(factor: gtsam.NonlinearFactor, timeline: Timeline, reason: str) -> None:
    """Count a measurement that the timeline has used and the estimator cannot use."""
    kind = record_kind(factor, timeline)
    timeline.dropped[f"{kind}: {reason}"] += 1
    timeline.used[kind] -= 1


def _kind_of_relative_pose(first: int, second: int) -> str:
    if is_vertex(second):
        return "corner"
    if robot_index(first) != robot_index(second):
        return "relative pose"
    return "odometry" if second - first == 1 else "loop closure"


def _stay(key: int, timeline: Timeline) -> tuple[float, float]:
    """When a robot came to a pose and when it left, s."""
    track = timeline.tracks[timeline.robots[robot_index(key)]]
    number = bisect_left(track.keys, key)
    return track.since_s[number], track.until_s[number]
