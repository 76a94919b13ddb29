"""Laying one map onto another, against scipy, numeric derivatives and drawn errors."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2, kstest
from surveys import survey

from coopslam.planning.map_fit import FLOOR_SIGMAS, fit
from coopslam.se2 import Pose2, xytheta

ROOM = np.array([[0, 0], [6, 0], [6, 4], [4, 4], [4, 5], [0, 5]], float)
T_SMALL_WORLD = Pose2(3.0, -2.0, 2.5)


def surveys(seed, scale=1.0, corners=None):
    rng = np.random.default_rng(seed)
    return survey(ROOM, rng, scale=scale), survey(ROOM, rng, T_SMALL_WORLD, corners, scale)


def test_exact_maps_fit_exactly():
    stored, small = surveys(0, scale=1e-9)
    small.interior_angles[:] = stored.interior_angles
    found = fit(stored, small, [(k, k) for k in range(6)])
    assert xytheta(found.T_stored_small * T_SMALL_WORLD) == pytest.approx(np.zeros(3), abs=1e-6)
    assert found.squares < 1e-6 and found.dof == 21


def test_the_pose_is_where_scipy_finds_the_least_squares():
    """Independent corners: the weighted sum of squares, written down plainly, has its minimum there."""
    stored, small = surveys(1, scale=0.1, corners=[2, 3, 4])
    for one in (stored, small):
        n = len(one.ids)
        one.covariance[:] = (
            np.einsum("ij,k->ikj", np.eye(n), np.ones(3))[:, :, :, None] * np.diag([1e-4, 1e-4, 4e-4])[None, :, None, :]
        )
    pairs = [(0, 2), (1, 3), (2, 4)]
    sigmas = np.sqrt(2 * np.array([1e-4, 1e-4, 4e-4]) + FLOOR_SIGMAS**2)

    def residuals(x):
        T, rows = Pose2(*x), []
        for i, j in pairs:
            rows += list(xytheta(Pose2(*stored.poses[j]).between(T * Pose2(*small.poses[i]))) / sigmas)
        return rows

    found = fit(stored, small, pairs)
    best = least_squares(residuals, xytheta(T_SMALL_WORLD.inverse()), x_scale=[0.01, 0.01, 0.01], xtol=1e-12)
    # the covariance of a difference turns with the small heading errors, 2 mrad: an effect of second order
    assert xytheta(found.T_stored_small) == pytest.approx(best.x, abs=1e-4)
    angles = (small.interior_angles - stored.interior_angles[[2, 3, 4]]) / (np.sqrt(2) * small.angle_sigma_rad)
    assert found.squares == pytest.approx(2 * best.cost + angles @ angles, rel=1e-3)


def test_the_squares_are_chi_square_and_the_pose_is_as_sure_as_it_says(monkeypatch):
    """Over 400 draws of both maps from their correlated covariances; what is added to them for safety is left out."""
    monkeypatch.setattr("coopslam.planning.map_fit.FLOOR_SIGMAS", np.full(3, 1e-6))
    squares, nees = [], []
    for seed in range(400):
        stored, small = surveys(seed, scale=0.1, corners=[1, 2, 3, 4])
        found = fit(stored, small, list(enumerate([1, 2, 3, 4])))
        error = xytheta(found.T_stored_small.between(T_SMALL_WORLD.inverse()))
        squares.append(found.squares)
        nees.append(error @ np.linalg.solve(found.cov_small, error))
    low, high = chi2.interval(0.999, 400 * 3) / np.array(400.0)
    assert low < np.mean(nees) < high
    assert kstest(squares, chi2(13).cdf).pvalue > 1e-3


def test_a_wrong_pair_is_improbable():
    stored, small = surveys(3, corners=[1, 2, 3])
    assert fit(stored, small, [(0, 1), (1, 2), (2, 3)]).probability > 1e-3
    assert fit(stored, small, [(0, 1), (1, 2), (2, 4)]).probability < 1e-12


def test_a_common_error_of_a_map_is_none():
    """A drift of the stored map as a whole, far beyond its independent sigmas, goes into the pose."""
    stored, small = surveys(4, corners=[1, 2, 3])
    before = fit(stored, small, [(0, 1), (1, 2), (2, 3)])
    drift = Pose2(2.0, -1.0, 0.5)
    stored.poses[:] = [xytheta(drift * Pose2(*pose)) for pose in stored.poses]
    after = fit(stored, small, [(0, 1), (1, 2), (2, 3)])
    assert after.squares == pytest.approx(before.squares, rel=1e-6)
    assert after.T_stored_small.equals(drift * before.T_stored_small, 1e-6)


def test_the_inverse_has_the_covariance_that_derivatives_give_it():
    stored, small = surveys(5, corners=[1, 2, 3])
    found = fit(stored, small, [(0, 1), (1, 2), (2, 3)])
    T, h = found.T_stored_small, 1e-6
    steps = [Pose2(*(h * axis)) for axis in np.eye(3)]
    slope = np.column_stack([xytheta(T.inverse().between((T * step).inverse())) / h for step in steps])
    back = found.inverted()
    assert back.T_stored_small.equals(T.inverse(), 1e-12) and back.pairs == ((1, 0), (2, 1), (3, 2))
    assert back.cov_small == pytest.approx(slope @ found.cov_small @ slope.T, rel=1e-4, abs=1e-9)
