import gtsam
import numpy as np
import pytest

from coopslam.estimation import factors
from coopslam.estimation.loss import Loss
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerSighting,
    LandmarkPrior,
    LoopClosure,
    PosePrior,
    RangeFix,
    RelativePoseFix,
    WallDecision,
)
from coopslam.se2 import Pose2

A, B = gtsam.symbol("x", 0), gtsam.symbol("x", 1)
COV = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]])
POSE_A, POSE_B = Pose2(0.4, -0.7, 2.1), Pose2(-2.0, 1.3, -1.2)
T_A_B = POSE_A.between(POSE_B)
SEEN = POSE_B.translation()
BEARING, RANGE = POSE_A.bearing(SEEN).theta(), POSE_A.range(SEEN)
BEARING_RANGE = BearingRangeFix(0.0, "a", "b", BEARING, RANGE, np.array([[0.01, 0.001], [0.001, 0.04]]))
RANGE_FIX, BEARING_FIX = RangeFix(0.0, "a", "b", RANGE, 0.1), BearingFix(0.0, "a", "b", BEARING, 0.1)
WALL_END = Pose2(*(POSE_A.transformFrom(np.array([3.0, 0.0]))), 0.3)

# factor, and the second pose at which it is satisfied
POSE_POSE = {
    "odometry": (factors.odometry_leg(A, B, T_A_B, COV), POSE_B),
    "relative pose": (factors.relative_pose(A, B, RelativePoseFix(0.0, "a", "b", T_A_B, COV)), POSE_B),
    "loop closure": (factors.loop_closure(A, B, LoopClosure(0.0, 1.0, "a", "b", T_A_B, COV)), POSE_B),
    "corner": (factors.corner(A, B, CornerSighting(0.0, "a", T_A_B, COV, 1.5, 0.1)), POSE_B),
    "wall": (factors.wall(A, B, WallDecision(0.0, 1, 2, 0.1)), WALL_END),
    "bearing and range": (factors.bearing_range(A, B, BEARING_RANGE), POSE_B),
    "range": (factors.distance(A, B, RANGE_FIX), POSE_B),
    "bearing": (factors.bearing(A, B, BEARING_FIX), POSE_B),
}
POSE_POINT = {
    "bearing and range": factors.bearing_range(A, B, BEARING_RANGE, is_point=True),
    "range": factors.distance(A, B, RANGE_FIX, is_point=True),
    "bearing": factors.bearing(A, B, BEARING_FIX, is_point=True),
}


def values_of(a, b):
    values = gtsam.Values()
    values.insert(A, a)
    values.insert(B, b)
    return values


def moved(x, step):
    return x.retract(step) if isinstance(x, Pose2) else x + step


def numeric_jacobian(factor, a, b, h=1e-6):
    """Of the whitened error, by central differences."""
    columns = []
    for which, x in enumerate((a, b)):
        for step in np.eye(3 if isinstance(x, Pose2) else 2) * h:
            ends = []
            for side in (step, -step):
                pair = [a, b]
                pair[which] = moved(x, side)
                ends.append(factor.whitenedError(values_of(*pair)))
            columns.append((ends[0] - ends[1]) / (2 * h))
    return np.array(columns).T


@pytest.mark.parametrize(("factor", "second"), POSE_POSE.values(), ids=POSE_POSE)
def test_a_factor_is_zero_at_truth_and_its_jacobian_is_the_derivative(factor, second):
    assert factor.error(values_of(POSE_A, second)) == pytest.approx(0.0, abs=1e-20)
    off = Pose2(-1.7, 1.8, -0.9)  # away from the minimum, where a wrong sign would show
    jacobian, _ = factor.linearize(values_of(POSE_A, off)).jacobian()
    np.testing.assert_allclose(jacobian, numeric_jacobian(factor, POSE_A, off), atol=1e-7)


@pytest.mark.parametrize("factor", POSE_POINT.values(), ids=POSE_POINT)
def test_a_factor_to_a_point(factor):
    assert factor.error(values_of(POSE_A, SEEN)) == pytest.approx(0.0, abs=1e-20)
    off = SEEN + [0.3, -0.4]
    jacobian, _ = factor.linearize(values_of(POSE_A, off)).jacobian()
    np.testing.assert_allclose(jacobian, numeric_jacobian(factor, POSE_A, off), atol=1e-7)


