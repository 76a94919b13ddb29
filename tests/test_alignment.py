import numpy as np
import pytest
from scipy.stats import chi2

from coopslam.errors import BadInput
from coopslam.estimation.alignment import Alignment, AlignmentSettings, align
from coopslam.se2 import Pose2, position, rotation, xytheta

SETTINGS = AlignmentSettings()
SIGMA_M = 0.1

pytestmark = pytest.mark.filterwarnings("error")  # a division by zero inside is a fault


def case(rng, count, outliers=0, sigma_m=SIGMA_M):
    """T_a_b, and points of frame a and b; the first `outliers` pairs are false."""
    T_a_b = Pose2(*rng.uniform(-20, 20, 2), rng.uniform(-np.pi, np.pi))
    points_b = rng.uniform(-4, 4, (count, 2))
    points_a = points_b @ rotation(T_a_b.theta()).T + position(T_a_b) + sigma_m * rng.standard_normal((count, 2))
    points_a[:outliers] = position(T_a_b) + rng.uniform(-8, 8, (outliers, 2))
    return T_a_b, points_a, points_b


def error_at_centre(found, T_a_b):
    """(3,) in the axes of b."""
    centre = Pose2(*found.centre, 0.0)
    return xytheta((T_a_b * centre).between(found.T_a_b * centre))


@pytest.mark.parametrize(("count", "outliers"), [(6, 0), (10, 3), (40, 12), (1500, 450)])
def test_the_alignment_is_found_among_thirty_percent_of_false_pairs(count, outliers):
    for seed in range(20):
        T_a_b, points_a, points_b = case(np.random.default_rng(seed), count, outliers)
        found = align(points_a, points_b, np.full(count, SIGMA_M), SETTINGS)
        error = error_at_centre(found, T_a_b)
        distance_sq = error @ np.linalg.solve(found.cov_centre, error)
        assert distance_sq * SETTINGS.caution**2 < chi2.isf(1e-7, 3)
        assert found.agreed >= 0.9 * (count - outliers)  # three sigmas in the plane: 98.9 % of the good ones


def test_exact_points_give_the_exact_pose():
    T_a_b, points_a, points_b = case(np.random.default_rng(0), 6, sigma_m=0.0)
    assert align(points_a, points_b, np.full(6, SIGMA_M), SETTINGS).T_a_b.equals(T_a_b, 1e-12)


def test_points_on_a_line_tell_the_pose():
    """A rigid motion in the plane does not mirror."""
    points_b = np.column_stack([np.linspace(0, 5, 8), np.zeros(8)])
    T_a_b = Pose2(1.0, 2.0, 2.5)
    points_a = points_b @ rotation(2.5).T + [1.0, 2.0]
    assert align(points_a, points_b, np.full(8, SIGMA_M), SETTINGS).T_a_b.equals(T_a_b, 1e-12)


def distances_sq(settings, sigmas, shared_m=0.0):
    """Squared Mahalanobis distances of many alignments, without the caution. shared_m: sigma of what all points do."""
    found, rng = [], np.random.default_rng(1)
    for _ in range(1000):
        T_a_b, points_a, points_b = case(rng, 12, sigma_m=np.broadcast_to(sigmas, 12)[:, None])
        points_a = points_a + shared_m * rng.standard_normal(2)
        alignment = align(points_a, points_b, np.broadcast_to(sigmas, 12), settings)
        if alignment is not None:
            error = error_at_centre(alignment, T_a_b)
            found.append(error @ np.linalg.solve(alignment.cov_centre, error) * settings.caution**2)
    assert len(found) > 900
    return np.array(found)


@pytest.mark.parametrize("sigmas", [0.1, np.geomspace(0.06, 0.6, 12)], ids=["equal", "different"])
def test_the_covariance_is_honest_where_nothing_drifts(sigmas):
    """Points that fit worse than expected by chance widen it, so it is somewhat below its 3 degrees of freedom."""
    found = distances_sq(AlignmentSettings(drift_sigma_m=1e-6), sigmas)
    assert 2.0 < found.mean() < 3.0 + 4 * np.sqrt(6.0 / len(found))


def test_what_all_points_drift_together_does_not_average_out():
    found = distances_sq(SETTINGS, 0.02, shared_m=SETTINGS.drift_sigma_m)
    assert 1.0 < found.mean() < 3.0  # the shift has its 2 degrees of freedom; the heading did not drift


def test_the_covariance_travels_with_a_lever():
    """Far from the points the turn dominates: sigma of the heading times the distance, across."""
    found = Alignment(Pose2(3.0, 1.0, 0.7), np.array([1.0, 2.0]), np.diag([0.01, 0.01, 0.04]) ** 2, 9)
    far = Pose2(1.0 + 50.0, 2.0, 0.0)
    expected = [[1e-4, 0, 0], [0, 1e-4 + (50 * 0.04) ** 2, 50 * 0.04**2], [0, 50 * 0.04**2, 0.04**2]]
    np.testing.assert_allclose(found.covariance_at(far), expected, atol=1e-12)


def none(points_a, points_b, sigma_m=SIGMA_M, settings=SETTINGS):
    count = len(points_a)
    return align(np.asarray(points_a, float), np.asarray(points_b, float), np.full(count, sigma_m), settings) is None


def test_what_is_too_little_or_open_is_none():
    rng = np.random.default_rng(2)
    _, points_a, points_b = case(rng, 20)
    assert none(points_a[:3], points_b[:3])
    assert none(np.zeros((0, 2)), np.zeros((0, 2)))
    assert none(np.ones((20, 2)), np.ones((20, 2)))  # all the same point
    assert none(np.ones((20, 2)), points_b)
    assert none(points_a, points_b, sigma_m=10.0)  # too near each other for their sigmas
    assert none(rng.uniform(-9, 9, (20, 2)), points_b)  # nothing agrees
    assert none(points_a, points_b, settings=AlignmentSettings(heading_sigma_max_rad=1e-4))


def test_two_answers_that_as_many_pairs_support_are_none():
    rng = np.random.default_rng(3)
    points_b = rng.uniform(-4, 4, (40, 2))
    for other in (Pose2(0, 0, np.pi), Pose2(3.0, 0, 0)):  # turned, or only shifted
        points_a = points_b.copy()
        points_a[22:] = points_b[22:] @ rotation(other.theta()).T + position(other)
        generous = AlignmentSettings(share_min=0.5)
        assert none(points_a, points_b, settings=generous)
        points_a[30:] = points_b[30:]  # 30 against 8
        assert not none(points_a, points_b, settings=generous)


def test_nonsense_in_the_settings_is_refused():
    for bad in ({"pairs_min": 1}, {"share_min": 1.5}, {"caution": 0.0}, {"gate_sigmas": np.nan}, {"ranges_min": 3}):
        with pytest.raises(BadInput, match=next(iter(bad))):
            AlignmentSettings(**bad)
