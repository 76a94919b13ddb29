import gtsam
import numpy as np
import pytest
from landmark_world import landmark_world
from leapfrog import FIX_COV, ROBOTS, difference, leapfrog

from coopslam.errors import BadRecord
from coopslam.estimation.keys import landmark_key, pose_key, value_of, vertex_key
from coopslam.estimation.timeline import Timeline, TimelineSettings, is_motion
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
    TriangleDecision,
    WallDecision,
)
from coopslam.se2 import Pose2, compose_leg

COV = np.diag([0.01, 0.01, 0.01]) ** 2
R0, R1 = ROBOTS


class Run:
    """A timeline with its guesses as the current values."""

    def __init__(self, robots=ROBOTS, landmarks=(), **settings):
        self.timeline = Timeline(robots, landmarks, TimelineSettings(**settings))
        self.values, self.graph = gtsam.Values(), gtsam.NonlinearFactorGraph()

    def take(self, *records):
        growth = self.timeline.extend(records, lambda key: value_of(self.values, key))
        self.values.insert(growth.values)
        self.graph.push_back(growth.graph)
        return growth

    def factor_keys(self):
        return [tuple(self.graph.at(i).keys()) for i in range(self.graph.size())]


def drive(robot, start_s, stamp_s, delta=None):
    return Odometry(start_s, stamp_s, robot, delta or Pose2(1.0, 0.0, 0.1), COV)


def fix(stamp_s, observer=R0, target=R1, relative=None):
    return RelativePoseFix(stamp_s, observer, target, relative or Pose2(2.0, 1.0, 0.5), FIX_COV)


def sighting(stamp_s, observer=R0):
    return CornerSighting(stamp_s, observer, Pose2(0.2, 0.1, -1.0), COV, 1.5, 0.01)


def test_a_stationary_robot_keeps_one_variable_and_odometry_is_composed_between_the_mover_s():
    run = Run()
    run.take(fix(0.0))
    deltas = [Pose2(1.0, 0.1, 0.3), Pose2(0.5, 0.0, -1.0)]
    run.take(drive(R1, 0.0, 1.0, deltas[0]), drive(R1, 1.0, 2.0, deltas[1]), fix(2.0), fix(2.0), fix(2.5))
    assert [len(run.timeline.tracks[robot].keys) for robot in ROBOTS] == [1, 2]
    assert run.timeline.stamps == {pose_key(0, 0): 0.0, pose_key(1, 0): 0.0, pose_key(1, 1): 2.0}
    leg = next(run.graph.at(i) for i, keys in enumerate(run.factor_keys()) if keys == (pose_key(1, 0), pose_key(1, 1)))
    assert difference(leg.measured(), deltas[0] * deltas[1]) < 1e-12
    _, cov = compose_leg(deltas, [COV, COV])
    np.testing.assert_allclose(leg.noiseModel().covariance(), cov, rtol=1e-9)
    assert run.factor_keys().count((pose_key(0, 0), pose_key(1, 1))) == 3


def test_a_sighting_makes_a_variable_and_the_later_decision_finds_it():
    run = Run()
    seen = sighting(1.0)
    run.take(drive(R0, 0.0, 1.0), seen)
    assert run.graph.size() == 2  # prior and leg: a bare sighting is no factor
    run.take(drive(R0, 1.0, 2.0), sighting(2.0), CornerDecision(2.0, seen, 7, True))
    assert run.factor_keys()[-1] == (pose_key(0, 1), vertex_key(7))
    assert run.timeline.vertices == [7]
    expected = run.values.atPose2(pose_key(0, 1)) * seen.T_observer_corner
    assert difference(run.values.atPose2(vertex_key(7)), expected) < 1e-12


def test_a_sighting_from_where_the_robot_stood_is_kept_and_one_from_mid_drive_is_dropped():
    run = Run()
    run.take(drive(R0, 0.0, 1.0), sighting(1.0), drive(R0, 5.0, 6.0), sighting(6.0))
    run.take(CornerDecision(6.0, sighting(4.0), 1, True), CornerDecision(6.0, sighting(5.5), 2, True))
    assert run.factor_keys()[-1] == (pose_key(0, 1), vertex_key(1))
    assert run.timeline.dropped == {"CornerSighting: older than the odometry after it": 1}


