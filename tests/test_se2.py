import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from monte_carlo import require_covariance
from scipy.optimize import minimize

from coopslam.se2 import (
    Pose2,
    PoseBelief,
    adjoint,
    compose_leg,
    fit_pose,
    is_covariance,
    observer_to_target_axes,
    position_covariance_in_parent,
    wrap,
    xytheta,
)

POSES = [Pose2(), Pose2(3.0, -2.0, 0.7), Pose2(-1.0, 5.0, -3.1), Pose2(0.0, 0.0, np.pi), Pose2(1e3, 1e-3, 1.5)]
SPD = np.array([[4.0, 1.0, 0.5], [1.0, 2.0, -0.7], [0.5, -0.7, 1.0]]) * 1e-6


def draws(rng, cov, count):
    return rng.multivariate_normal(np.zeros(len(cov)), cov, count)


@pytest.mark.parametrize("pose", POSES, ids=str)
def test_adjoint_against_gtsam_and_numeric(pose):
    np.testing.assert_allclose(adjoint(pose), pose.AdjointMap(), rtol=1e-12, atol=1e-12)
    step = 1e-6
    moved = [xytheta((pose * Pose2(*(step * axis))) * pose.inverse()) / step for axis in np.eye(3)]
    np.testing.assert_allclose(
        adjoint(pose), np.column_stack(moved), rtol=1e-5, atol=1e-5 * (1 + pose.range(np.zeros(2)))
    )


def test_a_leg_against_monte_carlo():
    """Five increments with turns between them; sigmas of millimetres and milliradians, so first order holds."""
    rng = np.random.default_rng(1)
    deltas = [Pose2(0.8, 0.1, turn) for turn in (0.5, -1.2, 2.0, 0.0, -0.4)]
    covariances = [SPD * scale for scale in (1.0, 2.0, 0.5, 1.5, 1.0)]
    total, cov = compose_leg(deltas, covariances)
    exact = Pose2()
    for delta in deltas:
        exact = exact * delta
    assert total.equals(exact, 1e-12)
    noise = np.stack([draws(rng, c, 10_000) for c in covariances], axis=1)
    errors = []
    for errors_of_steps in noise:
        leg = Pose2()
        for delta, error in zip(deltas, errors_of_steps, strict=True):
            leg = leg * delta * Pose2(*error)
        errors.append(xytheta(total.between(leg)))
    require_covariance(np.array(errors), cov)


def test_a_leg_against_gtsams_adjoint():
    deltas = POSES[:4]
    covariances = [SPD * (1 + k) for k in range(4)]
    expected = np.zeros((3, 3))
    for k, cov in enumerate(covariances):
        rest = Pose2()
        for delta in deltas[k + 1 :]:
            rest = rest * delta
        carry = rest.inverse().AdjointMap()
        expected += carry @ cov @ carry.T
    np.testing.assert_allclose(compose_leg(deltas, covariances)[1], expected, rtol=1e-9, atol=1e-18)


def test_a_leg_of_nothing_and_a_leg_with_a_gap():
    total, cov = compose_leg([], [])
    assert total.equals(Pose2(), 0) and not cov.any()
    with pytest.raises(ValueError):
        compose_leg([Pose2()], [])


@pytest.mark.parametrize("relative", POSES[1:4], ids=str)
def test_observers_axes_to_targets_axes_against_monte_carlo(relative):
    rng = np.random.default_rng(2)
    seen = xytheta(relative) + draws(rng, SPD, 20_000)  # noise of the fix, in the observer's axes
    errors = np.array([xytheta(relative.between(Pose2(*pose))) for pose in seen])
    require_covariance(errors, observer_to_target_axes(relative, SPD))


@pytest.mark.parametrize("pose", POSES[1:3], ids=str)
def test_position_covariance_against_monte_carlo(pose):
    errors = draws(np.random.default_rng(3), SPD, 20_000)
    where = np.array([xytheta(pose * Pose2(*error))[:2] for error in errors]) - xytheta(pose)[:2]
    cov = position_covariance_in_parent(pose, SPD)
    require_covariance(where, cov)
    belief = PoseBelief(pose, SPD)
    np.testing.assert_array_equal(belief.position_covariance, cov)
    # the worst direction, looked for among many
    angles = np.linspace(0, np.pi, 20_001)
    along = np.column_stack([np.cos(angles), np.sin(angles)])
    worst = np.sqrt(np.einsum("ij,jk,ik->i", along, cov, along).max())
    assert belief.position_sigma_m == pytest.approx(worst, rel=1e-6)


