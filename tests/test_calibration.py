"""Records set right: against hand-worked numbers, against distortions written out here, and numeric derivatives."""

from collections import Counter
from dataclasses import fields

import numpy as np
import pytest

from coopslam.errors import BadInput
from coopslam.estimation.calibration import (
    PARAMETERS,
    Calibration,
    CameraNoise,
    Provenance,
    RobotCalibration,
    calibrated,
)
from coopslam.io.toml import dump_toml, from_mapping, load_toml, to_mapping
from coopslam.odometry_noise import CommandNoise, Walk
from coopslam.records import BearingFix, BearingRangeFix, Odometry, PosePrior, RangeFix, RelativePoseFix
from coopslam.se2 import Pose2, xytheta

COV = np.array([[0.04, 0.003, 0.002], [0.003, 0.01, 0.001], [0.002, 0.001, 0.02]])
WRONG = RobotCalibration(0.1, 1.05, 0.02, 1.1, 0.9, -0.1, 0.05, 0.25)


def distorted(seed):
    """Random constants, records of a true world, and what sensors with these constants would have said of it."""
    rng = np.random.default_rng(seed)
    offset, bearing_offset, creep, drift, delay = rng.uniform(-0.1, 0.1, 5)
    scale, odometry_scale, turn_scale = rng.uniform(0.8, 1.2, 3)
    askew = rng.uniform(-0.1, 0.1)  # of a's own target, which b sees
    of = RobotCalibration(offset, scale, bearing_offset, odometry_scale, turn_scale, creep, drift, delay, askew)
    true, raw = [], []
    for k in range(20):
        stamp, range_m, bearing, heading = k + 1.0, rng.uniform(1, 6), rng.uniform(-1, 1), rng.uniform(-3, 3)
        read, seen = range_m * scale + offset, bearing + bearing_offset
        forward, turn = rng.uniform(-0.3, 0.3), rng.uniform(-1, 1)
        done = [odometry_scale * forward + creep * abs(turn), 0.0, turn_scale * turn + drift * forward]
        true += [
            Odometry(stamp - 1 + delay, stamp + delay, "a", Pose2.Expmap(np.array(done)), COV),
            BearingRangeFix(stamp, "a", "b", bearing, range_m, COV[:2, :2]),
            RangeFix(stamp, "a", "b", range_m, 0.1),
            BearingFix(stamp, "a", "b", bearing, 0.1),
            RelativePoseFix(stamp, "a", "b", polar(range_m, bearing, heading), COV),
            RelativePoseFix(stamp, "b", "a", polar(range_m, bearing, heading), COV),
        ]
        raw += [
            Odometry(stamp - 1, stamp, "a", Pose2.Expmap(np.array([forward, 0.0, turn])), COV),
            BearingRangeFix(stamp, "a", "b", seen, read * np.cos(seen), COV[:2, :2]),
            RangeFix(stamp, "a", "b", read, 0.1),
            BearingFix(stamp, "a", "b", seen, 0.1),
            RelativePoseFix(stamp, "a", "b", polar(read, seen, heading + bearing_offset), COV),
            RelativePoseFix(stamp, "b", "a", polar(range_m, bearing, heading + askew), COV),
        ]
    return of, true, raw


def polar(range_m, bearing, heading):
    return Pose2(range_m * np.cos(bearing), range_m * np.sin(bearing), heading)


def numbers(record):
    """Everything a record measured, in one array."""
    values = []
    for entry in fields(record):
        value = getattr(record, entry.name)
        if isinstance(value, Pose2):
            values += [value.x(), value.y(), np.cos(value.theta()), np.sin(value.theta())]
        elif isinstance(value, float) and not entry.name.startswith("sigma"):
            values.append(value)
    return np.array(values)


@pytest.mark.parametrize("seed", range(3))
def test_what_wrong_sensors_said_becomes_what_was_true(seed):
    of, true, raw = distorted(seed)
    found = calibrated(raw, Calibration({"a": of, "b": RobotCalibration()}, range_is_depth=True))
    assert [type(record) for record in found] == [type(record) for record in true]
    for one, other in zip(found, true, strict=True):
        assert numbers(one) == pytest.approx(numbers(other), abs=1e-12)


