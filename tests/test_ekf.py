"""The joint filter against closed forms, GTSAM's own filter, batch marginals, and its own promises over many seeds."""

import gtsam
import numpy as np
import pytest
from filter_runs import POST, R0, R1, STEP_COV, batch_of, run, seen, without
from leapfrog import FIX_COV, ROBOTS, difference, leapfrog

from coopslam.errors import BadInput, UnderDetermined
from coopslam.estimation.batch import BatchEstimate, solve_batch
from coopslam.estimation.ekf import SINGULAR, TOO_LATE, Ekf, EkfSettings
from coopslam.estimation.estimate import Trajectory
from coopslam.estimation.innovation_gate import REFUSED
from coopslam.evaluation.consistency import chi_square_band, pose_nees, position_nees
from coopslam.records import (
    BearingFix,
    LoopClosure,
    Odometry,
    PosePrior,
    RangeFix,
    RelativePoseFix,
)
from coopslam.se2 import Pose2, position

# ---- against exact answers ----


def test_on_a_line_it_is_the_scalar_kalman_filter():
    """One robot that drives ahead and is surveyed at each stop: P + Q, then P R / (P + R), with numbers by hand."""
    estimator = Ekf((R0,))
    Q, R = 0.04, 0.09  # m^2
    prior_cov = np.diag([R, 1.0, 1.0])
    estimate = estimator.update([Odometry(0.0, 1.0, R0, Pose2(1.0, 0, 0), np.diag([Q, 1e-12, 1e-12]))])
    x, P = 0.0, 1e-12
    for stop, surveyed in enumerate((1.3, 2.1, 2.8), start=1):
        if stop > 1:
            step = Odometry(stop - 1.0, stop, R0, Pose2(1.0, 0, 0), np.diag([Q, 1e-12, 1e-12]))
            estimate = estimator.update([step])
        estimate = estimator.update([PosePrior(stop, R0, Pose2(surveyed, 0, 0), prior_cov)])
        x, P = x + 1.0, P + Q
        x, P = x + P / (P + R) * (surveyed - x), P * R / (P + R)
        assert estimate.pose(R0).x() == pytest.approx(x, abs=1e-9)
        assert estimate.covariance(estimate.pose_key(R0))[0, 0] == pytest.approx(P, rel=1e-9)


def test_a_linear_problem_is_solved_as_a_batch_solves_it():
    """Headings that are known to 1e-6: what is left is linear, and filtering the last pose is smoothing it."""
    rng, estimator = np.random.default_rng(0), Ekf(ROBOTS)
    step_cov, fix_cov = np.diag([0.02, 0.03, 1e-6]) ** 2, np.diag([0.05, 0.04, 1e-6]) ** 2

    def noisy(pose, cov):
        return pose * Pose2(*rng.normal(size=3) * np.sqrt(np.diag(cov)) * (1, 1, 0))

    estimator.update([RelativePoseFix(0.0, R0, R1, noisy(Pose2(1, 2, 0), fix_cov), fix_cov)])
    for t in range(6):
        group = [Odometry(t, t + 1.0, robot, noisy(Pose2(0.5, 0.1, 0), step_cov), step_cov) for robot in ROBOTS]
        estimate = estimator.update([*group, RelativePoseFix(t + 1.0, R0, R1, noisy(Pose2(1, 2, 0), fix_cov), fix_cov)])
    batch = batch_of(estimator)
    keys = [estimate.pose_key(R0), estimate.pose_key(R1)]
    for robot in ROBOTS:  # what headings of 1e-6 bend over 3 m
        assert difference(estimate.pose(robot), batch.pose(robot)) < 1e-6
    np.testing.assert_allclose(estimate.joint_covariance(keys), batch.joint_covariance(keys), rtol=1e-4, atol=1e-10)


def test_one_robot_against_gtsams_invariant_filter():
    """Same prediction to first order; poses surveyed exactly where they are predicted leave no second order."""
    rng, prior_cov = np.random.default_rng(1), np.diag([0.02, 0.03, 0.02]) ** 2
    estimator, oracle, key, stamp = Ekf((R0,)), gtsam.InvariantEKFPose2(Pose2(), np.eye(3) * 1e-12), 0, 0.0
    for _ in range(5):
        step = Pose2(0.5, 0.0, rng.uniform(-1, 1))
        oracle.predict(step, STEP_COV)
        survey = oracle.state()
        estimate = estimator.update(
            [Odometry(stamp, stamp + 1, R0, step, STEP_COV), PosePrior(stamp + 1, R0, survey, prior_cov)]
        )
        stamp += 1
        oracle.updateWithVector(np.zeros(3), np.eye(3), np.zeros(3), prior_cov)
        key = estimate.pose_key(R0)
        assert difference(estimate.value(key), oracle.state()) < 1e-12
        np.testing.assert_allclose(estimate.covariance(key), oracle.covariance(), rtol=1e-9, atol=1e-14)


