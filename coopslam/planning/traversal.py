"""Traversal models: what becomes of a robot's belief while it crosses the triangles of a map.

On odometry it only loses: the error that was recorded in each triangle adds up. With its corner finder it sees each
corner that it passes so near that it is surely within reach, for all that is uncertain of its own place. Escorted, it
is watched by a partner that stands in a corner of the triangle that is crossed, between the side of entry and the side
of exit, and that goes on to the next such corner in turn.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import shapely

from coopslam.errors import BadInput, require_positive
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.sensor_laws import SightingLaw
from coopslam.planning.travel_belief import TravelBelief, carried
from coopslam.planning.walk import SAME_M, Stop, Walk, left_astray, nearest_on_segment
from coopslam.se2 import largest_sigma, planar_rotation, wrap

NO_HEADING_RAD = 1e3  # sigma of what is not measured
# Of a place that must still be within reach of a sensor that is counted on. Who misses a look keeps its error, maybe 40
# times what the look would have left of it: at 4.5 sigmas (3e-6) that adds less than 1 % to the mean square.
SURE_SIGMAS = 4.5
MODELS = ("odometry", "corners", "escorted")


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A measurement of the whole pose of a robot, relative to the map held fixed."""

    along: float  # where on the crossing, 0 to 1
    at: np.ndarray  # (2,) m; the robot's error, carried to here, is what is measured
    cov: np.ndarray  # (3, 3) axes of the map
    room_m: float = np.inf  # by how much the robot may be elsewhere and still be within reach


class TraversalModel(Protocol):
    """How a robot keeps track of itself."""

    def require(self, map_graph: MapGraph) -> None:
        """Raises BadInput when the map does not say how well the robot's sensors measure."""

    def stops(self, map_graph: MapGraph, points: np.ndarray) -> list[Stop]:
        """Where on a way through (k, 2) points something is sensed."""

    def sense(self, belief: TravelBelief, walk: Walk, station: int) -> list[int]:
        """What the robots sense at a station, before the robot goes on; the corners that the robot sees."""

    def fixes(self, map_graph: MapGraph, triangle: int, start: np.ndarray, end: np.ndarray, pivot: int) -> list[Fix]:
        """What is measured on a straight crossing of a triangle, in turn, for a search that holds the map fixed.

        start, end: (2,) m.  pivot: the corner between the sides of entry and exit.
        """


@dataclass(frozen=True, slots=True)
class OnOdometry:
    """Nothing but odometry."""

    def require(self, map_graph: MapGraph) -> None:
        _require_odometry(map_graph)

    def stops(self, map_graph: MapGraph, points: np.ndarray) -> list[Stop]:
        return []

    def sense(self, belief: TravelBelief, walk: Walk, station: int) -> list[int]:
        return []

    def fixes(self, map_graph: MapGraph, triangle: int, start: np.ndarray, end: np.ndarray, pivot: int) -> list[Fix]:
        return []


@dataclass(frozen=True, slots=True)
class WithCorners:
    """Odometry, and one look at each corner while the robot passes it, from the nearest point of its way.

    A look is counted on only if the corner is within reach for SURE_SIGMAS of all that is uncertain; what might be seen
    by good luck does not count.
    """

    reach_m: float = 0.5  # of the finder

    def __post_init__(self):
        require_positive(reach_m=self.reach_m)

    def require(self, map_graph: MapGraph) -> None:
        _require_odometry(map_graph)
        finder(map_graph)

    def stops(self, map_graph: MapGraph, points: np.ndarray) -> list[Stop]:
        ids, places = list(map_graph.vertices), np.array([vertex.xy for vertex in map_graph.vertices.values()])
        passing: dict[int, tuple[float, Stop]] = {}  # corner within reach since some leg -> nearest look so far
        found: list[Stop] = []
        for leg, (start, end) in enumerate(zip(points[:-1], points[1:], strict=True)):
            along, apart = nearest_on_segment(start, end, places)
            near = np.flatnonzero(apart <= self.reach_m)
            near = near[_seen(map_graph, start + along[near, None] * (end - start), places[near])]
            for k in near.tolist():
                look = float(apart[k]), Stop(leg, float(along[k]), ids[k])
                passing[k] = min(passing.get(k, look), look, key=lambda one: one[0])
            gone = [k for k in passing if np.hypot(*(places[k] - end)) > self.reach_m]
            found += [passing.pop(k)[1] for k in gone]
        return [*found, *(stop for _, stop in passing.values())]

    def sense(self, belief: TravelBelief, walk: Walk, station: int) -> list[int]:
        seen = []
        for vertex in walk.stops.get(station, ()):
            range_m = float(np.hypot(*(belief.map.vertices[vertex].xy - belief.at)))
            cov = belief.true_place_covariance(belief.vertex_rows(vertex))
            if range_m + SURE_SIGMAS * largest_sigma(cov) <= self.reach_m:
                belief.sight_corner(vertex, finder(belief.map))
                seen.append(vertex)
        return seen

    def fixes(self, map_graph: MapGraph, triangle: int, start: np.ndarray, end: np.ndarray, pivot: int) -> list[Fix]:
        corners = map_graph.corners[triangle]
        along, apart = nearest_on_segment(start, end, corners)
        found = []
        for corner, t, range_m in zip(corners, along.tolist(), apart.tolist(), strict=True):
            if t > 0.0 and range_m <= self.reach_m:
                turn = planar_rotation(np.arctan2(*(corner - start - t * (end - start))[::-1]))
                cov = turn @ finder(map_graph).line_covariance(range_m) @ turn.T
                found.append(Fix(t, corner, cov, self.reach_m - range_m))
        return sorted(found, key=lambda fix: fix.along)


