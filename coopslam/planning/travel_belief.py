"""How well a robot that travels through a mapped place knows where it is, jointly with the map itself.

The state is what is truly so minus what is believed, to first order, in the axes of the map: the robot's pose, the
pose of a partner that stands and watches it, and the poses of the vertices that the way has to do with, whose joint
covariance the map holds. Beside them stands how far the robot believes to be off its way: what it finds wrong by a
measurement moves its belief, not the robot, which then steers back to the end of its leg. All that happens is linear
in it, x -> A x + noise of covariance W, and is written down: so the same chain tells the covariance at each place, the
chance to touch a wall, and can be sampled.

Between measurements nothing puts the heading right, and a long way on odometry alone is not linear in it. So the
moments of the robot's place since the last one are also kept without linearization (`drift`), and these are told.

An error of pose carried along a rigid motion by d turns its heading error into one across: e -> C(d) e (the adjoint,
in axes that do not turn).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coopslam.planning.drift import Drift
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.sensor_laws import OdometryLaw, SightingLaw
from coopslam.se2 import planar_rotation, rotation

ROBOT, PARTNER, ASTRAY = slice(0, 3), slice(3, 6), slice(6, 8)  # in the state
FIRST_VERTEX = 8  # where the vertices begin in it
FLAT_M = 1e-6  # a triangle lower than this has no inside


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """x[part] becomes rows @ x + noise."""

    part: slice
    rows: np.ndarray  # (p, n)
    noise: np.ndarray  # (p, p)

    def cov(self, cov: np.ndarray) -> np.ndarray:
        """(n, n) of what had this covariance."""
        across = self.rows @ cov
        cov = cov.copy()
        cov[self.part], cov[:, self.part] = across, across.T
        cov[self.part, self.part] = across @ self.rows.T + self.noise
        return cov

    def draw(self, errors: np.ndarray, rng: np.random.Generator) -> None:
        """Let it happen to (s, n) samples, in place."""
        causes = np.flatnonzero(self.rows.any(axis=0))
        errors[:, self.part] = errors[:, causes] @ self.rows[:, causes].T + _drawn(self.noise, len(errors), rng)


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """x becomes x - gain (rows @ x - noise): rows @ x was measured (Kalman, 1960; covariance in Joseph's form)."""

    gain: np.ndarray  # (n, m)
    rows: np.ndarray  # (m, n)
    noise: np.ndarray  # (m, m)

    def cov(self, cov: np.ndarray) -> np.ndarray:
        """(n, n) of what had this covariance."""
        across = self.gain @ (self.rows @ cov)
        spread = self.gain @ (self.rows @ cov @ self.rows.T + self.noise) @ self.gain.T
        return cov - across - across.T + spread

    def draw(self, errors: np.ndarray, rng: np.random.Generator) -> None:
        """Let it happen to (s, n) samples, in place."""
        causes = np.flatnonzero(self.rows.any(axis=0))
        off = errors[:, causes] @ self.rows[:, causes].T - _drawn(self.noise, len(errors), rng)
        errors -= off @ self.gain.T


class TravelBelief:
    """The belief of a robot on its way, changed by what the robot does and sees."""

    def __init__(self, map_graph: MapGraph, vertices: Sequence[int], start: np.ndarray, triangle: int, cov: np.ndarray):
        """A robot that knows its place relative to the map around it.

        vertices: all that will be asked for.  start: (2,) m, in the triangle.  cov: (3, 3) of the robot's pose
        relative to that triangle, axes of the map.
        """
        self.map, self.at = map_graph, np.asarray(start, float)
        self._place = {vertex: FIRST_VERTEX + 3 * k for k, vertex in enumerate(vertices)}
        size = FIRST_VERTEX + 3 * len(vertices)
        self.cov = np.zeros((size, size))
        self.cov[FIRST_VERTEX:, FIRST_VERTEX:] = map_graph.joint_covariance(list(vertices))
        self.first = self.cov  # before the robot is put down
        self.steps: list[Move | Correction] = []
        self._happen(Move(ROBOT, self.around(self.at, triangle), np.asarray(cov, float)))
        self._begin_drift()

    def around(self, point: np.ndarray, triangle: int) -> np.ndarray:
        """(3, n) by which the errors of the vertices move and turn the map at a point of a triangle.

        Its place is interpolated between the corners (barycentric), its heading is that of the rigid motion that fits
        the three of them best.
        """
        vertices, corners = self.map.triangles[triangle], self.map.corners[triangle]
        weights = barycentric(point, corners)
        arms = corners - corners.mean(axis=0)
        turns = np.stack([-arms[:, 1], arms[:, 0]], axis=1) / max(np.sum(arms**2), FLAT_M**2)
        rows = np.zeros((3, len(self.cov)))
        for vertex, weight, turn in zip(vertices, weights, turns, strict=True):
            place = self._place[vertex]
            rows[0, place] = rows[1, place + 1] = weight
            rows[2, place : place + 2] = turn
        return rows

    def relative_covariance(self, triangle: int) -> np.ndarray:
        """(3, 3) of the robot's pose relative to the map around it, in the triangle in which it is; axes of the map.

        Mean squares of true less believed: where drift bends the way, the robot is on average short of its goal, and
        that is part of it.  Exact but for what measurements left before.
        """
        rows = self.robot_rows() - self.around(self.at, triangle)
        cov, across = rows @ self._cov_then @ rows.T, rows @ self._drift.with_start(self._cov_then[:, 2])
        cov[:, :2] += across
        cov[:2] += across.T
        cov[:2, :2] += self._drift.square()
        cov[:2, 2] += self._drift.with_drift()
        cov[2, :2] += self._drift.with_drift()
        cov[2, 2] += self._drift.variance - self._drift.start_variance
        return cov

    def true_place_covariance(self, reference: np.ndarray) -> np.ndarray:
        """(2, 2) of where the robot truly is less where its way has it, relative to the map; axes of the map.

        reference: (3, n) which place of the map, as `around` or `vertex_rows`.
        """
        rows = (self.robot_rows() - reference)[:2] + np.eye(2, len(self.cov), ASTRAY.start)
        return rows @ self.cov @ rows.T

    def robot_rows(self) -> np.ndarray:
        """(3, n) that picks the robot out of the state."""
        return np.eye(3, len(self.cov))

    def place(self, vertex: int) -> slice:
        """Where a vertex stands in the state."""
        return slice(self._place[vertex], self._place[vertex] + 3)

    def vertex_rows(self, vertex: int) -> np.ndarray:
        """(3, n) that picks a vertex out of the state."""
        return np.eye(3, len(self.cov), self._place[vertex])

    def turn(self, angle_rad: float, law: OdometryLaw) -> None:
        """The robot turns on the spot."""
        noise = np.diag([0.0, 0.0, law.heading_sigma_per_rad**2 * abs(angle_rad)])
        self._happen(Move(ROBOT, self.robot_rows(), noise))
        self._drift.turn(angle_rad, law)

    def drive(self, to: np.ndarray, law: OdometryLaw) -> None:
        """The robot drives straight to (2,) `to`."""
        way = np.asarray(to, float) - self.at
        self._happen(Move(ROBOT, carried(way) @ self.robot_rows(), leg_covariance(way, law)))
        self._drift.drive(way, law)
        self.at = np.asarray(to, float)

    def steer_back(self, left: float) -> None:
        """The robot believes to be off its way by a share `left` of what it was."""
        self._happen(Move(ASTRAY, left * np.eye(2, len(self.cov), ASTRAY.start), np.zeros((2, 2))))

    def sight_corner(self, vertex: int, law: SightingLaw) -> None:
        """The robot sees a corner, from where it is: its place and the direction of its wall."""
        way = self.map.vertices[vertex].xy - self.at
        rows = carried(way) @ self.robot_rows() - self.vertex_rows(vertex)
        turn = planar_rotation(np.arctan2(way[1], way[0]))
        self._measure(rows, turn @ law.line_covariance(float(np.hypot(*way))) @ turn.T)

    def stand_partner(self, vertex: int, law: SightingLaw) -> None:
        """The partner comes to stand in a corner, and sees it with its finder; what it saw before is forgotten."""
        self._happen(Move(PARTNER, self.vertex_rows(vertex), law.line_covariance(0.0)))

    def watch_robot(self, vertex: int, law: SightingLaw) -> None:
        """The partner, which stands in a vertex, sees the robot; without its heading when the tracker sees none."""
        way = self.at - self.map.vertices[vertex].xy
        partner = np.eye(3, len(self.cov), PARTNER.start)
        rows = self.robot_rows() - carried(way) @ partner
        bearing = np.arctan2(way[1], way[0])
        if law.heading_sigma_rad is None:
            turn = rotation(bearing)
            self._measure(rows[:2], turn @ np.diag(law.line_variances(float(np.hypot(*way)))) @ turn.T)
        else:
            turn = planar_rotation(bearing)
            self._measure(rows, turn @ law.line_covariance(float(np.hypot(*way))) @ turn.T)

    def _measure(self, rows: np.ndarray, cov: np.ndarray) -> None:
        gain = np.linalg.solve(rows @ self.cov @ rows.T + cov, rows @ self.cov).T
        gain[ASTRAY] = -gain[ROBOT][:2]  # the belief moves, the robot stays where it is
        self._happen(Correction(gain, rows, cov))
        self._begin_drift()

    def _begin_drift(self) -> None:
        self._cov_then, self._drift = self.cov, Drift(float(self.cov[2, 2]))

    def _happen(self, step: Move | Correction) -> None:
        self.cov = step.cov(self.cov)
        self.steps.append(step)


def _drawn(cov: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, m) normal samples; the covariance may be singular."""
    variances, axes = np.linalg.eigh(cov)
    return rng.standard_normal((count, len(cov))) @ (axes * np.sqrt(np.maximum(variances, 0.0))).T


def carried(way: np.ndarray) -> np.ndarray:
    """(..., 3, 3) C(d): what becomes of an error of pose when its owner moves by (..., 2) `way`, axes of the map."""
    way = np.asarray(way, float)
    carry = np.broadcast_to(np.eye(3), (*way.shape[:-1], 3, 3)).copy()
    carry[..., 0, 2], carry[..., 1, 2] = -way[..., 1], way[..., 0]
    return carry


def leg_covariance(way: np.ndarray, law: OdometryLaw) -> np.ndarray:
    """(3, 3) odometry error of a straight drive by (2,) `way`, at its end, in the axes of the map.

    The heading drifts as a random walk on the way, which adds up across it: q d^3 / 3 after d metres.
    """
    d = float(np.hypot(*way))
    q = law.heading_sigma_per_m**2
    cov = np.diag([law.translation_sigma_per_m**2 * d, q * d**3 / 3, q * d])
    cov[1, 2] = cov[2, 1] = q * d**2 / 2
    turn = planar_rotation(np.arctan2(way[1], way[0]))
    return turn @ cov @ turn.T


def barycentric(point: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(3,) weights of a triangle's (3, 2) corners at a point, kept in [0, 1]; of a flat one, of its nearest corner."""
    (ax, ay), (bx, by) = corners[1] - corners[0], corners[2] - corners[0]
    x, y = np.asarray(point) - corners[0]
    area = ax * by - ay * bx
    if abs(area) < FLAT_M * max(np.hypot(ax, ay), np.hypot(bx, by)):
        return np.eye(3)[np.argmin(np.hypot(*(corners - point).T))]
    second, third = (x * by - y * bx) / area, (ax * y - ay * x) / area
    weights = np.clip([1 - second - third, second, third], 0.0, 1.0)
    return weights / weights.sum()
