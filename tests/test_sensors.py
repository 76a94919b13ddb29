"""Noise and sensors against the paper's values, closed forms and the scatter of what is measured."""

from math import inf, nan, radians

import numpy as np
import pytest
from monte_carlo import require_covariance
from scipy.stats import chi2

from coopslam.errors import BadInput, BadRecord
from coopslam.se2 import Pose2, compose_leg, xytheta
from sim.noise import (
    EXACT,
    PRESETS,
    TYPICAL,
    FalseSightings,
    FinderNoise,
    Noise,
    OdometryBias,
    OdometryNoise,
    TrackerNoise,
)
from sim.sensors import Sensors

NO_FLOOR = OdometryNoise(floor_sigma=0.0)


def sensors(true=TYPICAL, believed=None, seed=0, **more) -> Sensors:
    return Sensors(true, believed or true, np.random.default_rng(seed), **more)


def split(turn: float, distance: float, steps: int):
    """Times, turns and distances of a turn followed by a drive, each in equal steps."""
    turns = np.append(np.full(steps, turn / steps), np.zeros(steps))
    distances = np.append(np.zeros(steps), np.full(steps, distance / steps))
    return np.arange(2 * steps + 1.0), turns, distances


def in_band(samples, sigma: float) -> bool:
    """Whether zero-mean samples have this sigma: two-sided chi-square band of 99.9 %."""
    low, high = chi2.ppf([0.0005, 0.9995], len(samples))
    return bool(low < np.sum(np.square(samples)) / sigma**2 < high)


@pytest.mark.parametrize(("turn", "distance"), [(0.0, 1.0), (1.2, 3.0), (-2.5, 0.2), (2.0, 0.0)])
@pytest.mark.parametrize("noise", [NO_FLOOR, OdometryNoise(0.3, radians(10), radians(20), 0.0)])
def test_a_legs_covariance_does_not_depend_on_the_sampling_rate(noise, turn, distance):
    legs = []
    for steps in (1, 10, 100):
        _, turns, distances = split(turn, distance, steps)
        deltas = [Pose2(d, 0.0, t) for t, d in zip(turns, distances, strict=True)]
        covariances = [noise.covariance(t, d) for t, d in zip(turns, distances, strict=True)]
        legs.append(compose_leg(deltas, covariances))
    for pose, cov in legs[1:]:
        assert pose.equals(legs[0][0], 1e-9)
        np.testing.assert_allclose(cov, legs[0][1], rtol=1e-9, atol=1e-15)


def test_the_floor_does_not_show_after_a_metre():
    """The step's floor of 1 µm and 1 µrad keeps single covariances regular and is no part of the law."""
    for steps in (1, 10):
        deltas, covs = [Pose2(1 / steps, 0, 0)] * steps, [OdometryNoise().covariance(0.0, 1 / steps)] * steps
        np.testing.assert_allclose(compose_leg(deltas, covs)[1], NO_FLOOR.covariance(0.0, 1.0), rtol=0.01, atol=1e-7)
    assert np.linalg.eigvalsh(OdometryNoise().covariance(1.0, 0.0))[0] > 0


def test_the_law_is_a_random_walk_that_was_integrated():
    """White noise of speed and turn rate, integrated in 200 steps by numpy: the covariance after 2.5 m."""
    rng, metres, steps, runs = np.random.default_rng(1), 2.5, 200, 20_000
    step = metres / steps
    heading = np.cumsum(rng.standard_normal((runs, steps)) * NO_FLOOR.drift_sigma_rad * np.sqrt(step), axis=1)
    along = rng.standard_normal((runs, steps)).sum(axis=1) * NO_FLOOR.translation_sigma_m * np.sqrt(step)
    sideways = (heading * step).sum(axis=1) - heading[:, -1] * step / 2  # trapezoidal
    require_covariance(np.column_stack([along, sideways, heading[:, -1]]), NO_FLOOR.covariance(0.0, metres))


@pytest.mark.parametrize("steps", [1, 5])
def test_scatter_after_a_metre_is_the_papers(steps):
    """3 cm along the track and 2 degrees of heading after 1 m, whatever the sampling rate."""
    sensor = sensors()
    times, step = np.arange(steps + 1.0), np.full(steps, 1.0 / steps)
    errors = []
    for _ in range(2000):
        end = Pose2()
        for record in sensor.odometry("ann", times, np.zeros(steps), step):
            end = end * record.T_start_now
        errors.append(xytheta(end) - [1.0, 0.0, 0.0])
    x, y, theta = np.array(errors).T
    assert in_band(x, 0.03) and in_band(theta, radians(2.0))
    assert in_band(y, radians(2.0) / np.sqrt(3))  # heading drift, integrated over the metre
    assert np.corrcoef(y, theta)[0, 1] == pytest.approx(np.sqrt(3) / 2, abs=0.03)