def test_numbers_worked_by_hand():
    fix = BearingRangeFix(3.0, "a", "b", 0.5, 2.0, np.diag([1e-4, 4e-4]))
    (found,) = calibrated([fix], Calibration({"a": WRONG}, range_is_depth=True))
    assert found.range_m == pytest.approx((2.0 / 0.8775825619 - 0.1) / 1.05)
    assert found.bearing_rad == pytest.approx(0.48)
    (found,) = calibrated([fix], Calibration({"a": WRONG}))
    assert found.range_m == pytest.approx(1.9 / 1.05)
    (step,) = calibrated([Odometry(1.0, 2.0, "a", Pose2(2.0, 0.0, 0.0), COV)], Calibration({"a": WRONG}))
    # 2 m become 2.2 m, and drift by 0.1 rad to the left along an arc
    assert xytheta(step.T_start_now) == pytest.approx([22 * np.sin(0.1), 22 * (1 - np.cos(0.1)), 0.1])
    assert (step.start_s, step.stamp_s) == (1.25, 2.25)
    (step,) = calibrated([Odometry(1.0, 2.0, "a", Pose2(0.0, 0.0, -2.0), COV)], Calibration({"a": WRONG}))
    assert step.T_start_now.theta() == pytest.approx(-1.8)
    assert np.hypot(step.T_start_now.x(), step.T_start_now.y()) == pytest.approx(0.2 * np.sin(0.9) / 0.9)
    assert step.T_start_now.x() < 0  # it creeps backwards, whichever way it turns


def test_no_calibration_changes_nothing():
    _, records, _ = distorted(4)
    records.append(PosePrior(3.0, "a", Pose2(1, 2, 3), COV))
    for calibration in (Calibration({}), Calibration({"a": RobotCalibration()})):
        for one, other in zip(calibrated(records, calibration), records, strict=True):
            assert numbers(one) == pytest.approx(numbers(other), abs=1e-12)
            for name in ("cov", "cov_now", "cov_observer", "cov_robot"):
                if hasattr(other, name):
                    assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-9, abs=1e-15)


def test_a_robot_that_stands_stays_and_unknown_motion_stays_unknown():
    stands = Odometry(0.0, 1.0, "a", Pose2(), np.zeros((3, 3)))
    lost = Odometry(1.0, 2.0, "a", Pose2(), np.eye(3))
    found = calibrated([stands, lost], Calibration({"a": WRONG}, odometry=CommandNoise()))
    assert [xytheta(step.T_start_now).tolist() for step in found] == [[0, 0, 0]] * 2
    assert not found[0].cov_now.any()
    assert np.array_equal(found[1].cov_now, np.eye(3))
    assert [step.start_s for step in found] == [0.25, 1.25]


def derivative(function, at, step=1e-6):
    """Central differences, (outputs, inputs)."""
    columns = [(function(at + d) - function(at - d)) / (2 * step) for d in step * np.eye(len(at))]
    return np.array(columns).T


def test_covariances_of_fixes_follow_the_equations():
    """First-order propagation with a numeric Jacobian of the whole transform."""
    calibration = Calibration({"a": WRONG}, range_is_depth=True)

    def bearing_range(values):
        (fix,) = calibrated([BearingRangeFix(0.0, "a", "b", *values, np.eye(2))], calibration)
        return np.array([fix.bearing_rad, fix.range_m])

    def relative(values):
        (fix,) = calibrated([RelativePoseFix(0.0, "a", "b", Pose2(*values), np.eye(3))], calibration)
        return xytheta(fix.T_observer_target)

    at, cov = np.array([0.6, 3.0]), np.array([[1e-4, 1e-5], [1e-5, 4e-4]])
    (fix,) = calibrated([BearingRangeFix(0.0, "a", "b", *at, cov)], calibration)
    jacobian = derivative(bearing_range, at)
    assert fix.cov == pytest.approx(jacobian @ cov @ jacobian.T, rel=1e-6)
    pose = np.array([2.0, 1.0, 0.4])
    (fix,) = calibrated([RelativePoseFix(0.0, "a", "b", Pose2(*pose), COV)], calibration)
    jacobian = derivative(relative, pose)
    assert fix.cov_observer == pytest.approx(jacobian @ COV @ jacobian.T, rel=1e-6)


