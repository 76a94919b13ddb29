"""How far slippery patches stand out in the dual graph: explorations of a world whose patches are rescaled.

Ratio of one run: median recorded odometry error of the edges between triangles that lie in a patch, over that of the
edges between triangles outside all of them. The noise factor that was set is expected; where the triangles truly lie
is told by the simulator. Factor 1 is the control: the same places without a patch.
"""

import sys
import tempfile
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _exploration import Exploration, ExplorationSettings, explore, prepare

from coopslam.errors import CoopSlamError
from sim.sensors import Sensors
from sim.team import Team
from sim.world import World

CLOSE = 0.25  # of the factor
SLIVER_M2 = 1e-6


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="slippery_hall", help="name or GeoJSON file; it must have patches")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--factors", type=float, nargs="+", default=[1.0, 2.0, 3.0, 5.0])
    parser.add_argument("--noise", default="typical", choices=["typical", "legged"])
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    jobs = [(options.world, options.noise, f, seed) for f in options.factors for seed in range(options.seeds)]
    print(f"{options.world}, {options.noise} noise, {options.seeds} seeds: edges in patches over edges outside")
    print("factor   runs   median     5 %    95 %   within 25 %   inside m/sqrt(m)   outside m/sqrt(m)")
    with ProcessPoolExecutor(options.processes) as pool:
        results = pool.map(_one, jobs)
        for factor in options.factors:
            _report(factor, [next(results) for _ in range(options.seeds)])
    return 0


def _one(job: tuple[str, str, float, int]) -> tuple[float, float] | str:
    """Median sigma per sqrt(m) inside and outside the patches; what went wrong when there is none."""
    world, noise, factor, seed = job
    ready = prepare(ExplorationSettings(world=world, noise=noise, seed=seed, figures="none"))
    settings, rescaled = ready.settings, _rescaled(ready.world, factor)
    rng = np.random.default_rng(seed)
    sensors = Sensors(settings.true_noise, settings.believed_noise, rng, settings.bias, settings.false_sightings)
    ready = replace(ready, world=rescaled, team=Team(rescaled, sensors, settings.team))
    try:
        with tempfile.TemporaryDirectory() as out:
            run = explore(ready, Path(out))
    except CoopSlamError as error:
        return f"seed {seed}: {error}"
    sides = ([], []) if run.dual_graph is None else _sides(run)
    if not all(sides):
        return f"seed {seed}: {run.mission.outcome}: {run.mission.reason}: no edges to compare"
    return float(np.median(sides[0])), float(np.median(sides[1]))


def _rescaled(world: World, factor: float) -> World:
    return replace(world, patches=tuple(replace(patch, noise_factor=factor) for patch in world.patches))


def _sides(run: Exploration) -> tuple[list[float], list[float]]:
    """Recorded errors of the edges in patches and of those outside; edges that a border touches are neither."""
    ground = shapely.union_all([patch.polygon for patch in run.world.patches])
    places = {vertex: run.world.points[corner] for vertex, corner in run.truth.corner_of.items()}
    inside, outside = set(), set()
    for triangle, vertices in run.dual_graph.nodes(data="vertices"):
        area = shapely.Polygon([places[vertex] for vertex in vertices])
        if ground.covers(area):  # also one without an area, between corners on a line
            inside.add(triangle)
        elif area.intersection(ground).area < SLIVER_M2:
            outside.add(triangle)
    edges = list(run.dual_graph.edges(data="odometry_sigma_per_m"))
    return tuple([sigma for one, other, sigma in edges if {one, other} <= side] for side in (inside, outside))


def _report(factor: float, results: list[tuple[float, float] | str]) -> None:
    found = np.array([result for result in results if not isinstance(result, str)]).reshape(-1, 2)
    if len(found):
        ratios = found[:, 0] / found[:, 1]
        low, high = np.percentile(ratios, [5, 95])
        share = np.mean(np.abs(ratios / factor - 1) <= CLOSE)
        inside, outside = np.median(found, axis=0)
        print(
            f"{factor:6.2f} {len(found):6d} {np.median(ratios):8.3f} {low:7.3f} {high:7.3f} {share:12.0%} "
            f"{inside:18.4f} {outside:19.4f}"
        )
    for result in results:
        if isinstance(result, str):
            print(f"  {result}")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
