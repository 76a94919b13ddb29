"""How likely a robot touches a wall on its way, for all that is uncertain: its own place, and where the walls are.

The robot steers by what it believes, so it strays from its way by its error; what a measurement puts right in its
belief it is off its way until it has steered back to the end of its leg. Whole ways of errors are drawn from the
very steps by which the covariance was propagated, each with walls of its own, and those that come nearer to a wall
than the robot's radius are counted. Chances of single places must not be added up, for errors at neighbouring ones are
nearly the same; and propagating what is left of a normal distribution after each place (Patil, van den Berg and
Alterovitz, 2012) missed a quarter of the touches on long ways beside walls, which drawing does not.
"""

from dataclasses import dataclass

import numpy as np

from coopslam.planning.map_graph import MapGraph
from coopslam.planning.travel_belief import ASTRAY, ROBOT, TravelBelief
from coopslam.planning.traversal import TraversalModel, travel
from coopslam.planning.walk import Walk, nearest_on_segment
from coopslam.se2 import largest_sigma

DRAWN = 4000  # ways: the standard error of the chance is at most 0.008
NEAR_SIGMAS = 5.0  # a wall farther away is not touched
WALL_SIGMA_M = 0.02  # how much farther to look because the walls are uncertain, too


@dataclass(frozen=True, slots=True, eq=False)
class Margin:
    """A wall near the way."""

    wall: tuple[int, int]
    place: np.ndarray  # (2,) m, of the way where it is nearest
    room_m: float  # between them, less the robot's radius


def touching_probability(
    map_graph: MapGraph,
    walk: Walk,
    model: TraversalModel,
    start_cov: np.ndarray,
    radius_m: float,
    rng: np.random.Generator | None = None,
) -> float:
    """Of a round robot that travels along a walk; the same number each time unless an `rng` is given.

    start_cov: (3, 3), as for `travel`.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    near = margins(map_graph, walk, travel(map_graph, walk, model, start_cov).off_way, radius_m)
    ends = {vertex for some in near for margin in some for vertex in margin.wall}
    trip = travel(map_graph, walk, model, start_cov, sorted(ends))
    belief, touched, done = trip.belief, np.zeros(DRAWN, bool), 0
    errors = rng.multivariate_normal(np.zeros(len(belief.first)), belief.first, DRAWN, method="eigh")
    for arrival, some in zip(trip.arrivals, near, strict=True):
        for step in belief.steps[done:arrival]:
            step.draw(errors, rng)
        done = arrival
        for margin in some:
            touched |= _touching(map_graph, belief, margin, errors, radius_m)
    return float(touched.mean())


def margins(map_graph: MapGraph, walk: Walk, covariances: np.ndarray, radius_m: float) -> list[list[Margin]]:
    """The walls and open gates that a robot may touch on the stretch to each station; at the first, where it stands.

    covariances: (k, 2, 2) of the robot's true place on arrival at the stations.
    """
    reach = np.array([NEAR_SIGMAS * largest_sigma(cov) for cov in covariances]) + radius_m
    found: list[list[Margin]] = [[] for _ in walk.points]
    befores = walk.points[[0, *range(walk.last)]]
    for a, b in (*map_graph.walls, *map_graph.gates):
        apart, places = _nearest_pairs(map_graph.vertices[a].xy, map_graph.vertices[b].xy, befores, walk.points)
        for k in np.flatnonzero(apart <= reach + NEAR_SIGMAS * WALL_SIGMA_M):
            found[k].append(Margin((a, b), places[k], float(apart[k]) - radius_m))
    return found


def _nearest_pairs(
    start: np.ndarray, end: np.ndarray, befores: np.ndarray, afters: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(k,) how near a wall is to each of k stretches, m, and (k, 2) where on the stretch that is.

    Stretches do not cross the wall, so one of the four ends is part of the nearest pair.
    """
    pairs = [(nearest_on_segment(start, end, places)[1], places) for places in (befores, afters)]
    ways = afters - befores
    for corner in (start, end):
        along = np.sum((corner - befores) * ways, axis=1) / np.maximum(np.sum(ways * ways, axis=1), 1e-18)
        places = befores + np.clip(along, 0.0, 1.0)[:, None] * ways
        pairs.append((np.hypot(*(places - corner).T), places))
    best = np.argmin([apart for apart, _ in pairs], axis=0)
    rows = np.arange(len(best))
    return np.array([apart for apart, _ in pairs])[best, rows], np.array([places for _, places in pairs])[best, rows]


def _touching(
    map_graph: MapGraph, belief: TravelBelief, margin: Margin, errors: np.ndarray, radius_m: float
) -> np.ndarray:
    """(s,) which of (s, n) drawn errors bring the robot nearer to the wall than its radius, or behind it.

    Who got behind it around the tip of an acute obstacle counts, too: that is on the safe side.
    """
    start, end = (map_graph.vertices[v].xy + errors[:, belief.place(v)][:, :2] for v in margin.wall)
    nominal = [map_graph.vertices[v].xy for v in margin.wall]
    way, off = end - start, margin.place + errors[:, ROBOT][:, :2] + errors[:, ASTRAY] - start
    length_sq = np.maximum(np.sum(way * way, axis=1), 1e-18)
    along = np.sum(way * off, axis=1) / length_sq
    nearest = np.clip(along, 0.0, 1.0)[:, None] * way
    apart = np.hypot(*(off - nearest).T)
    left = (way[:, 0] * off[:, 1] - way[:, 1] * off[:, 0]) / np.sqrt(length_sq)
    (ux, uy), (vx, vy) = nominal[1] - nominal[0], margin.place - nominal[0]
    beside = (along > 0.0) & (along < 1.0)
    behind = beside & (left < 0.0) if ux * vy - uy * vx >= 0.0 else np.zeros(len(errors), bool)
    return (apart < radius_m) | behind