def test_noise_of_the_calibration_replaces_what_records_say():
    noise = CommandNoise(Walk(0.02, 0.0, 0.0), Walk(0.0, 0.0, 0.0), Walk(0.0, 0.1, 0.0))
    calibration = Calibration({"a": WRONG}, camera=CameraNoise(0.02, 0.003, 0.01), odometry=noise)
    straight = Odometry(0.0, 1.0, "a", Pose2(4.0, 0.0, 0.0), COV)
    fix = BearingRangeFix(0.0, "a", "b", 0.0, 4.3, COV[:2, :2])
    far = RangeFix(0.0, "a", "b", 4.3, 1.0)
    step, fix, far = calibrated([straight, fix, far], calibration)
    assert fix.cov == pytest.approx(np.diag([1e-4, (0.02 + 0.003 * 16) ** 2]))
    assert far.sigma_m == pytest.approx(0.068)
    # 4.4 m along a gentle arc of 0.2 rad: variance 0.02^2 * 4.4 along its chord, which the end sees turned by 0.1 rad
    q = 0.1**2 * 0.2
    along, across = 0.02**2 * 4.4, q * 4.4**2 / 3
    c, s = np.cos(0.1), np.sin(0.1)
    turn = np.array([[c, s], [-s, c]])
    assert step.cov_now[:2, :2] == pytest.approx(turn @ np.diag([along, across]) @ turn.T)
    assert step.cov_now[2] == pytest.approx([q * 2.2 * s, q * 2.2 * c, q])


def test_ranges_below_zero_are_dropped_and_counted_and_strangers_get_the_mean():
    dropped = Counter()
    calibration = Calibration({"a": WRONG, "b": RobotCalibration(bearing_offset_rad=0.04)}, range_is_depth=True)
    near = BearingRangeFix(0.0, "a", "b", 0.0, 0.05, np.eye(2))
    behind = BearingRangeFix(0.0, "a", "b", 2.0, 1.0, np.eye(2))
    stranger = BearingFix(0.0, "c", "a", 0.5, 0.1)
    (found,) = calibrated([near, behind, stranger], calibration, dropped)
    assert found.bearing_rad == pytest.approx(0.47)
    assert dropped == {
        "BearingRangeFix: range less than zero after calibration": 2,
        "c: not in the calibration, the mean of the others is used": 1,
    }


def test_a_file_gives_back_what_was_written(tmp_path):
    provenance = Provenance("log", True, 3.0, 9.0, {"a": dict.fromkeys(PARAMETERS, 0.1)}, {"a": {"range_m": 0.2}})
    written = Calibration({"a": WRONG}, True, CameraNoise(0.02, 0.003, 0.01), CommandNoise(), provenance)
    for calibration in (written, Calibration({"a": WRONG})):
        path = tmp_path / "c.toml"
        path.write_text(dump_toml(to_mapping(calibration)), encoding="utf-8")
        assert from_mapping(Calibration, load_toml(path), str(path)) == calibration


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("range_is_depth = true", "robots"),
        ("[robots.a]\nrange_scale = 0.0", "range_scale"),
        ("[robots.a]\nrange_scale = nan", "robots.a.range_scale"),
        ("[robots.a]\ndelay_s = 'late'", "robots.a.delay_s"),
        ("[robots.a]\nrange_offset = 0.1", "range_offset"),
        ("[robots.a]\n[camera]\nrange_sigma_m = 0.1\nbearing_sigma_rad = 0.01", "range_sigma_per_m2"),
        ("[robots.a]\n[camera]\nrange_sigma_m = -1\nrange_sigma_per_m2 = 0\nbearing_sigma_rad = 0.01", "range_sigma_m"),
        ("[robots.a]\n[odometry.heading]\nafter_1_m = -1", "after_1_rad"),
    ],
)
def test_bad_files_are_said_with_file_and_field(tmp_path, text, named):
    path = tmp_path / "c.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BadInput, match=named) as caught:
        from_mapping(Calibration, load_toml(path), str(path))
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("tilted_rad", "lowered_m"), [(0.002, 0.0), (0.0, 0.003), (-0.001, 0.002)])
def test_what_a_wrong_tilt_or_height_of_the_tracker_does_to_ranges(tilted_rad, lowered_m):
    """The formulas of the module's docstring against trigonometry; H is 0.3 m."""
    ranges, below = np.linspace(2.5, 3.5, 21), 0.3
    elevation = np.arctan2(below - lowered_m, ranges)
    read = below / np.tan(elevation - tilted_rad)
    error = lowered_m * ranges / below + tilted_rad * (ranges**2 + below**2) / below
    np.testing.assert_allclose(read - ranges, error, rtol=0.08)  # first order: second is dR / R of that
    scale = 1 + lowered_m / below + 2 * tilted_rad * 3.0 / below
    offset = tilted_rad * (below**2 - 3.0**2) / below
    left = tilted_rad * (ranges - 3.0) ** 2 / below
    np.testing.assert_allclose(scale * ranges + offset + left - ranges, error, atol=1e-12)
