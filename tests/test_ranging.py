import numpy as np
import pytest
from scipy.stats import chi2

from coopslam.estimation.alignment import AlignmentSettings
from coopslam.estimation.ranging import align_by_ranges, intersect, locate
from coopslam.se2 import Pose2, position, rotation, xytheta

SETTINGS = AlignmentSettings()
pytestmark = pytest.mark.filterwarnings("error")  # a division by zero inside is a fault


def length(vectors):
    return np.hypot(*np.asarray(vectors).T)


def way(rng, count, size_m=4.0):
    """(N, 2) points of a smooth closed curve with turns to both sides."""
    t = np.linspace(0, 1, count)
    x, y = (np.sin(2 * np.pi * (t * rng.uniform(0.5, 1.5) + rng.random())) for _ in range(2))
    return size_m * np.column_stack([x, y])


def two_robots(seed, count, sigma_m):
    """T_a_b, where each robot was in its own frame, and the distances between them."""
    rng = np.random.default_rng(seed)
    T_a_b = Pose2(*rng.uniform(-8, 8, 2), rng.uniform(-np.pi, np.pi))
    a, b = way(rng, count), way(rng, count)
    ranges = length(b @ rotation(T_a_b.theta()).T + position(T_a_b) - a) + sigma_m * rng.standard_normal(count)
    return T_a_b, a, b, np.abs(ranges)


@pytest.mark.parametrize("count", [25, 60, 400])
@pytest.mark.parametrize("sigma_m", [0.0, 0.1])
def test_two_robots_find_each_other_by_distances(count, sigma_m):
    for seed in range(6):
        T_a_b, a, b, ranges = two_robots(seed, count, sigma_m)
        found = align_by_ranges(a, b, ranges, np.full(count, max(sigma_m, 0.02)), SETTINGS)
        if sigma_m == 0:
            assert found.T_a_b.equals(T_a_b, 1e-4)  # the search stops at a relative change of 1e-8
        centre = Pose2(*found.centre, 0.0)
        error = xytheta((T_a_b * centre).between(found.T_a_b * centre))
        distance_sq = error @ np.linalg.solve(found.cov_centre, error) * SETTINGS.caution**2
        assert distance_sq < 2 * chi2.isf(1e-6, 3)  # Cauchy's loss is 5 % less efficient, and more with few


def test_false_distances_are_outvoted():
    T_a_b, a, b, ranges = two_robots(1, 100, 0.05)
    ranges[::5] += 3.0
    assert align_by_ranges(a, b, ranges, np.full(100, 0.05), SETTINGS).T_a_b.equals(T_a_b, 0.1)


@pytest.mark.parametrize("which", ["a on a line", "both on a line", "a stands", "b stands", "both stand", "too few"])
def test_what_distances_leave_open_is_none(which):
    _, a, b, _ = two_robots(4, 60, 0.0)
    along = np.linspace(0, 5, 60)[:, None] * [0.6, 0.8]
    T_a_b = Pose2(6.0, 1.0, 1.0)
    if which in ("a on a line", "both on a line"):
        a = along  # mirrored at that line, b's way is as far everywhere: but then b turns the other way round
    if which == "both on a line":
        b = 2 * along[:, ::-1]
    if which in ("a stands", "both stand"):
        a = np.zeros_like(a)  # b may be anywhere on a circle
    if which in ("b stands", "both stand"):
        b = np.zeros_like(b)  # b may look anywhere
    if which == "too few":
        a, b = a[:19], b[:19]
    ranges = length(b @ rotation(T_a_b.theta()).T + position(T_a_b) - a)
    found = align_by_ranges(a, b, ranges, np.full(len(a), 0.05), SETTINGS)
    if which == "a on a line":  # b's own way tells left from right
        assert found is None or found.T_a_b.equals(T_a_b, 1e-3)
    else:
        assert found is None


def test_a_point_from_its_distances():
    located = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        points, point = way(rng, 12, 3.0), rng.uniform(-6, 6, 2)
        ranges = np.abs(length(points - point) + 0.05 * rng.standard_normal(12))
        found = locate(points, ranges, np.full(12, 0.05))
        if found is not None:  # a way that is nearly straight leaves two places
            away = (points - point) / length(points - point)[:, None]
            cov = 0.05**2 * np.linalg.inv(away.T @ away)
            assert (found - point) @ np.linalg.solve(cov, found - point) < 2 * chi2.isf(1e-6, 2)
            located += 1
    assert located > 30


def test_a_point_that_distances_leave_open_is_none():
    line = np.column_stack([np.linspace(0, 5, 10), np.zeros(10)])
    assert locate(line, length(line - [2.0, 3.0]), np.full(10, 0.05)) is None  # or at (2, -3)
    assert locate(np.zeros((10, 2)), np.full(10, 3.0), np.full(10, 0.05)) is None
    assert locate(np.zeros((10, 2)), np.zeros(10), np.full(10, 0.05)) is None
    corners = np.array([[0.0, 0], [4, 0], [0, 3]])
    assert locate(corners, length(corners - 1.0), np.full(3, 0.05)) is None  # nothing would tell a false one
    square = np.array([[0.0, 0], [4, 0], [0, 4], [4, 4], [2, 1]])
    np.testing.assert_allclose(locate(square, length(square - [1.0, 3.0]), np.full(5, 0.05)), [1, 3], atol=1e-5)
    assert locate(square, np.array([1.0, 9, 1, 9, 5]), np.full(5, 0.05)) is None  # nowhere fits


def directions(points, point):
    return np.arctan2(*(point - points).T[::-1])


def test_rays_meet():
    points, point = np.array([[0.0, 0], [4, 0], [2, -1], [1, 5]]), np.array([2.0, 3.0])
    exact = directions(points, point)
    np.testing.assert_allclose(intersect(points, exact, np.full(4, 0.01)), point, atol=1e-9)
    rng, errors = np.random.default_rng(5), []
    for _ in range(500):
        errors.append(intersect(points, exact + 0.01 * rng.standard_normal(4), np.full(4, 0.01)) - point)
    normals = np.column_stack([-np.sin(exact), np.cos(exact)]) / length(points - point)[:, None] / 0.01
    expected = np.linalg.inv(normals.T @ normals)
    np.testing.assert_allclose(np.cov(np.array(errors).T), expected, atol=5 * expected.max() * np.sqrt(2 / 500))


def test_rays_that_do_not_meet_are_none():
    points, point = np.array([[0.0, 0], [4, 0], [2, -1], [1, 5]]), np.array([2.0, 3.0])
    exact, sigmas = directions(points, point), np.full(4, 0.01)
    assert intersect(points[:2], exact[:2], sigmas[:2]) is None  # two always meet
    assert intersect(points, exact + np.pi, sigmas) is None  # behind
    assert intersect(points, np.zeros(4), sigmas) is None  # parallel
    assert intersect(np.zeros((4, 2)), exact, sigmas) is None  # from one place: anywhere
    assert intersect(np.zeros((4, 2)), np.zeros(4), sigmas) is None
    off = exact + [0.1, -0.1, 0.1, 0.1]
    assert intersect(points, off, np.full(4, 0.001)) is None  # far from each other
    assert intersect(points, off, np.full(4, 0.001), point_sigma_m=0.3) is not None
