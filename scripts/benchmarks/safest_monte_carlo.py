"""Safest paths against simulation: is what the planner predicts what happens, and does it pay to go around?

Prediction: 500 robots travel each path on the recorded ground, every one in a world drawn from the map's joint
covariance, with a filter that is not linearized beforehand. They look at the corners that the planner counts on, and
see only those that are truly within reach. Mean squares of their errors at the goal, whitened by the predicted ones,
are the identity; each eigenvalue is compared with the band that holds 99 % of the extreme eigenvalues of as many normal
samples, and each robot's touching of walls with the predicted probability.

Going around: a world with two lanes, the shorter one slippery, is explored by robots that trust their odometry a third
as much as it deserves on good ground, and do not know where it slips. The planner's shortest and safest path are then
driven on odometry in the true world, in pairs with the same random numbers, and the errors at the goal are compared
pair by pair.
"""

import sys
import tempfile
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _exploration import ExplorationSettings, explore, prepare
from _traversals import STEP_M, Traversals

from coopslam.errors import CoopSlamError
from coopslam.planning.belief_paths import Route, safest, shortest, widest
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.traversal import MODELS, OnOdometry, TraversalModel, model_named, start_covariance, travel
from coopslam.planning.walk import walk_along
from coopslam.se2 import fit_pose, wrap
from sim.ground import Patch
from sim.noise import TYPICAL, OdometryNoise
from sim.sensors import Sensors
from sim.team import Team
from sim.world import World

RADIUS_M = 0.15
OUTER = [(0.0, 0.0), (12.0, 0.0), (12.0, 4.0), (0.0, 4.0)]
ISLAND = [(3.0, 2.0), (3.0, 2.4), (9.0, 2.4), (9.0, 2.0)]  # between the lanes
SLIPPERY = [(3.0, 0.0), (9.0, 0.0), (9.0, 2.0), (3.0, 2.0)]
WARY = 3.0  # sigmas that the explorers of that world believe in, over those of good ground
START, GOAL = (2.4, 1.5), (9.6, 1.5)
PREDICTED = {"slippery_hall": ((1.0, 1.0), (8.0, 5.0)), "rooms_with_doors": None, "paper_one_obstacle": None}


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--traversals", type=int, default=500, help="robots on each path")
    parser.add_argument("--factors", type=float, nargs="+", default=[1, 3, 5, 8, 10], help="of the slippery lane")
    parser.add_argument("--maps", type=int, default=3, help="explorations for each factor")
    options = parser.parse_args()
    _report_predictions(options.traversals)
    _report_pairs(options.factors, options.maps, options.traversals)
    return 0


def explored(world: World | str, seed: int) -> tuple[MapGraph, dict[int, np.ndarray], World]:
    """The map of an exploration with typical noise, where its vertices truly are, and the world."""
    name = world if isinstance(world, str) else "paper_one_obstacle"
    ready = prepare(ExplorationSettings(world=name, seed=seed, figures="none"))
    if isinstance(world, World):
        settings, law = ready.settings, TYPICAL.odometry
        wary = OdometryNoise(WARY * law.translation_sigma_m, WARY * law.drift_sigma_rad, WARY * law.rotation_sigma_rad)
        believed = replace(settings.believed_noise, odometry=wary)
        sensors = Sensors(settings.true_noise, believed, np.random.default_rng(seed))
        ready = replace(ready, world=world, team=Team(world, sensors, settings.team))
    with tempfile.TemporaryDirectory() as out:
        run = explore(ready, Path(out))
        map_graph = MapGraph.load(Path(out) / "dual_graph.json")
    if run.mission.outcome != "complete":
        raise CoopSlamError(f"no map to plan on: {run.mission.outcome}: {run.mission.reason}")
    places = {vertex: run.world.points[corner] for vertex, corner in run.truth.corner_of.items()}
    return map_graph, places, run.world


def _report_predictions(count: int) -> None:
    low, high = _band(count)
    print(f"{count} traversals of each path on the recorded ground; eigenvalues expected in [{low:.3f}, {high:.3f}]")
    heading = "world               path      model      length m   predicted sigma m  measured  in band   "
    print(f"{heading}heading rad   touch: predicted  measured   eigenvalues     in band")
    inside = []
    for world, ends in PREDICTED.items():
        map_graph, _, _ = explored(world, 1)
        start, goal = ends or _far_apart(map_graph)
        for kind in (shortest, safest, widest):
            for name in MODELS:
                model = model_named(name)
                found = kind(map_graph, start, goal, model, RADIUS_M)
                trip = simulated(map_graph, found, model, count)
                inside.append(_print_prediction(f"{world:19s} {kind.__name__:9s} {name:9s}", found, trip, (low, high)))
    known, all_of_them = np.sum(inside, axis=0)
    print(f"in its band: root mean square in {known}, all eigenvalues in {all_of_them} of {len(inside)} cases")


