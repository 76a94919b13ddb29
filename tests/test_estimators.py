"""Every estimator on logs that tell too little: an estimate, or a reason in words."""

import numpy as np
import pytest

from coopslam.errors import BadInput, CoopSlamError
from coopslam.estimation.estimators import NAMES, EstimatorSettings, run
from coopslam.estimation.synchronize import synchronized
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerDecision,
    CornerSighting,
    LandmarkPrior,
    LoopClosure,
    MoveNote,
    Odometry,
    PosePrior,
    RangeFix,
    RelativePoseFix,
    WallDecision,
)
from coopslam.se2 import Pose2, xytheta

ROBOTS, LANDMARKS = ("a", "b"), ("p", "q")
STEP, STEP_COV = Pose2(1.0, 0.0, 0.3), np.diag([0.02, 0.01, 0.01]) ** 2
SEEN_COV = np.diag([0.01, 0.03]) ** 2
FIX_COV = np.diag([0.02, 0.02, 0.01]) ** 2
STEPS = 8


def drive(robot, steps=STEPS):
    return [Odometry(float(k), k + 1.0, robot, STEP, STEP_COV) for k in range(steps)]


def stand(robot):
    return [Odometry(float(k), k + 1.0, robot, Pose2(), np.zeros((3, 3))) for k in range(3)]


def at_each_step(make):
    return [make(k + 1.0) for k in range(STEPS)]


BOTH = drive("a") + drive("b")
SIGHTING = CornerSighting(2.0, "a", Pose2(0.1, 0.2, 0.3), FIX_COV, 1.5, 0.01)

# What robots of which nobody knows where they started leave open: no estimator can place b.
UNCONNECTED = {
    "nobody sees anybody": BOTH,
    "the first robot has no records": drive("b"),
    "the first robot has no records, the other sees a landmark": drive("b")
    + at_each_step(lambda t: BearingRangeFix(t, "b", "p", 0.1, 2.0, SEEN_COV)),
    "only one range": [*BOTH, RangeFix(1.0, "a", "b", 2.0, 0.1)],
    "only one bearing": [*BOTH, BearingFix(1.0, "a", "b", 0.2, 0.01)],
    "only bearings of one robot that stands": [
        *stand("a"),
        *stand("b"),
        *at_each_step(lambda t: BearingFix(t, "a", "b", 0.2, 0.01)),
    ],
    "only ranges of one robot that stands": [
        *stand("a"),
        *stand("b"),
        *at_each_step(lambda t: RangeFix(t, "a", "b", 2.0, 0.1)),
    ],
    "a landmark that each has seen once": [
        *BOTH,
        BearingRangeFix(2.0, "a", "p", 0.1, 2.0, SEEN_COV),
        BearingRangeFix(3.0, "b", "p", 0.2, 2.5, SEEN_COV),
    ],
}

# Of robot a all that matters is its odometry, which is what the estimate must be.
ODOMETRY_ALONE = {
    "one robot": drive("a"),
    "a wait in the middle": [*drive("a", 4), Odometry(4.0, 9.0, "a", Pose2(), np.zeros((3, 3)))],
    "a note": [*drive("a"), MoveNote(3.0, "a", "b", "go", "arrived")],
    "a robot that nobody knows": [*drive("a"), RelativePoseFix(3.0, "a", "x", STEP, FIX_COV)],
    "a landmark that nobody knows": [*drive("a"), BearingRangeFix(3.0, "a", "x", 0.1, 2.0, SEEN_COV)],
    "a landmark at range zero": [*drive("a"), RangeFix(3.0, "a", "p", 0.0, 0.1)],
    "a landmark sighted once": [*drive("a"), BearingRangeFix(3.0, "a", "p", 0.1, 2.0, SEEN_COV)],
    "the direction of a landmark once": [*drive("a"), BearingFix(3.0, "a", "p", 0.1, 0.01)],
    "the distance of a landmark once": [*drive("a"), RangeFix(3.0, "a", "p", 2.0, 0.1)],
    "a survey of a landmark that nobody sees": [*drive("a"), LandmarkPrior(0.0, "p", np.ones(2), np.eye(2))],
    "a survey of many, a step late": [
        *drive("a"),
        *(LandmarkPrior(3.0, name, np.array([1.0, k]), np.eye(2)) for k, name in enumerate(LANDMARKS)),
    ],
    "a corner seen and not decided on": [*drive("a"), SIGHTING],
    "a corner": [*drive("a"), SIGHTING, CornerDecision(3.0, SIGHTING, 0, True)],
    "a wall between corners that nobody saw": [*drive("a"), WallDecision(3.0, 4, 5)],
}
STANDING = {
    "one robot that stands": stand("a"),
    "one that stands, and surveys that nobody sees": [
        *stand("a"),
        *(LandmarkPrior(0.0, name, np.ones(2), np.eye(2)) for name in LANDMARKS),
    ],
    "one that stands, and a landmark seen again and again": [
        *stand("a"),
        *at_each_step(lambda t: BearingRangeFix(t, "a", "p", 0.1, 2.0, SEEN_COV)),
    ],
    "only a note": [MoveNote(0.0, "a", "b", "go", "arrived")],
    "only a survey of a landmark": [LandmarkPrior(0.0, "p", np.ones(2), np.eye(2))],
}
# Both are placed, more or less well.
CONNECTED = {
    "one fix": [*BOTH, RelativePoseFix(0.0, "a", "b", Pose2(1, 1, 1), FIX_COV)],
    "one fix by the other": [*BOTH, RelativePoseFix(8.0, "b", "a", Pose2(1, 1, 1), FIX_COV)],
    "the first robot only sees": [*drive("b"), RelativePoseFix(3.0, "a", "b", Pose2(1, 1, 1), FIX_COV)],
    "a loop closure alone": [*BOTH, LoopClosure(2.0, 5.0, "a", "b", Pose2(1, 1, 1), FIX_COV)],
    "a survey": [*BOTH, PosePrior(4.0, "b", Pose2(2, 3, 1), FIX_COV)],
}


