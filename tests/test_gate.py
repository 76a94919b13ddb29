from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from false_sightings import Sightings
from leapfrog import FIX_COV, ROBOTS, difference
from scipy.stats import chi2

from coopslam.errors import BadInput
from coopslam.estimation.batch import Batch
from coopslam.estimation.gate import CONTRADICTED, FAR, UNDECIDED, GateSettings
from coopslam.estimation.incremental import Incremental
from coopslam.estimation.relative import RelativeBelief, predicted_now, seen_by_tracker
from coopslam.evaluation.consistency import chi_square_band, pose_nees
from coopslam.records import BearingRangeFix, CornerSighting, Odometry, RelativePoseFix
from coopslam.se2 import Pose2, planar_rotation, relative_covariance, xytheta

R0, R1 = ROBOTS
OFF = GateSettings(distance_sq_max=np.inf)
THERE = Pose2(3.0, 1.0, 0.5)  # robot1 in the frame of robot0
STEP_COV = np.diag([0.01, 0.01, 0.01]) ** 2
HOPELESS_COV = np.diag([1.0, 1.0, 1.0]) ** 2


def fix(stamp_s, relative=THERE, observer=R0, target=R1):
    """relative: of robot1 (the target, when robot0 does not watch it) in the observer's frame as if robot0 watched."""
    seen = relative if observer < target else relative.inverse()
    return RelativePoseFix(stamp_s, observer, target, seen, FIX_COV)


def mutual(stamp_s, relative=THERE):
    return [fix(stamp_s, relative), fix(stamp_s, relative, R1, R0)]


def drive(stamp_s, cov=STEP_COV, robot=R1, delta=None):
    return Odometry(stamp_s - 1.0, stamp_s, robot, delta or Pose2(1.0, 0.0, 0.0), cov)


def began(*records, gate=None):
    estimator = Incremental(ROBOTS, gate=gate)
    estimator.update([record for stamp_s in (-0.2, -0.1, 0.0) for record in mutual(stamp_s)])
    estimator.update(records)
    return estimator


def dropped(**reasons):
    words = {"far": FAR, "contradicted": CONTRADICTED, "undecided": UNDECIDED}
    return {f"RelativePoseFix: {words[reason]}": number for reason, number in reasons.items()}


def run(groups, gate=None):
    estimator = Incremental(ROBOTS, gate=gate)
    for group in groups:
        estimate = estimator.update(group)
    return estimator, estimate


# the prediction


def normal(rng, cov):
    return Pose2.Expmap(np.linalg.cholesky(cov) @ rng.standard_normal(3))


def random_cov(rng, sigma):
    root = rng.standard_normal((3, 3)) * sigma
    return root @ root.T + np.eye(3) * (sigma / 3) ** 2


@pytest.mark.parametrize("observer", ROBOTS)
def test_innovations_of_a_carried_prediction_have_its_covariance(observer):
    """Sampled: a belief, odometry of both robots and a fix; the squared distance is chi-square with 3 dof."""
    rng = np.random.default_rng(1)
    before, moves = random_cov(rng, 0.02), [random_cov(rng, 0.02), random_cov(rng, 0.02)]
    delta_a, delta_b = Pose2(0.7, 0.1, 0.8), Pose2(-0.3, 1.0, -2.0)
    truth = delta_a.inverse() * THERE * delta_b
    truth = truth if observer == R0 else truth.inverse()
    fix_cov = np.diag([0.05, 0.02, 0.03]) ** 2  # axes of the observer
    distances = []
    for _ in range(4000):
        belief = RelativeBelief(THERE * normal(rng, before), before)
        belief = belief.after_a(delta_a * normal(rng, moves[0]), moves[0])
        belief = belief.after_b(delta_b * normal(rng, moves[1]), moves[1])
        seen = Pose2(*(xytheta(truth) + np.linalg.cholesky(fix_cov) @ rng.standard_normal(3)))
        belief = belief if observer == R0 else belief.inverse()
        distances.append(belief.distance_sq(seen_by_tracker(RelativePoseFix(0.0, R0, R1, seen, fix_cov), 1e-9)))
    low, high = chi_square_band(3, len(distances), confidence=0.9999)
    assert low < np.mean(distances) < high
    assert np.mean(np.array(distances) > chi2.ppf(0.99, 3)) < 0.02  # one in a hundred expected, and no heavy tail


