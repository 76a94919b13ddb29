"""How the team gets from the edge on which it stands to the open gates, over the triangles it has mapped.

The team stands on an edge (one robot at each end, or both at one vertex). One robot crosses triangles while the other
stands, so contact is never lost: the triangles around the one that stands are star-shaped about it, and any straight
way inside of them is seen from there, however many of their edges it crosses.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from heapq import heappop, heappush
from math import hypot, inf, sin

import numpy as np

from coopslam.exploration.free_map import FreeMap

CLEARANCE_RAD = 0.05  # by which a way across several triangles passes the corners beyond it, seen from its start
CLEARANCE_M = 0.3  # and by which it passes them at least: the map is not exact
Positions = Callable[[int], np.ndarray]  # vertex -> (2,) m


@dataclass(frozen=True, slots=True)
class Crossing:
    """The robot at `start` goes to `end`; the one at `stander` watches."""

    start: int
    end: int
    stander: int


@dataclass(frozen=True, slots=True)
class GateOption:
    """An open gate to which the team can go: the way with the fewest metres, and when the gate was opened."""

    gate: tuple[int, int]
    crossings: tuple[Crossing, ...]
    metres: float
    opened: int  # the triangle that opened it; -1: the first wall


def reachable_gates(free_map: FreeMap, at: tuple[int, int], positions: Positions) -> Iterator[GateOption]:
    """The open gates, nearest first, from the vertices where the team stands; searched as far as they are asked for."""
    for edge, metres, came in _reachable_edges(free_map, at, positions):
        for gate in (edge, edge[::-1]):
            if gate in free_map.gates:
                triangle = free_map.gates[gate]
                yield GateOption(gate, _unwind(came, edge), metres, -1 if triangle is None else triangle)


def way_to_edge(
    free_map: FreeMap, at: tuple[int, int], positions: Positions, is_goal: Callable[[int, int], bool]
) -> tuple[Crossing, ...] | None:
    """The way with the fewest metres to a pair of vertices of the right kind; None: there is none."""
    for edge, _, came in _reachable_edges(free_map, at, positions):
        if is_goal(*edge):
            return _unwind(came, edge)
    return None


Came = dict[tuple[int, int], tuple[tuple[int, int], Crossing] | None]  # edge -> the one before, and how it went on


def _reachable_edges(
    free_map: FreeMap, at: tuple[int, int], positions: Positions
) -> Iterator[tuple[tuple[int, int], float, Came]]:
    """Pairs of vertices on which the team can stand, how many metres away they are, and how it got there so far.

    One Dijkstra search over the edges of the map; of ways of equal length the one over the smaller edges.
    """
    places = _Places(positions)
    start = _edge(*at)
    came: Came = {start: None}
    cost = {start: 0.0}
    queue = [(0.0, start)]
    while queue:
        so_far, edge = heappop(queue)
        if so_far > cost[edge]:
            continue
        yield edge, so_far, came
        for crossing in crossings_from(free_map, edge, places.__getitem__):
            after = _edge(crossing.end, crossing.stander)
            total = so_far + places.metres(crossing.start, crossing.end)
            if total < cost.get(after, inf):
                cost[after], came[after] = total, (edge, crossing)
                heappush(queue, (total, after))


def crossings_from(free_map: FreeMap, edge: tuple[int, int], positions: Positions) -> list[Crossing]:
    """What one robot can do while the other stands: go to a vertex that has an edge to the one that stands, or to it.

    It goes by way of the other one where the straight way would brush past it.
    """
    u, v = edge
    if u == v:
        return [Crossing(u, w, u) for w in sorted({w for w in free_map.fans[u].spokes if w is not None})]
    across = [
        Crossing(start, end, stander)
        for start, stander in ((u, v), (v, u))
        for turn in (1, -1)
        for end in _around(free_map, start, stander, turn, positions)
    ]
    return [*across, Crossing(u, v, v), Crossing(v, u, u)]


def _around(free_map: FreeMap, start: int, stander: int, turn: int, positions: Positions) -> Iterator[int]:
    """Ends of straight ways about a standing robot, counter-clockwise (turn 1) or clockwise (-1), over free triangles.

    The vertices passed must lie beyond the way, the standing robot on this side of it, all clear of it.
    """
    fan = free_map.fans[stander]
    for k in (k for k, spoke in enumerate(fan.spokes) if spoke == start):
        x, y = positions(start)
        passed: list[tuple[float, float]] = []
        while True:
            sector = k if turn == 1 else k - 1
            if not 0 <= sector < len(fan.sectors) or fan.sectors[sector] is None:
                break
            k += turn
            end = positions(fan.spokes[k])
            way = (end[0] - x, end[1] - y)
            to_stander = (positions(stander)[0] - x, positions(stander)[1] - y)
            clear = _is_clear(to_stander, way, -turn)
            if passed and not clear:
                break  # further on, half a turn about the standing robot is full
            beside = 0 < way[0] * to_stander[0] + way[1] * to_stander[1] < hypot(*way) ** 2
            if (clear or not beside) and fan.spokes[k] != start and all(_is_clear(c, way, turn) for c in passed):
                yield fan.spokes[k]
            passed.append(way)


def _is_clear(corner: tuple[float, float], way: tuple[float, float], turn: int) -> bool:
    """Whether a corner lies far enough beside a way (to its right with turn 1), both seen from its start, m."""
    least = max(sin(CLEARANCE_RAD) * hypot(*corner), CLEARANCE_M)
    return turn * _cross(corner, way) > least * hypot(*way)


class _Places(dict):
    """Positions, asked for once."""

    def __init__(self, positions: Positions):
        self._positions = positions

    def __missing__(self, vertex: int) -> tuple[float, float]:
        x, y = self._positions(vertex)
        self[vertex] = float(x), float(y)
        return self[vertex]

    def metres(self, u: int, v: int) -> float:
        """Distance of two vertices."""
        return hypot(self[u][0] - self[v][0], self[u][1] - self[v][1])


def _unwind(came, edge) -> tuple[Crossing, ...]:
    crossings = []
    while came[edge] is not None:
        edge, crossing = came[edge]
        crossings.append(crossing)
    return tuple(crossings[::-1])


def _cross(u: tuple[float, float], v: tuple[float, float]) -> float:
    return u[0] * v[1] - u[1] * v[0]


def _edge(u: int, v: int) -> tuple[int, int]:
    return (u, v) if u <= v else (v, u)
