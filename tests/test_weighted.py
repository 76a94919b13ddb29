"""The paper's equation (1): its scalar form, its rules, and the confidence that it is not entitled to."""

import numpy as np
import pytest
from leapfrog import FIX_COV, ROBOTS, difference, leapfrog

from coopslam.estimation.ekf import Ekf
from coopslam.estimation.weighted import Weighted
from coopslam.evaluation.consistency import chi_square_band, pose_nees
from coopslam.records import BearingRangeFix, CornerDecision, CornerSighting, Odometry, RelativePoseFix, WallDecision
from coopslam.se2 import Pose2

R0, R1 = ROBOTS
SURE = 1e-12  # m^2 or rad^2: what does not matter on a line


def on_a_line(variance):
    return np.diag([variance, SURE, SURE])


def fix(t, observer, target, ahead_m, variance):
    return RelativePoseFix(t, observer, target, Pose2(ahead_m, 0, 0), on_a_line(variance))


def along(estimate, robot):
    """Position on the line and its variance."""
    belief = estimate.belief(robot)
    return belief.T_world_body.x(), belief.cov_body[0, 0]


def equation_1(odom, var_odom, stat, var_stat, track, var_track):
    """Weights are inverse variances; the second estimate is as uncertain as standing robot and tracker together."""
    w_t, w_o = 1 / (var_stat + var_track), 1 / var_odom
    return (w_t * (track + stat) + w_o * odom) / (w_t + w_o), 1 / (w_t + w_o)


def test_on_a_line_it_is_the_equation():
    """Robot 1 drives and watches robot 0 that stands; then they exchange roles. Numbers by the scalar form."""
    estimator = Weighted(ROBOTS)
    estimator.update([fix(0.0, R0, R1, 2.0, 0.04)])
    x0, v0, x1, v1 = 0.0, 1e-12, 2.0, 0.04
    for leg, (mover, ahead, seen) in enumerate([(R1, 1.0, 3.2), (R0, 2.0, 1.1), (R1, 1.0, 2.0), (R0, 1.5, 0.6)]):
        drive = Odometry(leg, leg + 1.0, mover, Pose2(ahead, 0, 0), on_a_line(0.09))
        estimate = estimator.update([drive, fix(leg + 1.0, R0, R1, seen, 0.01)])
        if mover == R1:
            x1, v1 = equation_1(x1 + ahead, v1 + 0.09, x0, v0, seen, 0.01)
        else:
            x0, v0 = equation_1(x0 + ahead, v0 + 0.09, x1, v1, -seen, 0.01)
        assert along(estimate, R0) == pytest.approx((x0, v0), rel=1e-6, abs=1e-9)
        assert along(estimate, R1) == pytest.approx((x1, v1), rel=1e-6, abs=1e-9)


def test_when_both_have_driven_both_are_corrected_each_with_the_others_prior():
    estimator = Weighted(ROBOTS)
    estimator.update([fix(0.0, R0, R1, 2.0, 0.04)])
    drives = [
        Odometry(0.0, 1.0, R0, Pose2(1.0, 0, 0), on_a_line(0.09)),
        Odometry(0.0, 1.0, R1, Pose2(1.0, 0, 0), on_a_line(0.25)),
    ]
    estimate = estimator.update([*drives, fix(1.0, R1, R0, -2.5, 0.01)])
    x0 = equation_1(1.0, 0.09, 3.0, 0.29, -2.5, 0.01)
    x1 = equation_1(3.0, 0.29, 1.0, 0.09, 2.5, 0.01)
    assert along(estimate, R0) == pytest.approx(x0, rel=1e-6)
    assert along(estimate, R1) == pytest.approx(x1, rel=1e-6)
    assert (estimate.joint_covariance([estimate.pose_key(R0), estimate.pose_key(R1)])[:3, 3:] == 0).all()


