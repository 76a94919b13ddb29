from math import inf

import gtsam
import numpy as np
import pytest
from leapfrog import FIX_COV, ROBOTS, difference, leapfrog

from coopslam.errors import BadInput, UnderDetermined
from coopslam.estimation.batch import BatchEstimate, solve_batch
from coopslam.estimation.fixed_lag import FixedLag, FixedLagSettings
from coopslam.estimation.keys import pose_key
from coopslam.estimation.loss import Loss
from coopslam.estimation.timeline import TimelineSettings
from coopslam.evaluation.consistency import chi_square_band, pose_nees, position_nees
from coopslam.records import (
    BearingRangeFix,
    CornerDecision,
    CornerSighting,
    LandmarkPrior,
    Odometry,
    RangeFix,
    RelativePoseFix,
)
from coopslam.se2 import Pose2, position

R0, R1 = ROBOTS
STEP_COV = np.diag([0.02, 0.01, 0.01]) ** 2
SEEN_COV = np.diag([0.01, 0.03]) ** 2
POSTS = {"post1": np.array([8.0, 4.0]), "post2": np.array([-7.0, 5.0]), "post3": np.array([9.0, -9.0])}


def run(world, lag_s):
    estimator = FixedLag(ROBOTS, settings=FixedLagSettings(lag_s))
    for group in world.groups:
        estimate = estimator.update(group)
    return estimator, estimate


def batch_of(estimator):
    return BatchEstimate(estimator.timeline, estimator.graph, solve_batch(estimator.graph, estimator.values()))


def seen(stamp_s, observer, target, T_world_observer, point, rng=None, cov=SEEN_COV):
    """A bearing and range."""
    there = T_world_observer.transformTo(point)
    noise = np.zeros(2) if rng is None else rng.normal(size=2) * np.sqrt(np.diag(cov))
    bearing, range_m = np.arctan2(there[1], there[0]) + noise[0], np.hypot(*there) + noise[1]
    return BearingRangeFix(stamp_s, observer, target, bearing, range_m, cov)


def circling(rng, seconds, scale=1.0):
    """Two robots on circles of their own that see posts and each other: groups of records, and the last true poses.

    scale: of the sigmas of odometry and bearings.
    """
    step_cov, seen_cov = STEP_COV * scale**2, SEEN_COV * np.array([scale**2, 1.0])
    where = {R0: Pose2(), R1: Pose2(1.0, -2.0, 0.5)}
    groups = [[RelativePoseFix(0.0, R0, R1, where[R0].between(where[R1]), FIX_COV)]]
    for second in range(seconds):
        group, stamp_s = [], second + 1.0
        for robot, turn in ((R0, 0.1), (R1, -0.07)):
            step = Pose2(0.3, 0.0, turn)
            where[robot] = where[robot] * step
            noisy = step * Pose2(*(rng.normal(size=3) * np.sqrt(np.diag(step_cov))))
            group.append(Odometry(second, stamp_s, robot, noisy, step_cov))
        for robot, pose in where.items():
            post = list(POSTS)[second % 3]
            group.append(seen(stamp_s, robot, post, pose, POSTS[post], rng, seen_cov))
        group.append(seen(stamp_s, R0, R1, where[R0], position(where[R1]), rng, seen_cov))
        groups.append(group)
    return groups, where


# ---- against batch ----


def test_with_a_lag_longer_than_the_run_it_is_batch():
    estimator, estimate = run(leapfrog(np.random.default_rng(1), legs=40), lag_s=1e6)
    batch = batch_of(estimator)
    assert estimator.window_size == len(estimator.graph.keyVector())
    for robot in ROBOTS:
        ours, theirs = estimate.trajectory(robot), batch.trajectory(robot)
        # sigmas are 1 cm and more; an update stops when its next step would be a small part of 3 mm
        assert max(difference(a, b) for a, b in zip(ours.poses, theirs.poses, strict=True)) < 1e-4
        np.testing.assert_allclose(ours.covariances, theirs.covariances, rtol=0.02, atol=1e-7)
    keys = [estimate.vertex_key(4), estimate.pose_key(R0), estimate.vertex_key(1), estimate.pose_key(R1)]
    np.testing.assert_allclose(estimate.joint_covariance(keys), batch.joint_covariance(keys), rtol=0.02, atol=1e-6)


