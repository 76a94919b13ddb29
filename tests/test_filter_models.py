"""Innovations and Jacobians of each kind of factor against the native factor itself, and its numeric derivatives."""

import gtsam
import numpy as np
import pytest

from coopslam.estimation.alignment import AlignmentSettings
from coopslam.estimation.filter_models import Sighting, linearized, noise_covariance, prior_mean, sighting
from coopslam.estimation.keys import landmark_key, pose_key
from coopslam.se2 import Pose2, rotation, wrap, xytheta

POSE, OTHER, POINT = pose_key(0, 3), pose_key(1, 5), landmark_key(2)
MEANS = {POSE: np.array([1.0, -2.0, 2.6]), OTHER: np.array([-0.5, 1.5, -2.9]), POINT: np.array([4.0, 0.5])}


def noise(dim):
    factor = np.random.default_rng(dim).normal(size=(dim, dim))
    return gtsam.noiseModel.Gaussian.Covariance(factor @ factor.T + np.eye(dim))


def exact(kind):
    """The kind of factor with what it would measure at MEANS."""
    a, b, point = Pose2(*MEANS[POSE]), Pose2(*MEANS[OTHER]), MEANS[POINT]
    to_pose, aim = b.translation(), a.bearing(b.translation())
    return {
        "between": gtsam.BetweenFactorPose2(POSE, OTHER, a.between(b), noise(3)),
        "bearing-range pose": gtsam.BearingRangeFactorPose2(POSE, OTHER, aim, a.range(to_pose), noise(2)),
        "bearing-range point": gtsam.BearingRangeFactor2D(POSE, POINT, a.bearing(point), a.range(point), noise(2)),
        "bearing pose": gtsam.BearingFactorPose2(POSE, OTHER, aim, noise(1)),
        "bearing point": gtsam.BearingFactor2D(POSE, POINT, a.bearing(point), noise(1)),
        "range pose": gtsam.RangeFactorPose2(POSE, OTHER, a.range(to_pose), noise(1)),
        "range point": gtsam.RangeFactor2D(POSE, POINT, a.range(point), noise(1)),
        "pose prior": gtsam.PriorFactorPose2(POSE, a, noise(3)),
        "landmark prior": gtsam.PriorFactorPoint2(POINT, point, noise(2)),
    }[kind]


KINDS = [
    *("between", "bearing-range pose", "bearing-range point", "bearing pose", "bearing point"),
    *("range pose", "range point", "pose prior", "landmark prior"),
]


def values_at(means):
    values = gtsam.Values()
    for key, mean in means.items():
        values.insert(key, Pose2(*mean) if len(mean) == 3 else mean)
    return values


def in_pose_axes(jacobian, mean):
    """From differences in the axes of the frame to right perturbations, as GTSAM has them."""
    if len(mean) == 2:
        return jacobian
    turn = np.eye(3)
    turn[:2, :2] = rotation(mean[2])
    return jacobian @ turn


@pytest.mark.parametrize("kind", KINDS)
def test_jacobians_are_those_of_the_native_factor(kind):
    """Whitened as GTSAM whitens, at a point where nothing is missed: there its own Jacobians are exact."""
    factor = exact(kind)
    keys = factor.keys()
    model = linearized(factor, [MEANS[key] for key in keys])
    np.testing.assert_allclose(model.miss, 0.0, atol=1e-12)
    native = factor.linearize(values_at(MEANS))
    ours = np.hstack([in_pose_axes(H, MEANS[key]) for H, key in zip(model.jacobians, keys, strict=True)])
    theirs = native.jacobian()[0]
    information = np.linalg.inv(noise_covariance(factor))
    np.testing.assert_allclose(ours.T @ information @ ours, theirs.T @ theirs, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_innovation_and_jacobians_against_the_native_error_away_from_the_measurement(kind):
    factor = exact(kind)
    keys = factor.keys()
    offsets = dict(zip(MEANS, np.random.default_rng(1).normal(size=(3, 3)) * 0.3, strict=True))
    means = {key: mean + offsets[key][: len(mean)] for key, mean in MEANS.items()}

    def missed(at):
        return linearized(factor, [at[key] for key in keys]).miss

    model = linearized(factor, [means[key] for key in keys])
    error = factor.unwhitenedError(values_at(means))
    if kind == "between":  # GTSAM takes the logarithm, the same to first order
        predicted = factor.measured() * Pose2.Expmap(error)
        error = xytheta(factor.measured().between(predicted))
    if kind == "pose prior":
        error = xytheta(factor.prior().between(Pose2(*means[POSE])))
    np.testing.assert_allclose(model.miss, -error, atol=1e-12)
    for key, jacobian in zip(keys, model.jacobians, strict=True):
        for column in range(len(means[key])):
            step = np.zeros(len(means[key]))
            step[column] = 1e-6
            change = missed(means | {key: means[key] + step}) - missed(means | {key: means[key] - step})
            np.testing.assert_allclose(-change / 2e-6, jacobian[:, column], atol=1e-8)


def test_angles_are_missed_by_less_than_half_a_turn():
    factor = gtsam.BearingFactor2D(POSE, POINT, gtsam.Rot2(3.1), noise(1))
    model = linearized(factor, [np.array([0.0, 0.0, 7.0]), np.array([-5.0, 0.1])])
    assert model.miss[0] == pytest.approx(float(wrap(3.1 - (np.arctan2(0.1, -5.0) - 7.0))))
    assert abs(model.miss[0]) <= np.pi


@pytest.mark.parametrize("kind", KINDS[1:7])
def test_where_observer_and_target_coincide_there_is_no_model(kind):
    factor = exact(kind)
    there = MEANS[POSE][: len(MEANS[factor.keys()[1]])]
    assert linearized(factor, [MEANS[POSE], there]) is None


def test_a_robust_loss_is_looked_through():
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), noise(2))
    factor = gtsam.BearingRangeFactor2D(POSE, POINT, gtsam.Rot2(0.1), 2.0, robust)
    np.testing.assert_allclose(noise_covariance(factor), noise(2).covariance())


