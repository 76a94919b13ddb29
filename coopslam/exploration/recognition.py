"""Is this corner one that the map already has? Log odds from its place, its direction and its own shape.

The two hypotheses about a sighting: it shows vertex V, then it differs from V by no more than their joint covariance
allows; or a corner that was never seen, which may lie and point anywhere. Their likelihood ratio is a normal density
over a flat one (the density of corners), so a loosely known vertex needs a closer look than a well known one.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import inf, log, pi

import numpy as np

from coopslam.errors import require_between, require_positive
from coopslam.estimation.estimate import Estimate
from coopslam.exploration.chart import Chart, outside
from coopslam.exploration.free_map import FreeMap, Sector
from coopslam.records import CornerSighting
from coopslam.se2 import Pose2, adjoint, observer_to_target_axes, position


@dataclass(frozen=True, slots=True)
class RecognitionSettings:
    """When a sighting counts as a known corner."""

    margin_log_odds: float = 7.0  # 1100 to 1; less is ambiguous
    corners_per_m2: float = 0.5  # that are yet to be found, at least
    crowd_radius_m: float = 0.3  # known corners within it say how dense corners lie here
    distance_sq_max: float = 30.66  # of a vertex that was gone to: chi-square, 3 dof, 1 - 1e-6
    contradiction_sq: float = 150.0  # beyond, a vertex that must be there is not: a decision before was wrong
    angle_sigmas: float = 5.0
    apart_sigmas: float = 10.0  # of a glance in passing; a corner nearer to its neighbours is left alone
    search_radius_m: float = 1.0
    search_sigmas: float = 10.0

    def __post_init__(self):
        require_between(1e-3, 1e3, crowd_radius_m=self.crowd_radius_m)
        require_positive(
            1e6,
            margin_log_odds=self.margin_log_odds,
            corners_per_m2=self.corners_per_m2,
            distance_sq_max=self.distance_sq_max,
            contradiction_sq=self.contradiction_sq,
            angle_sigmas=self.angle_sigmas,
            apart_sigmas=self.apart_sigmas,
            search_radius_m=self.search_radius_m,
            search_sigmas=self.search_sigmas,
        )


@dataclass(frozen=True, slots=True)
class Walked:
    """Which edges of a triangle (a, b, apex) were walked as walls: from b to the apex, or from the apex to a."""

    at_end: bool = False
    at_start: bool = False


@dataclass(frozen=True, slots=True)
class Match:
    """A known vertex that a sighting may show."""

    vertex: int
    log_odds: float  # against a corner never seen before
    distance_sq: float  # squared Mahalanobis distance
    sector: Sector | None  # where the triangle behind the gate fits; None: nowhere


def corner_distance_sq(estimate: Estimate, sighting: CornerSighting, vertex: int) -> float:
    """Squared Mahalanobis distance (3 dof) between a sighted corner and a map vertex, with their joint covariance."""
    mismatch, cov = corner_mismatch(estimate, [(sighting, vertex)])
    return float(mismatch @ np.linalg.solve(cov, mismatch))


def corner_mismatch(estimate: Estimate, pairs: Sequence[tuple[CornerSighting, int]]) -> tuple[np.ndarray, np.ndarray]:
    """(3k,) differences between k sighted corners and the vertices that they may show, and their (3k, 3k) covariance.

    With V a vertex, X the observer and Z the sighting, T = V^-1 X Z is the identity when both are one corner. The
    difference is its logarithm, in whose coordinates errors of heading over a long lever stay normal (Barfoot and
    Furgale, Associating Uncertainty with Three-Dimensional Poses, 2014); to first order in right perturbations its
    error is D (Ad(Z^-1) dX - Ad(T^-1) dV + dZ) with D the derivative of the logarithm at T.
    """
    observers = [estimate.pose_key_at(sighting.observer, sighting.stamp_s) for sighting, _ in pairs]
    vertices = [estimate.vertex_key(vertex) for _, vertex in pairs]
    keys = list(dict.fromkeys(observers + vertices))
    column = {key: 3 * k for k, key in enumerate(keys)}
    mismatch, jacobian = np.zeros(3 * len(pairs)), np.zeros((3 * len(pairs), 3 * len(keys)))
    cov = np.zeros((3 * len(pairs),) * 2)
    for k, ((sighting, _), observer, vertex) in enumerate(zip(pairs, observers, vertices, strict=True)):
        Z, row = sighting.T_observer_corner, slice(3 * k, 3 * k + 3)
        apart = estimate.value(vertex).between(estimate.value(observer) * Z)
        carry = Pose2.LogmapDerivative(apart)
        mismatch[row] = Pose2.Logmap(apart)
        jacobian[row, column[observer] : column[observer] + 3] += carry @ adjoint(Z.inverse())
        # the vertex is on the other side of T
        jacobian[row, column[vertex] : column[vertex] + 3] -= carry @ adjoint(apart.inverse())
        cov[row, row] = carry @ observer_to_target_axes(Z, sighting.cov_observer) @ carry.T
    return mismatch, jacobian @ estimate.joint_covariance(keys) @ jacobian.T + cov


def log_odds(
    chart: Chart, pairs: Sequence[tuple[CornerSighting, int]], corners_per_m2: float, angle_sigmas: float
) -> tuple[float, float]:
    """(log odds, squared Mahalanobis distance) of sightings that show certain vertices, all of them or none.

    Never-seen corners lie `corners_per_m2` dense, and are turned and open by any angle.
    """
    mismatch, cov = corner_mismatch(chart.estimate, pairs)
    distance_sq = float(mismatch @ np.linalg.solve(cov, mismatch))
    odds = -0.5 * (distance_sq + np.linalg.slogdet(2 * pi * cov)[1]) - len(pairs) * log(corners_per_m2 / (2 * pi))
    for sighting, vertex in pairs:
        known = chart.free_map.interior_angles[vertex]
        if not interior_angle_agrees(sighting, known, angle_sigmas):
            return -inf, distance_sq
        variance = 2 * sighting.interior_angle_sigma_rad**2
        odds += -0.5 * (sighting.interior_angle_rad - known) ** 2 / variance - 0.5 * log(variance / (2 * pi))
    return float(odds), distance_sq


def interior_angle_agrees(sighting: CornerSighting, known_rad: float, sigmas: float) -> bool:
    """Whether two measurements of an interior angle may be of one corner."""
    return abs(sighting.interior_angle_rad - known_rad) <= sigmas * np.sqrt(2) * sighting.interior_angle_sigma_rad


def known_corners(
    chart: Chart,
    limits: RecognitionSettings,
    sighting: CornerSighting,
    gate: tuple[int, int] | None = None,
    walked: Walked = Walked(),
    leave_out: Collection[int] = (),
) -> list[Match]:
    """The known vertices, but for some, that a sighting may show, the likeliest first.

    gate: behind which the corner is the apex of a triangle, which has to fit; None: it was seen on the way.
    """
    T_world_observer = chart.estimate.value(chart.estimate.pose_key_at(sighting.observer, sighting.stamp_s))
    here = position(T_world_observer * sighting.T_observer_corner)
    reach = max(
        limits.search_radius_m, limits.search_sigmas * chart.estimate.belief(sighting.observer).position_sigma_m
    )
    matches = []
    for vertex in chart.near(here, reach):
        angle = chart.free_map.interior_angles[vertex]
        if vertex in leave_out or not interior_angle_agrees(sighting, angle, limits.angle_sigmas):
            continue
        density = corner_density(chart, limits, here, vertex)
        odds, distance_sq = log_odds(chart, [(sighting, vertex)], density, limits.angle_sigmas)
        if odds > -limits.margin_log_odds:
            sector = None if gate is None else sector_for(chart, vertex, gate, walked)
            matches.append(Match(vertex, odds, distance_sq, sector))
    return sorted(matches, key=lambda match: -match.log_odds)


def corner_density(chart: Chart, limits: RecognitionSettings, here: np.ndarray, candidate: int) -> float:
    """Corners per m^2 that may be found around (2,) `here`: as many as are known there beside the candidate itself, or
    a few anywhere."""
    crowd = len(set(chart.near(here, limits.crowd_radius_m)) - {candidate})
    return max(limits.corners_per_m2, crowd / (pi * limits.crowd_radius_m**2))


def could_be(free_map: FreeMap, vertex: int, gate: tuple[int, int], walked: Walked) -> bool:
    """Whether the map leaves room for a vertex being the apex behind a gate, wherever it lies.

    Not when all space around it is explored, or when a wall that was just walked would be its second one.
    """
    a, b = gate
    if vertex in gate or not free_map.unexplored_sectors(vertex):
        return False
    if walked.at_end and free_map.wall_arriving(vertex) not in (None, b):
        return False
    return not (walked.at_start and free_map.wall_leaving(vertex) not in (None, a))


def sector_for(chart: Chart, vertex: int, gate: tuple[int, int], walked: Walked = Walked()) -> Sector | None:
    """The unexplored sector of a known vertex into which the triangle behind the gate fits, if any."""
    if vertex in gate:
        return None
    sector, miss = fitting_sector(chart, vertex, gate, walked)
    return sector if sector is not None and miss <= chart.sector_slack(vertex, gate) else None


def fitting_sector(chart: Chart, apex: int, gate: tuple[int, int], walked: Walked) -> tuple[Sector | None, float]:
    """The unexplored sector of a known vertex that the triangle behind `gate` fits best, and its miss in rad.

    Angles are counter-clockwise from the wall that leaves the vertex; the triangle spans apex -> a to apex -> b.
    """
    a, b = gate
    toward_a, toward_b = chart.bearing(apex, a), chart.bearing(apex, b)
    best, best_miss = None, np.inf
    for sector in chart.free_map.unexplored_sectors(apex):
        low, high = sector.clockwise, sector.counter_clockwise
        if walked.at_end and not (high.is_wall and high.other in (None, b)):
            continue
        if walked.at_start and not (low.is_wall and low.other in (None, a)):
            continue
        first, last = chart.sector_limits(apex, sector)
        miss_a = 0.0 if low.other == a or walked.at_start else outside(toward_a, first, last)
        miss_b = 0.0 if high.other == b or walked.at_end else outside(toward_b, first, last)
        if miss_a + miss_b < best_miss:
            best, best_miss = sector, miss_a + miss_b
    return best, best_miss