def test_a_wide_heading_bends_the_prediction_and_innovations_still_have_its_covariance():
    """A turn known to 20 degrees, then two metres: where the robot may be is a bent band, not an ellipse."""
    rng = np.random.default_rng(2)
    turn_cov, drive_cov = np.diag([0.01, 0.01, 0.35]) ** 2, np.diag([0.05, 0.02, 0.02]) ** 2
    start = RelativeBelief(THERE, np.eye(3) * 1e-6)
    truth = THERE * Pose2(2.0, 0.0, 0.0)
    distances = []
    for _ in range(4000):
        belief = start.after_b(normal(rng, turn_cov), turn_cov)
        belief = belief.after_b(Pose2(2.0, 0.0, 0.0) * normal(rng, drive_cov), drive_cov)
        seen = Pose2(*(xytheta(truth) + np.sqrt(np.diag(FIX_COV)) * rng.standard_normal(3)))
        distances.append(belief.distance_sq(seen_by_tracker(fix(0.0, seen), 1e-9)))
    assert np.mean(distances) == pytest.approx(3.0, rel=0.1)
    assert np.mean(np.array(distances) > GateSettings().distance_sq_max) < 1e-3


def test_an_update_with_a_measurement_is_the_least_squares_solution():
    rng = np.random.default_rng(3)
    prior = RelativeBelief(THERE, random_cov(rng, 0.05))
    seen = RelativeBelief(THERE * Pose2(0.03, -0.02, 0.05), random_cov(rng, 0.05))
    belief, distance_sq = prior.updated(seen)
    estimator = Incremental((R0, R1), gate=OFF)  # two fixes, whose covariances are in the target's axes: turn them back
    estimator.update([_in_observer_axes(prior), _in_observer_axes(seen)])
    smoothed = predicted_now(estimator.update([]), R0, R1)
    assert difference(belief.T_a_b, smoothed.T_a_b) < 1e-4
    np.testing.assert_allclose(belief.cov_b, smoothed.cov_b, rtol=0.02, atol=1e-6)
    assert distance_sq == pytest.approx(prior.distance_sq(seen), rel=1e-9)
    assert 2 * estimator.graph.error(estimator.values()) == pytest.approx(distance_sq, rel=0.01)


def _in_observer_axes(belief):
    turn = planar_rotation(belief.T_a_b.theta())
    return RelativePoseFix(0.0, R0, R1, belief.T_a_b, turn @ belief.cov_b @ turn.T)


def test_a_relative_covariance_is_that_of_its_numeric_derivative():
    rng = np.random.default_rng(4)
    a, b = Pose2(1.0, 2.0, 0.4), Pose2(-3.0, 0.5, -1.2)
    root = rng.standard_normal((6, 6)) * 0.01
    joint = root @ root.T

    def moved(error):
        return xytheta(a.between(b).between((a * Pose2(*error[:3])).between(b * Pose2(*error[3:]))))

    jacobian = np.array([(moved(step) - moved(-step)) / 2e-6 for step in np.eye(6) * 1e-6]).T
    np.testing.assert_allclose(
        relative_covariance(a.between(b), joint), jacobian @ joint @ jacobian.T, rtol=1e-6, atol=1e-12
    )


# what is refused


@pytest.mark.parametrize("odometry_factor", [1.0, 10.0])
def test_good_fixes_are_not_refused_and_nothing_changes_by_a_bit(odometry_factor):
    fixes = 0
    for seed in range(8):
        groups = Sightings(np.random.default_rng(seed), 60, odometry_factor=odometry_factor).clean.groups
        gated, estimate = run(groups)
        assert gated.timeline.dropped == {}
        fixes += gated.timeline.used["RelativePoseFix"]
        if seed == 0:
            ungated, other = run(groups, OFF)
            for robot in ROBOTS:
                ours, theirs = estimate.trajectory(robot), other.trajectory(robot)
                np.testing.assert_array_equal(*([xytheta(pose) for pose in t.poses] for t in (ours, theirs)))
                np.testing.assert_array_equal(ours.covariances, theirs.covariances)
    assert fixes > 2900


@pytest.mark.parametrize(("odometry_factor", "passed", "lost"), [(1.0, 0.0, 0.001), (10.0, 0.03, 0.01)])
def test_reflections_are_refused_and_good_fixes_kept(odometry_factor, passed, lost):
    """passed, lost: largest shares of false fixes used and of good ones refused."""
    count = Counter()
    for seed in range(12):
        log = Sightings(np.random.default_rng(seed), 20, 0.2, 0.2, odometry_factor)
        estimator, _ = run(log.world.groups)
        refused = [factor.measured() for factor in estimator.timeline.refused]
        count["refused"] += len(refused)
        for record in log.world.records:
            if isinstance(record, RelativePoseFix):
                is_refused = any(record.T_observer_target.equals(pose, 1e-12) for pose in refused)
                count[log.is_false(record), is_refused] += 1
        assert sum(estimator.timeline.dropped.values()) == len(refused)
    assert count["refused"] == count[True, True] + count[False, True]
    assert count[True, True] > 200
    assert count[True, False] <= passed * count[True, True]
    assert count[False, True] <= lost * count[False, False] + 2  # of two first fixes that disagree both are refused


