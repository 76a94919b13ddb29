"""Is this corner a known one: an honest distance, the corner's shape, and the sector that a triangle fits."""

from dataclasses import dataclass
from math import pi

import numpy as np
import pytest
from scipy.special import expit
from scipy.stats import chi2, multivariate_normal, norm

from coopslam.estimation.incremental import Incremental
from coopslam.exploration.chart import Chart, ChartSettings
from coopslam.exploration.free_map import FreeMap
from coopslam.exploration.recognition import (
    Walked,
    corner_distance_sq,
    could_be,
    fitting_sector,
    interior_angle_agrees,
    log_odds,
)
from coopslam.records import CornerDecision, CornerSighting, Odometry, RelativePoseFix
from coopslam.se2 import Pose2, xytheta

ODOMETRY_COV = np.diag([0.05, 0.03, 0.03]) ** 2
FIX_COV = np.array([[9.0, 2.0, 1.0], [2.0, 4.0, -1.0], [1.0, -1.0, 6.0]]) * 1e-5
SEEN_COV = np.diag([0.004, 0.009, 0.01]) ** 2
CORNER = Pose2(2.0, 3.0, 1.0)  # in the frame of the first robot's start


def sighting_after_a_walk(rng: np.random.Generator, really: Pose2 = CORNER):
    """(estimate, sighting): ann drives and sees the corner; bob, whom she tracks, drives there and sees `really`."""

    def noisy(pose, cov):  # in the pose's own axes
        return pose * Pose2(*rng.multivariate_normal(np.zeros(3), cov))

    def observed(pose, cov):  # in the observer's axes
        return Pose2(*(xytheta(pose) + rng.multivariate_normal(np.zeros(3), cov)))

    ann, bob = Pose2(1.5, 2.5, 0.7), Pose2(1.0, 0.5, -2.0)
    bob_later = Pose2(2.1, 2.8, 2.5)
    estimator = Incremental(("ann", "bob"))
    seen = CornerSighting(2.0, "ann", observed(ann.between(CORNER), SEEN_COV), SEEN_COV, 1.5, 0.01)
    estimator.update(
        [
            Odometry(0.0, 2.0, "ann", noisy(ann, ODOMETRY_COV), ODOMETRY_COV),
            seen,
            CornerDecision(2.0, seen, 0, True),
            RelativePoseFix(2.0, "ann", "bob", observed(ann.between(bob), FIX_COV), FIX_COV),
        ]
    )
    again = CornerSighting(4.0, "bob", observed(bob_later.between(really), SEEN_COV), SEEN_COV, 1.5, 0.01)
    estimate = estimator.update(
        [
            Odometry(2.0, 4.0, "bob", noisy(bob.between(bob_later), ODOMETRY_COV), ODOMETRY_COV),
            RelativePoseFix(4.0, "bob", "ann", observed(bob_later.between(ann), FIX_COV), FIX_COV),
            again,
        ]
    )
    return estimate, again


def test_the_distance_to_the_same_corner_is_chi_square_with_three_degrees():
    """300 independent worlds; all of ann's own uncertainty is common to both sightings and must drop out."""
    rng = np.random.default_rng(1)
    distances = np.array([corner_distance_sq(*sighting_after_a_walk(rng), 0) for _ in range(300)])
    low, high = chi2.ppf([0.0005, 0.9995], 3 * 300)
    assert low < distances.sum() < high
    for share in (0.5, 0.9):  # the tail is that of the distribution, too: three sigmas of a binomial
        beyond = np.mean(distances > chi2.ppf(share, 3))
        assert beyond == pytest.approx(1 - share, abs=3 * np.sqrt(share * (1 - share) / 300))


@pytest.mark.parametrize("away", [Pose2(0.3, 0, 0), Pose2(0, 0.3, 0), Pose2(0, 0, pi / 2), Pose2(0, 0, pi)])
def test_another_corner_is_far_away(away):
    rng = np.random.default_rng(2)
    assert corner_distance_sq(*sighting_after_a_walk(rng, CORNER * away), 0) > 100


def test_the_interior_angle_must_agree():
    def seen(angle, sigma):
        return CornerSighting(0.0, "ann", Pose2(), np.eye(3), angle, sigma)

    # two measurements of one angle differ by sqrt(2) sigma: 5 of these are 0.0707 rad for a sigma of 0.01
    assert interior_angle_agrees(seen(1.5, 0.01), 1.57, 5.0) and interior_angle_agrees(seen(1.5, 0.01), 1.43, 5.0)
    assert not interior_angle_agrees(seen(1.5, 0.01), 1.572, 5.0)
    assert not interior_angle_agrees(seen(1.5, 0.01), 1.428, 5.0)
    assert interior_angle_agrees(seen(1.5, 0.02), 1.572, 5.0)
    assert not interior_angle_agrees(seen(1.5, 0.01), 1.57, 4.0)


