"""How the team gets from the edge on which it stands to an open gate, over the triangles it has mapped.

The team stands on an edge (one robot at each end, or both at one vertex). One robot crosses a triangle to its
third vertex while the other stands, so contact is never lost.
"""

from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count

import numpy as np

from coopslam.exploration.free_map import FreeMap


@dataclass(frozen=True, slots=True)
class Crossing:
    """The robot at `start` goes to `end`; the one at `stander` watches."""

    start: int
    end: int
    stander: int


def route_to_gate(free_map: FreeMap, at: tuple[int, int], positions) -> tuple[list[Crossing], tuple[int, int]] | None:
    """The way with the fewest metres from the vertices where the team stands to any open gate (Dijkstra over edges).

    positions: vertex -> (2,) in metres.  None: no gate can be reached.
    """

    def metres(u, v):
        return float(np.hypot(*(positions(u) - positions(v))))

    order = count()
    start = _edge(*at)
    came: dict[tuple[int, int], tuple[tuple[int, int], Crossing] | None] = {start: None}
    cost = {start: 0.0}
    queue = [(0.0, next(order), start)]
    while queue:
        so_far, _, edge = heappop(queue)
        if so_far > cost[edge]:
            continue
        gate = _open_gate(free_map, edge)
        if gate is not None:
            return _unwind(came, edge), gate
        for crossing in _crossings(free_map, edge):
            after = _edge(crossing.end, crossing.stander)
            total = so_far + metres(crossing.start, crossing.end)
            if total < cost.get(after, np.inf):
                cost[after], came[after] = total, (edge, crossing)
                heappush(queue, (total, next(order), after))
    return None


def _crossings(free_map: FreeMap, edge: tuple[int, int]) -> list[Crossing]:
    u, v = edge
    if u == v:
        neighbours = {w for w in free_map.fans[u].spokes if w is not None}
        return [Crossing(u, w, u) for w in sorted(neighbours)]
    third = [next(w for w in free_map.triangles[t] if w not in edge) for t in free_map.triangles_at(u, v)]
    return [crossing for w in third for crossing in (Crossing(u, w, v), Crossing(v, w, u))]


def _open_gate(free_map: FreeMap, edge: tuple[int, int]) -> tuple[int, int] | None:
    u, v = edge
    return next((gate for gate in ((u, v), (v, u)) if gate in free_map.gates), None)


def _unwind(came, edge) -> list[Crossing]:
    crossings = []
    while came[edge] is not None:
        edge, crossing = came[edge]
        crossings.append(crossing)
    return crossings[::-1]


def _edge(u: int, v: int) -> tuple[int, int]:
    return (u, v) if u <= v else (v, u)
