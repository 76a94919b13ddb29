"""Robots and corners that get their place late, and every kind of measurement together, in the joint filter."""

import gtsam
import numpy as np
import pytest
from filter_runs import POST, R0, R1, SEEN_COV, STEP_COV, batch_of, run, seen, without
from leapfrog import FIX_COV, ROBOTS, difference, leapfrog
from scipy.linalg import block_diag

from coopslam.estimation.batch import BatchEstimate, solve_batch
from coopslam.estimation.ekf import TOO_LATE, Ekf
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
from coopslam.se2 import Pose2, position, xytheta

# ---- robots that get their place late ----


def late_world(rng, joins_back=False):
    """Three robots; 1 and 2 know each other long before 0 sees 1, and all have driven meanwhile."""
    robots = (R0, R1, "robot2")
    where = {R0: Pose2(), R1: Pose2(2.0, 1.0, 0.3), "robot2": Pose2(3.0, -1.0, 2.0)}

    def drive(t):
        group = []
        for robot, turn in zip(robots, (0.1, -0.2, 0.3), strict=True):
            step = Pose2(0.4, 0.0, turn)
            where[robot] = where[robot] * step
            noise = rng.normal(size=3) * np.sqrt(np.diag(STEP_COV)) * 0.01
            group.append(Odometry(t, t + 1.0, robot, step * Pose2(*noise), STEP_COV * 1e-4))
        return group

    def fix(t, observer, target):
        noise = rng.normal(size=3) * np.sqrt(np.diag(FIX_COV)) * 0.01
        relative = xytheta(where[observer].between(where[target])) + noise
        return RelativePoseFix(t, observer, target, Pose2(*relative), FIX_COV * 1e-4)

    groups = [[fix(0.0, R1, "robot2")]]
    groups += [drive(0.0) + [fix(1.0, R1, "robot2")]]
    groups += [drive(1.0) + [fix(2.0, "robot2", R1)]]
    groups += [drive(2.0) + [fix(3.0, R1, R0) if joins_back else fix(3.0, R0, R1)]]
    return robots, groups, where


@pytest.mark.parametrize("joins_back", [False, True])
@pytest.mark.parametrize("at_once", [False, True])
def test_robots_that_are_placed_late_come_with_the_covariance_of_their_tree(joins_back, at_once):
    """Against a batch of the edges alone: odometry, the first fix of 1 and 2, and the fix that placed them."""
    robots, groups, where = late_world(np.random.default_rng(10), joins_back)
    estimator = Ekf(robots)
    for group in [sum(groups, [])] if at_once else groups:
        estimate = estimator.update(group)
    fixes = [i for i in range(estimator.graph.size()) if _is_fix(estimator.graph.at(i))]
    assert len(fixes) == 4 and estimator.timeline.dropped[f"RelativePoseFix: {TOO_LATE}"] == 2
    unused = sorted(fixes, key=lambda i: _last_number(estimator.graph.at(i).keys()))[1:3]
    graph = without(estimator.graph, unused)
    batch = BatchEstimate(estimator.timeline, graph, solve_batch(graph, estimator.values()))
    keys = [estimate.pose_key(robot) for robot in robots]
    for robot, key in zip(robots, keys, strict=True):
        assert difference(estimate.pose(robot), where[robot]) < 0.01  # sigmas of 1e-4 m and 1e-4 rad, levers of 3 m
        assert difference(estimate.value(key), batch.value(key)) < 1e-8
    np.testing.assert_allclose(estimate.joint_covariance(keys), batch.joint_covariance(keys), rtol=1e-5, atol=1e-13)
    for robot in robots[1:]:
        track = estimator.timeline.tracks[robot].keys
        assert len(track) > 2
        for past in track[:-1]:
            assert difference(estimate.value(past), batch.value(past)) < 1e-8
            np.testing.assert_allclose(estimate.covariance(past), batch.covariance(past), rtol=1e-5, atol=1e-13)
        assert len(estimate.causal_trajectory(robot).poses) == len(track)


def _is_fix(factor):
    keys = factor.keys()
    return isinstance(factor, gtsam.BetweenFactorPose2) and keys[0] >> 32 != keys[1] >> 32


