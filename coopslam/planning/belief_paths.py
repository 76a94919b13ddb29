"""Paths by what a robot knows at the end of them: safest, widest, and the front of length against uncertainty.

Which way to take is decided on a lattice of crossings with labels that are covariances (`label_search`, which says
what is exact). The ways found are pulled straight within their channel of triangles, and judged anew with the whole
joint covariance of the map (`traversal.travel`), together with the shortest and the widest path: the best of them is
the answer. So it is never worse than those, and its covariances are those of the full model.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from coopslam.errors import require_between
from coopslam.planning.label_search import EPSILON, Label, search
from coopslam.planning.lattice import Gate, Lattice, gates_of, lattice, limits, on_gate, spread
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.shortest import ShortestPaths
from coopslam.planning.touching import touching_probability
from coopslam.planning.traversal import OnOdometry, TraversalModel, start_covariance, travel
from coopslam.planning.walk import SAME_M, walk_along

CANDIDATES = 4  # ways through different channels that are judged with the whole map
LONGEST_DETOUR = 2.0  # of the shortest path, where measurements might pay for any
ROUNDS = 4  # of pulling straight, each with points half as far apart
IN_LINE_M = 1e-3  # a bend that leaves the straight line by less is none
LARGEST_ROBOT_M = 100.0
WIDTH_TOLERANCE_M = 1e-3
LONGEST_LEAD = 2.0  # times the width, out of a corner


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A path over a map, and what a robot knows along it."""

    points: np.ndarray  # (k, 2) m; its bends, and stations between them
    bends: np.ndarray  # (b, 2) m; start, turns, goal
    triangles: Sequence[int]  # crossed, in turn
    length_m: float
    covariances: np.ndarray  # (k, 3, 3) of the robot's pose relative to the map around it, axes of the map
    clearance_m: float  # between the robot and the nearest wall
    touching_probability: float

    @property
    def final_sigma_m(self) -> float:
        """Square root of the trace of the position's covariance at the goal: expected distance from it, squared."""
        return float(np.sqrt(np.trace(self.covariances[-1][:2, :2])))


def route(map_graph: MapGraph, bends: np.ndarray, model: TraversalModel, robot_radius_m: float = 0.0) -> Route:
    """What a robot knows along a way through (b, 2) points, m.

    It starts with the doubt of one corner sighting relative to the map around it.  Raises BadInput where the way leaves
    the map, and when the map does not say how well the robot's sensors measure.
    """
    model.require(map_graph)
    bends = _straightened(np.asarray(bends, float))
    walk = walk_along(map_graph, bends, model.stops(map_graph, bends))
    start_cov = start_covariance(map_graph)
    trip = travel(map_graph, walk, model, start_cov)
    path = shapely.LineString(bends) if len(bends) > 1 else shapely.Point(bends[0])
    return Route(
        points=walk.points,
        bends=bends,
        triangles=[t for k, t in enumerate(walk.triangles) if k == 0 or t != walk.triangles[k - 1]],
        length_m=float(path.length),
        covariances=trip.covariances,
        clearance_m=float(map_graph.wall_lines.distance(path)) - robot_radius_m,
        touching_probability=touching_probability(map_graph, walk, model, start_cov, robot_radius_m),
    )


def shortest(map_graph: MapGraph, start, goal, model: TraversalModel, robot_radius_m: float = 0.0) -> Route:
    """The shortest path. start, goal: (2,) m.  Raises BadInput when the robot cannot be there; Unreachable."""
    return route(map_graph, _shortest(map_graph, start, goal, robot_radius_m), model, robot_radius_m)


def safest(map_graph: MapGraph, start, goal, model: TraversalModel, robot_radius_m: float = 0.0) -> Route:
    """The path with the least trace of the position's covariance at the goal. Arguments and errors as `shortest`."""
    model.require(map_graph)
    plan = _Plan(map_graph, start, goal, model, robot_radius_m)
    return plan.route(_safest(plan.judged(plan.candidates(with_length=False))))


