"""Constants planted in simulated logs are found against truth, as well as their standard deviations say."""

import numpy as np
import pytest
from miscalibrated_world import BEARING_SIGMA_RAD, PLANTED, RANGE_SIGMA_M, STEP_S, STEP_SIGMAS, miscalibrated_world
from scipy.stats import chi2

from coopslam.errors import BadInput
from coopslam.estimation.calibration import PARAMETERS
from coopslam.estimation.truth_calibration import TruthCalibrationSettings, truth_calibrate
from coopslam.records import Odometry

EXACT = TruthCalibrationSettings(truth_sigma_m=1e-3, truth_sigma_rad=1e-3)  # chords between true poses, 0.1 s apart


@pytest.fixture(scope="module")
def found():
    worlds = [miscalibrated_world(seed, duration_s=300.0) for seed in range(8)]
    return [truth_calibrate(world.records, world.robots, world.truth, world.landmarks, EXACT) for world in worlds]


def test_planted_constants_are_found_within_their_sigmas(found):
    """Squared errors over eight worlds against both ends of the chi-square distribution, one in a thousand beyond."""
    errors = []
    for calibration in found:
        for robot, constants in PLANTED.items():
            one, sigmas = calibration.robots[robot], calibration.provenance.sigmas[robot]
            names = PARAMETERS[: len(constants)]
            errors += [(getattr(one, n) - true) / sigmas[n] for n, true in zip(names, constants, strict=True)]
    low, high = chi2.ppf([0.0005, 0.9995], len(errors))
    assert low < np.sum(np.square(errors)) < high
    assert all(calibration.range_is_depth for calibration in found)


def test_the_noise_that_is_left_is_that_of_the_simulator(found):
    """Robust sizes of some 5 000 sightings and some 400 windows, in which variances add up step by step."""
    for calibration in found[:3]:
        assert calibration.camera.range_sigma(3.0) == pytest.approx(RANGE_SIGMA_M, rel=0.1)
        assert calibration.camera.bearing_sigma_rad == pytest.approx(BEARING_SIGMA_RAD, rel=0.1)
        heading, steps = calibration.odometry.heading, 10.0 / STEP_S
        # 10 s of the four phases by turns, a quarter each: 1.4 m and 2.3 rad in three quarters of the steps
        assert np.sqrt(heading.variance(1.4, 2.3, 7.5)) == pytest.approx(
            STEP_SIGMAS[2] * np.sqrt(0.75 * steps), rel=0.4
        )
        for before, after in zip(*_sizes(calibration), strict=True):
            assert after < before


def _sizes(calibration):
    provenance = calibration.provenance
    return [
        [sizes[robot]["range_m"] for robot in PLANTED]
        for sizes in (provenance.residuals_before, provenance.residuals_after)
    ]


def test_robots_without_truth_or_sightings_or_odometry():
    world = miscalibrated_world(1, duration_s=60.0)
    truth = {robot: track for robot, track in world.truth.items() if robot != "c"}
    records = [r for r in world.records if getattr(r, "observer", "") != "b" and getattr(r, "robot", "") != "a"]
    calibration = truth_calibrate(records, world.robots, truth, world.landmarks)
    assert list(calibration.robots) == ["a", "b"]
    a, b = calibration.robots.values()
    assert (a.odometry_scale, a.turn_scale, a.delay_s) == (1.0, 1.0, 0.0)
    assert (b.range_offset_m, b.range_scale, b.bearing_offset_rad) == (0.0, 1.0, 0.0)
    assert a.range_scale == pytest.approx(PLANTED["a"][1], abs=0.02)
    assert b.odometry_scale == pytest.approx(PLANTED["b"][3], abs=0.02)
    # c has no truth: the mean of the others stands in for it
    assert calibration.of("c").range_scale == pytest.approx((a.range_scale + b.range_scale) / 2)


def test_errors_are_said():
    world = miscalibrated_world(1, duration_s=10.0)
    with pytest.raises(BadInput, match="simulated: no truth of any robot"):
        truth_calibrate(world.records, world.robots, {}, world.landmarks, log="simulated")
    odometry = [r for r in world.records if isinstance(r, Odometry) and r.robot == "a"]
    with pytest.raises(BadInput, match="no odometry nor sighting of a robot with truth"):
        truth_calibrate(odometry, world.robots, {"b": world.truth["b"]}, {})
    with pytest.raises(BadInput, match="window_s"):
        TruthCalibrationSettings(window_s=0.0)


def test_targets_that_are_mounted_askew():
    planted = {robot: (*PLANTED[robot], offset) for robot, offset in (("a", 0.03), ("b", -0.02), ("c", 0.05))}
    world = miscalibrated_world(5, planted, duration_s=120.0, landmarks=0, tracker=True)
    found = truth_calibrate(world.records, world.robots, world.truth, {})
    for robot, constants in planted.items():
        sigma = found.provenance.sigmas[robot]["heading_offset_rad"]
        assert sigma < 0.005
        assert found.robots[robot].heading_offset_rad == pytest.approx(constants[8], abs=3.5 * sigma)