@pytest.mark.parametrize("steps", [1, 4])
def test_scatter_after_a_full_turn_is_the_papers(steps):
    sensor = sensors()
    turned = [
        sum(r.T_start_now.theta() for r in sensor.odometry("ann", np.arange(steps + 1.0), turn, np.zeros(steps)))
        for turn in [np.full(steps, np.pi / 2 / steps)] * 2000
    ]
    assert in_band(np.array(turned) - np.pi / 2, radians(3.0) / 2)  # a quarter of the turn, half the sigma
    assert np.sqrt(NO_FLOOR.covariance(2 * np.pi, 0.0)[2, 2]) == pytest.approx(radians(3.0))
    np.testing.assert_array_equal(NO_FLOOR.covariance(-1.0, 0.0), NO_FLOOR.covariance(1.0, 0.0))


def test_odometry_records_carry_the_covariance_of_their_scatter():
    sensor = sensors()
    records = [sensor.odometry("ann", np.array([3.0, 4.0]), np.zeros(1), np.array([0.5]))[0] for _ in range(5000)]
    assert {(r.start_s, r.stamp_s, r.robot) for r in records} == {(3.0, 4.0, "ann")}
    errors = np.array([xytheta(Pose2(0.5, 0, 0).between(r.T_start_now)) for r in records])
    claimed = np.mean([r.cov_now for r in records], axis=0)  # each of its measured step, so only nearly the same
    require_covariance(errors, claimed)


@pytest.mark.parametrize("relative", [Pose2(3.0, 2.0, 0.7), Pose2(-0.5, -4.0, -3.0), Pose2(0.0, 1.0, 2.0)], ids=str)
def test_the_trackers_covariance_is_that_of_its_scatter(relative):
    """Along the line of sight the sigma of range, across it that of bearing; both in the axes of the observer."""
    sensor, noise = sensors(), TYPICAL.tracker
    fixes = [sensor.relative_pose(1.5, "ann", "bob", relative) for _ in range(4000)]
    errors = np.array([xytheta(fix.T_observer_target) - xytheta(relative) for fix in fixes])
    errors[:, 2] = (errors[:, 2] + np.pi) % (2 * np.pi) - np.pi
    metres = relative.range(np.zeros(2))
    line = np.array([relative.x(), relative.y()]) / metres
    across = np.array([-line[1], line[0]])
    assert in_band(errors[:, :2] @ line, np.hypot(noise.range_sigma_m, noise.range_sigma_per_m * metres))
    assert in_band(errors[:, :2] @ across, np.hypot(noise.lateral_sigma_m, noise.bearing_sigma_rad * metres))
    assert in_band(errors[:, 2], noise.heading_sigma_rad)
    require_covariance(errors, np.mean([fix.cov_observer for fix in fixes], axis=0))
    assert (fixes[0].stamp_s, fixes[0].observer, fixes[0].target) == (1.5, "ann", "bob")


def test_the_finders_covariance_is_that_of_its_scatter():
    sensor, corner = sensors(), Pose2(0.1, -0.2, 2.0)
    seen = [sensor.corner(2.0, "ann", corner, 4.5) for _ in range(4000)]
    errors = np.array([xytheta(s.T_observer_corner) - xytheta(corner) for s in seen])
    require_covariance(errors, seen[0].cov_observer)
    assert in_band(np.array([s.interior_angle_rad for s in seen]) - 4.5, seen[0].interior_angle_sigma_rad)
    line = np.array([0.1, -0.2]) / np.hypot(0.1, 0.2)
    assert in_band(errors[:, :2] @ line, 0.005) and in_band(errors[:, 2], radians(0.5))


def test_the_finders_error_across_the_line_of_sight_grows_with_distance():
    """5 mm and half a degree: at 1.5 m the sideways sigma is that of both, along the line it stays 5 mm."""
    sensor, corner = sensors(), Pose2(-0.9, 1.2, 0.4)
    seen = [sensor.corner(2.0, "ann", corner, 4.5) for _ in range(4000)]
    errors = np.array([xytheta(s.T_observer_corner) - xytheta(corner) for s in seen])
    line, across = np.array([-0.6, 0.8]), np.array([-0.8, -0.6])
    assert in_band(errors[:, :2] @ line, 0.005)
    assert in_band(errors[:, :2] @ across, np.hypot(0.005, 1.5 * radians(0.5)))
    require_covariance(errors, np.mean([s.cov_observer for s in seen], axis=0))


