"""Simulated traversals of a map, for comparison with what the planner predicts: many robots at once, not linearized.

Each robot has its own truth: the corners are drawn from the map's joint covariance, the robot is put down relative to
them, its wheels slip by what was recorded in the triangle where it believes to be. It steers by its own estimate, an
iterated extended Kalman filter (Bell and Cathey, 1993) over its pose, its partner's and all corners, from leg to leg of
its way. Iterated, because the robots' own estimators relinearize, too: one linearization where 0.08 rad and 0.25 m are
open leaves their product, 2 cm, in a place that one sighting tells to 7 mm.
"""

import numpy as np

from coopslam.planning.map_graph import MapGraph
from coopslam.planning.sensor_laws import OdometryLaw, SightingLaw
from coopslam.planning.traversal import Escorted, TraversalModel, WithCorners, finder, pivot, tracker
from coopslam.planning.walk import AIM_M, Walk
from coopslam.se2 import fit_pose, wrap

STEP_M = 0.05  # of the simulation
LOOKS = 3  # linearizations of one measurement: after a long way on odometry the first one is far off


class Traversals:
    """`count` robots on the same way, each in a world of its own. Poses are rows (x, y, heading)."""

    def __init__(
        self,
        map_graph: MapGraph,
        walk: Walk,
        start_cov: np.ndarray,
        count: int,
        rng: np.random.Generator,
        radius_m: float,
    ):
        self.map, self.walk, self.rng, self.count, self.radius_m = map_graph, walk, rng, count, radius_m
        self.touched = np.zeros(count, bool)  # a wall, so far
        self.ids = list(map_graph.vertices)
        believed = np.array([map_graph.vertices[v].pose for v in self.ids])
        drawn = rng.multivariate_normal(np.zeros(3 * len(self.ids)), map_graph.joint, count, method="eigh")
        self.corners = believed + drawn.reshape(count, -1, 3)  # true; (count, n, 3)
        ahead = walk.points[1] - walk.points[0]
        start = np.array([*walk.points[0], np.arctan2(ahead[1], ahead[0])])
        size = 6 + 3 * len(self.ids)
        self.estimate = np.tile(np.concatenate([start, np.zeros(3), believed.ravel()]), (count, 1))
        self.cov = np.zeros((count, size, size))
        self.cov[:, 6:, 6:] = map_graph.joint
        self.robots = self._put_down(start, walk.triangle(0), start_cov)  # true; (count, 3)
        rows = self.around(walk.points[0], walk.triangle(0))
        self.cov[:, :3] = rows @ self.cov
        self.cov[:, :, :3] = self.cov[:, :3].transpose(0, 2, 1)
        self.cov[:, :3, :3] = rows @ self.cov[:, :, :3] + start_cov
        self.partners = np.zeros((count, 3))  # true

    def run(self, model: TraversalModel) -> np.ndarray:
        """(count, 3) errors of the believed pose at the goal, relative to the map around it, axes of the map."""
        self._sense(model, 0)
        for k in range(self.walk.last):
            self._drive(k)
            self._sense(model, k + 1)
        rows = self.around(self.walk.points[-1], self.walk.triangle(self.walk.last))
        error = np.zeros((self.count, 6 + 3 * len(self.ids)))
        error[:, :3] = self.robots - self.estimate[:, :3]
        error[:, 6:] = (self.corners - self.estimate[:, 6:].reshape(self.count, -1, 3)).reshape(self.count, -1)
        error[:, 2::3] = wrap(error[:, 2::3])
        relative = error[:, :3] - error @ rows.T
        relative[:, 2] = wrap(relative[:, 2])
        return relative

    def around(self, point: np.ndarray, triangle: int) -> np.ndarray:
        """(3, n) by which errors of corners move the map at a point: affine for the place, a rigid fit for heading."""
        members = [self.ids.index(v) for v in self.map.triangles[triangle]]
        corners = self.map.corners[triangle]
        weights = np.linalg.solve(np.vstack([corners.T, np.ones(3)]), [*point, 1.0])
        rows, step = np.zeros((3, 6 + 3 * len(self.ids))), 1e-6
        for k, member in enumerate(members):
            column = 6 + 3 * member
            rows[0, column] = rows[1, column + 1] = weights[k]
            for axis in (0, 1):
                moved = corners.copy()
                moved[k, axis] += step
                rows[2, column + axis] = fit_pose(corners, moved).theta() / step
        return rows

    def _put_down(self, start: np.ndarray, triangle: int, start_cov: np.ndarray) -> np.ndarray:
        members = [self.ids.index(v) for v in self.map.triangles[triangle]]
        believed = self.map.corners[triangle]
        weights = np.linalg.solve(np.vstack([believed.T, np.ones(3)]), [*start[:2], 1.0])
        true = self.corners[:, members, :2]
        turns = [fit_pose(believed, corners).theta() for corners in true]
        placed = np.column_stack([np.einsum("k,ski->si", weights, true), start[2] + np.array(turns)])
        return placed + self.rng.multivariate_normal(np.zeros(3), start_cov, self.count)

    def _drive(self, stretch: int) -> None:
        """Turn to the end of the leg and drive a stretch; the truth slips, the estimate takes the command for done."""
        law, planned = self.map.odometry_law(self.walk.triangles[stretch]), np.diff(self.walk.points[stretch:], axis=0)
        ahead = np.arctan2(planned[:, 1], planned[:, 0])
        bends = np.flatnonzero(np.abs(wrap(ahead - ahead[0])) > 1e-6)
        leg_end = stretch + (int(bends[0]) if len(bends) else len(ahead))
        way = self.walk.points[leg_end] - self.estimate[:, :2]
        lengths = np.hypot(*planned.T)
        left_m, planned_left_m = np.hypot(*way.T), float(lengths[: leg_end - stretch].sum())
        near = (left_m < AIM_M) | (planned_left_m < AIM_M)  # who is beside its path there would turn for nothing
        aim = np.where(near, ahead[0], np.arctan2(way[:, 1], way[:, 0]))
        self._turn(wrap(aim - self.estimate[:, 2]), law)
        distance = lengths[0] * np.where(near, 1.0, left_m / planned_left_m)
        steps = max(int(np.ceil(lengths[0] / STEP_M)), 1)
        for _ in range(steps):
            self._straight(distance / steps, law)
            self._touch()

    def _touch(self) -> None:
        """Who is nearer to a true wall than its radius."""
        ends = [[self.ids.index(v) for v in wall] for wall in self.map.walls]
        starts, stops = (self.corners[:, [pair[k] for pair in ends], :2] for k in (0, 1))
        way, off = stops - starts, self.robots[:, None, :2] - starts
        along = np.clip(np.sum(way * off, axis=2) / np.sum(way * way, axis=2), 0.0, 1.0)
        apart = np.linalg.norm(off - along[..., None] * way, axis=2)
        self.touched |= (apart < self.radius_m).any(axis=1)

    def _turn(self, angle: np.ndarray, law: OdometryLaw) -> None:
        variance = law.heading_sigma_per_rad**2 * np.abs(angle)
        self.robots[:, 2] += angle + np.sqrt(variance) * self.rng.standard_normal(self.count)
        self.estimate[:, 2] += angle
        self.cov[:, 2, 2] += variance

    def _straight(self, metres: np.ndarray, law: OdometryLaw) -> None:
        white = self.rng.standard_normal((self.count, 2))
        length = metres + law.translation_sigma_per_m * np.sqrt(metres) * white[:, 0]
        bend = law.heading_sigma_per_m * np.sqrt(metres) * white[:, 1]
        middle = self.robots[:, 2] + bend / 2
        self.robots += np.column_stack([length * np.cos(middle), length * np.sin(middle), bend])
        heading = self.estimate[:, 2].copy()
        self.estimate[:, 0] += metres * np.cos(heading)
        self.estimate[:, 1] += metres * np.sin(heading)
        carry = np.tile(np.eye(3), (self.count, 1, 1))
        carry[:, 0, 2], carry[:, 1, 2] = -metres * np.sin(heading), metres * np.cos(heading)
        noise = np.zeros((self.count, 3, 3))
        c, s = np.cos(heading), np.sin(heading)
        along, drift = law.translation_sigma_per_m**2 * metres, law.heading_sigma_per_m**2 * metres
        effect = np.stack([-s * metres / 2, c * metres / 2, np.ones(self.count)], axis=1)
        forward = np.stack([c, s], axis=1)
        noise[:, :2, :2] = along[:, None, None] * forward[:, :, None] * forward[:, None, :]
        noise += drift[:, None, None] * effect[:, :, None] * effect[:, None, :]
        self.cov[:, :3] = carry @ self.cov[:, :3]
        self.cov[:, :, :3] = self.cov[:, :, :3] @ carry.transpose(0, 2, 1)
        self.cov[:, :3, :3] += noise

    def _sense(self, model: TraversalModel, station: int) -> None:
        for vertex in self.walk.stops.get(station, ()):
            column = 6 + 3 * self.ids.index(vertex)
            corner = self.corners[:, self.ids.index(vertex)]
            reach_m = model.reach_m if isinstance(model, WithCorners) else np.inf
            self._measure(self.robots, corner, 0, column, finder(self.map), reach_m)
        if isinstance(model, Escorted):
            if station and model.watches(self.walk, station):
                self._measure(self.partners, self.robots, 3, 0, tracker(self.map))
            if model.moves(self.map, self.walk, station):
                self._stand(pivot(self.map, self.walk, station))

    def _stand(self, vertex: int) -> None:
        """A partner that believes to stand exactly in the corner, after a look at it, stands a little beside."""
        column = 6 + 3 * self.ids.index(vertex)
        cov = finder(self.map).line_covariance(0.0)
        noise = self.rng.multivariate_normal(np.zeros(3), cov, self.count)
        self.partners = self.corners[:, self.ids.index(vertex)] + noise
        self.estimate[:, 3:6] = self.estimate[:, column : column + 3]
        self.cov[:, 3:6] = self.cov[:, column : column + 3]
        self.cov[:, :, 3:6] = self.cov[:, 3:6].transpose(0, 2, 1)
        self.cov[:, 3:6, 3:6] = self.cov[:, column : column + 3, column : column + 3] + cov

    def _measure(
        self, observers, targets, observer: int, target: int, law: SightingLaw, reach_m: float = np.inf
    ) -> None:
        """A relative pose in the observer's axes, with noise along and across the line of sight, and its update.

        Who is truly farther away than the reach sees nothing.
        """
        true, noise = _relative(observers, targets), np.zeros((self.count, 3, 3))
        for s in range(self.count):
            range_m, bearing = np.hypot(*true[s, :2]), np.arctan2(true[s, 1], true[s, 0])
            turn = np.array([[np.cos(bearing), -np.sin(bearing), 0], [np.sin(bearing), np.cos(bearing), 0], [0, 0, 1]])
            noise[s] = turn @ law.line_covariance(float(range_m)) @ turn.T
        factors = np.linalg.cholesky(noise)
        measured = true + np.einsum("sij,sj->si", factors, self.rng.standard_normal((self.count, 3)))
        seen_at_all = np.hypot(*true[:, :2].T) <= reach_m
        before, gain, jacobian = self.estimate, None, None
        for _ in range(LOOKS):
            seen_by, seen = self.estimate[:, observer : observer + 3], self.estimate[:, target : target + 3]
            expected = _relative(seen_by, seen)
            jacobian = self._jacobian(observer, target, expected)
            innovation = measured - expected - np.einsum("sij,sj->si", jacobian, before - self.estimate)
            innovation[:, 2] = wrap(innovation[:, 2])
            across = jacobian @ self.cov
            gain = np.linalg.solve(across @ jacobian.transpose(0, 2, 1) + noise, across).transpose(0, 2, 1)
            gain[~seen_at_all] = 0.0
            self.estimate = before + np.einsum("sij,sj->si", gain, innovation)
        self.cov = self.cov - gain @ (jacobian @ self.cov)

    def _jacobian(self, observer: int, target: int, expected: np.ndarray) -> np.ndarray:
        """(count, 3, n) of the target's pose in the axes of its observer, (count, 3), at the estimate."""
        jacobian = np.zeros((self.count, 3, self.cov.shape[1]))
        heading = self.estimate[:, observer + 2]
        c, s = np.cos(heading), np.sin(heading)
        back = np.zeros((self.count, 3, 3))
        back[:, 0, 0], back[:, 0, 1], back[:, 1, 0], back[:, 1, 1], back[:, 2, 2] = c, s, -s, c, 1.0
        jacobian[:, :, target : target + 3] = back
        jacobian[:, :, observer : observer + 3] = -back
        jacobian[:, 0, observer + 2], jacobian[:, 1, observer + 2] = expected[:, 1], -expected[:, 0]
        return jacobian


def _relative(observers: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """(s, 3) targets in the axes of their observers."""
    c, s = np.cos(observers[:, 2]), np.sin(observers[:, 2])
    x, y = (targets - observers)[:, :2].T
    return np.column_stack([c * x + s * y, c * y - s * x, wrap(targets[:, 2] - observers[:, 2])])
