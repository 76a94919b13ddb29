"""Belief propagation over the ways through a map: search with labels that are covariances.

Every covariance is written down as what it will be at the goal: an error of pose carried there, the map held fixed. In
these axes a drive without error changes nothing, odometry adds a matrix that depends on nothing but where it was
driven, P -> P + Q, and a measurement adds another to the inverse, P -> (P^-1 + L)^-1; a corner is counted on only
where P is small enough to be sure of it, and then it is for every smaller one. All keep the Loewner order (P <= P'
when P' - P has no negative eigenvalue): who is better by it stays better, whatever comes. Errors are those of first
order, drift included; the ways found are judged without that (`traversal.travel`). So:

* On odometry alone the trace of the position's covariance at the goal is a sum of costs of zero or more along the way.
  Labels are settled in the order of that number, as in Dijkstra (1959): exact among the ways offered.
* With measurements the trace may fall, and who has the greater one here may have the smaller one there. Labels are
  kept unless another is not worse in the Loewner order (Pareto labels, as in Martins, 1984), and corrected until none
  is left. A label must be better by a share EPSILON in some direction to be kept, and there are at most MOST_LABELS at
  one point; and as looking at the same corners again and again would pay for ever, a way crosses no gate twice and is
  at most `longest_m` long. So this is no proof of the best way, but a good one, for a map held fixed.
* With the length as second criterion the same holds for pairs, with EPSILON in both models, so that the front does not
  hold a thousand ways that are all but the same.

A turn depends on how the point was reached. A label is therefore dropped for another only if that one is still not
worse after it has turned to the direction in which this one came: then it can follow it anywhere.
"""

from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count

import numpy as np

from coopslam.planning.lattice import Lattice
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.sensor_laws import OdometryLaw
from coopslam.planning.travel_belief import carried, leg_covariance
from coopslam.planning.traversal import SURE_SIGMAS, OnOdometry, TraversalModel
from coopslam.se2 import largest_sigma, wrap

MOST_LABELS = 8  # at one point
EPSILON = 0.01  # of length and of covariance
START, GOAL = 0, 1
NOT_WORSE = 1e-12  # rounding, of the trace


@dataclass(frozen=True, slots=True, eq=False)
class Label:
    """One way to a point."""

    point: int
    length_m: float
    heading_rad: float | None  # in which it arrives; None: at the start
    cov: np.ndarray  # (3, 3) at the goal
    gates: int  # crossed so far, a bit each
    parent: "Label | None"

    @property
    def value(self) -> float:
        """Trace of the position's covariance at the goal, m^2."""
        return float(self.cov[0, 0] + self.cov[1, 1])

    def way(self) -> list[int]:
        """The points passed, the start first."""
        points, label = [], self
        while label is not None:
            points.append(label.point)
            label = label.parent
        return points[::-1]


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """Part of an arc that ends with a measurement; all at the goal."""

    noise: np.ndarray  # (3, 3) of odometry since the last one
    information: np.ndarray  # (3, 3) that it brings
    here: np.ndarray  # (2, 3) by which an error of pose at the goal is one of place here
    room_m: float  # by how much the robot may be elsewhere

    def is_sure(self, cov: np.ndarray) -> bool:
        """Whether a robot with a (3, 3) covariance gets the measurement: less uncertain ones do, too."""
        return self.room_m == np.inf or SURE_SIGMAS * largest_sigma(self.here @ cov @ self.here.T) <= self.room_m