def test_odometry_that_goes_back_in_time_is_dropped_and_counted():
    run = Run()
    run.take(drive(R0, 0.0, 1.0), drive(R0, 0.0, 1.0), drive(R0, 0.5, 1.5), drive(R0, 1.0, 2.0), sighting(2.0))
    assert run.timeline.dropped == {"Odometry: overlaps what was already driven": 2}
    assert run.timeline.used["Odometry"] == 2
    assert difference(run.values.atPose2(pose_key(0, 1)), Pose2(1, 0, 0.1) * Pose2(1, 0, 0.1)) < 1e-12


@pytest.mark.parametrize("observer", ROBOTS)
def test_another_robot_starts_from_its_first_fix_in_either_direction(observer):
    relative = Pose2(2.0, 1.0, 0.5)
    run = Run()
    run.take(drive(R0, 0.0, 1.0), fix(1.0, observer, R1 if observer == R0 else R0, relative))
    expected = Pose2(1.0, 0.0, 0.1) * (relative if observer == R0 else relative.inverse())
    assert difference(run.values.atPose2(pose_key(1, 0)), expected) < 1e-12


def test_what_concerns_a_robot_without_a_place_waits_for_it():
    run = Run(("robot0", "robot1", "robot2"))
    seen = sighting(1.0, "robot2")
    run.take(drive(R0, 0.0, 1.0), drive("robot2", 0.0, 1.0), seen, CornerDecision(1.0, seen, 3, True))
    run.take(fix(1.0, "robot1", "robot2"), WallDecision(1.0, 3, 4))
    assert run.timeline.held_back == 4  # leg, corner, fix, wall
    assert not run.timeline.is_placed("robot2") and run.timeline.vertices == []
    assert list(run.values.keys()) == [pose_key(0, 0)]
    growth = run.take(fix(1.0, "robot0", "robot1", Pose2(0.0, 3.0, 1.0)))
    assert run.timeline.held_back == 1  # the wall: vertex 4 is still unknown
    assert set(growth.poses) == {pose_key(0, 1), pose_key(1, 0), pose_key(2, 0), pose_key(2, 1)}
    T_world_robot2 = Pose2(1, 0, 0.1) * Pose2(0, 3, 1) * Pose2(2, 1, 0.5)
    assert difference(run.values.atPose2(pose_key(2, 1)), T_world_robot2) < 1e-12
    assert difference(run.values.atPose2(vertex_key(3)), T_world_robot2 * seen.T_observer_corner) < 1e-12
    run.take(CornerDecision(1.0, sighting(1.0), 4, True))
    assert run.timeline.held_back == 0 and (vertex_key(3), vertex_key(4)) in run.factor_keys()


def test_a_vertex_of_a_robot_without_a_place_is_placed_by_one_that_has_it():
    run = Run()
    lost, seen = sighting(0.0, R1), sighting(0.0, R0)
    run.take(CornerDecision(0.0, lost, 1, True), CornerDecision(0.0, seen, 1, False))
    assert run.timeline.vertices == [1] and not run.timeline.is_placed(R1)
    assert difference(run.values.atPose2(vertex_key(1)), seen.T_observer_corner) < 1e-12
    run.take(fix(0.0))
    assert sorted(run.factor_keys()[-2:]) == sorted([(pose_key(1, 0), vertex_key(1)), (pose_key(0, 0), pose_key(1, 0))])
    assert run.timeline.vertices == [1] and run.timeline.held_back == 0


def test_a_fix_guesses_better_than_hopeless_odometry():
    run = Run()
    run.take(fix(0.0))
    legged = Odometry(0.0, 1.0, R1, Pose2(9.0, 9.0, 2.0), np.eye(3))
    run.take(legged, fix(1.0, R0, R1, Pose2(3.0, 0.0, 0.0)))
    assert difference(run.values.atPose2(pose_key(1, 1)), Pose2(3.0, 0.0, 0.0)) < 1e-12