# ---- where something new is ----


def sampled(draw, count=40_000):
    points = np.array([draw() for _ in range(count)])
    return points.mean(axis=0), np.cov(points.T)


def test_a_bearing_and_range_say_where_a_point_is():
    """Against samples: 40 000 of them tell a covariance to 1 %; the second order adds less than that here."""
    rng, cov = np.random.default_rng(2), np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    factor = gtsam.BearingRangeFactor2D(POSE, POINT, gtsam.Rot2(0.7), 3.0, gtsam.noiseModel.Gaussian.Covariance(cov))
    seen = sighting(factor, Pose2(), np.zeros(2), AlignmentSettings())
    polar = rng.multivariate_normal([0.7, 3.0], cov, size=40_000)
    points = polar[:, 1:] * np.stack([np.cos(polar[:, 0]), np.sin(polar[:, 0])], axis=1)
    np.testing.assert_allclose(seen.relative, points.mean(axis=0), atol=2e-3)
    np.testing.assert_allclose(seen.cov, np.cov(points.T), rtol=0.03, atol=5e-5)


def test_half_a_sighting_takes_the_other_half_from_the_guess():
    eye, guess, settings = Pose2(1.0, 1.0, 0.5), np.array([3.0, 4.0]), AlignmentSettings()
    towards = eye.transformTo(guess)
    direction = towards / np.hypot(*towards)
    bearing = gtsam.BearingFactor2D(POSE, POINT, eye.bearing(guess), gtsam.noiseModel.Isotropic.Sigma(1, 0.01))
    distance = gtsam.RangeFactor2D(POSE, POINT, eye.range(guess), gtsam.noiseModel.Isotropic.Sigma(1, 0.02))
    for factor, along, across in ((bearing, 0.3 * eye.range(guess), 0.01 * eye.range(guess)), (distance, 0.02, None)):
        seen = sighting(factor, eye, guess, settings)
        np.testing.assert_allclose(seen.relative, towards, atol=1e-12)
        assert direction @ seen.cov @ direction == pytest.approx(along**2)
        normal = np.array([-direction[1], direction[0]])
        across = across or settings.gate_sigmas * np.hypot(0.02, settings.drift_sigma_m)
        assert normal @ seen.cov @ normal == pytest.approx(across**2)


def test_a_sighting_from_elsewhere_carries_the_error_of_the_way():
    rng = np.random.default_rng(3)
    T, cov_way = Pose2(2.0, -1.0, 0.8), np.diag([0.02, 0.03, 0.01]) ** 2
    for relative, cov in ((np.array([1.5, 0.5]), np.diag([0.01, 0.02]) ** 2), (Pose2(1.5, 0.5, 0.4), cov_way / 2)):
        carried = Sighting(relative, cov).carried(T, cov_way)

        def draw(relative=relative, cov=cov):
            eye = T * Pose2(*rng.multivariate_normal(np.zeros(3), cov_way))
            if isinstance(relative, Pose2):
                there = eye * relative * Pose2(*rng.multivariate_normal(np.zeros(3), cov))
                return xytheta((T * relative).between(there))
            return eye.transformFrom(rng.multivariate_normal(relative, cov)) - T.transformFrom(relative)

        _, cov_sampled = sampled(draw, 4_000)  # 2 % each
        np.testing.assert_allclose(carried.cov, cov_sampled, atol=0.08 * np.abs(cov_sampled).max())


def test_priors_say_where_something_is():
    np.testing.assert_allclose(prior_mean(exact("pose prior")), [1.0, -2.0, 2.6])
    np.testing.assert_allclose(prior_mean(exact("landmark prior")), MEANS[POINT])