class Costs:
    """What the arcs of a lattice do to a label."""

    def __init__(self, map_graph: MapGraph, ways: Lattice, model: TraversalModel):
        self.goal, starts, ends = ways.points[GOAL], ways.points[ways.tails], ways.points[ways.heads]
        goal = self.goal
        laws = {triangle: map_graph.odometry_law(triangle) for triangle in set(ways.triangles.tolist())}
        self.lengths = np.hypot(*ways.ways.T)
        self.ahead = np.hypot(*(goal - ends).T)  # at least that far from the goal
        self.headings = np.arctan2(ways.ways[:, 1], ways.ways[:, 0])
        self.per_rad = np.array([laws[t].heading_sigma_per_rad ** 2 for t in ways.triangles.tolist()])
        # the error at the goal of a heading error of one radian at each point
        self.levers = carried(goal - ways.points)[:, :, 2]
        self.worst_per_rad = np.zeros(len(ways.points))
        np.maximum.at(self.worst_per_rad, ways.tails, self.per_rad)
        # of each arc: what is measured on it in turn, and the odometry noise of the rest
        self.stages: list[list[Stage]] = []
        self.noise = np.empty((len(ways.tails), 3, 3))
        arcs = zip(ways.triangles.tolist(), starts, ends, ways.pivots.tolist(), strict=True)
        for arc, (triangle, start, end, pivot) in enumerate(arcs):
            stages, at = [], start
            for fix in model.fixes(map_graph, triangle, start, end, pivot):
                place = start + fix.along * (end - start)
                back = carried(fix.at - goal)
                information = back.T @ np.linalg.solve(fix.cov, back)
                noise = self._noise(at, place, laws[triangle])
                stages.append(Stage(noise, information, carried(place - goal)[:2], fix.room_m))
                at = place
            self.noise[arc] = self._noise(at, end, laws[triangle])
            self.stages.append(stages)
        self.measured = np.array([bool(stages) for stages in self.stages])

    def _noise(self, start: np.ndarray, end: np.ndarray, law: OdometryLaw) -> np.ndarray:
        """(3, 3) what odometry adds on a stretch, at the goal."""
        carry = carried(self.goal - end)
        return carry @ leg_covariance(end - start, law) @ carry.T

    def along(self, label: Label, arcs: np.ndarray) -> np.ndarray:
        """(m, 3, 3) covariances after a turn and a drive along each of m arcs from where the label is."""
        cov = np.tile(label.cov, (len(arcs), 1, 1))
        if label.heading_rad is not None:
            lever = self.levers[label.point]
            turns = self.per_rad[arcs] * np.abs(wrap(self.headings[arcs] - label.heading_rad))
            cov += turns[:, None, None] * np.outer(lever, lever)
        for k in np.flatnonzero(self.measured[arcs]):
            for stage in self.stages[arcs[k]]:
                cov[k] += stage.noise
                if not stage.is_sure(cov[k]):
                    continue
                # (P^-1 + L)^-1 without inverting P, which may be singular
                cov[k] = np.linalg.solve(np.eye(3) + cov[k] @ stage.information, cov[k])
                cov[k] = (cov[k] + cov[k].T) / 2
        return cov + self.noise[arcs]

    def turned(self, one: Label, other: Label) -> np.ndarray:
        """(3, 3) the covariance of one label after it has turned to the direction of another at the same point."""
        if one.heading_rad is None or other.heading_rad is None:
            return one.cov
        lever = self.levers[one.point]
        angle = abs(float(wrap(one.heading_rad - other.heading_rad)))
        return one.cov + self.worst_per_rad[one.point] * angle * np.outer(lever, lever)


