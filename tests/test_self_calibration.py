"""Constants planted in simulated logs are found without truth, as well as their standard deviations say."""

from dataclasses import replace

import numpy as np
import pytest
from explorations import ROBOTS, run
from miscalibrated_world import BEARING_SIGMA_RAD, NOTHING_WRONG, PLANTED, RANGE_SIGMA_M, miscalibrated_world
from scipy.stats import chi2

from coopslam.errors import BadInput, UnderDetermined
from coopslam.estimation.calibration import PARAMETERS, CameraNoise, calibrated
from coopslam.estimation.loss import Loss
from coopslam.estimation.offline import SmoothSettings, smooth
from coopslam.estimation.self_calibration import PriorSigmas, SelfCalibrationSettings, self_calibrate, smooth_calibrated
from coopslam.estimation.synchronize import synchronized
from coopslam.estimation.timeline import TimelineSettings
from coopslam.records import BearingFix, LandmarkPrior, Odometry, RelativePoseFix
from coopslam.se2 import Pose2, xytheta

SETTINGS = SelfCalibrationSettings(rounds=6, camera=CameraNoise(RANGE_SIGMA_M, 0.0, BEARING_SIGMA_RAD))


def found_in(world, settings=SETTINGS):
    return self_calibrate(world.records, world.robots, tuple(world.landmarks), settings=settings, log="simulated")


def errors_in_sigmas(calibration, planted):
    """(robots, 8), or 9 where headings are planted, too."""
    rows = []
    for robot, constants in planted.items():
        sigmas = calibration.provenance.sigmas[robot]
        one = calibration.robots[robot]
        names = PARAMETERS[: len(constants)]
        rows.append([(getattr(one, n) - true) / sigmas[n] for n, true in zip(names, constants, strict=True)])
    return np.array(rows)


@pytest.fixture(scope="module")
def found():
    worlds = [miscalibrated_world(seed) for seed in range(6)]
    return worlds, [found_in(world) for world in worlds]


def test_planted_constants_are_found_within_their_sigmas(found):
    """Squared errors over six worlds against both ends of the chi-square distribution; one in a thousand is beyond."""
    errors = np.array([errors_in_sigmas(one.calibration, PLANTED) for one in found[1]])
    low, high = chi2.ppf([0.0005, 0.9995], errors.size)
    assert low < (errors**2).sum() < high
    assert all(one.calibration.range_is_depth for one in found[1])
    # and that is worth something: the sigmas are far below what is planted
    sigmas = found[1][0].calibration.provenance.sigmas["a"]
    assert sigmas["range_scale"] < 0.005 and sigmas["odometry_scale"] < 0.01 and sigmas["delay_s"] < 0.01


def test_residuals_shrink_to_the_noise(found):
    provenance = found[1][0].calibration.provenance
    for robot in PLANTED:
        before, after = provenance.residuals_before[robot], provenance.residuals_after[robot]
        assert after["range_m"] < before["range_m"]
        # half as large to half as large again: a smoothed trajectory bends to its sightings
        assert 0.5 * RANGE_SIGMA_M < after["range_m"] < 1.5 * RANGE_SIGMA_M
        assert after["turn_rad"] < before["turn_rad"]


def test_smoothing_on_gives_what_smoothing_from_nothing_gives(found):
    """Two ways to the same minimum: from the calibration's trajectory, and from the records alone."""
    world, one = found[0][0], found[1][0]
    records = synchronized(calibrated(world.records, one.calibration))
    timeline, landmarks = TimelineSettings(loss=Loss("cauchy")), tuple(world.landmarks)
    again = smooth_calibrated(records, world.robots, landmarks, timeline, SmoothSettings(), one.solution)
    anew = smooth(records, world.robots, landmarks, timeline)
    for robot in world.robots:
        own, other = again.estimate.trajectory(robot), anew.estimate.trajectory(robot)
        assert own.stamps_s == pytest.approx(other.stamps_s)
        poses = np.array([[xytheta(pose) for pose in one.poses] for one in (own, other)])
        # each ends within a twentieth of a sigma of the minimum; sigmas are a few centimetres
        assert np.abs(poses[0] - poses[1])[:, :2].max() < 5e-3


def test_without_truth_the_scale_is_shared_and_with_surveys_it_is_found():
    """Odometry 10 % too short, ranges right: scale sqrt(1 / 1.1) of the world makes the two scales equal."""
    planted = {robot: (0.0, 1.0, 0.0, 1.1, 1.0, 0.0, 0.0, 0.0) for robot in ("a", "b", "c")}
    world = miscalibrated_world(11, planted)
    calibration = found_in(world).calibration
    both = np.sqrt(1.1)
    scales = np.array([[one.odometry_scale, one.range_scale] for one in calibration.robots.values()])
    assert scales.mean(axis=0) == pytest.approx([both, both], abs=0.01)
    assert scales[:, 0].mean() == pytest.approx(scales[:, 1].mean(), abs=1e-9)
    # surveys are told in the frame of the first robot's start
    start = world.truth["a"].poses[0]
    surveys = [
        LandmarkPrior(0.0, name, start.transformTo(place), 1e-4 * np.eye(2)) for name, place in world.landmarks.items()
    ]
    world.records[:0] = surveys[:6]
    calibration = found_in(world).calibration
    scales = np.array([[one.odometry_scale, one.range_scale] for one in calibration.robots.values()])
    assert scales.mean(axis=0) == pytest.approx([1.1, 1.0], abs=0.01)


