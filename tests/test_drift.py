"""Moments of a drifting robot: double integrals over its random walk, and a plain simulation."""

import numpy as np
import pytest
from drift_by_quadrature import straight_by_quadrature

from coopslam.planning.drift import Drift
from coopslam.planning.sensor_laws import OdometryLaw
from coopslam.planning.travel_belief import leg_covariance
from coopslam.se2 import rotation


@pytest.mark.parametrize("direction", [0.0, 2.1])
@pytest.mark.parametrize("start_sigma", [0.0, 0.3])
@pytest.mark.parametrize(("length", "drift"), [(6.0, 0.03), (15.0, 0.2)])
def test_a_straight_leg_is_a_double_integral(length, drift, start_sigma, direction):
    """Cut in three, so that what one stretch hands on to the next counts."""
    law, turn = OdometryLaw(0.05, drift, 0.1), rotation(direction)
    found = Drift(start_sigma**2)
    for share in (0.2, 0.5, 0.3):
        found.drive(turn @ [share * length, 0.0], law)
    expected = straight_by_quadrature(length, law, start_sigma**2)
    np.testing.assert_allclose(turn.T @ found.square() @ turn, expected[:2, :2], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(turn.T @ found.with_drift(), expected[2, :2], rtol=1e-9, atol=1e-10)
    assert found.variance - found.start_variance == pytest.approx(expected[2, 2])


def test_small_noise_is_the_linear_leg():
    """Relative deviations are of the order of the heading's variance, 1e-6."""
    law, way = OdometryLaw(5e-4, 5e-4, 0.0), np.array([3.0, 1.0])
    found = Drift(0.0)
    found.drive(way, law)
    np.testing.assert_allclose(found.square(), leg_covariance(way, law)[:2, :2], rtol=1e-5)
    np.testing.assert_allclose(found.with_drift(), leg_covariance(way, law)[:2, 2], rtol=1e-5)


def test_legs_with_turns_against_a_simulation():
    """Slippery ground, a start heading that errs with something else; 40 000 robots in steps of 5 cm."""
    rng, count, step = np.random.default_rng(4), 40_000, 0.05
    law, slippery = OdometryLaw(0.05, 0.08, 0.15), OdometryLaw(0.15, 0.2, 0.4)
    cov = np.array([[0.04, 0.012], [0.012, 0.02]])  # of something else, and of the heading at the start
    else_, heading = rng.multivariate_normal(np.zeros(2), cov, count).T
    start, off, found, before = heading.copy(), np.zeros((count, 2)), Drift(cov[1, 1]), None
    for way, ground in (((3.0, 1.0), law), ((0.5, 2.5), slippery), ((-2.0, 1.0), law)):
        length, ahead = float(np.hypot(*way)), float(np.arctan2(way[1], way[0]))
        if before is not None:
            found.turn(ahead - before, ground)
            heading += ground.heading_sigma_per_rad * np.sqrt(abs(ahead - before)) * rng.standard_normal(count)
        found.drive(np.array(way), ground)
        part = length / np.ceil(length / step)
        for _ in range(round(length / part)):
            bend = ground.heading_sigma_per_m * np.sqrt(part) * rng.standard_normal(count)
            driven = part + ground.translation_sigma_per_m * np.sqrt(part) * rng.standard_normal(count)
            middle = ahead + heading + bend / 2
            off += driven[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
            heading += bend
        off -= way
        before = ahead
    sample = np.column_stack([off, heading - start, else_])
    expected = np.zeros((4, 4))
    expected[:2, :2], expected[2, 2], expected[3, 3] = found.square(), found.variance - found.start_variance, cov[0, 0]
    expected[2, :2] = expected[:2, 2] = found.with_drift()
    expected[3, :2] = found.with_start(cov[0, 1:])[0]
    expected[:2, 3] = expected[3, :2]
    linear_mean = sample.mean(axis=0)
    assert np.hypot(*linear_mean[:2]) > 10 * np.sqrt(np.trace(expected[:2, :2]) / count)  # the cloud is bent
    second = sample.T @ sample / count
    # standard errors from the sample itself, for it is not normal
    products = sample[:, :, None] * sample[:, None, :]
    error = products.std(axis=0) / np.sqrt(count)
    assert (np.abs(second - expected) < 4.5 * error + 1e-12).all()
