"""Is this corner one that the map already has? Joint Mahalanobis distance, then the corner's own shape."""

from dataclasses import dataclass

import numpy as np

from coopslam.estimation.estimate import Estimate
from coopslam.exploration.free_map import FreeMap, Sector
from coopslam.records import CornerSighting
from coopslam.se2 import Pose2, adjoint, observer_to_target_axes, wrap, xytheta


@dataclass(frozen=True, slots=True)
class RecognitionSettings:
    """When a sighting counts as a known corner."""

    distance_sq_max: float = 30.66  # chi-square, 3 dof, 1 - 1e-6
    angle_sigmas: float = 5.0
    sector_slack_rad: float = 0.35
    search_radius_m: float = 1.0
    search_sigmas: float = 10.0


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


def fitting_sector(
    free_map: FreeMap, estimate: Estimate, apex: int, gate: tuple[int, int], wall_at_end: bool, wall_at_start: bool
) -> tuple[Sector | None, float]:
    """The unexplored sector of a known vertex into which the triangle behind `gate` fits, and by how much it misses, rad.

    Angles are counter-clockwise from the wall that leaves the vertex; the triangle spans apex -> a to apex -> b.
    """
    a, b = gate
    corner = estimate.vertex(apex)
    toward_a, toward_b = bearing(corner, estimate.vertex(a)), bearing(corner, estimate.vertex(b))
    best, best_miss = None, np.inf
    for sector in free_map.unexplored_sectors(apex):
        low, high = sector.clockwise, sector.counter_clockwise
        if wall_at_end and not (high.is_wall and high.other in (None, b)):
            continue
        if wall_at_start and not (low.is_wall and low.other in (None, a)):
            continue
        first, last = sector_limits(free_map, estimate, apex, sector)
        miss_a = 0.0 if low.other == a or wall_at_start else outside(toward_a, first, last)
        miss_b = 0.0 if high.other == b or wall_at_end else outside(toward_b, first, last)
        if miss_a + miss_b < best_miss:
            best, best_miss = sector, miss_a + miss_b
    return best, best_miss


def bearing(T_world_corner: Pose2, T_world_other: Pose2) -> float:
    """Direction of another vertex in a corner's frame, in [0, 2 pi)."""
    there = T_world_corner.transformTo(np.array([T_world_other.x(), T_world_other.y()]))
    return float(np.arctan2(there[1], there[0]) % (2 * np.pi))


def sector_limits(free_map: FreeMap, estimate: Estimate, vertex: int, sector: Sector) -> tuple[float, float]:
    """Directions of a sector's two sides in the vertex's frame, in [0, 2 pi); the second may be a little below the first."""
    low, high, corner = sector.clockwise, sector.counter_clockwise, estimate.vertex(vertex)
    first = 0.0 if low.is_wall else bearing(corner, estimate.vertex(low.other))
    last = free_map.interior_angles[vertex] if high.is_wall else bearing(corner, estimate.vertex(high.other))
    return first, last


def outside(angle: float, first: float, last: float) -> float:
    """How far an angle lies outside [first, last], rad; all modulo a full turn."""
    return min(max(first - turn, turn - last, 0.0) for turn in (angle - 2 * np.pi, angle, angle + 2 * np.pi))
