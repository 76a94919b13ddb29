import gtsam
import numpy as np
import pytest

from coopslam.estimation import factors
from coopslam.estimation.ekf import Ekf
from coopslam.estimation.factor_kinds import record_kind
from coopslam.estimation.fixed_lag import FixedLag, FixedLagSettings
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerDecision,
    CornerSighting,
    LandmarkPrior,
    LoopClosure,
    Odometry,
    PosePrior,
    RangeFix,
    RelativePoseFix,
    WallDecision,
)
from coopslam.se2 import Pose2

COV = np.diag([0.02, 0.01, 0.01]) ** 2
SEEN_COV = np.diag([0.01, 0.03]) ** 2
SIGHTINGS = [CornerSighting(4.0, "a", Pose2(k, 1, 0), COV, 1.5, 0.01) for k in (1, 2)]

# Both drive at each second; what is said about t = 2 s is said of poses that they have left.
RECORDS = [
    RelativePoseFix(4.0, "a", "b", Pose2(0, 1, 0), COV),
    LoopClosure(2.0, 4.0, "a", "b", Pose2(2, 1, 0), COV),
    LoopClosure(2.0, 4.0, "a", "a", Pose2(2, 0, 0), COV),
    BearingRangeFix(4.0, "a", "b", np.pi / 2, 1.0, SEEN_COV),
    BearingRangeFix(4.0, "a", "p", 0.0, 1.0, SEEN_COV),
    BearingFix(4.0, "b", "a", -np.pi / 2, 0.01),
    RangeFix(4.0, "b", "a", 1.0, 0.01),
    PosePrior(4.0, "b", Pose2(4, 1, 0), COV),
    LandmarkPrior(4.0, "p", np.array([5.0, 0.0]), np.eye(2)),
    CornerDecision(4.0, SIGHTINGS[0], 0, True),
]


def driven(until_s=4):
    records = [RelativePoseFix(0.0, "a", "b", Pose2(0, 1, 0), COV)]
    for k in range(until_s):
        records += [Odometry(k, k + 1.0, robot, Pose2(1, 0, 0), COV) for robot in "ab"]
    return records


def timeline_with(*records):
    timeline = Timeline("ab", ("p",), TimelineSettings(every_leg=True))
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(timeline.extend(driven(), lambda key: None).graph)
    return timeline, graph.size(), timeline.extend(records, lambda key: Pose2()).graph


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: type(record).__name__)
def test_a_factor_is_told_by_the_record_that_it_came_from(record):
    timeline, _, graph = timeline_with(LandmarkPrior(4.0, "p", np.array([5.0, 0.0]), np.eye(2)), record)
    assert record_kind(graph.at(graph.size() - 1), timeline) == type(record).__name__


def test_a_wall_is_one():
    wall = WallDecision(4.0, 0, 1)
    factor = factors.wall(gtsam.symbol("v", 0), gtsam.symbol("v", 1), wall)
    assert record_kind(factor, Timeline("ab")) == "WallDecision"


def test_a_loop_closure_between_robots_that_stand_is_counted_as_what_was_used():
    timeline = Timeline("ab")
    graph = timeline.extend([LoopClosure(0.0, 4.0, "a", "b", Pose2(0, 1, 0), COV)], lambda key: None).graph
    assert record_kind(graph.at(graph.size() - 1), timeline) == "LoopClosure"


@pytest.mark.parametrize("make", [Ekf, lambda *names, **more: FixedLag(*names, settings=FixedLagSettings(1.0), **more)])
def test_what_comes_too_late_leaves_the_count_of_its_own_kind(make):
    estimator = make("ab", timeline=TimelineSettings(every_leg=True))
    for k in range(5):  # a second with each update
        estimator.update([record for record in driven() if k - 1 < record.stamp_s <= k])
    closures = [LoopClosure(1.0, 4.0, first, second, Pose2(3, 1, 0), COV) for first, second in ("ab", "ba")]
    estimator.update(closures)
    assert estimator.timeline.used["RelativePoseFix"] == 1 and estimator.timeline.used["LoopClosure"] == 0
    kinds = {entry.partition(":")[0]: number for entry, number in estimator.timeline.dropped.items()}
    assert kinds == {"LoopClosure": 2}