@pytest.mark.parametrize("shift", [(0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01), (0.01, -0.02, 0.005)])
def test_an_observers_covariance_weighs_errors_in_the_observers_axes(shift):
    """Half of the squared Mahalanobis distance, computed in the observer's axes without GTSAM."""
    measured = Pose2(T_A_B.x() + shift[0], T_A_B.y() + shift[1], T_A_B.theta() + shift[2])
    factor = factors.relative_pose(A, B, RelativePoseFix(0.0, "a", "b", measured, COV))
    expected = 0.5 * np.array(shift) @ np.linalg.solve(COV, shift)
    # the measured heading turns the axes by 0.01 rad at most
    assert factor.error(values_of(POSE_A, POSE_B)) == pytest.approx(expected, rel=0.02)


def test_a_bearing_and_range_fix_orders_its_noise_as_bearing_then_range():
    fix = BearingRangeFix(0.0, "a", "b", BEARING + 0.01, RANGE, np.diag([0.1, 1.0]) ** 2)
    assert factors.bearing_range(A, B, fix).error(values_of(POSE_A, POSE_B)) == pytest.approx(0.5 * 0.1**2, rel=1e-6)


def test_a_pure_turn_gets_a_floor_and_a_regular_covariance_is_left_alone():
    turn = np.diag([0.0, 0.0, 0.05**2])
    np.testing.assert_allclose(factors.floored(turn), np.diag([1e-12, 1e-12, 0.05**2]), atol=1e-20)
    assert factors.floored(COV) is COV
    factor = factors.odometry_leg(A, B, Pose2(0, 0, 1.0), turn)
    assert np.isfinite(factor.linearize(values_of(Pose2(), Pose2(0, 0, 1.1))).jacobian()[0]).all()


POSE_PRIOR = factors.pose_prior(A, PosePrior(0.0, "a", POSE_A, COV))
POINT_PRIOR = factors.landmark_prior(A, LandmarkPrior(0.0, "l", SEEN, COV[:2, :2]))


@pytest.mark.parametrize(
    ("factor", "place", "off"),
    [(POSE_PRIOR, POSE_A, Pose2(0.9, -0.4, 2.4)), (POINT_PRIOR, SEEN, SEEN + [0.3, -0.4])],
    ids=["pose", "landmark"],
)
def test_a_prior(factor, place, off):
    def value_of(x):
        values = gtsam.Values()
        values.insert(A, x)
        return values

    assert factor.error(value_of(place)) == pytest.approx(0.0, abs=1e-20)
    steps = np.eye(3 if isinstance(place, Pose2) else 2) * 1e-6
    ends = [[factor.whitenedError(value_of(moved(off, side))) for side in (step, -step)] for step in steps]
    numeric = np.array([(plus - minus) / 2e-6 for plus, minus in ends]).T
    jacobian, _ = factor.linearize(value_of(off)).jacobian()
    np.testing.assert_allclose(jacobian, numeric, atol=1e-7)


def test_a_surveyed_point_weighs_errors_in_the_axes_of_the_frame_and_a_pose_in_its_own():
    values = gtsam.Values()
    values.insert(A, SEEN + [0.1, 0.0])
    assert POINT_PRIOR.error(values) == pytest.approx(0.5 * 0.1**2 * np.linalg.inv(COV[:2, :2])[0, 0])
    values = gtsam.Values()
    values.insert(A, POSE_A * Pose2(0.0, 0.1, 0.0))
    assert POSE_PRIOR.error(values) == pytest.approx(0.5 * 0.1**2 * np.linalg.inv(COV)[1, 1])


@pytest.mark.parametrize("is_point", [False, True])
def test_a_loss_reaches_every_fix_of_a_point(is_point):
    """Ten sigmas off, Cauchy's cost is c^2 / 2 log(1 + (10 / c)^2) for two or for one that is off."""
    loss = Loss("cauchy")
    place = SEEN if is_point else POSE_B
    for make, fix in (
        (factors.bearing_range, BearingRangeFix(0.0, "a", "b", BEARING, RANGE + 1.0, np.diag([0.1, 0.1]) ** 2)),
        (factors.distance, RangeFix(0.0, "a", "b", RANGE + 1.0, 0.1)),
        (factors.bearing, BearingFix(0.0, "a", "b", BEARING + 1.0, 0.1)),
    ):
        cost = make(A, B, fix, is_point, loss).error(values_of(POSE_A, place))
        assert cost == pytest.approx(2.385**2 / 2 * np.log1p((10 / 2.385) ** 2), rel=1e-3)
