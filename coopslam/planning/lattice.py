"""The ways a search chooses from: straight crossings of triangles between points on their gates.

A way between two points of a triangle's sides is straight within the triangle, where the ground is one and the same;
so points on the gates make a graph of ways that is complete but for the spacing of the points (the Steiner points of
Lanthier, Maheshwari and Sack, 1997, for paths over regions of different cost).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from coopslam.planning.map_graph import MapGraph

SPACING_M = 0.6  # of points on a gate, where it takes no more than MOST_POINTS
MOST_POINTS = 9
NEAR_ENDS = (1.2, 1.5)  # times the least distance from a gate's end: to get around the corner in straight crossings
INSET_M = 0.02  # of the first point from a gate's end, for a robot without extent
ROUNDING_M = 1e-6

Gate = tuple[int, int]  # vertices, the lower first


@dataclass(frozen=True, eq=False)
class Lattice:
    """n points and a directed arcs between them; point 0 is the start, point 1 the goal."""

    points: np.ndarray  # (n, 2) m
    gates: Sequence[Gate | None]  # n, on which each point lies; None: start and goal
    tails: np.ndarray  # (a,) points
    heads: np.ndarray  # (a,)
    triangles: np.ndarray  # (a,)
    pivots: np.ndarray  # (a,) vertex between the sides of entry and exit

    @cached_property
    def ways(self) -> np.ndarray:
        """(a, 2) m."""
        return self.points[self.heads] - self.points[self.tails]

    @cached_property
    def leaving(self) -> list[np.ndarray]:
        """n, the arcs that leave each point."""
        order = np.argsort(self.tails, kind="stable")
        return np.split(order, np.searchsorted(self.tails[order], np.arange(1, len(self.points))))


def gates_of(map_graph: MapGraph) -> dict[Gate, tuple[int, int]]:
    """Every diagonal, and the two triangles beside it."""
    return {tuple(sorted(edge["gate"])): (one, other) for one, other, edge in map_graph.graph.edges(data=True)}


def spread(map_graph: MapGraph, gate: Gate, radius_m: float) -> np.ndarray:
    """(m, 2) points on a gate at which a round robot can cross it, denser at its ends; none when it is too narrow."""
    first, last = limits(map_graph, gate, radius_m)
    if last < first:
        return np.empty((0, 2))
    width = _width(map_graph, gate)
    count = int(np.clip(np.ceil((last - first) * width / SPACING_M) + 1, 3, MOST_POINTS))
    ends = np.outer(NEAR_ENDS, [first, first])
    ends[:, 1] = 1 - ends[:, 1]
    shares = np.unique([*np.linspace(first, last, count), *ends[(first < ends) & (ends < last)]])
    return on_gate(map_graph, gate, shares)


def limits(map_graph: MapGraph, gate: Gate, radius_m: float) -> tuple[float, float]:
    """Where on a gate, 0 to 1, a robot can cross; the first is greater than the second when it cannot."""
    width = _width(map_graph, gate)
    if width < 2 * radius_m:
        return 1.0, 0.0
    inset = min(max(radius_m, INSET_M) / max(width, ROUNDING_M), 0.5)
    return inset, 1.0 - inset


def on_gate(map_graph: MapGraph, gate: Gate, shares: np.ndarray) -> np.ndarray:
    """(m, 2) points at (m,) shares of a gate, from its lower vertex."""
    a, b = (map_graph.vertices[vertex].xy for vertex in gate)
    return a + np.asarray(shares)[:, None] * (b - a)


def lattice(
    map_graph: MapGraph, start: np.ndarray, goal: np.ndarray, points_on: Mapping[Gate, np.ndarray], radius_m: float
) -> Lattice:
    """All crossings between the points on some gates, the start and the goal on which the robot does not touch a wall.

    points_on: (m, 2) of each gate that may be crossed, m.
    """
    points, gates = [np.asarray(start, float), np.asarray(goal, float)], [None, None]
    sides: dict[int, list[int]] = {}
    for k in (0, 1):
        sides.setdefault(map_graph.nearest_triangle(*points[k]), []).append(k)
    beside = gates_of(map_graph)
    for gate, places in points_on.items():
        for place in places:
            for triangle in beside[gate]:
                sides.setdefault(triangle, []).append(len(points))
            points.append(place)
            gates.append(gate)
    arcs = [
        (tail, head, triangle, _pivot(map_graph, triangle, gates[tail], gates[head], points[head]))
        for triangle, members in sides.items()
        for tail in members
        for head in members
        if tail != head and head != 0 and tail != 1 and (gates[tail] is None or gates[tail] != gates[head])
    ]
    places = np.array(points)
    tails, heads, triangles, pivots = np.array(arcs, int).reshape(-1, 4).T
    free = _free(map_graph, places[tails], places[heads], radius_m)
    return Lattice(places, gates, tails[free], heads[free], triangles[free], pivots[free])


def _pivot(map_graph: MapGraph, triangle: int, entry: Gate | None, exit_: Gate | None, end: np.ndarray) -> int:
    """The corner that two sides of a triangle share, or the one of those left nearest to the end."""
    choice = set(map_graph.triangles[triangle])
    for gate in (entry, exit_):
        choice = choice & set(gate) if gate is not None else choice
    return min(choice, key=lambda v: (float(np.hypot(*(map_graph.vertices[v].xy - end))), v))


def _free(map_graph: MapGraph, starts: np.ndarray, ends: np.ndarray, radius_m: float) -> np.ndarray:
    """(a,) whether a robot does not touch a wall between (a, 2) starts and ends."""
    lines = shapely.linestrings(np.stack([starts, ends], axis=1))
    inside = shapely.covers(map_graph.grown, lines)
    return inside & (shapely.distance(map_graph.wall_lines, lines) >= radius_m - ROUNDING_M)


def _width(map_graph: MapGraph, gate: Gate) -> float:
    return float(np.hypot(*(map_graph.vertices[gate[1]].xy - map_graph.vertices[gate[0]].xy)))
