"""Explore worlds with noise over many seeds: success, errors and honesty, as a table on the terminal.

Success: outcome complete, and a true triangulation (distinct real vertices, free triangles, full cover, no overlap).
Honesty: mean NEES of vertices (2 dof) and poses (3 dof) over the seeds in the two-sided 95 % band for one
independent sample a seed; samples within a run depend on each other, so the band is the widest that it can be.
"""

import sys
import tempfile
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _exploration import ExplorationSettings, explore, prepare
from _study import is_success

from coopslam.evaluation.consistency import chi_square_band
from sim.noise import FalseSightings


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("worlds", nargs="+", help="names or GeoJSON files")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--noise", default="typical", choices=["none", "typical", "legged"])
    parser.add_argument("--outliers", type=float, default=0.0, help="fraction of sightings that are reflections")
    parser.add_argument("--dropouts", type=float, default=0.0, help="fraction of sightings that are missed")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    false = FalseSightings(options.outliers, options.dropouts)
    everything = []
    with ProcessPoolExecutor(options.processes) as pool:
        for world in options.worlds:
            settings = ExplorationSettings(world=world, noise=options.noise, false_sightings=false, figures="none")
            summaries = list(pool.map(_one, [replace(settings, seed=seed) for seed in range(options.seeds)]))
            _report(world, summaries)
            everything += summaries
    _total(everything)
    return 0


def _one(settings: ExplorationSettings) -> dict:
    with tempfile.TemporaryDirectory() as out:
        return explore(prepare(settings), Path(out)).summary


def _total(summaries: list[dict]) -> None:
    complete = [summary for summary in summaries if summary["outcome"] == "complete"]
    good = sum(map(is_success, summaries))
    print(
        f"\nall worlds: {len(summaries)} runs, {len(complete)} complete, {good} of these true triangulations "
        f"({100 * good / len(summaries):.1f} % of all runs); sightings of corners taken for another: "
        f"{sum(summary['corners_misnamed'] for summary in summaries)}"
    )


def _report(world: str, summaries: list[dict]) -> None:
    good = [summary for summary in summaries if is_success(summary)]
    wrong = [s["seed"] for s in summaries if s["outcome"] == "complete" and not is_success(s)]
    print(f"\n{Path(world).stem}: {len(good)} of {len(summaries)} complete and true; complete but wrong: {wrong or 0}")
    for summary in summaries:
        if summary["outcome"] != "complete":
            print(f"  seed {summary['seed']}: {summary['outcome']}: {summary['outcome_reason']}")
    if not good:
        return
    _row("vertex rmse, cm", [100 * s["vertex_rmse_m"] for s in good])
    for name in good[0]["estimators"]:
        _row(f"{name} ATE, cm", [100 * s["estimators"][name]["ate_rmse_m"] for s in good])
    errors = [{name: scores["ate_rmse_m"] for name, scores in s["estimators"].items()} for s in good]
    _row("odometry alone / smoothed", [error["dead-reckoning"] / error["batch"] for error in errors])
    _row("travel / perimeter", [s["travel_over_perimeter"] for s in good])
    _band("vertex NEES", [s["vertex_nees_mean"] for s in good], 2)
    _band("pose NEES", [s["estimators"]["batch"]["nees_mean"] for s in good], 3)
    ratio = np.sqrt(np.mean([s["estimators"]["batch"]["crlb_ratio"] ** 2 for s in good]))
    print(f"  {'batch ATE / Cramer-Rao bound':30s} rms over seeds {ratio:.3f}", flush=True)


def _row(name: str, values: list[float]) -> None:
    print(f"  {name:30s} median {np.median(values):8.3f}  worst {max(values):8.3f}")


def _band(name: str, values: list[float], dof: int) -> None:
    low, high = chi_square_band(dof, len(values))
    mean = float(np.mean(values))
    error = float(np.std(values) / np.sqrt(len(values)))
    inside = "inside" if low <= mean <= high else "OUTSIDE"
    print(f"  {name:30s} mean   {mean:8.3f} +- {error:.3f}  band {low:.3f} .. {high:.3f}  {inside}")


if __name__ == "__main__":
    sys.exit(main())