def test_covariances_of_the_loop_are_honest_with_reflections_about():
    """One pose of each run: a 99.9 % band."""
    scores = []
    for seed in range(60):
        log = Sightings(np.random.default_rng(500 + seed), 6, 0.2, 0.2)
        _, estimate = run(log.world.groups)
        belief = estimate.belief(R1)
        scores += list(pose_nees([belief.T_world_body], belief.cov_body[None], [log.truth[R1].poses[-1]]))
    low, high = chi_square_band(3, len(scores), confidence=0.999)
    assert low < np.mean(scores) < high


def test_a_refused_fix_has_its_variables_and_no_factor():
    false = fix(1.0, Pose2(-2.0, 5.0, 2.0))
    estimator = began(drive(1.0), false)
    timeline = estimator.timeline
    assert timeline.dropped == dropped(far=1)
    assert timeline.used["RelativePoseFix"] == 6
    assert [len(timeline.tracks[robot].keys) for robot in ROBOTS] == [1, 2]
    assert [tuple(factor.keys()) for factor in timeline.refused] == [
        (timeline.tracks[R0].keys[0], timeline.tracks[R1].keys[1])
    ]
    assert timeline.refused[0].measured().equals(false.T_observer_target, 0.0)
    assert estimator.graph.size() == 1 + 6 + 1  # prior, fixes, leg


def test_two_trackers_that_are_wrong_at_once_are_both_refused():
    ghosts = fix(1.0, Pose2(-2.0, 5.0, 2.0)), fix(1.0, Pose2(1.0, -2.0, -1.0), R1, R0)
    assert began(drive(1.0), *ghosts).timeline.dropped == dropped(far=2)


def test_two_trackers_that_agree_are_believed_against_odometry():
    """Robot1 slipped: it is a metre away from where its odometry says, and goes on from there."""
    slipped = THERE * Pose2(0.0, 0.2, 0.0)
    later = slipped * Pose2(1.0, 0.0, 0.0)
    estimator = began(drive(1.0), *mutual(1.0, slipped), drive(2.0), fix(2.0, later))
    assert estimator.timeline.dropped == {}
    assert began(drive(1.0), fix(1.0, slipped)).timeline.dropped == dropped(far=1)  # one alone is not


def test_of_two_that_contradict_each_other_the_clearly_nearer_one_is_used():
    near, off = THERE * Pose2(1.3, 0.2, 0.1), THERE * Pose2(-2.5, 2.0, 1.5)
    for one, other in ((near, off), (off, near)):
        records = drive(1.0, HOPELESS_COV), fix(1.0, one), fix(1.0, other, R1, R0)
        estimator = began(*records)
        assert estimator.timeline.dropped == dropped(contradicted=1)
        assert difference(estimator.update([]).pose(R1), near) < 0.1


def test_of_two_that_contradict_each_other_without_a_clear_choice_none_is_used():
    records = drive(1.0, HOPELESS_COV), fix(1.0, THERE * Pose2(0.2, 1.0, 0.5)), fix(1.0, THERE, R1, R0)
    assert began(*records).timeline.dropped == dropped(contradicted=2)


def test_first_fixes_vote():
    """Reflections first, and more than one: the largest number that agree places the robot."""
    ghosts = [fix(0.0, Pose2(-2.0, 5.0, 2.0)), fix(0.0, Pose2(1.0, -2.0, -1.0), R1, R0), fix(0.1, Pose2(4.0, 4.0, 0.0))]
    estimator = Incremental(ROBOTS)
    estimate = estimator.update([*ghosts, *mutual(0.2), fix(0.3)])
    assert estimator.timeline.dropped == dropped(undecided=3)
    assert difference(estimate.pose(R1), THERE) < 1e-6


def test_first_fixes_that_contradict_each_other_wait_for_a_majority():
    estimator = Incremental(ROBOTS)
    estimator.update([fix(0.0, Pose2(-2.0, 5.0, 2.0)), fix(0.0, THERE, R1, R0)])
    assert not estimator.timeline.is_placed(R1)
    assert estimator.timeline.dropped == dropped(undecided=2)
    estimate = estimator.update([drive(1.0), fix(1.0, THERE * Pose2(1.0, 0.0, 0.0))])
    assert difference(estimate.pose(R1), THERE * Pose2(1.0, 0.0, 0.0)) < 1e-6
    assert estimator.timeline.dropped == dropped(undecided=2)