@dataclass(frozen=True, slots=True)
class Escorted:
    """Odometry, and a partner that looks at the robot after every metre, when it leaves a triangle, and at its goal."""

    watch_every_m: float = 1.0

    def __post_init__(self):
        require_positive(watch_every_m=self.watch_every_m)

    def require(self, map_graph: MapGraph) -> None:
        _require_odometry(map_graph)
        finder(map_graph)
        tracker(map_graph)

    def stops(self, map_graph: MapGraph, points: np.ndarray) -> list[Stop]:
        return []

    def sense(self, belief: TravelBelief, walk: Walk, station: int) -> list[int]:
        if station and self.watches(walk, station):
            belief.watch_robot(pivot(belief.map, walk, station - 1), tracker(belief.map))
        if self.moves(belief.map, walk, station):
            belief.stand_partner(pivot(belief.map, walk, station), finder(belief.map))
        return []

    def watches(self, walk: Walk, station: int) -> bool:
        """Whether the partner looks at the robot when it comes to a station."""
        if station == walk.last or walk.triangles[station] != walk.triangles[station - 1]:
            return True
        before, here = walk.driven_m[station - 1 : station + 1] / self.watch_every_m
        return bool(np.floor(here + SAME_M) > np.floor(before + SAME_M))

    def moves(self, map_graph: MapGraph, walk: Walk, station: int) -> bool:
        """Whether the partner takes up another stand there."""
        if station == walk.last:
            return False
        return station == 0 or pivot(map_graph, walk, station) != pivot(map_graph, walk, station - 1)

    def fixes(self, map_graph: MapGraph, triangle: int, start: np.ndarray, end: np.ndarray, pivot: int) -> list[Fix]:
        law, count = tracker(map_graph), max(int(np.hypot(*(end - start)) / self.watch_every_m), 1)
        heading = NO_HEADING_RAD if law.heading_sigma_rad is None else law.heading_sigma_rad
        found = []
        for along in np.arange(1, count + 1) / count:
            place = start + along * (end - start)
            way = place - map_graph.vertices[pivot].xy
            carry, turn = carried(way), planar_rotation(np.arctan2(way[1], way[0]))
            seen = turn @ np.diag([*law.line_variances(float(np.hypot(*way))), heading**2]) @ turn.T
            found.append(Fix(float(along), place, carry @ finder(map_graph).line_covariance(0.0) @ carry.T + seen))
        return found


def model_named(name: str) -> TraversalModel:
    """One of MODELS with its default settings. Raises BadInput."""
    models = dict(zip(MODELS, (OnOdometry, WithCorners, Escorted), strict=True))
    if name not in models:
        raise BadInput(f"model: one of {', '.join(MODELS)} expected, got {name}")
    return models[name]()


def finder(map_graph: MapGraph) -> SightingLaw:
    """How well corners are seen. Raises BadInput when the map does not say."""
    law = map_graph.laws.finder
    if law is None or law.heading_sigma_rad is None:
        raise BadInput("graph.sensors.finder: the map does not say how well the robots see corners")
    return law


def tracker(map_graph: MapGraph) -> SightingLaw:
    """How well robots see each other. Raises BadInput when the map does not say."""
    if map_graph.laws.tracker is None:
        raise BadInput("graph.sensors.tracker: the map does not say how well the robots see each other")
    return map_graph.laws.tracker