def test_an_exact_sensor_tells_the_truth():
    sensor = sensors(EXACT)
    times, turns, distances = split(1.1, 2.0, 3)
    for record, turn, distance in zip(sensor.odometry("ann", times, turns, distances), turns, distances, strict=True):
        assert record.T_start_now.equals(Pose2(distance, 0.0, turn), 1e-15) and not record.cov_now.any()
    relative, corner = Pose2(1.0, -2.0, 3.0), Pose2(0.01, 0.02, -3.0)
    assert sensor.relative_pose(0.0, "ann", "bob", relative).T_observer_target.equals(relative, 1e-15)
    with pytest.raises(BadRecord, match="sigma 0"):
        sensor.corner(0.0, "ann", corner, 1.0)  # a sigma of zero is no belief
    sighting = sensors(*PRESETS["none"]).corner(0.0, "ann", corner, 1.0)
    assert sighting.T_observer_corner.equals(corner, 1e-15) and sighting.interior_angle_rad == 1.0


def test_truth_and_belief_are_two_things():
    true, believed = Noise(OdometryNoise(0.1, 0.1, 0.1)), Noise(OdometryNoise(0.01, 0.02, 0.03), TrackerNoise(0.5))
    records = [
        sensors(true, believed, seed).odometry("a", np.arange(2.0), np.zeros(1), np.ones(1))[0] for seed in range(500)
    ]
    assert in_band([r.T_start_now.x() - 1.0 for r in records], 0.1)
    assert np.sqrt(np.mean([r.cov_now[0, 0] for r in records])) == pytest.approx(0.01, rel=0.02)
    fixes = [sensors(true, believed, seed).relative_pose(0.0, "a", "b", Pose2(1, 0, 0)) for seed in range(500)]
    assert in_band([f.T_observer_target.x() - 1.0 for f in fixes], np.sqrt(true.tracker.line_covariance(1.0)[0, 0]))
    assert np.sqrt(np.mean([f.cov_observer[0, 0] for f in fixes])) == pytest.approx(0.5, rel=0.01)


def test_the_stream_of_random_numbers_is_the_seeds():
    def story(seed, noise=TYPICAL):
        sensor = sensors(noise, seed=seed)
        odometry = sensor.odometry("ann", np.arange(3.0), np.array([0.5, 0.0]), np.array([0.0, 1.0]))
        return np.array([*(xytheta(r.T_start_now) for r in odometry), sensor.rng.standard_normal(3)])

    np.testing.assert_array_equal(story(1), story(1))
    assert not np.isclose(story(1), story(2)).any()
    np.testing.assert_array_equal(story(1)[-1], story(1, EXACT)[-1])  # a noise does not shift the others' draws


@pytest.mark.parametrize("value", [-1e-3, nan, inf, -inf])
@pytest.mark.parametrize("kind", [OdometryNoise, TrackerNoise, FinderNoise])
def test_sigmas_that_cannot_be_are_refused(kind, value):
    for name in kind.__dataclass_fields__:
        with pytest.raises(BadInput, match=f"{name}.*{value}"):
            kind(**{name: value})


def test_slippery_ground_scales_the_true_sigmas_and_not_the_belief():
    sensor, factors = sensors(), np.array([1.0, 3.0, 0.5])
    legs = [sensor.odometry("a", np.arange(4.0), np.zeros(3), np.ones(3), factors) for _ in range(1500)]
    for k, factor in enumerate(factors):
        errors = np.array([xytheta(Pose2(1, 0, 0).between(leg[k].T_start_now)) for leg in legs])
        assert in_band(errors[:, 0], factor * 0.03) and in_band(errors[:, 2], factor * radians(2.0))
        require_covariance(errors, factor**2 * TYPICAL.odometry.covariance(0.0, 1.0))
        assert np.sqrt(np.mean([leg[k].cov_now[0, 0] for leg in legs])) == pytest.approx(0.03, rel=0.02)
    turned = [sensor.odometry("a", np.arange(2.0), np.ones(1), np.zeros(1), np.full(1, 3.0))[0] for _ in range(1500)]
    sigma = 3 * radians(3.0) / np.sqrt(2 * np.pi)
    assert in_band([record.T_start_now.theta() - 1.0 for record in turned], sigma)


def believed_path(bias: OdometryBias, turn: float, distance: float, steps: int) -> Pose2:
    pose = Pose2()
    for record in sensors(EXACT, bias=bias).odometry("ann", *split(turn, distance, steps)):
        pose = pose * record.T_start_now
    return pose


