import gtsam
import numpy as np
import pytest

from coopslam.errors import BadInput
from coopslam.estimation.loss import SQUARES, Loss

NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.5, 2.0]))
KEY = gtsam.symbol("l", 0)
RESIDUALS = np.geomspace(0.01, 100, 40)  # in sigmas


def cost(loss, residual):
    """Of a point that is so many sigmas off its prior, half of them along each axis."""
    factor = gtsam.PriorFactorPoint2(KEY, np.zeros(2), loss.applied(NOISE))
    values = gtsam.Values()
    values.insert(KEY, residual * np.array([0.5, 2.0]) / np.sqrt(2))
    return factor.error(values)


def test_squares_leave_the_noise_as_it_is():
    assert Loss().applied(NOISE) is NOISE and Loss() == SQUARES
    np.testing.assert_allclose([cost(SQUARES, r) for r in RESIDUALS], RESIDUALS**2 / 2, rtol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_the_losses_of_the_textbooks(scale):
    """Huber: linear beyond k. Cauchy: c^2 / 2 log(1 + (r / c)^2). Constants of 95 % efficiency (Zhang 1997)."""
    k, c = 1.345 * scale, 2.3849 * scale
    huber = np.where(k >= RESIDUALS, RESIDUALS**2 / 2, k * (RESIDUALS - k / 2))
    cauchy = c**2 / 2 * np.log1p((RESIDUALS / c) ** 2)
    np.testing.assert_allclose([cost(Loss("huber", scale), r) for r in RESIDUALS], huber, rtol=1e-6)
    np.testing.assert_allclose([cost(Loss("cauchy", scale), r) for r in RESIDUALS], cauchy, rtol=1e-3)


@pytest.mark.parametrize("kind", ["huber", "cauchy"])
def test_the_mean_of_normal_samples_loses_five_percent(kind):
    """Asymptotic variance of an M-estimator: E[psi^2] / E[psi']^2, by numeric derivatives of the cost."""
    x = np.linspace(-8, 8, 4001)
    factor_cost = np.array([cost(Loss(kind), abs(r)) for r in x])
    psi = np.gradient(factor_cost, x)
    density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    expectation = [np.trapezoid(part * density, x) for part in (psi**2, np.gradient(psi, x))]
    assert expectation[1] ** 2 / expectation[0] == pytest.approx(0.95, abs=0.002)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_scale_that_is_none_is_refused(scale):
    with pytest.raises(BadInput, match="scale_sigmas"):
        Loss("huber", scale)


def test_another_kind_is_refused():
    with pytest.raises(BadInput, match="squares, huber, cauchy"):
        Loss("tukey")