def simulated(
    map_graph: MapGraph, found: Route, model: TraversalModel, count: int, seed: int = 0
) -> tuple[np.ndarray, float]:
    """(count, 3) errors at the goal of as many robots, and the share of them that touched a wall."""
    walk = walk_along(map_graph, found.bends, model.stops(map_graph, found.bends))
    trip = travel(map_graph, walk, model, start_covariance(map_graph))
    walk, rng = replace(walk, stops=trip.looks), np.random.default_rng(seed)  # robots look where it was planned
    robots = Traversals(map_graph, walk, start_covariance(map_graph), count, rng, RADIUS_M)
    return robots.run(model), float(robots.touched.mean())


def _print_prediction(
    name: str, found: Route, trip: tuple[np.ndarray, float], band: tuple[float, float]
) -> tuple[bool, bool]:
    """Returns whether the root mean square and whether all eigenvalues are in their bands."""
    errors, touched = trip
    cov = found.covariances[-1]
    eigenvalues = np.linalg.eigvalsh(_whitened_covariance(errors, cov))
    measured = np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1)))
    low, high = _rms_band(cov[:2, :2], len(errors))
    inside, known = bool(band[0] <= eigenvalues[0] and eigenvalues[-1] <= band[1]), bool(low <= measured <= high)
    print(
        f"{name}  {found.length_m:8.2f} {found.final_sigma_m:19.4f} {measured:9.4f}  {_yes(known)}     "
        f"{np.sqrt(cov[2, 2]):13.3f} {found.touching_probability:18.3f} {touched:9.3f}   "
        f"{' '.join(f'{value:.2f}' for value in eigenvalues)}  {_yes(inside)}",
        flush=True,
    )
    return known, inside


def _yes(right: bool) -> str:
    return "yes" if right else "NO "


def _rms_band(cov: np.ndarray, count: int) -> tuple[float, float]:
    """Between which the root mean square of as many normal errors lies in 99 of 100 cases, m."""
    rng, variances = np.random.default_rng(0), np.linalg.eigvalsh(cov)
    drawn = np.sqrt(rng.chisquare(count, (4000, 2)) / count @ variances)
    return float(np.percentile(drawn, 0.5)), float(np.percentile(drawn, 99.5))


def _whitened_covariance(errors: np.ndarray, cov: np.ndarray) -> np.ndarray:
    white = np.linalg.solve(np.linalg.cholesky(cov), errors.T)
    return white @ white.T / len(errors)


def _band(count: int) -> tuple[float, float]:
    """Between which 99 % of the least and of the greatest eigenvalues of normal samples' covariances lie."""
    rng = np.random.default_rng(0)
    drawn = np.array([np.linalg.eigvalsh(np.cov(rng.standard_normal((3, count)))) for _ in range(4000)])
    return float(np.percentile(drawn[:, 0], 0.5)), float(np.percentile(drawn[:, 2], 99.5))


def _far_apart(map_graph: MapGraph) -> tuple[tuple[float, float], tuple[float, float]]:
    """Centroids of two triangles that are far apart and roomy enough for the robot."""
    roomy = [
        np.array(node["centroid"])
        for _, node in map_graph.graph.nodes(data=True)
        if map_graph.wall_lines.distance(shapely.Point(node["centroid"])) > 2 * RADIUS_M
    ]
    pairs = [(float(np.hypot(*(a - b))), tuple(a), tuple(b)) for a in roomy for b in roomy]
    return max(pairs)[1:]


def _report_pairs(factors: list[float], maps: int, count: int) -> None:
    print(f"\ntwo lanes, the shorter one slippery; {count} pairs of traversals on odometry in the true world, each map")
    print("factor  map  length m: short  safe   sigma m: short (predicted)   safe (predicted)   safe is nearer")
    for factor in factors:
        for seed in range(maps):
            try:
                _report_pair(factor, seed, count)
            except CoopSlamError as error:
                print(f"{factor:6.1f} {seed:4d} {error}", flush=True)