def pareto(map_graph: MapGraph, start, goal, model: TraversalModel, robot_radius_m: float = 0.0) -> list[Route]:
    """Paths none of which is both shorter and better known at the goal than another; the shortest first.

    Arguments and errors as `shortest`, which is the first of them; `safest` is the last but for what it gives up for a
    shorter way.
    """
    model.require(map_graph)
    plan = _Plan(map_graph, start, goal, model, robot_radius_m)
    return [plan.route(way) for way in front(plan.judged(plan.candidates(with_length=True)))]


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A way, and what it costs."""

    bends: np.ndarray  # (b, 2) m
    length_m: float
    final_sigma_m: float  # as that of a route


def _safest(ways: Sequence[Judged]) -> Judged:
    least = min(way.final_sigma_m for way in ways)
    return min((way for way in ways if way.final_sigma_m <= (1 + EPSILON / 2) * least), key=lambda way: way.length_m)


def front(ways: Sequence[Judged]) -> list[Judged]:
    """Those that are better known at the goal, by a share EPSILON / 2, than every shorter one; the shortest first."""
    kept: list[Judged] = []
    for candidate in sorted(ways, key=lambda way: (way.length_m, way.final_sigma_m)):
        if not kept or candidate.final_sigma_m < (1 - EPSILON / 2) * kept[-1].final_sigma_m:
            kept.append(candidate)
    return kept


def widest(map_graph: MapGraph, start, goal, model: TraversalModel, robot_radius_m: float = 0.0) -> Route:
    """The path whose narrowest place, but near its two ends, is as wide as can be; the shortest of such paths.

    Exact but for a tolerance of 1 mm in the estimated map: the greatest radius w for which free space that is narrowed
    by it still joins the two ends. An end that is nearer than w to a wall is led straight to the nearest point that is
    not, no farther than 2 w, as out of a corner of 60 degrees or more. Arguments and errors as `shortest`.
    """
    model.require(map_graph)
    return route(map_graph, _widest(map_graph, start, goal, robot_radius_m), model, robot_radius_m)


def _widest(map_graph: MapGraph, start, goal, robot_radius_m: float) -> np.ndarray:
    bends = _shortest(map_graph, start, goal, robot_radius_m)
    if _length(bends) < SAME_M:
        return bends
    narrow, wide = robot_radius_m, float(np.sqrt(map_graph.polygon.area / np.pi))  # no wider disc fits in
    while wide - narrow > WIDTH_TOLERANCE_M:
        middle = (narrow + wide) / 2
        found = _through(map_graph, start, goal, middle, robot_radius_m)
        if found is None:
            wide = middle
        else:
            narrow, bends = middle, found
    return bends


class _Plan:
    """The ways between two places."""

    def __init__(self, map_graph: MapGraph, start, goal, model: TraversalModel, radius_m: float):
        self.map, self.model, self.radius_m = map_graph, model, radius_m
        self.shortest = _shortest(map_graph, start, goal, radius_m)
        self.start, self.goal = self.shortest[0], self.shortest[-1]
        self.measures = not isinstance(model, OnOdometry)
        self.longest_m = LONGEST_DETOUR * _length(self.shortest) if self.measures else np.inf
        self.ways = self._lattice({gate: spread(map_graph, gate, radius_m) for gate in gates_of(map_graph)})

    def candidates(self, with_length: bool) -> list[np.ndarray]:
        """What the safest path is chosen from, or with_length the front, as the search found it and pulled straight.

        With measurements the safest one is chosen from the front as well: whether a corner is surely within reach is a
        matter of where exactly the way runs, which the search does not know.
        """
        ways = [self.shortest, _widest(self.map, self.start, self.goal, self.radius_m)]
        for label in self.of_different_channels(self.search(with_length=False)):
            ways += [self.ways.points[label.way()], self.pulled(label, 0.0)]
        if with_length or self.measures:
            labels = sorted(self.search(with_length=True), key=lambda label: label.length_m)
            for label, weight in zip(labels, _slopes(labels), strict=True):
                ways += [self.ways.points[label.way()], self.pulled(label, weight)]
        return ways

    def judged(self, ways: Sequence[np.ndarray]) -> list[Judged]:
        """Their lengths and final uncertainties, by the whole joint covariance of the map."""
        found = []
        for way in ways:
            bends = _straightened(np.asarray(way, float))
            walk = walk_along(self.map, bends, self.model.stops(self.map, bends))
            cov = travel(self.map, walk, self.model, start_covariance(self.map)).covariances[-1]
            found.append(Judged(bends, _length(bends), float(np.sqrt(np.trace(cov[:2, :2])))))
        return found

    def route(self, way: Judged) -> Route:
        """All that is known along it."""
        return route(self.map, way.bends, self.model, self.radius_m)

    def search(self, with_length: bool) -> list[Label]:
        """The labels at the goal."""
        if _length(self.shortest) == 0.0:
            return []
        return self._search(self.ways, with_length, 0.0)

    def of_different_channels(self, labels: Sequence[Label]) -> list[Label]:
        """The first ones through different gates."""
        first: dict[tuple, Label] = {}
        for label in labels:
            first.setdefault(tuple(self.ways.gates[point] for point in label.way()), label)
        return list(first.values())[:CANDIDATES]

    def pulled(self, label: Label, weight_m2_per_m: float) -> np.ndarray:
        """(b, 2) the way of a label in its channel, on ever finer lattices around it."""
        gates = [self.ways.gates[point] for point in label.way()[1:-1]]
        bends = self.ways.points[label.way()]
        if not gates or len(set(gates)) < len(gates):
            return bends
        half = {gate: self._spacing(gate) for gate in gates}
        for _ in range(ROUNDS):
            shares = {gate: self._share(gate, place) for gate, place in zip(gates, bends[1:-1], strict=True)}
            near = {gate: self._around(gate, shares[gate], half[gate]) for gate in gates}
            finer = self._lattice(near)
            labels = self._search(finer, False, weight_m2_per_m)
            labels = [found for found in labels if [finer.gates[p] for p in found.way()[1:-1]] == gates]
            if not labels:
                break
            bends = finer.points[labels[0].way()]
            half = {gate: share / 2 for gate, share in half.items()}
        return bends

    def _lattice(self, points_on: dict[Gate, np.ndarray]) -> Lattice:
        return lattice(self.map, self.start, self.goal, points_on, self.radius_m)

    def _search(self, ways: Lattice, with_length: bool, weight: float) -> list[Label]:
        start_cov = start_covariance(self.map)
        return search(self.map, ways, self.model, start_cov, self.longest_m, with_length, weight)

    def _spacing(self, gate: Gate) -> float:
        """Share of a gate between two points of the lattice."""
        points = spread(self.map, gate, self.radius_m)
        first, last = limits(self.map, gate, self.radius_m)
        return (last - first) / max(len(points) - 1, 1)

    def _share(self, gate: Gate, place: np.ndarray) -> float:
        a, b = (self.map.vertices[vertex].xy for vertex in gate)
        return float((place - a) @ (b - a) / max((b - a) @ (b - a), 1e-12))

    def _around(self, gate: Gate, share: float, half: float) -> np.ndarray:
        first, last = limits(self.map, gate, self.radius_m)
        return on_gate(self.map, gate, np.unique(np.clip(share + half * np.linspace(-1, 1, 5), first, last)))


def _slopes(labels: Sequence[Label]) -> list[float]:
    """How much trace a metre more saves at each point of a front, m^2 per m; labels from short to long."""
    lengths, values = np.array([label.length_m for label in labels]), np.array([label.value for label in labels])
    if len(labels) < 2:
        return [0.0] * len(labels)
    slopes = -np.diff(values) / np.maximum(np.diff(lengths), 1e-9)
    return np.maximum(np.append(slopes, 0.0), 0.0).tolist()


def _through(map_graph: MapGraph, start, goal, width_m: float, radius_m: float) -> np.ndarray | None:
    """The shortest path that keeps so far from walls but near its two ends; None: there is no such path."""
    narrowed, whole = map_graph.polygon.buffer(-width_m), map_graph.polygon.buffer(-radius_m).buffer(1e-6)
    best = None
    for part in shapely.get_parts(narrowed):
        if part.is_empty:
            continue
        ends = [shapely.shortest_line(part, shapely.Point(place)) for place in (start, goal)]
        if any(line.length > LONGEST_LEAD * width_m for line in ends):
            continue
        if not all(line.length == 0.0 or whole.covers(line) for line in ends):
            continue
        first, last = (np.array(line.coords[0]) for line in ends)
        # the path runs in what is a hair wider, so that points on the border are inside
        middle = ShortestPaths(part.buffer(1e-6)).path(tuple(first), tuple(last))
        bends = np.vstack([[start], middle, [goal]])
        if best is None or _length(bends) < _length(best):
            best = bends
    return best


def _shortest(map_graph: MapGraph, start, goal, radius_m: float) -> np.ndarray:
    require_between(0.0, LARGEST_ROBOT_M, robot_radius_m=radius_m)
    return ShortestPaths(map_graph.polygon, radius_m).path(tuple(start), tuple(goal))


def _length(bends: np.ndarray) -> float:
    return float(np.hypot(*np.diff(bends, axis=0).T).sum())


def _straightened(bends: np.ndarray) -> np.ndarray:
    """Without repeated points, and without those that stand off the line between their neighbours by almost nothing."""
    kept = [bends[0]]
    for k in range(1, len(bends) - 1):
        line = shapely.LineString([kept[-1], bends[k + 1]])
        if line.distance(shapely.Point(bends[k])) > IN_LINE_M:
            kept.append(bends[k])
    return np.array([*kept, bends[-1]] if len(bends) > 1 else kept)
