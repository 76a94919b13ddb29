"""The map seen through the current estimate: where things are, in which direction, and how sure that is."""

from dataclasses import dataclass

import numpy as np

from coopslam.errors import require_positive
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.relative import relative_now
from coopslam.exploration.free_map import Boundary, FreeMap, Sector
from coopslam.se2 import Pose2, largest_sigma, position, rotation

STRAIGHT_RAD = 1e-6  # angles closer than this are one direction, however good the sensors
SAME_PLACE_M = 1e-6


@dataclass(frozen=True, slots=True)
class ChartSettings:
    """How sure the explorer wants to be of what it reads off the estimate."""

    angle_sigmas: float = 5.0  # an angle this close to a straight line counts as undecided
    place_sigmas: float = 3.0
    sector_slack_max_rad: float = 0.35  # a direction further outside a sector never counts as inside

    def __post_init__(self):
        require_positive(
            1e6,
            angle_sigmas=self.angle_sigmas,
            place_sigmas=self.place_sigmas,
            sector_slack_max_rad=self.sector_slack_max_rad,
        )


class Chart:
    """Asks the estimate for what decisions need; positions are cached until the next estimate."""

    def __init__(self, free_map: FreeMap, settings: ChartSettings):
        self.free_map, self.settings = free_map, settings
        self.estimate: Estimate | None = None
        self.corner_angle_sigma = 0.0  # of measured interior angles, rad
        self._vertices: dict[int, Pose2] = {}
        self._former: dict[int, np.ndarray] = {}  # positions as last asked, for a first coarse look

    def look_at(self, estimate: Estimate) -> None:
        """Read off this estimate from now on."""
        self.estimate = estimate
        self._vertices.clear()

    def vertex(self, vertex: int) -> Pose2:
        """T_world_vertex of an oriented corner."""
        if vertex not in self._vertices:
            self._vertices[vertex] = self.estimate.vertex(vertex)
            self._former[vertex] = position(self._vertices[vertex])
        return self._vertices[vertex]

    def near(self, place: np.ndarray, reach_m: float) -> list[int]:
        """Vertices within reach of (2,) `place`.

        Only those that were within twice the reach and a metre when they were last asked for are asked again.
        """
        for vertex in self.free_map.fans:
            if vertex not in self._former:
                self.vertex(vertex)
        vertices = list(self._former)
        apart = np.hypot(*(np.array([self._former[vertex] for vertex in vertices]) - place).T)
        coarse = (vertices[k] for k in np.flatnonzero(apart <= 2 * reach_m + 1.0))
        return sorted(vertex for vertex in coarse if np.hypot(*(self.position(vertex) - place)) <= reach_m)

    def position(self, vertex: int) -> np.ndarray:
        """(2,) m."""
        return position(self.vertex(vertex))

    def robot(self, robot: str) -> Pose2:
        """T_world_robot now."""
        return self.estimate.pose(robot)

    def bearing(self, corner: int, other: int) -> float:
        """Direction of another vertex, counter-clockwise from the wall that leaves the corner, in [0, 2 pi)."""
        return bearing(self.vertex(corner), self.vertex(other))

    def opening(self, corner: int, pivot: int, boundary: Boundary, clockwise: bool) -> tuple[float, float]:
        """Unexplored angle at a gate's end between the gate and its next boundary, and how sure that is, rad.

        An angle within the margin of a full turn is one of zero: the gate runs along the wall.
        """
        toward_pivot = self.bearing(corner, pivot)
        if not boundary.is_wall:
            edge = self.bearing(corner, boundary.other)
        else:
            edge = 0.0 if clockwise else self.free_map.interior_angles[corner]
        opening = ((toward_pivot - edge) if clockwise else (edge - toward_pivot)) % (2 * np.pi)
        margin = self._bearing_margin(corner, pivot, clearance=min(opening, abs(opening - np.pi), 2 * np.pi - opening))
        return (0.0 if opening > 2 * np.pi - margin else opening), margin

    def sector_limits(self, vertex: int, sector: Sector) -> tuple[float, float]:
        """Directions of a sector's two sides from the wall that leaves the vertex, rad.

        An edge along a wall may be measured a little outside of the free angle; its direction is not wrapped there.
        """
        low, high = sector.clockwise, sector.counter_clockwise
        first = 0.0 if low.is_wall else self._free_bearing(vertex, low.other)
        last = self.free_map.interior_angles[vertex] if high.is_wall else self._free_bearing(vertex, high.other)
        return first, last

    def _free_bearing(self, corner: int, other: int) -> float:
        """Direction of another vertex, cut open in the middle of the corner's own obstacle instead of at its wall."""
        angle, interior = self.bearing(corner, other), self.free_map.interior_angles[corner]
        return angle - 2 * np.pi if angle > (interior + 2 * np.pi) / 2 else angle

    def sector_slack(self, vertex: int, others) -> float:
        """How far the direction of others may lie outside a sector of a vertex and still count as inside, rad."""
        corner = self.estimate.vertex_belief(vertex)
        across = max(
            (corner.position_sigma_m + self.estimate.vertex_belief(other).position_sigma_m)
            / max(float(np.hypot(*(self.position(other) - self.position(vertex)))), SAME_PLACE_M)
            for other in others
        )
        doubt = self.settings.angle_sigmas * (across + np.sqrt(corner.cov_body[2, 2]) + self.corner_angle_sigma)
        return min(doubt + STRAIGHT_RAD, self.settings.sector_slack_max_rad)

    def relative_covariance(self, robot: str, vertex: int) -> np.ndarray:
        """(2, 2) covariance of a vertex's position relative to a robot, axes of the map, m^2."""
        cov = relative_now(self.estimate, robot, vertex).cov_b
        turn = rotation(self.vertex(vertex).theta())
        return turn @ cov[:2, :2] @ turn.T

    def relative_sigma(self, robot: str, vertex: int) -> float:
        """Largest sigma of a vertex's position relative to a robot, m."""
        return largest_sigma(self.relative_covariance(robot, vertex))

    def _bearing_margin(self, corner: int, other: int, clearance: float) -> float:
        """How far off the direction of one vertex in another's frame may be, rad.

        A quick bound from the two marginals is enough when it is below the clearance that the decision has.
        """
        sigmas = self.settings.angle_sigmas
        there = self.vertex(corner).transformTo(self.position(other))
        range_m = float(np.hypot(*there))
        near, far = self.estimate.vertex_belief(corner), self.estimate.vertex_belief(other)
        bound = (near.position_sigma_m + far.position_sigma_m) / range_m + np.sqrt(near.cov_body[2, 2])
        if sigmas * bound < clearance:
            return max(sigmas * bound, STRAIGHT_RAD)
        across = np.array([-there[1], there[0]]) / range_m**2
        turn = rotation(self.vertex(corner).between(self.vertex(other)).theta())
        jacobian = np.concatenate([-across, [-1.0], across @ turn, [0.0]])
        joint = self.estimate.joint_covariance([self.estimate.vertex_key(corner), self.estimate.vertex_key(other)])
        return max(sigmas * float(np.sqrt(max(jacobian @ joint @ jacobian, 0.0))), STRAIGHT_RAD)


def bearing(T_world_corner: Pose2, T_world_other: Pose2) -> float:
    """Direction of another vertex in a corner's frame, in [0, 2 pi)."""
    there = T_world_corner.transformTo(position(T_world_other))
    return float(np.arctan2(there[1], there[0]) % (2 * np.pi))


def outside(angle: float, first: float, last: float) -> float:
    """How far an angle lies outside [first, last], rad; all modulo a full turn."""
    return min(max(first - turn, turn - last, 0.0) for turn in (angle - 2 * np.pi, angle, angle + 2 * np.pi))
