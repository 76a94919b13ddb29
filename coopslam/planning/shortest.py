"""Shortest paths in free space: exact, through as many channels as there are obstacles.

A shortest path is straight but for turns at corners, to which it is tangent. The corners that see each other along
common tangents are joined once (the tangent visibility graph, Liu and Arimoto 1992); a query joins its two ends and
searches by A* with the straight distance as bound. What a corner sees is found when a search first asks for it.
"""

from heapq import heappop, heappush
from math import dist, isfinite

import numpy as np
import shapely

from coopslam.errors import BadInput, CoopSlamError
from coopslam.planning.triangulated import Point, eroded, triangulated
from coopslam.planning.visibility import view_from

START, GOAL = -1, -2  # among the corners' numbers


class Unreachable(CoopSlamError):
    """No path leads from the start to the goal."""

    exit_code = 3


class ShortestPaths:
    """Shortest paths in one free space, for a round robot."""

    def __init__(self, free_space: shapely.Polygon | shapely.MultiPolygon, robot_radius_m: float = 0.0):
        """free_space: valid; paths may touch its boundary. With a radius they are shortest in what is left of it."""
        self.free_space = eroded(free_space, robot_radius_m)
        self.mesh = triangulated(self.free_space)
        self._whole, self._radius_m = free_space, robot_radius_m
        self._turns = [self.mesh.turns(vertex) for vertex in range(len(self.mesh.points))]
        self._around: dict[int, list[int]] = {vertex: [] for vertex in range(len(self.mesh.points))}
        for t, vertices in enumerate(self.mesh.triangles):
            for vertex in vertices:
                self._around[vertex].append(t)
        self._tangents: dict[int, list[tuple[int, float]]] = {}

    def prepare(self) -> int:
        """Join all corners now, not when they are first asked for. Returns how many pairs are joined."""
        return sum(len(self.tangents(vertex)) for vertex, turns in enumerate(self._turns) if turns) // 2

    def path(self, start: Point, goal: Point) -> np.ndarray:
        """(k, 2) points of the shortest path, m; one point when start and goal are the same.

        Raises BadInput when an end is not in free space, or the robot does not fit there; Unreachable.
        """
        start, goal = self._end(start, "start"), self._end(goal, "goal")
        start_at, goal_at = self.mesh.triangles_at(start), self.mesh.triangles_at(goal)
        if start == goal:
            return np.array([start])
        view = view_from(self.mesh, start, start_at)
        if view.holds(goal, goal_at):
            return np.array([start, goal])
        first = self._joined(start, view.vertices)
        last = dict(self._joined(goal, view_from(self.mesh, goal, goal_at).vertices))
        return self._search(start, goal, first, last)

    def tangents(self, vertex: int) -> list[tuple[int, float]]:
        """(corner, m) of all corners that share a tangent with this one, and see it along it."""
        if vertex not in self._tangents:
            here = self.mesh.points[vertex]
            seen = view_from(self.mesh, here, self._around[vertex]).vertices - {vertex}
            joined = [(w, m) for w, m in self._joined(here, seen) if self.mesh.tangent(self.mesh.points[w], vertex)]
            self._tangents[vertex] = joined
        return self._tangents[vertex]

    def _joined(self, point: Point, seen) -> list[tuple[int, float]]:
        """Those of the corners seen that a shortest path from a point can touch, and how far away they are, m."""
        mesh, points = self.mesh, self.mesh.points
        return [(v, dist(point, points[v])) for v in seen if self._turns[v] and mesh.tangent(point, v)]

    def _search(self, start: Point, goal: Point, first: list[tuple[int, float]], last: dict[int, float]) -> np.ndarray:
        """A*: the straight distance to the goal is never too long, so the first arrival is shortest."""
        points, came_from, way_m, done = self.mesh.points, {}, {START: 0.0}, set()
        queue: list[tuple[float, int]] = [(dist(start, goal), START)]
        while queue:
            _, here = heappop(queue)
            if here == GOAL:
                return self._traced(came_from, start, goal)
            if here in done:
                continue
            done.add(here)
            steps = first if here == START else self.tangents(here)
            ahead = [(v, m, dist(points[v], goal)) for v, m in steps if v not in done]
            ahead += [(GOAL, last[here], 0.0)] if here in last else []
            for there, step_m, left_m in ahead:
                through_m = way_m[here] + step_m
                if through_m < way_m.get(there, np.inf):
                    way_m[there], came_from[there] = through_m, here
                    heappush(queue, (through_m + left_m, there))
        raise Unreachable(f"no path leads from {_shown(start)} to {_shown(goal)}{self._for_robot}")

    def _traced(self, came_from: dict[int, int], start: Point, goal: Point) -> np.ndarray:
        path, here = [goal], GOAL
        while (here := came_from[here]) != START:
            path.append(self.mesh.points[here])
        path.append(start)
        path.reverse()
        return np.array([point for k, point in enumerate(path) if k == 0 or point != path[k - 1]])

    def _end(self, point: Point, name: str) -> Point:
        """A start or goal as a pair of numbers; raises BadInput unless the robot can be there."""
        x, y = (float(value) for value in point)
        if not (isfinite(x) and isfinite(y)):
            raise BadInput(f"{name}: two finite numbers expected, m, got {x:g},{y:g}")
        if self.mesh.triangles and self.mesh.triangles_at((x, y)):
            return x, y
        if self._whole.is_empty:
            raise BadInput(f"{name}: a place in mapped free space expected, and nothing is mapped")
        wall_m = self._whole.boundary.distance(shapely.Point(x, y))
        if self._whole.covers(shapely.Point(x, y)):
            raise BadInput(
                f"{name}: a place at least {self._radius_m:g} m from walls expected, {_shown((x, y))} is {wall_m:.3f} m"
            )
        raise BadInput(f"{name}: a place in mapped free space expected, {_shown((x, y))} is {wall_m:.3f} m outside")

    @property
    def _for_robot(self) -> str:
        return f" for a robot of {self._radius_m:g} m radius" if self._radius_m else ""


def _shown(point: Point) -> str:
    return f"({point[0]:.3f}, {point[1]:.3f})"