def test_where_the_problem_is_linear_a_short_lag_loses_nothing():
    """Headings without doubt: translations are linear then, and elimination is exact."""
    rng = np.random.default_rng(2)
    sure = np.diag([0.05, 0.03, 1e-6]) ** 2
    where = {R0: Pose2(), R1: Pose2(2.0, 1.0, 0.7)}

    def measured(pose):
        return Pose2(pose.x() + rng.normal() * 0.05, pose.y() + rng.normal() * 0.03, pose.theta())

    estimator = FixedLag(ROBOTS, settings=FixedLagSettings(3.0))
    estimate = estimator.update([RelativePoseFix(0.0, R0, R1, measured(where[R0].between(where[R1])), sure)])
    for second in range(60):
        robot, group = ROBOTS[second // 5 % 2], []
        where[robot] = where[robot] * Pose2(0.5, 0.1, 0.3)
        group.append(Odometry(second, second + 1.0, robot, measured(Pose2(0.5, 0.1, 0.3)), sure))
        group.append(RelativePoseFix(second + 1.0, R0, R1, measured(where[R0].between(where[R1])), sure))
        estimate = estimator.update(group)
    assert estimator.window_size < 10 < len(estimator.timeline.stamps)
    batch = batch_of(estimator)
    for robot in ROBOTS:  # what heading is left in doubt, 1e-6 rad times the root of 60, bends 20 m by some 1e-7 of it
        assert difference(estimate.pose(robot), batch.pose(robot)) < 1e-5
        np.testing.assert_allclose(estimate.belief(robot).cov_body, batch.belief(robot).cov_body, rtol=1e-4, atol=1e-11)
    keys = [estimate.pose_key(R0), estimate.pose_key(R1)]
    np.testing.assert_allclose(estimate.joint_covariance(keys), batch.joint_covariance(keys), rtol=1e-4, atol=1e-11)


def test_a_short_lag_stays_close_to_batch_and_as_sure_as_it():
    estimator, estimate = run(leapfrog(np.random.default_rng(3), legs=120), lag_s=6.0)
    batch = batch_of(estimator)
    assert estimator.window_size < 20
    for robot in ROBOTS:
        ours, theirs = estimate.belief(robot), batch.belief(robot)
        apart = np.abs(np.array(gtsam.Pose2.Logmap(theirs.T_world_body.between(ours.T_world_body))))
        assert (apart < 0.3 * np.sqrt(np.diag(theirs.cov_body))).all()  # linearization cost a part of a sigma
        np.testing.assert_allclose(np.diag(ours.cov_body), np.diag(theirs.cov_body), rtol=0.1)


def test_the_heading_of_the_whole_map_is_not_learned_from_relative_measurements():
    """With a prior in the axes of the frame instead of the anchor's these variances are 0.1 to 0.3 of batch's."""
    groups, _ = circling(np.random.default_rng(4), seconds=150, scale=6.0)
    estimator = FixedLag(ROBOTS, tuple(POSTS), FixedLagSettings(5.0))
    for group in groups:
        estimate = estimator.update(group)
    batch = batch_of(estimator)
    for post in POSTS:
        ours, theirs = estimate.landmark_belief(post), batch.landmark_belief(post)
        np.testing.assert_allclose(np.diag(ours.cov), np.diag(theirs.cov), rtol=0.1)
        apart = ours.xy - theirs.xy
        assert apart @ np.linalg.solve(theirs.cov, apart) < 0.1  # both have the same information


def test_its_covariances_are_honest_over_many_runs():
    """One current pose, one pose that left and one vertex of each run: 99.9 % bands, fixed seeds."""
    now, left, corners = [], [], []
    for seed in range(50):
        world = leapfrog(np.random.default_rng(2000 + seed), legs=20, scale=0.5)
        _, estimate = run(world, lag_s=5.0)
        belief, truth = estimate.belief(R1), world.truth[R1]
        now += list(pose_nees([belief.T_world_body], belief.cov_body[None], [truth.poses[-1]]))
        trajectory, middle = estimate.trajectory(R1), 15
        true = truth.poses[int(np.argmin(np.abs(truth.stamps_s - trajectory.stamps_s[middle])))]
        left += list(pose_nees([trajectory.poses[middle]], trajectory.covariances[middle][None], [true]))
        corner = estimate.vertex_belief(3)
        errors = position(corner.T_world_body)[None], corner.position_covariance[None]
        corners += list(position_nees(*errors, position(world.corners[3])[None]))
    for scores, dof in ((now, 3), (left, 3), (corners, 2)):
        low, high = chi_square_band(dof, len(scores), confidence=0.999)
        assert low < np.mean(scores) < high


# ---- what stays and what leaves ----


def test_a_standing_robot_stays_for_as_long_as_it_is_watched():
    estimator = FixedLag(ROBOTS, settings=FixedLagSettings(5.0))
    relative = Pose2(2.0, 0.0, 1.0)
    estimator.update([RelativePoseFix(0.0, R0, R1, relative, FIX_COV)])
    for second in range(200):
        step = Odometry(second, second + 1.0, R1, Pose2(0.0, 0.0, 0.1), STEP_COV)
        relative = relative * Pose2(0.0, 0.0, 0.1)
        estimate = estimator.update([step, RelativePoseFix(second + 1.0, R0, R1, relative, FIX_COV)])
    assert len(estimator.timeline.tracks[R0].keys) == 1
    assert estimator.window_size <= 1 + 7
    assert not estimator.timeline.dropped
    # what it may know best: each of the 201 sightings, odometry between them, one standing observer that is the origin
    assert difference(estimate.pose(R1), relative) < 1e-6
    np.testing.assert_allclose(
        estimate.belief(R1).cov_body, batch_of(estimator).belief(R1).cov_body, rtol=1e-4, atol=1e-12
    )


def test_the_window_stays_bounded_over_a_long_run():
    groups, _ = circling(np.random.default_rng(6), seconds=400)
    estimator, sizes, factors = FixedLag(ROBOTS, tuple(POSTS), FixedLagSettings(5.0)), [], []
    for group in groups:
        estimator.update(group)
        sizes.append(estimator.window_size)
        factors.append(len(estimator._window.factors))
    assert max(sizes) == sizes[-1] == 3 + 2 * 6  # posts; of each robot the poses of 0 to 5 s ago
    assert max(factors[100:]) == max(factors[:100])
    assert len(estimator._window.prior.chart.keys) <= 3 + 2
    assert estimator.values().size() == len(estimator.timeline.stamps) + 3


def test_poses_that_left_are_told_as_they_were_and_have_no_joint_covariance():
    estimator, inside, outside = FixedLag(ROBOTS, settings=FixedLagSettings(5.0)), [], []
    key = pose_key(1, 1)
    for group in leapfrog(np.random.default_rng(7), legs=20).groups:
        estimate = estimator.update(group)
        if key in estimator.timeline.stamps:
            told = inside if estimator._window.values.exists(key) else outside
            told.append((estimate.value(key), estimate.covariance(key)))
    assert len(inside) >= 2 and len(outside) > 10
    assert difference(inside[0][0], outside[0][0]) > 1e-4  # smoothed, and then never again
    for pose, cov in outside:
        assert difference(pose, outside[0][0]) == 0.0
        np.testing.assert_array_equal(cov, outside[0][1])
    trajectory = estimate.trajectory(R1)
    assert difference(trajectory.poses[1], outside[0][0]) == 0.0
    np.testing.assert_array_equal(trajectory.covariances[1], outside[0][1])
    assert estimator.values().atPose2(key).equals(outside[0][0], 1e-12)
    with pytest.raises(UnderDetermined, match="robot1 pose 1 left the window of 5 s"):
        estimate.joint_covariance([estimate.pose_key(R1), key])


def test_fixes_of_poses_that_left_are_counted_and_do_no_harm():
    rng = np.random.default_rng(8)
    groups, where = circling(rng, seconds=30)
    estimator = FixedLag(ROBOTS, tuple(POSTS), FixedLagSettings(5.0))
    for group in groups:
        estimate = estimator.update(group)
    used, before = estimator.timeline.used["BearingRangeFix"], estimate.pose(R0)
    old = seen(10.0, R0, "post1", where[R0], POSTS["post1"])
    estimate = estimator.update([old, RelativePoseFix(10.0, R0, R1, Pose2(), FIX_COV)])
    assert estimator.timeline.dropped["BearingRangeFix: older than the window"] == 1
    assert estimator.timeline.used["BearingRangeFix"] == used
    assert sum(estimator.timeline.dropped.values()) == 2
    assert difference(estimate.pose(R0), before) < 1e-3


# ---- hard cases ----


def test_a_robot_placed_late_brings_its_whole_past():
    """200 s on its own, seeing posts that the other sees only then: their frames are joined by these."""
    rng, fine = np.random.default_rng(9), np.diag([0.002, 0.002, 0.0005]) ** 2
    where, groups = {R0: Pose2(), R1: Pose2(1.0, -2.0, 0.5)}, []
    for second in range(220):
        group, stamp_s = [], second + 1.0
        for robot, turn in ((R0, 0.1), (R1, -0.07)):
            step = Pose2(0.3, 0.0, turn)
            where[robot] = where[robot] * step
            noisy = step * Pose2(*(rng.normal(size=3) * np.sqrt(np.diag(fine))))
            group.append(Odometry(second, stamp_s, robot, noisy, fine))
        for robot, pose in where.items():
            if robot == R1 or second >= 200:
                post = list(POSTS)[second % 3]
                group.append(seen(stamp_s, robot, post, pose, POSTS[post], rng))
        groups.append(group)
    estimator, placed = FixedLag(ROBOTS, tuple(POSTS), FixedLagSettings(5.0)), []
    for group in groups:
        estimate = estimator.update(group)
        placed.append(estimator.timeline.is_placed(R1))
    assert not any(placed[:200]) and placed[-1]
    assert estimator.window_size <= 3 + 2 * 6
    assert len(estimate.trajectory(R1).poses) == 221
    ours, theirs = estimate.belief(R1), batch_of(estimator).belief(R1)
    assert difference(ours.T_world_body, theirs.T_world_body) < theirs.position_sigma_m
    # a landmark waits for a second sighting; the first ones, older than the window by then, are lost
    assert 0.98 < ours.position_sigma_m / theirs.position_sigma_m < 1.5


def test_a_corner_decided_on_long_after_its_sighting_gets_a_place():
    estimator, records = FixedLag(ROBOTS, settings=FixedLagSettings(5.0)), []
    for second in range(20):
        records.append(Odometry(second, second + 1.0, R0, Pose2(0.5, 0.0, 0.0), STEP_COV))
        sighting = CornerSighting(second + 1.0, R0, Pose2(0.1, 0.2, 1.0), STEP_COV, 1.5, 0.01)
        records.append(sighting)
        estimator.update(records[-2:])
    estimate = estimator.update([CornerDecision(20.0, records[3], 0, True)])  # seen at t = 2 s
    assert difference(estimate.vertex(0), Pose2(1.0, 0.0, 0.0) * records[3].T_observer_corner) < 1e-6
    assert estimator.timeline.dropped == {"CornerDecision: older than the window": 1}
    heading = 2 * 1e-4 + 1e-4  # two steps and the sighting, rad^2
    assert estimate.vertex_belief(0).cov_body[2, 2] == pytest.approx(heading, rel=1e-3)


def test_a_landmark_located_by_ranges_older_than_the_window_keeps_its_guess():
    post, pose = np.array([4.0, 3.0]), Pose2()
    estimator = FixedLag((R0,), ("post",), FixedLagSettings(5.0))
    for k in range(14):
        step = Pose2(0.8, 0.0, 0.4)
        pose = pose * step
        drive = Odometry(10.0 * k, 10.0 * k + 10.0, R0, step, STEP_COV)
        range_m = float(np.hypot(*(post - position(pose))))
        estimate = estimator.update([drive, RangeFix(10.0 * k + 10.0, R0, "post", range_m, 0.02)])
    assert estimate.landmarks == ["post"]
    np.testing.assert_allclose(estimate.landmark("post"), post, atol=0.05)
    assert np.linalg.eigvalsh(estimate.landmark_belief("post").cov)[0] > 0


def test_a_surveyed_landmark_pins_the_map():
    groups, where = circling(np.random.default_rng(10), seconds=60)
    groups[0].append(LandmarkPrior(0.0, "post2", POSTS["post2"], np.eye(2) * 1e-8))
    estimator = FixedLag(ROBOTS, tuple(POSTS), FixedLagSettings(5.0))
    for group in groups:
        estimate = estimator.update(group)
    np.testing.assert_allclose(estimate.landmark("post2"), POSTS["post2"], atol=5e-4)  # five sigmas
    belief = estimate.belief(R0)
    score = position_nees(
        position(belief.T_world_body)[None], belief.position_covariance[None], position(where[R0])[None]
    )
    assert score[0] < 16.0  # one in 3 000 of chi-square with 2 degrees of freedom


def test_a_robust_loss_bears_false_sightings():
    rng = np.random.default_rng(11)
    groups, where = circling(rng, seconds=80)
    for second in range(10, 80, 5):
        groups[second].append(BearingRangeFix(float(second), R0, "post1", rng.uniform(-3, 3), 9.0, SEEN_COV))
    scores = {}
    for kind in ("squares", "cauchy"):
        settings = TimelineSettings(loss=Loss(kind))
        estimator = FixedLag(ROBOTS, tuple(POSTS), FixedLagSettings(5.0), timeline=settings)
        for group in groups:
            estimate = estimator.update(group)
        belief = estimate.belief(R0)
        scores[kind] = pose_nees([belief.T_world_body], belief.cov_body[None], [where[R0]])[0]
    assert scores["cauchy"] < 18.7 < scores["squares"]  # one in 3 000 of chi-square with 3 degrees of freedom


def test_records_of_several_robots_out_of_order_and_a_gap_raise_nothing():
    rng = np.random.default_rng(12)
    groups, _ = circling(rng, seconds=60)
    records = [record for group in groups for record in group if not 20.0 < record.stamp_s < 40.0]
    order = np.argsort([record.stamp_s + rng.normal() * 1.5 for record in records], kind="stable")
    estimator = FixedLag(ROBOTS, tuple(POSTS), FixedLagSettings(2.0))
    for start in range(0, len(records), 7):
        estimate = estimator.update([records[i] for i in order[start : start + 7]])
    assert sum(estimator.timeline.dropped.values()) > 0
    assert all(np.isfinite(estimate.belief(robot).cov_body).all() for robot in ROBOTS)


def test_frames_that_were_joined_by_what_is_older_than_the_window_stay_joined():
    """The fix that places R1 comes when R0's pose of it has left: it counts from that pose as it was then."""
    estimator = FixedLag(ROBOTS, settings=FixedLagSettings(2.0))
    for second in range(10):
        drive = Odometry(second, second + 1.0, R0, Pose2(1.0, 0.0, 0.0), STEP_COV)
        sighting = CornerSighting(second + 1.0, R0, Pose2(), STEP_COV, 1.5, 0.01)
        estimator.update([drive, sighting])
    estimate = estimator.update([RelativePoseFix(4.0, R0, R1, Pose2(0.0, 2.0, 0.0), FIX_COV)])
    assert estimator.timeline.dropped == {"RelativePoseFix: older than the window": 1}
    assert difference(estimate.pose(R1), Pose2(4.0, 2.0, 0.0)) < 1e-6
    heading = 4 * STEP_COV[2, 2] + FIX_COV[2, 2]  # four steps and the fix, rad^2
    assert estimate.belief(R1).cov_body[2, 2] == pytest.approx(heading, rel=1e-3)


def test_settings_are_checked_and_absence_has_words():
    with pytest.raises(BadInput, match="lag_s: more than zero"):
        FixedLagSettings(lag_s=-1.0)
    with pytest.raises(BadInput, match="lag_s"):
        FixedLagSettings(lag_s=inf)
    with pytest.raises(BadInput, match="rounds"):
        FixedLagSettings(rounds=0)
    estimate = FixedLag(ROBOTS).update([Odometry(0.0, 1.0, R0, Pose2(1, 0, 0), STEP_COV)])
    with pytest.raises(UnderDetermined, match="robot1 has no place yet"):
        estimate.pose(R1)
    with pytest.raises(UnderDetermined, match="vertex 3"):
        estimate.vertex(3)