def _report_pair(factor: float, seed: int, count: int) -> None:
    rings = (np.array(OUTER), np.array(ISLAND))
    world = World("two_lanes", rings, (Patch(np.array(SLIPPERY), factor),))
    map_graph, places, world = explored(world, seed)
    start, goal = (_believed(map_graph, places, np.array(place)) for place in (START, GOAL))
    model = OnOdometry()
    paths = [kind(map_graph, start, goal, model, RADIUS_M) for kind in (shortest, safest)]
    errors = [driven(map_graph, path, places, world, count, seed) for path in paths]
    off = [np.hypot(*error.T) for error in errors]
    sigmas = [np.sqrt(np.mean(distance**2)) for distance in off]
    short, safe = paths
    print(
        f"{factor:6.1f} {seed:4d} {short.length_m:16.2f} {safe.length_m:5.2f}   "
        f"{sigmas[0]:14.3f} ({short.final_sigma_m:.3f})     {sigmas[1]:12.3f} ({safe.final_sigma_m:.3f})   "
        f"{np.mean(off[1] < off[0]):14.1%}",
        flush=True,
    )


def driven(map_graph: MapGraph, path: Route, places, world: World, count: int, seed: int) -> np.ndarray:
    """(count, 2) where robots end that drive a path by odometry in the true world, relative to the true goal, m.

    The start and the goal are truly where their triangles' true corners put them. The same seed draws the same numbers
    whatever the path.
    """
    rng, law = np.random.default_rng(seed + 1000), TYPICAL.odometry
    start, turn = _truly(map_graph, places, path.bends[0])
    goal, _ = _truly(map_graph, places, path.bends[-1])
    at = np.tile(start, (count, 1))
    at += rng.multivariate_normal(np.zeros(2), start_covariance(map_graph)[:2, :2], count)
    off = turn + np.sqrt(start_covariance(map_graph)[2, 2]) * rng.standard_normal(count)
    before = None
    for a, b in zip(path.bends[:-1], path.bends[1:], strict=True):
        ahead = float(np.arctan2(*(b - a)[::-1]))
        if before is not None:
            off = _turned(off, float(wrap(ahead - before)), at, world, law, rng)
        steps = max(int(np.ceil(np.hypot(*(b - a)) / STEP_M)), 1)
        for _ in range(steps):
            at, off = _stepped(at, off, ahead, float(np.hypot(*(b - a))) / steps, world, law, rng)
        before = ahead
    return at - goal


def _turned(off, angle, at, world, law, rng):
    cov = law.covariance(angle, 0.0)
    return off + world.noise_factors(at, at) * np.sqrt(cov[2, 2]) * rng.standard_normal(len(off))


def _stepped(at, off, ahead, distance, world, law, rng):
    """One step with the simulator's own noise, on the true ground."""
    error = rng.multivariate_normal(np.zeros(3), law.covariance(0.0, distance), len(at))
    heading = ahead + off
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    left = np.column_stack([-forward[:, 1], forward[:, 0]])
    factor = world.noise_factors(at, at + distance * forward)[:, None]
    moved = (distance + factor * error[:, :1]) * forward + factor * error[:, 1:2] * left
    return at + moved, off + factor[:, 0] * error[:, 2]


def _truly(map_graph: MapGraph, places, point) -> tuple[np.ndarray, float]:
    """(2,) where a place of the map truly is, and by how much the map is turned there, rad."""
    triangle = map_graph.triangle_at(*point)
    believed = map_graph.corners[triangle]
    true = np.array([places[v] for v in map_graph.triangles[triangle]])
    weights = np.linalg.solve(np.vstack([believed.T, np.ones(3)]), [*point, 1.0])
    return weights @ true, fit_pose(believed, true).theta()


def _believed(map_graph: MapGraph, places, point: np.ndarray) -> np.ndarray:
    """(2,) where a place of the world is in the map: the same weights of the same corners."""
    best = None
    for triangle, vertices in map_graph.triangles.items():
        true = np.array([places[v] for v in vertices])
        if abs(np.linalg.det(np.vstack([true.T, np.ones(3)]))) > 1e-6:
            weights = np.linalg.solve(np.vstack([true.T, np.ones(3)]), [*point, 1.0])
            if best is None or weights.min() > best[0]:
                best = weights.min(), weights @ map_graph.corners[triangle]
    return best[1]


if __name__ == "__main__":
    sys.exit(main())