def search(
    map_graph: MapGraph,
    ways: Lattice,
    model: TraversalModel,
    start_cov: np.ndarray,
    longest_m: float = np.inf,
    with_length: bool = False,
    weight_m2_per_m: float = 0.0,
) -> list[Label]:
    """The labels that arrive at the goal and are not worse than another, the one of least cost first.

    start_cov: (3, 3) at the start, axes of the map.  with_length: a shorter way is of use, too.  weight: of length in
    the cost, trace + weight * length; the trace alone without.
    """
    costs, additive = Costs(map_graph, ways, model), isinstance(model, OnOdometry)
    order = _Order(costs, additive, with_length, weight_m2_per_m)
    carry = carried(ways.points[GOAL] - ways.points[START])
    first = Label(START, 0.0, None, carry @ start_cov @ carry.T, 0, None)
    bits = {gate: 1 << k for k, gate in enumerate(dict.fromkeys(ways.gates)) if gate is not None}
    bit = [bits.get(gate, 0) for gate in ways.gates]
    number = count()
    kept: dict[int, list[Label]] = {START: [first]}
    queue = [(order.rank(first), next(number), first)]
    while queue:
        _, _, label = heappop(queue)
        if not any(label is other for other in kept[label.point]):
            continue  # dropped for a better one meanwhile
        if label.point == GOAL:
            if additive and not with_length:
                break
            continue
        arcs = ways.leaving[label.point]
        arcs = arcs[label.length_m + costs.lengths[arcs] + costs.ahead[arcs] <= longest_m + NOT_WORSE]
        for arc, cov in zip(arcs.tolist(), costs.along(label, arcs), strict=True):
            point = int(ways.heads[arc])
            if label.gates & bit[point]:
                continue
            length = label.length_m + float(costs.lengths[arc])
            heading = float(costs.headings[arc]) if costs.lengths[arc] > NOT_WORSE else label.heading_rad
            new = Label(point, length, heading, cov, label.gates | bit[point], label)
            if additive and order.beaten(new, kept.get(GOAL, [])):
                continue
            if order.keep(new, kept.setdefault(point, [])):
                heappush(queue, (order.rank(new), next(number), new))
    return sorted(kept.get(GOAL, []), key=order.cost)


class _Order:
    """Which of two labels is of no use."""

    def __init__(self, costs: Costs, additive: bool, with_length: bool, weight_m2_per_m: float):
        self.costs, self.additive, self.with_length, self.weight = costs, additive, with_length, weight_m2_per_m

    def cost(self, label: Label) -> float:
        """What is to be least at the goal."""
        return label.value + self.weight * label.length_m

    def rank(self, label: Label) -> float:
        """The less, the earlier it is looked at: with measurements the shorter, which a longer one then has to beat."""
        return self.cost(label) if self.additive else label.length_m

    def keep(self, new: Label, others: list[Label]) -> bool:
        """Add a label to those of its point, and drop what is worse than it; False when it is worse than another."""
        if any(self.not_worse(other, new) for other in others):
            return False
        others[:] = [other for other in others if not self.not_worse(new, other)]
        others.append(new)
        if len(others) > MOST_LABELS and new.point != GOAL:
            worst = max(others, key=self.cost)
            others[:] = [other for other in others if other is not worst]
            return worst is not new
        return True

    def not_worse(self, one: Label, other: Label) -> bool:
        """Whether one label at a point, even after turning as the other stands, makes the other useless."""
        room = 1.0 + (EPSILON if self.with_length or not self.additive else 0.0)
        if (self.with_length or (self.weight and not self.additive)) and one.length_m > room * other.length_m:
            return False
        if self.additive:
            weight = 0.0 if self.with_length else self.weight
            cov = self.costs.turned(one, other)
            cost = float(cov[0, 0] + cov[1, 1]) + weight * one.length_m
            return cost <= room * (other.value + weight * other.length_m)
        if one.point == GOAL:
            return one.value <= room * other.value
        if one.value > room * other.value:
            return False
        return _not_negative(room * other.cov - self.costs.turned(one, other), NOT_WORSE * other.value)

    def beaten(self, new: Label, arrived: list[Label]) -> bool:
        """Whether a label is worse than one that has arrived already, wherever it goes: costs only grow."""
        for label in arrived:
            if self.with_length:
                if label.length_m <= new.length_m and label.value <= new.value:
                    return True
            elif self.cost(label) <= self.cost(new):
                return True
        return False


def _not_negative(matrix: np.ndarray, slack: float) -> bool:
    """Whether a symmetric (3, 3) matrix has no eigenvalue below -slack: by its leading minors (Sylvester)."""
    (a, b, c), (_, d, e), (_, _, f) = matrix.tolist()
    a, d, f = a + slack, d + slack, f + slack
    return a >= 0 and a * d - b * b >= 0 and a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d) >= 0
