import numpy as np
import pytest
from leapfrog import FIX_COV, ROBOTS, difference, leapfrog

from coopslam.errors import BadInput, UnderDetermined
from coopslam.estimation.batch import BatchEstimate, solve_batch
from coopslam.estimation.incremental import Incremental, IncrementalSettings
from coopslam.evaluation.consistency import chi_square_band, pose_nees, position_nees
from coopslam.records import CornerSighting, Odometry, RelativePoseFix
from coopslam.se2 import Pose2, chain_covariance, position


def run(world):
    estimator = Incremental(ROBOTS)
    for group in world.groups:
        estimate = estimator.update(group)
    return estimator, estimate


def test_it_agrees_with_batch_in_values_and_covariances():
    world = leapfrog(np.random.default_rng(1), legs=60)
    estimator, estimate = run(world)
    values = solve_batch(estimator.graph, world.values(estimator.timeline, estimator.values().keys()))  # from truth
    batch = BatchEstimate(estimator.timeline, estimator.graph, values)
    for robot in ROBOTS:
        ours, theirs = estimate.trajectory(robot), batch.trajectory(robot)
        # sigmas are 1 cm and more; relinearization leaves a hundredth of that
        assert max(difference(a, b) for a, b in zip(ours.poses, theirs.poses, strict=True)) < 1e-4
        np.testing.assert_allclose(ours.covariances, theirs.covariances, rtol=0.02, atol=1e-7)
        np.testing.assert_allclose(estimate.belief(robot).cov_body, batch.belief(robot).cov_body, rtol=0.02, atol=1e-7)
    assert estimate.vertices == batch.vertices == list(range(6))
    for vertex in estimate.vertices:
        assert difference(estimate.vertex(vertex), batch.vertex(vertex)) < 1e-4
    keys = [estimate.vertex_key(4), estimate.pose_key("robot0"), estimate.vertex_key(1), estimate.pose_key("robot1")]
    np.testing.assert_allclose(estimate.joint_covariance(keys), batch.joint_covariance(keys), rtol=0.02, atol=1e-6)
    for i, key in enumerate(keys):
        block = estimate.joint_covariance(keys)[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        np.testing.assert_allclose(block, estimate.covariance(key), rtol=1e-6, atol=1e-12)


def test_each_factor_is_given_once():
    world = leapfrog(np.random.default_rng(2), legs=20)
    estimator, _ = run(world)
    legs, fixes, corners, prior = 60, 61, 20, 1
    assert estimator.graph.size() == legs + fixes + corners + prior
    assert estimator._isam.getFactorsUnsafe().size() == estimator.graph.size()


def test_without_noise_it_stays_exact_over_many_legs():
    world = leapfrog(np.random.default_rng(3), legs=400, scale=1e-4, corners=40)  # sigmas of 1e-6
    estimator, estimate = run(world)
    for robot in ROBOTS:
        assert difference(estimate.pose(robot), world.truth[robot].poses[-1]) < 1e-4
        assert estimate.belief(robot).position_sigma_m < 1e-4
    batch = solve_batch(estimator.graph, estimator.values())
    error, best = estimator.graph.error(estimator.values()), estimator.graph.error(batch)
    assert error == pytest.approx(best, rel=1e-3)


def test_the_causal_trajectory_keeps_what_was_known_then():
    world = leapfrog(np.random.default_rng(4), legs=12)
    estimator = Incremental(ROBOTS)
    then = []
    for group in world.groups:
        estimate = estimator.update(group)
        then.append((estimate.pose_key("robot1"), estimate.pose("robot1")))
    causal, final = estimate.causal_trajectory("robot1"), estimate.trajectory("robot1")
    np.testing.assert_array_equal(causal.stamps_s, final.stamps_s)
    keys = estimator.timeline.tracks["robot1"].keys
    first_seen = {key: pose for key, pose in reversed(then)}
    assert all(difference(causal.poses[keys.index(key)], pose) < 1e-12 for key, pose in first_seen.items())
    assert (
        max(difference(a, b) for a, b in zip(causal.poses, final.poses, strict=True)) > 1e-3
    )  # smoothing did something


def test_odometry_since_the_last_variable_is_in_the_pose_and_its_belief():
    estimator = Incremental(ROBOTS)
    before = estimator.update([RelativePoseFix(0.0, *ROBOTS, Pose2(1, 2, 0.5), FIX_COV)]).belief("robot1")
    delta, cov = Pose2(2.0, 0.0, 0.3), np.diag([0.03, 0.02, 0.01]) ** 2
    after = estimator.update([Odometry(0.0, 1.0, "robot1", delta, cov)]).belief("robot1")
    assert difference(after.T_world_body, before.T_world_body * delta) < 1e-9
    np.testing.assert_allclose(after.cov_body, chain_covariance(delta, before.cov_body, cov), rtol=1e-9)


def test_absence_has_words():
    estimate = Incremental(("robot0", "robot1")).update([Odometry(0.0, 1.0, "robot0", Pose2(1, 0, 0), FIX_COV)])
    with pytest.raises(UnderDetermined, match="robot1 has no place yet"):
        estimate.pose("robot1")
    with pytest.raises(UnderDetermined, match="vertex 3"):
        estimate.vertex(3)
    with pytest.raises(BadInput, match="no robot is called robot7"):
        estimate.belief("robot7")


def test_hopeless_odometry_converges_to_what_was_seen():
    """A wild guess, an odometry without information, and only fixes to go by."""
    estimator = Incremental(ROBOTS)
    estimator.update([RelativePoseFix(0.0, *ROBOTS, Pose2(1, 2, 0.5), FIX_COV)])
    wild = Odometry(0.0, 1.0, "robot1", Pose2(8.0, -9.0, 3.0), np.eye(3) * 1e4)
    estimate = estimator.update([wild, RelativePoseFix(1.0, "robot0", "robot1", Pose2(-3.0, 0.5, -2.0), FIX_COV)])
    assert difference(estimate.pose("robot1"), Pose2(-3.0, 0.5, -2.0)) < 1e-3


def test_its_covariances_are_honest_over_many_runs():
    """One pose and one vertex of each run, so the samples are independent: 99.9 % bands, fixed seeds."""
    pose_scores, vertex_scores = [], []
    for seed in range(150):
        world = leapfrog(np.random.default_rng(1000 + seed), legs=10, scale=0.5)
        _, estimate = run(world)
        belief = estimate.belief("robot1")
        truth = world.truth["robot1"].poses[-1]
        pose_scores += list(pose_nees([belief.T_world_body], belief.cov_body[None], [truth]))
        corner = estimate.vertex_belief(3)
        errors = position(corner.T_world_body)[None], corner.position_covariance[None]
        vertex_scores += list(position_nees(*errors, position(world.corners[3])[None]))
    for scores, dof in ((pose_scores, 3), (vertex_scores, 2)):
        low, high = chi_square_band(dof, len(scores), confidence=0.999)
        assert low < np.mean(scores) < high


@pytest.mark.slow
def test_a_chain_of_a_hundred_thousand_poses_in_one_update_has_covariances():
    """iSAM2's tree is as deep as the chain; on a common stack its joint covariances end the process."""
    cov, count = np.diag([0.01, 0.01, 0.001]) ** 2, 100_000
    records = []
    for i in range(count):
        records.append(Odometry(i, i + 1.0, "robot0", Pose2(0.1, 0.0, 0.01), cov))
        records.append(CornerSighting(i + 1.0, "robot0", Pose2(), cov, 1.0, 0.1))
    estimator = Incremental(("robot0",))
    estimate = estimator.update(records)
    first, last = estimator.timeline.tracks["robot0"].keys[1], estimate.pose_key("robot0")
    joint = estimate.joint_covariance([first, last])
    assert joint[2, 5] == pytest.approx(1e-6, rel=1e-3)  # the heading error of the first step is in all others
    assert joint[5, 5] == pytest.approx(count * 1e-6, rel=1e-3)


def test_a_pure_turn_beside_coarse_measurements_is_solved():
    """Sigmas of 1e-6 m and of 0.1 m meet at one variable: far more than 4096 apart."""
    estimator = Incremental(ROBOTS)
    coarse = np.diag([0.1, 0.1, 0.1]) ** 2
    estimator.update([RelativePoseFix(0.0, *ROBOTS, Pose2(1.0, 2.0, 0.5), coarse)])
    turn = Odometry(0.0, 1.0, "robot1", Pose2(0.0, 0.0, 1.0), np.diag([0.0, 0.0, 0.1]) ** 2)
    estimate = estimator.update([turn, RelativePoseFix(1.0, *ROBOTS, Pose2(1.0, 2.0, 1.5), coarse)])
    assert difference(estimate.pose("robot1"), Pose2(1.0, 2.0, 1.5)) < 1e-6
    batch = BatchEstimate(estimator.timeline, estimator.graph, estimator.values())
    key = estimate.pose_key("robot1")
    np.testing.assert_allclose(estimate.covariance(key)[:2, :2], np.eye(2) * 0.01 / 2, rtol=0.01, atol=1e-6)
    np.testing.assert_allclose(estimate.covariance(key), batch.covariance(key), rtol=1e-4, atol=1e-7)


def test_where_cholesky_gives_up_qr_goes_on_to_the_same():
    """Drives known in heading alone, turns known in place alone: sigmas 10 million times each other in one front."""
    drive, turn = np.diag([10.0, 10.0, 1e-6]) ** 2, np.diag([1e-6, 1e-6, 0.5]) ** 2
    groups = [[RelativePoseFix(0.0, "a", "b", Pose2(1, 0, 0), np.eye(3) * 1e-4)]]
    for k in range(40):
        odometry = Odometry(k, k + 1.0, "b", Pose2(0, 0, 1) if k % 2 else Pose2(1, 0, 0), turn if k % 2 else drive)
        groups.append([odometry, RelativePoseFix(k + 1.0, "a", "b", Pose2(1, k, 0), np.eye(3) * 2500.0)])
    both = [Incremental(("a", "b"), settings=IncrementalSettings(factorization=f)) for f in ("CHOLESKY", "QR")]
    for group in groups:
        fast, sure = (estimator.update(group) for estimator in both)
    assert not both[0]._is_cholesky
    assert difference(fast.pose("b"), sure.pose("b")) < 1e-6
    np.testing.assert_allclose(fast.belief("b").cov_body, sure.belief("b").cov_body, rtol=1e-6)