def test_decisions_without_measurement_add_nothing_and_what_is_unusable_is_counted():
    run = Run()
    run.take(
        TriangleDecision(0.0, 0, (1, 2, 3)), MoveNote(0.0, R0, R1, "m", "e"), RangeFix(0.0, R0, "stranger", 1.0, 0.1)
    )
    run.take(BearingRangeFix(0.0, R0, R1, 0.0, 0.0, np.eye(2)))
    assert run.graph.size() == 0
    assert run.timeline.dropped == {"RangeFix: unknown robot": 1, "BearingRangeFix: range zero": 1}
    with pytest.raises(BadRecord, match="different names of robots"):
        Timeline(("a", "a"))


def test_the_same_records_give_the_same_keys_however_they_are_grouped():
    records = leapfrog(np.random.default_rng(0), legs=8).records
    whole, single = Run(), Run()
    whole.take(*records)
    for record in records:
        single.take(record)
    assert whole.timeline.stamps == single.timeline.stamps
    assert whole.factor_keys() == single.factor_keys()


@pytest.mark.parametrize("kind", ["bearing and range", "range", "bearing"])
def test_landmarks_and_meetings_too_are_the_same_however_they_are_grouped(kind):
    """Records of two robots that find each other on the way: keys, their order, and every number of the graph."""
    world = landmark_world(4, kind=kind)
    runs = []
    for group in (1, 7, 10_000):
        run = Run(world.robots, tuple(world.landmarks))
        for k in range(0, len(world.records), group):
            run.take(*world.records[k : k + group])
        runs.append(run)
    assert runs[0].timeline.is_placed("r1") or kind == "bearing"
    assert runs[0].timeline.placed_landmarks
    for run in runs[1:]:
        assert run.timeline.stamps == runs[0].timeline.stamps
        assert run.timeline.placed_landmarks == runs[0].timeline.placed_landmarks
        assert run.graph.equals(runs[0].graph, 1e-12)
        assert run.values.equals(runs[0].values, 1e-9)


@pytest.mark.parametrize("first_robot_began", [True, False])
def test_a_pose_prior_gives_a_robot_its_place(first_robot_began):
    run, place = Run(), Pose2(3.0, 4.0, 1.0)
    if first_robot_began:
        run.take(sighting(0.5, R0))
    growth = run.take(drive(R1, 0.0, 1.0), PosePrior(1.0, R1, place, COV))
    assert run.timeline.is_placed(R1)
    assert difference(run.values.atPose2(pose_key(0, 0)), Pose2()) < 1e-12
    assert difference(run.values.atPose2(pose_key(1, 1)), place) < 1e-12
    assert difference(run.values.atPose2(pose_key(1, 0)), place * Pose2(1.0, 0.0, 0.1).inverse()) < 1e-12
    edge = growth.tree[-1]
    assert (edge.key_a, edge.key_b) == (pose_key(0, 0), pose_key(1, 1)) and difference(edge.T_a_b, place) < 1e-12
    priors = [run.graph.at(i) for i, keys in enumerate(run.factor_keys()) if keys == (pose_key(1, 1),)]
    assert [difference(prior.prior(), place) < 1e-12 for prior in priors] == [True]
    run.take(drive(R0, 1.0, 2.0), sighting(2.0, R0))  # the first robot's odometry comes later
    assert not run.timeline.dropped
    assert difference(run.values.atPose2(pose_key(0, 1)), Pose2(1.0, 0.0, 0.1)) < 1e-12


def test_a_pose_prior_of_the_first_robot_is_one_more_factor():
    run = Run()
    run.take(drive(R0, 0.0, 1.0), PosePrior(1.0, R0, Pose2(1.1, 0.0, 0.1), COV))
    assert run.factor_keys() == [(pose_key(0, 0),), (pose_key(0, 0), pose_key(0, 1)), (pose_key(0, 1),)]
    assert difference(run.values.atPose2(pose_key(0, 1)), Pose2(1.0, 0.0, 0.1)) < 1e-12  # odometry guesses


