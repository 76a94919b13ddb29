"""Explore worlds without noise or figures: is each map exact, and how does the time grow with the number of vertices?

Prints a row per world, the exponent of wall time against n (least squares in logarithms), and where the time of the
largest world goes.
"""

import cProfile
import pstats
import sys
import tempfile
import time
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _exploration import ExplorationSettings, explore, prepare
from _study import is_success

from sim.world import load_world, world_names

PROFILED_ROWS = 12


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("worlds", nargs="*", help="names or GeoJSON files; default: all worlds of the repository")
    parser.add_argument("--profile", action="store_true", help="profile the largest world")
    options = parser.parse_args()
    worlds = sorted(options.worlds or world_names(), key=lambda name: load_world(name).n)
    _one(worlds[0])  # imports and first calls are not what is measured
    sizes, seconds, failed = [], [], []
    for name in worlds:
        world = load_world(name)
        began = time.perf_counter()
        summary = _one(name)
        seconds.append(time.perf_counter() - began)
        sizes.append(world.n)
        good = is_success(summary)
        failed += [] if good else [world.name]
        print(
            f"{world.name:28s} n {world.n:4d}  h {world.holes:2d}  {'exact' if good else summary['outcome_reason']:6s} "
            f"triangles {summary['triangles']:4d}  covered {summary['covered_fraction']:.9f}  "
            f"overlap {summary['overlap_fraction']:.0e}  moves {summary['moves']:5d}  "
            f"travel/perimeter {summary['travel_over_perimeter']:5.2f}  {seconds[-1]:6.2f} s",
            flush=True,
        )
    print(f"{len(worlds) - len(failed)} of {len(worlds)} exact {failed or ''}")
    if len(worlds) > 2:
        slope, _ = np.polyfit(np.log(sizes), np.log(seconds), 1)
        print(f"wall time grows like n^{slope:.2f}")
    if options.profile:
        _profile(worlds[-1])
    return bool(failed)


def _one(world: str) -> dict:
    with tempfile.TemporaryDirectory() as out:
        return explore(prepare(ExplorationSettings(world=world, noise="none", figures="none")), Path(out)).summary


def _profile(world: str) -> None:
    profile = cProfile.Profile()
    profile.runcall(_one, world)
    pstats.Stats(profile).sort_stats("tottime").print_stats(PROFILED_ROWS)


if __name__ == "__main__":
    sys.exit(main())
