import gtsam
import numpy as np
import pytest
from landmark_world import STEP_S, landmark_world

from coopslam.errors import BadInput, UnderDetermined
from coopslam.estimation.keys import pose_key
from coopslam.estimation.loss import Loss
from coopslam.estimation.offline import SmoothSettings, smooth
from coopslam.estimation.timeline import TimelineSettings
from coopslam.records import BearingRangeFix, LoopClosure, Odometry
from coopslam.se2 import Pose2

ROBUST = TimelineSettings(loss=Loss("cauchy"))


def smoothed(world):
    return smooth(world.records, world.robots, world.landmarks, ROBUST)


def from_truth(world, result):
    """Where bare GTSAM ends in the same graph when it starts at the truth."""
    truth, timeline = gtsam.Values(), result.estimate.timeline
    for robot, track in timeline.tracks.items():
        for key in track.keys:
            true = world.truth[robot][round(timeline.stamps[key] / STEP_S)]
            truth.insert(key, world.in_first_start(true))
    for landmark in timeline.placed_landmarks:
        true = world.truth[world.robots[0]][0].transformTo(world.landmarks[landmark])
        truth.insert(result.estimate.landmark_key(landmark), true)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    return gtsam.LevenbergMarquardtOptimizer(result.solution.graph, truth, parameters).optimize()


@pytest.mark.parametrize("seed", range(20))
def test_the_basin_of_the_truth_is_found_without_the_truth(seed):
    """Unknown starts, and one name in twenty is false."""
    world = landmark_world(seed, false_share=0.05)
    assert world.false > 3
    result = smoothed(world)
    graph, best = result.solution.graph, from_truth(world, result)
    assert graph.error(result.solution.values) <= graph.error(best) * (1 + 1e-6)
    assert len(result.estimate.landmarks) >= 11  # the twelfth may hardly be seen
    for robot in world.robots:
        belief = result.estimate.belief(robot)
        error = belief.T_world_body.between(world.in_first_start(world.truth[robot][-1]))
        distance_sq = Pose2.Logmap(error) @ np.linalg.solve(belief.cov_body, Pose2.Logmap(error))
        assert distance_sq < 30  # one in a million of 3 degrees of freedom


def test_robots_by_themselves_are_smoothed_by_what_they_see_of_each_other():
    world = landmark_world(5, robots=3, targets="robots", steps=100)
    result = smoothed(world)
    graph = result.solution.graph
    assert graph.error(result.solution.values) == pytest.approx(graph.error(from_truth(world, result)), rel=1e-6)


def seen(stamp_s, observer, target):
    return BearingRangeFix(stamp_s, observer, target, 0.1, 1.0, np.diag([0.03, 0.08]) ** 2)


def test_a_robot_that_nothing_ties_is_named_with_what_it_saw():
    world = landmark_world(1, robots=3, blind=("r2",))
    with pytest.raises(UnderDetermined, match="r2 is not connected to r0.*r2 sees nothing and is never seen$"):
        smoothed(world)
    world.records += [seen(33.0, "r2", "L3"), seen(34.04, "r2", "L3")]
    expected = r"r2 sees only L3 \(2 times\), last at t = 34.0 s and is never seen$"
    with pytest.raises(UnderDetermined, match=expected) as caught:
        smoothed(world)
    assert "\n" not in str(caught.value)
    world.records += [seen(35.0 + k, "r2", f"L{k + 5}") for k in range(4)] + [seen(40.0, "r1", "r2")]
    expected = r"sees only L3 \(2 times\).* and 2 more, last at t = 38.0 s and is seen only by r1 \(1 times\)"
    with pytest.raises(UnderDetermined, match=expected):
        smoothed(world)


def ring(rng, count=80, laps=3, sigmas=(0.05, 0.05, 0.08)):
    """Odometry of a robot that goes round in a circle and closes the loop once a lap, and the true poses."""
    step, cov = Pose2(1.0, 0.0, 2 * np.pi / count), np.diag(sigmas) ** 2
    truth, records = [Pose2()], []
    for k in range(laps * count):
        truth.append(truth[-1] * step)
        measured = step * Pose2(*(np.array(sigmas) * rng.standard_normal(3)))
        records.append(Odometry(float(k), float(k + 1), "a", measured, cov))
        if k + 1 >= count and (k + 1) % 10 == 0:
            earlier = k + 1 - count
            relative = truth[earlier].between(truth[-1]) * Pose2(*(0.02 * rng.standard_normal(3)))
            closure = LoopClosure(float(earlier), float(k + 1), "a", "a", relative, np.eye(3) * 0.02**2)
            records.append(closure)
    return records, truth


@pytest.mark.parametrize("seed", range(3))
def test_a_ring_with_hopeless_odometry_closes_from_nothing(seed):
    """After a lap the heading is off by 40 degrees: lago's start, which needs none, and the truth lead to one end."""
    records, truth = ring(np.random.default_rng(seed))
    timeline = TimelineSettings(every_leg=True)
    result = smooth(records, ("a",), (), timeline, SmoothSettings(start_period_s=1e6))
    graph, start = result.solution.graph, gtsam.Values()
    for k, pose in enumerate(truth):
        start.insert(pose_key(0, k), pose)
    assert result.solution.values.size() == len(truth)
    best = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    assert graph.error(result.solution.values) == pytest.approx(graph.error(best), rel=1e-5)
    assert graph.size() == len(records) + 1  # and the prior
    dead = gtsam.Values()
    dead.insert(pose_key(0, 0), Pose2())
    for record in records:
        if isinstance(record, Odometry):
            before = dead.atPose2(pose_key(0, int(record.start_s)))
            dead.insert(pose_key(0, int(record.stamp_s)), before * record.T_start_now)
    linear = gtsam.lago.initialize(graph, False)
    assert graph.error(linear) < 0.5 * graph.error(dead)
    assert graph.error(result.start) <= graph.error(linear) * (1 + 1e-6)  # lago's, or better


def test_a_period_that_is_none_is_refused():
    with pytest.raises(BadInput, match="start_period_s"):
        SmoothSettings(start_period_s=-1.0)