def test_a_single_first_fix_is_taken_as_it_is():
    ghost = Pose2(-2.0, 5.0, 2.0)
    assert difference(Incremental(ROBOTS).update([fix(0.0, ghost)]).pose(R1), ghost) < 1e-9


def test_a_late_fix_is_held_against_where_the_robots_were():
    at_stop = CornerSighting(1.0, R1, Pose2(), FIX_COV, 1.5, 0.01)
    estimator = began(drive(1.0), at_stop)
    estimator.update([drive(2.0), fix(2.0, THERE * Pose2(2.0, 0.0, 0.0))])
    estimator.update([fix(1.0, THERE * Pose2(1.0, 0.0, 0.0)), fix(1.0, THERE * Pose2(2.0, 0.0, 0.0)), fix(1.5)])
    assert estimator.timeline.dropped == dropped(far=1) | {"RelativePoseFix: older than the odometry after it": 1}


def test_robots_that_never_saw_each_other_are_predicted_by_the_others():
    robots = (R0, R1, "robot2")
    estimator = Incremental(robots)
    estimator.update([fix(0.0), fix(0.0, Pose2(0.0, 2.0, 0.0), R0, "robot2")])
    true = THERE.between(Pose2(0.0, 2.0, 0.0))
    estimator.update([fix(1.0, Pose2(5.0, 5.0, 0.0), R1, "robot2"), fix(1.1, true, R1, "robot2")])
    assert estimator.timeline.dropped == dropped(far=1)


def test_a_pair_whose_first_fixes_disagreed_is_predicted_once_both_are_placed():
    robots = (R0, R1, "robot2")
    estimator = Incremental(robots)
    there = Pose2(0.0, 2.0, 0.0)
    estimator.update([fix(0.0, Pose2(5.0, 5.0, 0.0), R1, "robot2"), fix(0.0, Pose2(-5.0, 5.0, 0.0), R1, "robot2")])
    estimator.update([fix(0.0), fix(0.0, there, R0, "robot2")])
    estimator.update([fix(1.0, Pose2(-5.0, 5.0, 0.0), R1, "robot2"), fix(1.1, THERE.between(there), R1, "robot2")])
    assert estimator.timeline.dropped == dropped(undecided=2, far=1)


def test_a_sensor_without_noise_is_not_refused_for_rounding():
    cov = np.eye(3) * 1e-12
    log = Sightings(np.random.default_rng(0), 12).clean
    for group in log.groups:
        for k, record in enumerate(group):
            if isinstance(record, RelativePoseFix):
                poses = [_pose_at(log, robot, record.stamp_s) for robot in (record.observer, record.target)]
                group[k] = replace(record, T_observer_target=poses[0].between(poses[1]), cov_observer=cov)
            elif isinstance(record, Odometry):
                poses = [_pose_at(log, record.robot, stamp) for stamp in (record.start_s, record.stamp_s)]
                group[k] = replace(record, T_start_now=poses[0].between(poses[1]), cov_now=cov)
    estimator, _ = run(log.groups)
    assert estimator.timeline.dropped == {}


def _pose_at(log, robot, stamp_s):
    truth = log.truth[robot]
    return truth.poses[max(int(np.searchsorted(truth.stamps_s, stamp_s + 1e-9)) - 1, 0)]


@pytest.mark.parametrize("grouped", [True, False])
def test_batch_refuses_the_same(grouped):
    log = Sightings(np.random.default_rng(5), 8, 0.2, 0.2)
    batch, (incremental, _) = Batch(ROBOTS), run(log.world.groups)
    for group in log.world.groups if grouped else [log.world.records]:
        batch.update(group)
    assert batch.timeline.dropped == incremental.timeline.dropped
    assert sum(batch.timeline.dropped.values()) == len(log.false.keys() & {id(r) for r in log.world.records})


def test_what_the_timeline_drops_and_other_fixes_are_not_the_gate_s_matter():
    estimator = began(
        fix(0.5, Pose2(9.0, 9.0, 0.0), R0, "stranger"), BearingRangeFix(0.5, R0, R1, 3.0, 9.0, np.eye(2) * 1e-2)
    )
    assert estimator.timeline.dropped == {"RelativePoseFix: unknown robot": 1}
    assert estimator.timeline.refused == []


def test_nonsense_settings_are_refused_and_infinity_means_no_gate():
    for nonsense in (
        {"distance_sq_max": 0.0},
        {"distance_sq_max": np.nan},
        {"margin_sq": -1.0},
        {"numerical_sigma": 1e4},
    ):
        with pytest.raises(BadInput, match=next(iter(nonsense))):
            GateSettings(**nonsense)
    assert began(drive(1.0), fix(1.0, Pose2(-2.0, 5.0, 2.0)), gate=OFF).timeline.dropped == {}
