"""Is this corner one that the map already has? Joint Mahalanobis distance, and the corner's own shape."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from coopslam.errors import require_positive
from coopslam.estimation.estimate import Estimate
from coopslam.exploration.chart import Chart, outside
from coopslam.exploration.free_map import Sector
from coopslam.records import CornerSighting
from coopslam.se2 import adjoint, observer_to_target_axes, position, wrap, xytheta


@dataclass(frozen=True, slots=True)
class RecognitionSettings:
    """When a sighting counts as a known corner."""

    distance_sq_max: float = 30.66  # chi-square, 3 dof, 1 - 1e-6
    angle_sigmas: float = 5.0
    search_radius_m: float = 1.0
    search_sigmas: float = 10.0

    def __post_init__(self):
        require_positive(
            distance_sq_max=self.distance_sq_max,
            angle_sigmas=self.angle_sigmas,
            search_radius_m=self.search_radius_m,
            search_sigmas=self.search_sigmas,
        )


@dataclass(frozen=True, slots=True)
class Match:
    """A known vertex that a sighting may show, the best first in a list of them."""

    distance_sq: float
    vertex: int
    sector: Sector | None  # where the triangle behind the gate fits; None: nowhere


def corner_distance_sq(estimate: Estimate, sighting: CornerSighting, vertex: int) -> float:
    """Squared Mahalanobis distance (3 dof) between a sighted corner and a map vertex, with their joint covariance.

    The sighting must have been made at the observer's latest pose variable. With V the vertex, X the observer and
    Z the sighting, e = V^-1 X Z is the identity when both are one corner; to first order in right perturbations
    its error is Ad(Z^-1) dX - dV + dZ.
    """
    Z = sighting.T_observer_corner
    mismatch = xytheta(estimate.vertex(vertex).between(estimate.pose(sighting.observer) * Z))
    jacobian = np.hstack([adjoint(Z.inverse()), -np.eye(3)])
    joint = estimate.joint_covariance([estimate.pose_key(sighting.observer), estimate.vertex_key(vertex)])
    cov = jacobian @ joint @ jacobian.T + observer_to_target_axes(Z, sighting.cov_observer)
    mismatch[2] = wrap(mismatch[2])
    return float(mismatch @ np.linalg.solve(cov, mismatch))


def interior_angle_agrees(sighting: CornerSighting, known_rad: float, sigmas: float) -> bool:
    """Whether two measurements of an interior angle may be of one corner."""
    return abs(sighting.interior_angle_rad - known_rad) <= sigmas * np.sqrt(2) * sighting.interior_angle_sigma_rad


def known_corners(
    chart: Chart,
    limits: RecognitionSettings,
    sighting: CornerSighting,
    gate: tuple[int, int],
    leave_out: Collection[int] = (),
    wall_at_end: bool = False,
    wall_at_start: bool = False,
) -> list[Match]:
    """Which known vertices, but for some, a sighting may show; nearest in Mahalanobis distance first."""
    belief = chart.estimate.belief(sighting.observer)
    here = position(belief.T_world_body * sighting.T_observer_corner)
    reach = max(limits.search_radius_m, limits.search_sigmas * belief.position_sigma_m)
    matches = []
    for vertex in chart.near(here, reach):
        if vertex in leave_out:
            continue
        if not interior_angle_agrees(sighting, chart.free_map.interior_angles[vertex], limits.angle_sigmas):
            continue
        distance_sq = corner_distance_sq(chart.estimate, sighting, vertex)
        if distance_sq <= limits.distance_sq_max:
            matches.append(Match(distance_sq, vertex, sector_for(chart, vertex, gate, wall_at_end, wall_at_start)))
    return sorted(matches, key=lambda match: match.distance_sq)


def sector_for(
    chart: Chart, vertex: int, gate: tuple[int, int], wall_at_end: bool = False, wall_at_start: bool = False
) -> Sector | None:
    """The unexplored sector of a known vertex into which the triangle behind the gate fits, if any.

    wall_at_end / wall_at_start: the edge from the gate's end to the vertex / from the vertex to the gate's start is a
    wall that was just walked.
    """
    if vertex in gate:
        return None
    sector, miss = fitting_sector(chart, vertex, gate, wall_at_end, wall_at_start)
    return sector if sector is not None and miss <= chart.sector_slack(vertex, gate) else None


def fitting_sector(
    chart: Chart, apex: int, gate: tuple[int, int], wall_at_end: bool, wall_at_start: bool
) -> tuple[Sector | None, float]:
    """The unexplored sector of a known vertex that the triangle behind `gate` fits best, and its miss in rad.

    Angles are counter-clockwise from the wall that leaves the vertex; the triangle spans apex -> a to apex -> b.
    """
    a, b = gate
    toward_a, toward_b = chart.bearing(apex, a), chart.bearing(apex, b)
    best, best_miss = None, np.inf
    for sector in chart.free_map.unexplored_sectors(apex):
        low, high = sector.clockwise, sector.counter_clockwise
        if wall_at_end and not (high.is_wall and high.other in (None, b)):
            continue
        if wall_at_start and not (low.is_wall and low.other in (None, a)):
            continue
        first, last = chart.sector_limits(apex, sector)
        miss_a = 0.0 if low.other == a or wall_at_start else outside(toward_a, first, last)
        miss_b = 0.0 if high.other == b or wall_at_end else outside(toward_b, first, last)
        if miss_a + miss_b < best_miss:
            best, best_miss = sector, miss_a + miss_b
    return best, best_miss