def test_robots_that_both_stand_keep_their_roles():
    estimator = Weighted(ROBOTS)
    estimator.update([fix(0.0, R0, R1, 2.0, 0.04)])
    drive = Odometry(0.0, 1.0, R1, Pose2(1.0, 0, 0), on_a_line(0.09))
    before = along(estimator.update([drive, fix(1.0, R0, R1, 3.1, 0.01)]), R0)
    x1, v1 = along(estimator.update([]), R1)
    estimate = estimator.update([fix(1.0, R1, R0, -3.3, 0.01)])
    assert along(estimate, R0) == before
    assert along(estimate, R1) == pytest.approx(equation_1(x1, v1, *before, 3.3, 0.01), rel=1e-6)


def test_a_landmark_is_estimated_in_the_same_way():
    """A range along the line of sight of a robot that knows its heading: one dimension again."""
    estimator, cov = Weighted((R0,), ("post",)), np.diag([SURE, 0.01])

    def seen(t, range_m):
        return BearingRangeFix(t, R0, "post", 0.0, range_m, cov)

    estimator.update([seen(0.0, 4.0)])
    estimate = estimator.update([seen(0.5, 4.1)])  # the timeline places it with the second: from a pose that is sure
    x0, v0, x, v = 0.0, 1e-12, *_landmark(estimate)
    drive = Odometry(0.5, 1.0, R0, Pose2(1.0, 0, 0), on_a_line(0.09))
    estimate = estimator.update([drive, seen(1.0, 3.2)])
    robot = equation_1(x0 + 1.0, v0 + 0.09, x, v, -3.2, 0.01)
    post = equation_1(x, v, x0 + 1.0, v0 + 0.09, 3.2, 0.01)
    assert along(estimate, R0) == pytest.approx(robot, rel=1e-6)
    assert _landmark(estimate) == pytest.approx(post, rel=1e-6)


def _landmark(estimate):
    belief = estimate.landmark_belief("post")
    return belief.xy[0], belief.cov[0, 0]


def test_walls_and_corners_are_used_and_nothing_is_correlated():
    world = leapfrog(np.random.default_rng(1), legs=18, scale=0.1)
    estimator = Weighted(ROBOTS)
    for group in world.groups:
        estimate = estimator.update(group)
    stamp, before = world.records[-1].stamp_s, [estimate.vertex_belief(vertex).cov_body for vertex in (0, 1)]
    a, b = (estimate.vertex(vertex) for vertex in (0, 1))
    towards = a.bearing(b.translation()).theta()
    sighting = CornerSighting(stamp, R1, estimate.pose(R1).between(a * Pose2(0, 0, towards)), FIX_COV, 1.5, 0.01)
    turned = CornerDecision(stamp, sighting, 7, True)
    estimate = estimator.update([turned, WallDecision(stamp, 7, 1, 0.01)])
    assert np.trace(estimate.vertex_belief(1).cov_body) < np.trace(before[1])
    np.testing.assert_array_equal(estimate.vertex_belief(0).cov_body, before[0])
    cov = estimator._state.cov.copy()
    for place in range(0, len(cov), 3):
        cov[place : place + 3, place : place + 3] = 0.0
    assert not cov.any()
    assert {kind for kind, _, _ in estimate.innovations} == {"relative pose", "corner", "wall"}


def test_it_is_sure_of_more_than_it_knows_where_the_joint_filter_is_not():
    """Leap-frog on the fixes of both trackers, 50 runs: two-sided 99.9 % band of the NEES."""
    low, high = chi_square_band(3, 50, confidence=0.999)
    scores = {Weighted: [], Ekf: []}
    for kind, nees in scores.items():
        for seed in range(50):
            world = leapfrog(np.random.default_rng(7000 + seed), legs=20, scale=0.2)
            estimator = kind(ROBOTS)
            for group in world.groups:
                estimate = estimator.update(group)
            belief = estimate.belief(R1)
            nees += list(pose_nees([belief.T_world_body], belief.cov_body[None], [world.truth[R1].poses[-1]]))
            assert difference(estimate.pose(R1), world.truth[R1].poses[-1]) < 0.5
    assert low < np.mean(scores[Ekf]) < high
    assert np.mean(scores[Weighted]) > 2 * high