def settled(name, records):
    return run(name, synchronized(records), ROBOTS, LANDMARKS, EstimatorSettings())


def check(estimate):
    """Numbers everywhere: finite poses, covariances that are some."""
    for robot in filter(estimate.timeline.is_placed, ROBOTS):
        if not estimate.timeline.tracks[robot].keys:
            continue
        trajectory = estimate.trajectory(robot)
        covariances = [*trajectory.covariances, estimate.belief(robot).cov_body]
        assert np.isfinite([xytheta(pose) for pose in trajectory.poses]).all()
        assert all((np.linalg.eigvalsh(cov) > 0).all() for cov in covariances)
        assert len(estimate.causal_trajectory(robot).poses) <= len(trajectory.poses)
    for landmark in estimate.landmarks:
        belief = estimate.landmark_belief(landmark)
        assert np.isfinite(belief.xy).all() and (np.linalg.eigvalsh(belief.cov) > 0).all()
    for vertex in estimate.vertices:
        assert (np.linalg.eigvalsh(estimate.vertex_belief(vertex).cov_body) > 0).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("log", UNCONNECTED)
def test_robots_that_nothing_ties_to_the_first_are_named(name, log):
    with pytest.raises(CoopSlamError, match="b is not connected to a"):
        settled(name, UNCONNECTED[log])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("log", ODOMETRY_ALONE)
def test_what_tells_nothing_of_a_robot_leaves_its_odometry(name, log):
    estimate = settled(name, ODOMETRY_ALONE[log]).estimate
    check(estimate)
    there = Pose2()
    for record in ODOMETRY_ALONE[log]:
        if isinstance(record, Odometry):
            there = there * record.T_start_now
    assert there.equals(estimate.pose("a"), 1e-6)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("log", STANDING)
def test_who_does_not_move_stays_at_the_origin(name, log):
    estimate = settled(name, STANDING[log]).estimate
    check(estimate)
    if estimate.timeline.tracks["a"].keys:
        assert Pose2().equals(estimate.pose("a"), 1e-6)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("log", CONNECTED)
def test_one_measurement_places_the_other_robot(name, log):
    estimate = settled(name, CONNECTED[log]).estimate
    check(estimate)
    assert all(map(estimate.timeline.is_placed, ROBOTS))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("target", ["b", "p"])
@pytest.mark.parametrize("kind", ["range", "bearing"])
def test_ranges_or_bearings_alone_give_an_estimate_or_a_reason(name, target, kind):
    """Of exact measurements: b drives beside a, 3 m to its left; p stands."""

    def record(robot, stamp_s, T_world_robot, xy):
        there = T_world_robot.transformTo(xy)
        if kind == "range":
            return RangeFix(stamp_s, robot, target, float(np.hypot(*there)), 0.02)
        return BearingFix(stamp_s, robot, target, float(np.arctan2(there[1], there[0])), 0.01)

    where, fixes = {"a": Pose2(), "b": Pose2(0.0, 3.0, 0.0)}, []
    for k in range(STEPS):
        where = {robot: pose * STEP for robot, pose in where.items()}
        xy = where["b"].translation() if target == "b" else np.array([4.0, 1.0])
        fixes.append(record("a", k + 1.0, where["a"], xy))
    try:
        estimate = settled(name, drive("a") + (drive("b") if target == "b" else []) + fixes).estimate
    except CoopSlamError as error:
        assert "b is not connected to a" in str(error)
    else:
        check(estimate)
        assert where["a"].equals(estimate.pose("a"), 1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_a_log_without_records_and_a_name_that_nobody_has(name):
    with pytest.raises(BadInput, match="no records"):
        run(name, [], ROBOTS, LANDMARKS, EstimatorSettings())
    with pytest.raises(BadInput, match="no estimator is called kalman"):
        run("kalman", drive("a"), ROBOTS, LANDMARKS, EstimatorSettings())