@pytest.mark.parametrize("drift", [0.0, 1e-9, 0.2, -1.0])
def test_drift_to_one_side_is_an_arc_whatever_the_sampling_rate(drift):
    """Turned by 1.1 * 0.8 rad, then an arc of 0.95 * 3 m that bends by 3 times the drift; drawn by 20 000 chords."""
    bias, turned = OdometryBias(scale=-0.05, turn_scale=0.1, drift_rad_per_m=drift), 1.1 * 0.8
    headings = turned + 3.0 * drift * (np.arange(20_000) + 0.5) / 20_000
    expected = [np.mean(np.cos(headings)) * 2.85, np.mean(np.sin(headings)) * 2.85, turned + 3.0 * drift]
    once = believed_path(bias, 0.8, 3.0, 1)
    assert once.equals(Pose2(*expected), 1e-8)
    for steps in (2, 7, 100):
        assert believed_path(bias, 0.8, 3.0, steps).equals(once, 1e-12)


def test_without_bias_nothing_changes():
    assert (OdometryBias().measured(0.3, 0.0).theta(), OdometryBias().measured(0.0, 1.7).x()) == (0.3, 1.7)
    assert believed_path(OdometryBias(), -0.7, 2.0, 3).equals(Pose2(0, 0, -0.7) * Pose2(2, 0, 0), 1e-15)


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        *[(OdometryBias, name, value) for name in ("scale", "turn_scale") for value in (0.51, -0.51, nan, inf)],
        *[(OdometryBias, "drift_rad_per_m", value) for value in (1.01, -1.01, nan)],
        *[(FalseSightings, name, value) for name in ("outliers", "dropouts") for value in (-0.01, 0.51, nan)],
    ],
)
def test_biases_and_shares_that_cannot_be_are_refused(kind, name, value):
    with pytest.raises(BadInput, match=f"{name}.*{value}"):
        kind(**{name: value})


def test_false_sightings_come_as_often_as_they_are_said_to():
    """Of 4000 looks a fifth drops out and a tenth shows a mirror image: counts within 5 sigmas of the binomial law."""
    target = Pose2(2.0, -1.0, 0.5)
    exact = sensors(EXACT, TYPICAL, false_sightings=FalseSightings(outliers=0.1, dropouts=0.2))
    fixes = [exact.relative_pose(0.0, "ann", "bob", target) for _ in range(4000)]
    dropped = sum(fix is None for fix in fixes)
    images = [f.T_observer_target for f in fixes if f is not None and not f.T_observer_target.equals(target, 1e-12)]
    for count, share in ((dropped, 0.2), (len(images), 0.1)):
        assert abs(count - 4000 * share) < 5 * np.sqrt(4000 * share * (1 - share))
    ranges = np.array([image.range(np.zeros(2)) for image in images]) / np.sqrt(5)
    assert ranges.min() >= 1 + 0.3 / np.sqrt(5) - 1e-9 and 2.5 < ranges.max() <= 3.0
    for angles in ([np.arctan2(image.y(), image.x()) for image in images], [image.theta() for image in images]):
        resultant = np.hypot(np.mean(np.cos(angles)), np.mean(np.sin(angles)))
        assert 2 * len(angles) * resultant**2 < chi2.ppf(0.999, 2)  # Rayleigh's test of uniform directions
    # the belief is that of the range that was measured, which looks like any other
    fix = next(f for f in fixes if f is not None and f.T_observer_target.range(np.zeros(2)) > 5.0)
    metres = fix.T_observer_target.range(np.zeros(2))
    believed = np.linalg.eigvalsh(fix.cov_observer)
    assert believed == pytest.approx(np.sort(np.diag(TYPICAL.tracker.line_covariance(metres))))


def test_a_mirror_image_near_by_is_at_least_30_cm_farther():
    mirrored = sensors(EXACT, TYPICAL, false_sightings=FalseSightings(outliers=0.5))
    ranges = [
        mirrored.relative_pose(0.0, "a", "b", Pose2(0.06, -0.08, 0.0)).T_observer_target.range(np.zeros(2))
        for _ in range(100)
    ]
    far = [metres for metres in ranges if metres > 0.1 + 1e-9]
    assert 30 < len(far) < 70 and far == pytest.approx([0.4] * len(far))


def test_without_false_sightings_no_random_number_is_spent_on_them():
    plain, none = sensors(), sensors(false_sightings=FalseSightings())
    for sensor in (plain, none):
        sensor.relative_pose(0.0, "a", "b", Pose2(1, 0, 0))
    assert not none.contact_seems_lost(1)
    fresh = np.random.default_rng(0)
    fresh.standard_normal(3)
    assert plain.rng.random() == none.rng.random() == fresh.random()


@pytest.mark.parametrize("confirmations", [1, 3])
def test_contact_seems_lost_after_so_many_false_sightings_in_a_row(confirmations):
    sensor = sensors(false_sightings=FalseSightings(outliers=0.2, dropouts=0.3))
    lost = sum(sensor.contact_seems_lost(confirmations) for _ in range(4000))
    share = 0.5**confirmations
    assert abs(lost - 4000 * share) < 5 * np.sqrt(4000 * share * (1 - share))