def test_a_landmark_prior_is_a_place_at_once():
    run = Run(landmarks=("tree", "post"))
    fixes = [BearingFix(0.0, R0, "post", 0.1, 0.01), RangeFix(0.0, R0, "post", 2.0, 0.1)]
    run.take(*fixes)
    assert run.timeline.held_back == 2
    run.take(LandmarkPrior(0.0, "post", [2.0, 0.2], np.eye(2)), LandmarkPrior(0.0, "house", np.zeros(2), np.eye(2)))
    assert run.timeline.placed_landmarks == ["post"] and run.timeline.held_back == 0
    np.testing.assert_array_equal(run.values.atPoint2(landmark_key(1)), [2.0, 0.2])
    assert run.factor_keys()[1:] == [(pose_key(0, 0), landmark_key(1))] * 2 + [(landmark_key(1),)]
    assert run.timeline.dropped == {"LandmarkPrior: unknown landmark": 1}
    run.take(LandmarkPrior(0.0, "post", [9.0, 9.0], np.eye(2)))  # a second one moves no guess
    np.testing.assert_array_equal(run.values.atPoint2(landmark_key(1)), [2.0, 0.2])


def test_a_loop_closure_finds_a_past_pose_where_each_leg_has_its_own():
    closure = LoopClosure(1.0, 3.0, R0, R0, Pose2(2.0, 0.3, 0.2), COV)
    steps = [drive(R0, k, k + 1) for k in range(3)]
    run = Run(every_leg=True)
    run.take(*steps, closure)
    assert run.factor_keys()[-1] == (pose_key(0, 1), pose_key(0, 3))
    factor = run.graph.at(run.graph.size() - 1)
    assert difference(factor.measured(), closure.T_earlier_now) < 1e-12
    np.testing.assert_allclose(factor.noiseModel().covariance(), COV, rtol=1e-9)
    without = Run()
    without.take(*steps, closure)
    assert without.timeline.dropped == {"LoopClosure: older than the odometry after it": 1}


def test_a_loop_closure_with_another_robots_past_places_a_robot():
    run = Run(every_leg=True)
    run.take(*(drive(R0, k, k + 1) for k in range(3)), drive(R1, 0.0, 4.0))
    run.take(LoopClosure(2.0, 4.0, R0, R1, Pose2(0.5, 0.5, 3.0), COV), LoopClosure(2.0, 4.0, "x", R1, Pose2(), COV))
    expected = Pose2(1.0, 0.0, 0.1) * Pose2(1.0, 0.0, 0.1) * Pose2(0.5, 0.5, 3.0)
    assert difference(run.values.atPose2(pose_key(1, 1)), expected) < 1e-12
    assert run.timeline.dropped == {"LoopClosure: unknown robot": 1}


def test_a_target_that_nobody_knows_is_dropped_and_counted():
    run = Run(landmarks=("tree",))
    run.take(BearingFix(0.0, R0, "house", 0.1, 0.1), BearingFix(0.0, "x", "tree", 0.1, 0.1), fix(0.0, R0, "house"))
    assert run.timeline.dropped == {
        "BearingFix: unknown target": 1,
        "BearingFix: unknown robot": 1,
        "RelativePoseFix: unknown target": 1,
    }
    assert run.graph.size() == 0
    with pytest.raises(BadRecord, match="different names"):
        Timeline(("a", "b"), ("b",))


def test_who_saw_whom_is_counted():
    run = Run(landmarks=("tree",))
    run.take(
        BearingFix(1.0, R1, "tree", 0.1, 0.1), RangeFix(3.0, R1, "tree", 1.0, 0.1), RangeFix(2.0, R0, R1, 1.0, 0.1)
    )
    told = {pair: (seen.times, seen.last_s) for pair, seen in run.timeline.seen.items()}
    assert told == {(R1, "tree"): (2, 3.0), (R0, R1): (1, 2.0)}


@pytest.mark.parametrize(
    ("step", "cov", "moves"),
    [
        (Pose2(), np.zeros((3, 3)), False),
        (Pose2(0, 0, 1e-9), np.zeros((3, 3)), True),
        (Pose2(0, -1e-9, 0), np.zeros((3, 3)), True),
        (Pose2(), np.diag([0.0, 0.0, 1e-9]), True),  # it may have turned
    ],
)
def test_what_is_motion(step, cov, moves):
    assert is_motion(Odometry(0.0, 1.0, R0, step, cov)) is moves