def test_wrap_at_the_cut():
    assert wrap(np.pi) == np.pi and wrap(-np.pi) == np.pi and wrap(3 * np.pi) == pytest.approx(np.pi)
    assert wrap(0.0) == 0.0 and wrap(2 * np.pi) == pytest.approx(0.0, abs=1e-15)
    above = np.nextafter(np.pi, 4)
    assert wrap(above) == pytest.approx(-np.pi) and wrap(above) < 0
    angles = np.linspace(-50, 50, 10_007)
    wrapped = wrap(angles)
    assert ((wrapped > -np.pi) & (wrapped <= np.pi)).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-13)
    np.testing.assert_allclose(wrapped, [gtsam.Rot2(a).theta() for a in angles], atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "size", "good"),
    [
        (SPD, 3, True),
        (np.zeros((3, 3)), 3, True),
        (np.diag([1.0, 0.0, 0.0]), 3, True),
        (1e-30 * SPD, 3, True),
        (SPD, 2, False),
        (SPD[:2], 3, False),
        (np.diag([1.0, 1.0, -1e-3]), 3, False),
        (1e-12 * np.diag([1.0, 1.0, -1e-3]), 3, False),
        (SPD + np.triu(SPD, 1), 3, False),
        (np.diag([1.0, np.nan, 1.0]), 3, False),
        (np.diag([1.0, np.inf, 1.0]), 3, False),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), 2, False),
        (np.ones((2, 2)), 2, True),
        (4.0, 1, False),
        ([[4.0]], 1, True),
    ],
)
def test_what_is_a_covariance(matrix, size, good):
    assert is_covariance(matrix, size) is good


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 3]), st.integers(-12, 0))
def test_what_is_a_covariance_is_what_numpy_decomposes(seed, size, exponent):
    """Eigenvalues of all sizes around zero; a billionth of the largest entry is rounding."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(size, size)))[0]
    variances = rng.choice([-1, 1, 1, 1], size) * 10.0 ** rng.uniform(exponent, 0, size)
    matrix = (axes * variances) @ axes.T * 10.0 ** rng.integers(-20, 20)
    matrix = (matrix + matrix.T) / 2
    smallest = np.linalg.eigvalsh(matrix)[0] / np.abs(matrix).max() + 1e-9
    if abs(smallest) > 1e-13:
        assert is_covariance(matrix, size) == (smallest > 0)


def sum_of_squares(pose, points_b, points_a, weights):
    off = np.array([Pose2(*pose).transformFrom(point) for point in points_b]) - points_a
    return weights @ (off**2).sum(axis=1)


@pytest.mark.parametrize("count", [2, 3, 20])
@pytest.mark.parametrize("weighted", [False, True])
def test_a_fit_against_a_search(count, weighted):
    rng = np.random.default_rng(count)
    points_b = rng.normal(size=(count, 2)) * 3
    truth = Pose2(2.0, -7.0, 2.8)
    points_a = np.array([truth.transformFrom(point) for point in points_b]) + 0.3 * rng.normal(size=(count, 2))
    weights = rng.uniform(0.1, 9, count) if weighted else np.ones(count)
    found = fit_pose(points_b, points_a, weights if weighted else None)
    best = minimize(sum_of_squares, xytheta(truth), (points_b, points_a, weights), tol=1e-12)
    np.testing.assert_allclose(xytheta(found.between(Pose2(*best.x))), 0.0, atol=1e-5)  # the search's differences
    assert sum_of_squares(xytheta(found), points_b, points_a, weights) <= best.fun * (1 + 1e-9)


def test_a_fit_against_gtsams():
    rng = np.random.default_rng(7)
    points_b = rng.normal(size=(6, 2))
    points_a = points_b @ np.array([[0.0, 1], [-1, 0]]) + [3.0, 1.0] + 0.01 * rng.normal(size=(6, 2))
    assert fit_pose(points_b, points_a).equals(gtsam.Pose2.Align(points_a.T, points_b.T), 1e-9)


def test_a_fit_of_points_that_coincide_does_not_turn():
    assert fit_pose(np.ones((3, 2)), np.full((3, 2), 5.0)).equals(Pose2(4.0, 4.0, 0.0), 1e-12)
