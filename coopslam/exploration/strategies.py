"""Which waiting gate next: variants with one method, chosen once by name.

All of them see the open gates nearest first, and how far each is. A gate that bounds the edge on which the team stands
is 0 m away.
"""

from collections.abc import Iterator
from itertools import islice
from typing import Literal, Protocol

import numpy as np

from coopslam.exploration.chart import Chart
from coopslam.exploration.travel import GateOption, reachable_gates

StrategyName = Literal["nearest", "depth-first", "least-uncertain", "loop-closing", "regret"]


class Strategy(Protocol):
    """Chooses one of the gates that can be reached; must be deterministic."""

    def choose(self, options: Iterator[GateOption], chart: Chart) -> GateOption | None:
        """options: nearest first, searched as far as they are asked for. None: there is none."""


class Nearest:
    """The fewest metres away."""

    def choose(self, options: Iterator[GateOption], chart: Chart) -> GateOption | None:
        return next(options, None)


class DepthFirst:
    """Opened last; of two that one triangle opened, the nearer."""

    def choose(self, options: Iterator[GateOption], chart: Chart) -> GateOption | None:
        return max(options, key=lambda option: (option.opened, -option.metres), default=None)


class LeastUncertain:
    """The gate whose worse known end is known best, relative to the start; of equally good ones the nearer."""

    def choose(self, options: Iterator[GateOption], chart: Chart) -> GateOption | None:
        known: dict[int, float] = {}

        def sigma_m(option: GateOption) -> float:
            for vertex in option.gate:
                if vertex not in known:
                    known[vertex] = chart.estimate.vertex_belief(vertex).position_sigma_m
            return max(known[vertex] for vertex in option.gate)

        return min(options, key=lambda option: (sigma_m(option), option.metres), default=None)


class LoopClosing:
    """One of two gates that face each other over a short unexplored gap, with a long way between them on the map.

    The gap joins the middles of the gates and lies on the unexplored side of both. Without such a pair: the nearest.
    """

    def __init__(self, detour: float = 3.0, pairs: int = 5):
        """detour: how many times longer than the gap the way on the map is at least.  pairs: looked at, at most."""
        self.detour, self.pairs = detour, pairs

    def choose(self, options: Iterator[GateOption], chart: Chart) -> GateOption | None:
        first = next(options, None)
        if first is None:
            return None
        waiting = [first, *options]
        for gap_m, one, other in islice(_facing(waiting, chart), self.pairs):
            start, end = waiting[one], waiting[other]
            ways = reachable_gates(chart.free_map, start.gate, chart.position)
            around_m = next((way.metres for way in ways if way.gate == end.gate), np.inf)
            if around_m >= self.detour * gap_m:
                return start  # it is the nearer one
        return first


class Regret:
    """Near, but of gates about equally near the loneliest: the one that would be the dearest to come back to.

    The cost of a gate is the metres to it less a share of the metres from it to the nearest other one.
    """

    def __init__(self, share: float = 0.3):
        self.share = share

    def choose(self, options: Iterator[GateOption], chart: Chart) -> GateOption | None:
        """Asks for no gate that cannot win: from it to the nearest one it is no farther than by way of the team."""
        best = next(options, None)
        if best is None or best.metres == 0.0:
            return best
        nearest_m, best_cost = best.metres, self._cost(best, chart)
        for option in options:
            if option.metres - self.share * (option.metres + nearest_m) >= best_cost:
                break
            cost = self._cost(option, chart)
            if cost < best_cost:
                best, best_cost = option, cost
        return best

    def _cost(self, option: GateOption, chart: Chart) -> float:
        ways = reachable_gates(chart.free_map, option.gate, chart.position)
        others = (way.metres for way in ways if way.gate != option.gate)
        return option.metres - self.share * next(others, 0.0)


STRATEGIES: dict[StrategyName, type[Strategy]] = {
    "nearest": Nearest,
    "depth-first": DepthFirst,
    "least-uncertain": LeastUncertain,
    "loop-closing": LoopClosing,
    "regret": Regret,
}


def _facing(waiting: list[GateOption], chart: Chart) -> Iterator[tuple[float, int, int]]:
    """(gap in m, index, index) of pairs of gates that face each other and share no vertex, the shortest gap first."""
    ends = np.array([[chart.position(vertex) for vertex in option.gate] for option in waiting])
    middles, along = ends.mean(axis=1), ends[:, 1] - ends[:, 0]
    gaps = middles[None] - middles[:, None]  # [i, j]: from gate i to gate j
    ahead = along[:, None, 0] * gaps[..., 1] - along[:, None, 1] * gaps[..., 0] > 0  # on the left: unexplored
    one, other = np.nonzero(np.triu(ahead & ahead.T, 1))
    metres = np.hypot(*gaps[one, other].T)
    for k in np.argsort(metres, kind="stable"):
        if not set(waiting[one[k]].gate) & set(waiting[other[k]].gate):
            yield float(metres[k]), int(one[k]), int(other[k])