def chart_of(estimate, interior_angle_rad: float = 1.5) -> Chart:
    """A chart of a map with the one vertex 0."""
    free_map = FreeMap()
    free_map.add_vertex(0, interior_angle_rad)
    chart = Chart(free_map, ChartSettings())
    chart.look_at(estimate)
    return chart


def test_odds_are_a_normal_density_over_a_flat_one():
    """scipy's densities of place, direction and interior angle; a stranger's are 0.5 / m^2, 1 / 2 pi and 1 / 2 pi."""
    estimate, sighting = sighting_after_a_walk(np.random.default_rng(3))
    chart = chart_of(estimate, interior_angle_rad=1.51)
    keys = [estimate.pose_key("bob"), estimate.vertex_key(0)]
    there, Z = estimate.vertex(0).between(estimate.pose("bob")), sighting.T_observer_corner
    joint, step = estimate.joint_covariance(keys), 1e-6

    def mismatch(errors):  # of the pose, the vertex and the sighting, all on the right
        pose, vertex, seen = (Pose2(*errors[k : k + 3]) for k in (0, 3, 6))
        return xytheta(vertex.inverse() * there * pose * Z * seen)

    jacobian = np.array([(mismatch(step * e) - mismatch(-step * e)) / (2 * step) for e in np.eye(9)]).T
    turn = np.eye(3)
    turn[:2, :2] = Z.inverse().rotation().matrix()
    spread = np.block([[joint, np.zeros((6, 3))], [np.zeros((3, 6)), turn @ SEEN_COV @ turn.T]])
    known = multivariate_normal(np.zeros(3), jacobian @ spread @ jacobian.T).logpdf(mismatch(np.zeros(9)))
    known += norm(1.51, np.sqrt(2) * 0.01).logpdf(1.5)
    stranger = np.log(0.5 / (2 * pi) / (2 * pi))
    odds, distance_sq = log_odds(chart, [(sighting, 0)], 0.5, 5.0)
    assert odds == pytest.approx(known - stranger, abs=1e-3)
    assert distance_sq == pytest.approx(corner_distance_sq(estimate, sighting, 0))


def test_odds_are_those_of_a_fair_bet():
    """Half of the corners are the known one, half are strangers near by: of sightings that leave doubt, as
    many are strangers as the odds say."""
    rng = np.random.default_rng(4)
    estimate, _ = sighting_after_a_walk(rng)
    chart = chart_of(estimate)
    mean = estimate.pose("bob").between(estimate.vertex(0))
    keys = [estimate.pose_key("bob"), estimate.vertex_key(0)]
    joint = np.linalg.cholesky(estimate.joint_covariance(keys))
    chances, same = [], []
    for _ in range(4000):
        is_same = rng.random() < 0.5
        pose, vertex = (Pose2(*error) for error in (joint @ rng.standard_normal(6)).reshape(2, 3))
        really = pose.inverse() * mean * vertex
        angle = 1.5 + np.sqrt(2) * 0.01 * rng.standard_normal()
        if not is_same:  # in a square of 10 cm, so that many leave doubt
            x, y = rng.uniform(-0.05, 0.05, 2)
            really = Pose2(mean.x() + x, mean.y() + y, mean.theta() + rng.uniform(-0.1, 0.1))
            angle = 1.5 + rng.uniform(-0.05, 0.05)
        seen = Pose2(*(xytheta(really) + rng.multivariate_normal(np.zeros(3), SEEN_COV)))
        odds, _ = log_odds(chart, [(CornerSighting(4.0, "bob", seen, SEEN_COV, angle, 0.01), 0)], 100.0, 50.0)
        odds += np.log(0.2 * 0.1 / (2 * pi) ** 2)  # their directions and angles are not spread over full turns
        chances.append(expit(odds))
        same.append(is_same)
    chances, same = np.array(chances), np.array(same)
    doubtful = (chances > 0.02) & (chances < 0.98)
    assert doubtful.sum() > 60
    spread = np.sqrt(np.sum(chances[doubtful] * (1 - chances[doubtful])))
    assert same[doubtful].sum() == pytest.approx(chances[doubtful].sum(), abs=4 * spread)


@dataclass
class Known:
    """An estimate that is simply right."""

    poses: dict[int, Pose2]

    def vertex(self, vertex: int) -> Pose2:
        return self.poses[vertex]