def test_the_robot_tracker_is_calibrated_without_landmarks():
    """Targets that are mounted askew included."""
    planted = {robot: (*PLANTED[robot], offset) for robot, offset in (("a", 0.03), ("b", -0.02), ("c", 0.05))}
    world = miscalibrated_world(5, planted, duration_s=120.0, landmarks=0, tracker=True)
    calibration = self_calibrate(world.records, world.robots, settings=SelfCalibrationSettings(rounds=6)).calibration
    assert not calibration.range_is_depth
    assert calibration.provenance.sigmas["a"]["heading_offset_rad"] < 0.01
    errors = errors_in_sigmas(calibration, planted)
    low, high = chi2.ppf([0.0005, 0.9995], errors.size)
    assert low < (errors**2).sum() < high


# ---- explorations ----

TRACKER_WRONG = {
    "range_offset_m": 0.02,
    "range_scale": 1.03,
    "bearing_offset_rad": 0.01745,
    "heading_offset_rad": 0.0349,
}


def explored_with_wrong_trackers(seed: int):
    """Records of an exploration whose sightings of robots were 3 % and 2 cm too far, 1 and 2 degrees too far left."""
    offset, scale, bearing, heading = TRACKER_WRONG.values()
    records = []
    for record in run("paper_one_obstacle", "typical", seed).records:
        if isinstance(record, RelativePoseFix):
            x, y, turn = xytheta(record.T_observer_target)
            ratio = scale + offset / np.hypot(x, y)
            seen = Pose2(0.0, 0.0, bearing) * Pose2(x * ratio, y * ratio, turn + heading)
            record = replace(record, T_observer_target=seen)
        records.append(record)
    return records


def test_trackers_of_an_exploration_are_calibrated_when_odometry_tells_the_scale():
    """Squared errors of four constants of two robots over eight runs, in the band that one in a thousand leaves."""
    settings, errors = SelfCalibrationSettings(rounds=4, hold=("odometry_scale",)), []
    for seed in range(8):
        found = self_calibrate(explored_with_wrong_trackers(seed), ROBOTS, settings=settings)
        for robot, one in found.calibration.robots.items():
            sigmas = found.calibration.provenance.sigmas[robot]
            assert one.odometry_scale == 1.0 and sigmas["range_scale"] < 0.01 and sigmas["heading_offset_rad"] < 0.01
            errors += [(getattr(one, name) - true) / sigmas[name] for name, true in TRACKER_WRONG.items()]
        assert found.not_told == ()
    low, high = chi2.ppf([0.0005, 0.9995], len(errors))
    assert low < np.sum(np.square(errors)) < high
    assert np.max(np.abs(errors)) < 4.0


def test_an_exploration_alone_tells_the_product_of_the_scales_only_and_says_so():
    found = self_calibrate(explored_with_wrong_trackers(0), ROBOTS)
    scales = np.array([[one.odometry_scale, one.range_scale] for one in found.calibration.robots.values()]).mean(axis=0)
    sigma = max(own["odometry_scale"] for own in found.calibration.provenance.sigmas.values())
    assert scales[0] == pytest.approx(scales[1], abs=1e-9)
    assert np.prod(scales) == pytest.approx(1.03, abs=3 * sigma)
    (line,) = found.not_told
    assert line.startswith("size of the world: not observable") and "range_scale and odometry_scale" in line


def test_what_a_log_does_not_excite_stays_at_its_default():
    """One robot that measures bearings only: nothing tells what is wrong with ranges, nor how large the world is."""
    world = miscalibrated_world(3, {"a": PLANTED["a"]})
    records = [
        BearingFix(r.stamp_s, r.observer, r.target, r.bearing_rad, BEARING_SIGMA_RAD) if hasattr(r, "range_m") else r
        for r in world.records
    ]
    found = self_calibrate(records, world.robots, tuple(world.landmarks))
    calibration = found.calibration
    one, sigmas = calibration.robots["a"], calibration.provenance.sigmas["a"]
    assert (one.range_offset_m, one.range_scale) == (0.0, 1.0)
    assert (sigmas["range_offset_m"], sigmas["range_scale"]) == (0.1, 0.1)  # what was known before
    assert one.odometry_scale == pytest.approx(1.0, abs=1e-9)  # the gauge
    assert found.not_told[0].startswith("a: range_offset_m, range_scale, odometry_scale, heading_offset_rad: not obs")
    assert found.not_told[1] == "size of the world: nothing in this log measures it"
    assert one.turn_scale == pytest.approx(PLANTED["a"][4], abs=4 * sigmas["turn_scale"])


def test_right_sensors_are_left_alone_and_ranges_are_not_taken_for_depths():
    planted = dict.fromkeys(("a", "b"), NOTHING_WRONG)
    calibration = found_in(miscalibrated_world(7, planted, is_depth=False)).calibration
    assert not calibration.range_is_depth
    errors = errors_in_sigmas(calibration, planted)
    low, high = chi2.ppf([0.0005, 0.9995], errors.size)
    assert low < (errors**2).sum() < high


def test_the_same_log_gives_the_same_calibration():
    world = miscalibrated_world(1, duration_s=40.0)
    first, second = (found_in(world, replace(SETTINGS, rounds=2)).calibration for _ in range(2))
    assert first == second


def test_errors_are_said():
    with pytest.raises(BadInput, match="no records"):
        self_calibrate([], ["a"])
    with pytest.raises(BadInput, match="rounds"):
        SelfCalibrationSettings(rounds=0)
    with pytest.raises(BadInput, match="hold: 'scale': expected some of range_offset_m"):
        SelfCalibrationSettings(hold=("scale",))
    with pytest.raises(BadInput, match="delay_s"):
        PriorSigmas(delay_s=0.0)
    world = miscalibrated_world(1, duration_s=20.0)
    alone = [record for record in world.records if isinstance(record, Odometry)]
    with pytest.raises(UnderDetermined, match="b, c are not connected to a"):
        self_calibrate(alone, world.robots)
