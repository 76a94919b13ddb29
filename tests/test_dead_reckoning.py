import numpy as np
import pytest
from leapfrog import ROBOTS, difference, leapfrog

from coopslam.estimation.batch import Batch
from coopslam.estimation.dead_reckoning import DeadReckoning
from coopslam.records import CornerDecision, CornerSighting, Odometry, RelativePoseFix
from coopslam.se2 import Pose2


def test_a_straight_drive_has_the_closed_form_covariance():
    steps, length, sigma_m, sigma_rad = 50, 0.2, 0.003, 0.01
    estimator = DeadReckoning(("robot0",))
    cov = np.diag([sigma_m, sigma_m, sigma_rad]) ** 2
    for i in range(steps):
        drive = Odometry(float(i), i + 1.0, "robot0", Pose2(length, 0, 0), cov)
        estimate = estimator.update([drive, CornerSighting(i + 1.0, "robot0", Pose2(), np.eye(3), 1.0, 0.1)])
    arms = length * np.arange(steps)  # from where each heading error arose to the end
    expected = np.diag([steps * sigma_m**2, steps * sigma_m**2 + sigma_rad**2 * (arms**2).sum(), steps * sigma_rad**2])
    expected[1, 2] = expected[2, 1] = sigma_rad**2 * arms.sum()
    np.testing.assert_allclose(estimate.belief("robot0").cov_body, expected, rtol=1e-6, atol=1e-9)
    trajectory = estimate.trajectory("robot0")
    assert trajectory.covariances.shape == (steps + 1, 3, 3)
    np.testing.assert_allclose(trajectory.stamps_s, np.arange(steps + 1.0))


def spanning_tree(world):
    """Only odometry and the first fix: what dead reckoning uses, as a graph that a batch can solve.

    Sightings stay, so that both make the same variables.
    """
    first = next(r for r in world.records if isinstance(r, RelativePoseFix))
    return [r for r in world.records if isinstance(r, Odometry | CornerSighting) or r is first]


@pytest.mark.parametrize("late", [False, True])
def test_it_is_the_batch_of_odometry_and_the_first_fix(late):
    """Also when the fix that places robot1 comes last."""
    world = leapfrog(np.random.default_rng(9), legs=7)
    records = spanning_tree(world)
    if late:
        delta = Pose2(-3.0, 1.0, 2.0)
        records = [*records[1:], RelativePoseFix(records[-1].stamp_s, *ROBOTS[::-1], delta, records[0].cov_observer)]
    estimate, batch = DeadReckoning(ROBOTS).update(records), Batch(ROBOTS).update(records)
    keys = [key for track in batch.timeline.tracks.values() for key in track.keys]
    assert set(keys) == set(estimate.timeline.stamps) and len(keys) == 2 + 7
    for key in keys:
        assert difference(estimate.value(key), batch.value(key)) < 1e-6
    np.testing.assert_allclose(estimate.joint_covariance(keys), batch.joint_covariance(keys), rtol=1e-4, atol=1e-9)


def test_it_has_the_instants_of_the_batch_and_vertices_as_first_seen():
    world = leapfrog(np.random.default_rng(10), legs=6)
    estimate, batch = DeadReckoning(ROBOTS).update(world.records), Batch(ROBOTS).update(world.records)
    for robot in ROBOTS:
        ours = estimate.trajectory(robot)
        np.testing.assert_array_equal(ours.stamps_s, batch.trajectory(robot).stamps_s)
        assert len(estimate.causal_trajectory(robot).poses) == len(ours.poses)
    first = next(record for record in world.records if isinstance(record, CornerDecision))
    seen = first.sighting
    expected = estimate.value(estimate.pose_key_at(seen.observer, seen.stamp_s)) * seen.T_observer_corner
    assert estimate.vertex(first.vertex).equals(expected, 1e-12)
    again = DeadReckoning(ROBOTS)
    for group in world.groups:
        last = again.update(group)
    assert last.vertices == estimate.vertices == batch.vertices
    for vertex in last.vertices:
        assert last.vertex(vertex).equals(estimate.vertex(vertex), 1e-9)


def test_a_corner_that_a_robot_saw_before_it_had_a_place_gets_one_with_it():
    """Hand-worked: robot1 starts 1 m ahead of robot0, drives 2 m, and sees a corner 1 m to its left."""
    cov, estimator = np.eye(3) * 1e-4, DeadReckoning(ROBOTS)
    sighting = CornerSighting(1.0, ROBOTS[1], Pose2(0, 1, 0), cov, 1.5, 0.01)
    estimator.update([Odometry(0.0, 1.0, ROBOTS[1], Pose2(2, 0, 0), cov), sighting])
    estimate = estimator.update([CornerDecision(1.0, sighting, 7, True)])
    assert estimate.vertices == []
    estimate = estimator.update([RelativePoseFix(1.0, ROBOTS[0], ROBOTS[1], Pose2(3, 0, 0), cov)])
    assert estimate.vertices == [7]
    assert estimate.vertex(7).equals(Pose2(3, 1, 0), 1e-9)


def test_a_decision_on_a_sighting_that_was_dropped_does_no_harm():
    cov, estimator = np.eye(3) * 1e-4, DeadReckoning(ROBOTS[:1])
    drive = [Odometry(float(k), k + 1.0, ROBOTS[0], Pose2(1, 0, 0), cov) for k in range(4)]
    late = CornerSighting(1.5, ROBOTS[0], Pose2(0, 1, 0), cov, 1.5, 0.01)
    estimator.update(drive)
    estimate = estimator.update([late, CornerDecision(4.0, late, 0, True)])
    assert estimate.vertices == [] and sum(estimator.timeline.dropped.values()) == 2