def _last_number(keys):
    return max(gtsam.symbolIndex(key) & 0xFFFF for key in keys)


def test_a_prior_places_a_robot_in_the_frame_itself():
    estimator = Ekf(ROBOTS)
    estimator.update([Odometry(0.0, 1.0, R0, Pose2(5, 0, 1), STEP_COV), RangeFix(1.0, R0, R1, 3.0, 0.1)])
    cov = np.diag([0.1, 0.2, 0.05]) ** 2
    estimate = estimator.update([PosePrior(1.0, R1, Pose2(2.0, 3.0, 0.7), cov)])
    assert difference(estimate.pose(R1), Pose2(2.0, 3.0, 0.7)) < 0.2  # the range of 3.0 m has moved both
    # the prior alone gives cov; the range that waited for the robot takes something away
    assert np.linalg.eigvalsh(cov - estimate.covariance(estimate.pose_key(R1)))[0] > -1e-12
    assert estimator.innovations[0].kind == "range of a robot"


def is_at_least(cov, other):
    return np.linalg.eigvalsh(cov - other)[0] > -1e-9 * np.abs(cov).max()


def test_a_robot_that_a_pose_of_the_past_ties_is_found_by_odometry_back():
    """Exact in the mean; the way back counts as new odometry, so the covariance is at least that of a batch."""
    estimator = Ekf(ROBOTS)
    for t in range(3):  # the ranges give robot 0 a pose at each stop, and wait for robot 1
        step = Odometry(t, t + 1.0, R0, Pose2(1.0, 0.2, 0.4), STEP_COV)
        estimator.update([step, RangeFix(t + 1.0, R0, R1, 3.0, 1e3)])
    estimate = estimator.update([LoopClosure(1.0, 3.0, R0, R1, Pose2(2.0, -1.0, 0.3), FIX_COV)])
    batch = batch_of(estimator)
    assert difference(estimate.pose(R1), batch.pose(R1)) < 1e-6  # ranges of a kilometre's sigma say nothing
    key = estimate.pose_key(R1)
    assert is_at_least(estimate.covariance(key), batch.covariance(key) * (1 - 1e-6))
    assert np.trace(estimate.covariance(key)) < 5 * np.trace(batch.covariance(key))


def test_a_corner_that_only_poses_of_the_past_have_seen_is_placed_by_odometry_since():
    estimator, sees = Ekf(ROBOTS), Pose2(0.2, 0.1, 1.0)
    sighting = CornerSighting(1.0, R1, sees, FIX_COV, 1.5, 0.01)
    estimator.update([Odometry(0.0, 1.0, R1, Pose2(1, 0, 0.5), STEP_COV), CornerDecision(1.0, sighting, 4, True)])
    drive = Odometry(1.0, 2.0, R1, Pose2(1, 0, 0.5), STEP_COV)
    estimate = estimator.update([drive, RelativePoseFix(2.0, R0, R1, Pose2(3, 1, 2), FIX_COV)])
    batch = batch_of(estimator)
    assert estimate.vertices == [4] and not estimator.timeline.dropped
    assert difference(estimate.vertex(4), batch.vertex(4)) < 1e-9
    np.testing.assert_allclose(estimate.vertex_belief(4).cov_body, batch.vertex_belief(4).cov_body, rtol=1e-5)
    estimator.update([WallDecision(2.0, 4, 9)])  # of a corner that nobody has seen: it waits
    assert estimator.timeline.held_back == 1


# ---- every kind of factor together ----