def pivot(map_graph: MapGraph, walk: Walk, stretch: int) -> int:
    """Where a partner stands while a stretch is driven: the corner that the sides of entry and exit share.

    In the first triangle a corner of the exit that serves for the next one too, in the last one the nearest corner of
    the entry; where there is neither, the nearest corner.
    """
    here = walk.triangles[stretch]
    first, last = stretch, stretch
    while first > 0 and walk.triangles[first - 1] == here:
        first -= 1
    while last + 2 <= walk.last and walk.triangles[last + 1] == here:
        last += 1
    choice = set(map_graph.triangles[here])
    for beyond in (first - 1, last + 1):
        if 0 <= beyond < walk.last:
            shared = choice & set(map_graph.triangles[walk.triangles[beyond]])
            choice = shared or choice
    end = walk.points[last + 1]
    return min(choice, key=lambda v: (float(np.hypot(*(map_graph.vertices[v].xy - end))), v))


@dataclass(frozen=True, slots=True, eq=False)
class Travel:
    """What a robot knows on its way."""

    walk: Walk
    arriving: np.ndarray  # (k, 3, 3) at the stations, of its pose relative to the map around it; axes of the map
    covariances: np.ndarray  # (k, 3, 3) the same after it has sensed there
    off_way: np.ndarray  # (k, 2, 2) on arrival, of its true place less where the way has it, likewise
    looks: Mapping[int, Sequence[int]]  # station -> corners that it surely sees there
    belief: TravelBelief  # at the end
    arrivals: Sequence[int]  # k, how many steps of the belief lie behind it when it arrives, before it senses there


def travel(
    map_graph: MapGraph, walk: Walk, model: TraversalModel, start_cov: np.ndarray, extra: Sequence[int] = ()
) -> Travel:
    """Belief propagation along a way, jointly with the map.

    start_cov: (3, 3) of the robot's pose relative to the map around its start, axes of the map.  extra: vertices that
    the belief holds besides those of the triangles on the way.
    """
    crossed = {vertex for triangle in {walk.home, *walk.triangles} for vertex in map_graph.triangles[triangle]}
    seen = {vertex for vertices in walk.stops.values() for vertex in vertices}
    belief = TravelBelief(map_graph, sorted(crossed | seen | set(extra)), walk.points[0], walk.triangle(0), start_cov)
    arrivals, arriving, heading = [len(belief.steps)], [belief.relative_covariance(walk.home)], None
    off_way, looks = (
        [belief.true_place_covariance(belief.around(belief.at, walk.home))],
        {0: model.sense(belief, walk, 0)},
    )
    covs, steered = [belief.relative_covariance(walk.home)], left_astray(walk)
    for k, triangle in enumerate(walk.triangles):
        law, way = map_graph.odometry_law(triangle), walk.points[k + 1] - walk.points[k]
        ahead = float(np.arctan2(way[1], way[0]))
        if heading is not None:
            belief.turn(float(wrap(ahead - heading)), law)
        belief.drive(walk.points[k + 1], law)
        belief.steer_back(float(steered[k]))
        arrivals.append(len(belief.steps))
        arriving.append(belief.relative_covariance(triangle))
        off_way.append(belief.true_place_covariance(belief.around(belief.at, triangle)))
        looks[k + 1] = model.sense(belief, walk, k + 1)
        covs.append(belief.relative_covariance(triangle))
        heading = ahead
    looks = {station: seen for station, seen in looks.items() if seen}
    return Travel(walk, np.array(arriving), np.array(covs), np.array(off_way), looks, belief, arrivals)


def start_covariance(map_graph: MapGraph) -> np.ndarray:
    """(3, 3) of a robot that has just seen a corner: it starts with that much doubt, relative to the map around it."""
    law = map_graph.laws.finder
    return np.zeros((3, 3)) if law is None or law.heading_sigma_rad is None else law.line_covariance(0.0)


def _require_odometry(map_graph: MapGraph) -> None:
    if map_graph.laws.odometry is None:
        raise BadInput("graph.sensors.odometry: the map does not say how well the robots drive")


def _seen(map_graph: MapGraph, eyes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n,) whether nothing stands between (n, 2) places and (n, 2) corners; what touches the line does not hide."""
    lines = shapely.linestrings(np.stack([eyes, corners], axis=1))
    return shapely.covers(map_graph.grown, lines)