def test_it_agrees_with_batch_marginals_where_the_run_is_nearly_linear():
    world = leapfrog(np.random.default_rng(3), legs=24, scale=0.03)
    estimator, estimate = run(world)
    batch = batch_of(estimator)
    keys = [estimate.vertex_key(4), estimate.pose_key(R0), estimate.vertex_key(1), estimate.pose_key(R1)]
    for key in keys:  # sigmas are 3e-4 and more; the second order of 1e-3 rad over 4 m is 4e-6
        assert difference(estimate.value(key), batch.value(key)) < 2e-5
    ours, theirs = estimate.joint_covariance(keys), batch.joint_covariance(keys)
    sigmas = np.sqrt(np.diag(theirs))
    np.testing.assert_allclose(ours / np.outer(sigmas, sigmas), theirs / np.outer(sigmas, sigmas), atol=5e-3)
    for i, key in enumerate(keys):
        np.testing.assert_allclose(estimate.covariance(key), ours[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], rtol=1e-12)
        assert estimate.covariance(key)[0, 0] == pytest.approx(batch.covariance(key)[0, 0], rel=0.01)
    assert estimate.vertices == list(range(6)) and not estimator.timeline.dropped


def test_a_new_landmark_has_the_marginal_and_the_correlations_of_a_batch():
    rng, estimator, pose, stamp = np.random.default_rng(4), Ekf((R0,), ("post",)), Pose2(), 0.0
    for leg in range(5):
        step = Pose2(0.5, 0.0, 0.2)
        pose, stamp = pose * step, stamp + 1.0
        group = [Odometry(stamp - 1, stamp, R0, step, STEP_COV)]
        if leg >= 3:  # the timeline places it with the second glimpse; the first one is then of a pose of the past
            group.append(seen(stamp, R0, "post", pose, POST, rng.normal(size=2) * 1e-4))
        estimate = estimator.update(group)
    first = next(i for i in range(estimator.graph.size()) if _is_sighting(estimator.graph.at(i)))
    assert dict(estimator.timeline.dropped) == {f"BearingRangeFix: {TOO_LATE}": 1}
    graph = without(estimator.graph, [first])
    batch = BatchEstimate(estimator.timeline, graph, solve_batch(graph, estimator.values()))
    keys = [estimate.pose_key(R0), estimate.landmark_key("post")]
    assert estimate.landmark("post") == pytest.approx(batch.landmark("post"), abs=1e-9)
    np.testing.assert_allclose(estimate.joint_covariance(keys), batch.joint_covariance(keys), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(estimate.landmark_belief("post").cov, batch.covariance(keys[1]), rtol=1e-6)


def _is_sighting(factor):
    return isinstance(factor, gtsam.BearingRangeFactor2D)


# ---- honesty ----


def test_its_covariances_are_honest_over_many_runs_with_small_noise():
    """One pose and one vertex of each of 50 runs: independent samples, 99.9 % bands, fixed seeds."""
    poses, corners = [], []
    for seed in range(50):
        world = leapfrog(np.random.default_rng(5000 + seed), legs=10, scale=0.2)
        _, estimate = run(world)
        belief = estimate.belief(R1)
        poses += list(pose_nees([belief.T_world_body], belief.cov_body[None], [world.truth[R1].poses[-1]]))
        corner = estimate.vertex_belief(3)
        errors = position(corner.T_world_body)[None], corner.position_covariance[None]
        corners += list(position_nees(*errors, position(world.corners[3])[None]))
    for scores, dof in ((poses, 3), (corners, 2)):
        low, high = chi_square_band(dof, len(scores), confidence=0.999)
        assert low < np.mean(scores) < high


def test_relative_measurements_tell_nothing_about_a_turn_of_everything():
    """Information on the one direction that no sighting tells, N' P^-1 N, does not grow however the mean moves."""
    rng, posts = np.random.default_rng(13), {"post": POST, "far": np.array([8.0, -6.0]), "third": np.array([-5.0, 4.0])}
    estimator, poses = Ekf(ROBOTS, posts), {R0: Pose2(), R1: Pose2(2.0, 0.5, 1.0)}
    estimator.update([RelativePoseFix(0.0, R0, R1, poses[R1], FIX_COV)])
    turned = np.diag([0.3, 0.3, 0.6]) ** 2  # a heading that may be off by 35 degrees: far from linear
    known = []
    for t in range(30):
        group = []
        for robot in ROBOTS:
            poses[robot] = poses[robot] * Pose2(0.3, 0.0, 0.2)
            cov = turned if t % 5 == 0 else STEP_COV
            noise = rng.normal(size=3) * np.sqrt(np.diag(cov))
            group.append(Odometry(t, t + 1.0, robot, Pose2(0.3, 0.0, 0.2) * Pose2(*noise), cov))
        for robot in ROBOTS:
            for post, point in posts.items():
                group.append(seen(t + 1.0, robot, post, poses[robot], point, rng.normal(size=2) * (0.01, 0.03)))
        estimate = estimator.update(group)
        keys = [estimate.pose_key(robot) for robot in ROBOTS]
        keys += [estimate.landmark_key(post) for post in posts if post in estimate.landmarks]
        means = [estimate.any_value(key) for key in keys]
        turn = [
            [-m[1], m[0]] if isinstance(m, np.ndarray) else [*m.rotation().unrotate([-m.y(), m.x()]), 1] for m in means
        ]
        turn = np.concatenate(turn)
        known.append(turn @ np.linalg.solve(estimate.joint_covariance(keys), turn))
    assert len(estimate.landmarks) == 3
    assert max(known) < 1.02 * known[0]  # levers follow by the millimetre; left where they were: 300 times as much


def test_innovations_are_chi_square_distributed_by_kind():
    by_kind = {}
    for seed in range(20):
        estimator, estimate = run(leapfrog(np.random.default_rng(6000 + seed), legs=12, scale=0.1))
        assert estimate.innovations is estimator.innovations and not estimator.refused_innovations
        for kind, nis, dof in estimator.innovations:
            by_kind.setdefault((kind, dof), []).append(nis)
    assert by_kind.keys() == {("relative pose", 3), ("corner", 3)}  # the first fix and first sightings place something
    assert len(by_kind["relative pose", 3]) == 20 * 36 and len(by_kind["corner", 3]) == 20 * 6
    for (_, dof), values in by_kind.items():
        low, high = chi_square_band(dof, len(values), confidence=0.999)
        assert low < np.mean(values) < high


def test_the_covariance_stays_symmetric_and_positive_over_sigmas_a_million_times_apart():
    estimator, turn = Ekf(ROBOTS, ("post",)), np.diag([0.0, 0.0, 0.01]) ** 2
    estimator.update([RelativePoseFix(0.0, R0, R1, Pose2(1, 2, 0.5), FIX_COV)])
    for t in range(300):
        wild = np.eye(3) * 1e2 if t % 50 == 0 else turn
        fine = np.eye(3) * 1e-10 if t % 3 == 0 else FIX_COV
        estimator.update(
            [Odometry(t, t + 1.0, R1, Pose2(), wild), RelativePoseFix(t + 1.0, R0, R1, Pose2(1, 2, 0.5), fine)]
        )
        cov = estimator._state.cov
        np.testing.assert_array_equal(cov, cov.T)
        assert np.linalg.eigvalsh(cov)[0] > 0


# ---- the gate ----


def test_a_wild_fix_is_refused_and_counted():
    estimator, pose = Ekf((R0,), ("post",)), Pose2()
    estimator.update([seen(0.0, R0, "post", pose, POST)])
    before = estimator.update([seen(0.1, R0, "post", pose, POST)]).landmark("post")
    factors = estimator.graph.size()
    estimate = estimator.update([seen(0.2, R0, "post", pose, POST + [1.0, 0.0])])
    assert dict(estimator.timeline.dropped) == {f"BearingRangeFix: {REFUSED}": 1}
    assert estimator.timeline.used["BearingRangeFix"] == 2
    np.testing.assert_array_equal(estimate.landmark("post"), before)
    (kind, nis, dof), *others = estimator.refused_innovations
    assert not others and estimator.innovations[-1] == (kind, nis, dof)
    assert kind == "bearing-range of a landmark" and dof == 2 and nis > 18.42  # chi-square, 2 dof, 1e-4
    assert len(estimator.timeline.refused) == 1 and estimator.graph.size() == factors  # a batch may decide anew
    open_door = Ekf((R0,), ("post",), EkfSettings(gate_probability=0.0))
    for t, offset in ((0.0, 0.0), (0.1, 0.0), (0.2, 1.0)):
        moved = open_door.update([seen(t, R0, "post", pose, POST + [offset, 0.0])])
    assert moved.landmark("post")[0] - POST[0] == pytest.approx(1 / 3, abs=0.05) and not open_door.timeline.dropped


def test_a_wild_relative_pose_is_refused_by_the_gate_of_all_estimators():
    world = leapfrog(np.random.default_rng(7), legs=6, scale=0.1)
    estimator, estimate = run(world)
    before = estimate.pose(R1)
    stamp = world.records[-1].stamp_s
    estimate = estimator.update([RelativePoseFix(stamp, R0, R1, Pose2(-9.0, 5.0, 2.0), FIX_COV)])
    assert list(estimator.timeline.dropped) == ["RelativePoseFix: far from the prediction"]
    assert difference(estimate.pose(R1), before) == 0.0


def test_settings_out_of_range_are_refused():
    with pytest.raises(BadInput, match="gate_probability"):
        EkfSettings(gate_probability=1.5)


# ---- what leaves the state, and what comes late ----


def test_the_state_holds_latest_poses_vertices_and_landmarks_only():
    world = leapfrog(np.random.default_rng(8), legs=30, scale=0.1)
    estimator, estimate = run(world, Ekf(ROBOTS, settings=EkfSettings(sightings_kept=0)))
    assert estimator._state.size == 3 * (2 + 6)
    assert estimator.values().size() == len(estimator.timeline.stamps) + 6
    past, now = estimator.timeline.tracks[R0].keys[3], estimate.pose_key(R0)
    with pytest.raises(UnderDetermined, match="robot0 pose 3 has left the filter's state"):
        estimate.joint_covariance([past, now])
    assert np.linalg.eigvalsh(estimate.covariance(past))[0] > 0


def test_the_trajectory_is_what_was_known_when_a_pose_left():
    world = leapfrog(np.random.default_rng(9), legs=12, scale=0.5)
    estimator, before = Ekf(ROBOTS, settings=EkfSettings(sightings_kept=0)), {}
    for group in world.groups:
        estimate = estimator.update(group)
        for robot in ROBOTS:
            key = estimate.pose_key(robot)
            before[key] = estimate.value(key), estimate.covariance(key)
    trajectory, causal = estimate.trajectory(R1), estimate.causal_trajectory(R1)
    assert isinstance(trajectory, Trajectory) and len(causal.poses) == len(trajectory.poses)
    keys = estimator.timeline.tracks[R1].keys
    for key, pose, cov in zip(keys, trajectory.poses, trajectory.covariances, strict=True):
        if key in before:  # the last of its group, then left at the next leg
            assert difference(pose, before[key][0]) < 1e-12
            np.testing.assert_allclose(cov, before[key][1], rtol=1e-9)


def test_the_last_poses_that_sighted_corners_stay_with_all_that_they_have_in_common():
    world = leapfrog(np.random.default_rng(14), legs=20, scale=0.03)
    estimator, estimate = run(world, Ekf(ROBOTS, settings=EkfSettings(sightings_kept=4)))
    assert estimator._state.size == 3 * (2 + 6 + 4)
    sighted = [estimate.pose_key_at(R1, group[-1].stamp_s) for group in world.groups[11:20:2]]  # robot1's last legs
    with pytest.raises(UnderDetermined, match="has left the filter's state"):
        estimate.joint_covariance([sighted[0]])
    batch = batch_of(estimator)
    keys = [sighted[-2], estimate.vertex_key(3), estimate.pose_key(R1)]
    ours, theirs = estimate.joint_covariance(keys), batch.joint_covariance(keys)
    sigmas = np.sqrt(np.diag(theirs))
    np.testing.assert_allclose(ours / np.outer(sigmas, sigmas), theirs / np.outer(sigmas, sigmas), atol=5e-3)
    assert difference(estimate.value(keys[0]), batch.value(keys[0])) < 2e-5
    assert np.linalg.eigvalsh(estimator._state.cov)[0] > 0


def test_a_fix_of_a_pose_that_has_left_is_counted():
    estimator = Ekf((R0, R1), ("post",))
    estimator.update([RelativePoseFix(0.0, R0, R1, Pose2(1, 2, 0.5), FIX_COV)])
    step = Odometry(0.0, 1.0, R1, Pose2(0.5, 0, 0), STEP_COV)
    estimator.update([step, RelativePoseFix(1.0, R0, R1, Pose2(1.4, 2.2, 0.5), FIX_COV)])
    late = RangeFix(0.0, R0, R1, float(np.hypot(1, 2)), 0.05)
    closure = LoopClosure(0.0, 1.0, R1, R1, Pose2(0.5, 0, 0), STEP_COV)
    estimator.update([late, closure])
    assert dict(estimator.timeline.dropped) == {f"RangeFix: {TOO_LATE}": 1, f"LoopClosure: {TOO_LATE}": 1}
    assert estimator.timeline.used["RangeFix"] == 0


def test_a_singular_sighting_is_counted():
    estimator = Ekf((R0, R1))
    estimator.update([RelativePoseFix(0.0, R0, R1, Pose2(), FIX_COV)])
    estimator.update([BearingFix(0.0, R0, R1, 0.3, 0.1)])
    assert dict(estimator.timeline.dropped) == {f"BearingFix: {SINGULAR}": 1}


def test_absence_has_words():
    estimate = Ekf(ROBOTS, ("post",)).update([Odometry(0.0, 1.0, R0, Pose2(1, 0, 0), FIX_COV)])
    for question in (lambda: estimate.pose(R1), lambda: estimate.vertex(3), lambda: estimate.landmark("post")):
        with pytest.raises(UnderDetermined):
            question()