def at(degrees: float, metres: float = 2.0) -> Pose2:
    return Pose2(metres * np.cos(np.radians(degrees)), metres * np.sin(np.radians(degrees)), 0.0)


@pytest.fixture
def touched():
    """A straight corner 0 at the origin, its walls along x; triangle (1, 2, 0) from 60 to 120 degrees touches it.

    Unexplored: sector 0 from 0 to 60 degrees, sector 2 from 120 to 180.
    """
    free_map = FreeMap()
    for vertex in range(9):
        free_map.add_vertex(vertex, pi)
    free_map.add_first_wall(1, 2)
    free_map.add_triangle((1, 2), 0, False, False)
    degrees = {1: 60, 2: 120, 3: 10, 4: 40, 5: 140, 6: 170, 7: 80, 8: 0}
    turn = Pose2(5.0, -3.0, 2.0)  # whichever way the corner lies in the world
    poses = {0: turn, **{vertex: turn * at(angle, 1 + vertex / 5) for vertex, angle in degrees.items()}}
    return free_map, Known(poses)


def fit(free_map: FreeMap, estimate: Known, gate: tuple[int, int], at_end: bool = False, at_start: bool = False):
    """(sector, miss) of the triangle behind a gate at corner 0."""
    chart = Chart(free_map, ChartSettings())
    chart.look_at(estimate)
    return fitting_sector(chart, 0, gate, Walked(at_end, at_start))


@pytest.mark.parametrize(
    ("gate", "at_end", "at_start", "index", "miss_degrees"),
    [
        ((3, 4), False, False, 0, 0.0),
        ((5, 6), False, False, 2, 0.0),
        ((4, 1), False, False, 0, 0.0),  # closes up to the known triangle
        ((2, 5), False, False, 2, 0.0),
        ((8, 4), False, True, 0, 0.0),  # along the wall that leaves the corner
        ((3, 4), False, True, 0, 0.0),  # the wall was walked: the estimate of 3 does not matter
        ((5, 6), True, False, 2, 0.0),
        ((3, 7), False, False, 0, 20.0),  # reaches 20 degrees into the known triangle
        ((7, 5), False, False, 2, 40.0),
    ],
)
def test_the_sector_that_a_triangle_fits(touched, gate, at_end, at_start, index, miss_degrees):
    sector, miss = fit(*touched, gate, at_end, at_start)
    assert sector.index == index and np.degrees(miss) == pytest.approx(miss_degrees, abs=1e-9)


def test_a_direction_a_little_below_zero_is_not_a_full_turn_off(touched):
    free_map, estimate = touched
    estimate.poses[8] = estimate.poses[0] * at(-0.5)
    sector, miss = fit(free_map, estimate, (8, 4))
    assert sector.index == 0 and np.degrees(miss) == pytest.approx(0.5)


def test_a_sector_that_begins_a_little_below_zero_has_its_full_width(touched):
    """A flat triangle along the leaving wall: its edges lie at -1e-9 degrees, the sector from there to 180."""
    free_map, estimate = touched
    for vertex in (1, 2):
        estimate.poses[vertex] = estimate.poses[0] * at(-1e-9, vertex)
    sector, miss = fit(free_map, estimate, (2, 5))
    assert sector.index == 2 and np.degrees(miss) == pytest.approx(0.0, abs=1e-6)


def test_walls_that_are_taken_leave_no_sector(touched):
    free_map, estimate = touched
    free_map.add_triangle((1, 0), 3, True, True)
    assert fit(free_map, estimate, (8, 4), False, True)[0] is None  # the wall that leaves the corner goes to 3
    assert fit(free_map, estimate, (5, 6), True, False)[0].index == 2
    sector, miss = fit(free_map, estimate, (3, 4))  # only the far sector is left
    assert sector.index == 2 and np.degrees(miss) == pytest.approx(110.0 + 80.0)


def test_the_map_leaves_no_room_for_some_vertices(touched):
    free_map, _ = touched
    assert could_be(free_map, 0, (3, 4), Walked())  # it has unexplored sectors
    assert not could_be(free_map, 3, (3, 4), Walked())  # a triangle has three different corners
    free_map.add_triangle((1, 0), 3, True, True)  # walls 0 -> 3 and 3 -> 1
    assert could_be(free_map, 0, (5, 6), Walked(at_end=True))
    assert not could_be(free_map, 0, (8, 4), Walked(at_start=True))  # the wall that leaves 0 goes to 3, not to 8
    assert not could_be(free_map, 3, (5, 6), Walked())  # nothing around 3 is unexplored