def test_all_kinds_of_sightings_and_priors_agree_with_a_batch():
    rng = np.random.default_rng(11)
    estimator, poses = Ekf(ROBOTS, ("post",)), {R0: Pose2(), R1: Pose2(2.0, 0.5, 1.0)}
    scale = 1e-2  # of sigmas of centimetres: nearly linear
    estimator.update(
        [
            LandmarkPrior(0.0, "post", POST + rng.normal(size=2) * 0.05 * scale, np.eye(2) * (0.05 * scale) ** 2),
            RelativePoseFix(0.0, R0, R1, poses[R1], FIX_COV * scale**2),
        ]
    )
    for t in range(4):
        group = []
        for robot, turn in ((R0, 0.2), (R1, -0.3)):
            step = Pose2(0.3, 0.0, turn)
            poses[robot] = poses[robot] * step
            noise = rng.normal(size=3) * np.sqrt(np.diag(STEP_COV)) * scale
            group.append(Odometry(t, t + 1.0, robot, step * Pose2(*noise), STEP_COV * scale**2))
        there, ours = poses[R1].transformTo(POST), poses[R0].transformTo(position(poses[R1]))
        now, e = t + 1.0, rng.normal(size=4) * scale
        group += [
            BearingFix(now, R1, "post", np.arctan2(there[1], there[0]) + 0.02 * e[0], 0.02 * scale),
            RangeFix(now, R1, "post", np.hypot(*there) + 0.05 * e[1], 0.05 * scale),
            BearingFix(now, R0, R1, np.arctan2(ours[1], ours[0]) + 0.02 * e[2], 0.02 * scale),
            RangeFix(now, R0, R1, np.hypot(*ours) + 0.05 * e[3], 0.05 * scale),
            BearingRangeFix(now, R0, R1, np.arctan2(ours[1], ours[0]), np.hypot(*ours), SEEN_COV * scale**2),
            seen(now, R0, "post", poses[R0], POST),
            PosePrior(now, R1, poses[R1], FIX_COV * scale**2),
        ]
        estimate = estimator.update(group)
    batch = batch_of(estimator)
    keys = [estimate.pose_key(R0), estimate.landmark_key("post"), estimate.pose_key(R1)]
    ours, theirs = estimate.joint_covariance(keys), batch.joint_covariance(keys)
    sigmas = np.sqrt(np.diag(theirs))
    np.testing.assert_allclose(ours / np.outer(sigmas, sigmas), theirs / np.outer(sigmas, sigmas), atol=0.01)
    for key, sigma in zip(keys, (sigmas[:3], sigmas[3:5], sigmas[5:]), strict=True):
        apart = np.asarray(estimate.any_value(key) - batch.any_value(key)) if len(sigma) == 2 else 0.0
        if len(sigma) == 3:
            apart = xytheta(batch.value(key).between(estimate.value(key)))
        assert np.abs(apart / sigma).max() < 0.05  # linearized at another place, by a tenth of a millimetre
    assert {kind for kind, _, _ in estimator.innovations} == {
        *("bearing of a landmark", "range of a landmark", "bearing of a robot", "range of a robot"),
        *("bearing-range of a robot", "bearing-range of a landmark", "pose prior"),
    }
    assert not estimator.timeline.dropped


@pytest.mark.parametrize("kind", [BearingFix, RangeFix])
def test_a_landmark_that_is_only_heard_or_only_seen_gets_a_place_with_a_covariance_that_holds(kind):
    estimator, pose = Ekf((R0,), ("post",)), Pose2()
    errors = []
    for t in range(24):
        pose = pose * Pose2(0.4, 0.0, 0.25)
        there = pose.transformTo(POST)
        fix = (
            BearingFix(t + 1.0, R0, "post", float(np.arctan2(there[1], there[0])), 0.01)
            if kind is BearingFix
            else RangeFix(t + 1.0, R0, "post", float(np.hypot(*there)), 0.02)
        )
        estimate = estimator.update([Odometry(t, t + 1.0, R0, Pose2(0.4, 0.0, 0.25), STEP_COV * 0.01), fix])
        if estimate.landmarks:
            belief = estimate.landmark_belief("post")
            errors.append((belief.xy - POST) @ np.linalg.solve(belief.cov, belief.xy - POST))
    assert len(errors) > 10 and max(errors) < 9.2  # exact sightings; chi-square with 2 dof, 1 %
    assert np.hypot(*(estimate.landmark("post") - POST)) < 0.05


def test_block_of_a_joint_covariance_follows_the_question():
    _, estimate = run(leapfrog(np.random.default_rng(12), legs=8, scale=0.1))
    a, b = estimate.pose_key(R0), estimate.vertex_key(2)
    joint, other = estimate.joint_covariance([a, b]), estimate.joint_covariance([b, a])
    np.testing.assert_array_equal(joint[:3, 3:], other[3:, :3])
    assert np.abs(joint - block_diag(joint[:3, :3], joint[3:, 3:])).max() > 0
