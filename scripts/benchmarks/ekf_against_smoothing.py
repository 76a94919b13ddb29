"""EKF against smoothing on simulated explorations: level of noise x role exchanges x estimator.

Each exploration is recorded once (driven by the incremental smoother) and replayed by every estimator, in full and cut
after several numbers of role exchanges. Errors are compared with the Cramer-Rao bound of the same records; honesty is
the mean NEES of poses (3 degrees of freedom) in the two-sided 95 % band for one independent sample a seed: samples
within a run depend on each other, so the band is the widest that it can be.
"""

import csv
import sys
from argparse import ArgumentParser
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _exploration import Exploration, ExplorationSettings, explore, prepare

from coopslam.errors import CoopSlamError
from coopslam.estimation.estimators import NAMES, EstimatorSettings, run
from coopslam.evaluation.consistency import chi_square_band
from coopslam.evaluation.exploration_score import bound_on_ate, causal_ate_rmse_m, score_trajectories
from coopslam.records import MoveNote, Record
from coopslam.report.comparison_figures import draw_study
from sim.noise import TYPICAL, Noise

COLUMNS = (
    "world", "noise", "seed", "role_exchanges", "estimator", "ate_rmse_m", "heading_rmse_rad", "causal_ate_rmse_m",
    "nees_mean", "crlb_ratio",
)  # fmt: skip


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("worlds", nargs="*", default=["paper_one_obstacle"], help="names or GeoJSON files")
    parser.add_argument("--scales", type=float, nargs="+", default=[1.0], help="of all sigmas; 1: typical; default: 1")
    parser.add_argument("--cuts", type=int, nargs="*", default=[], help="also cut after so many role exchanges")
    parser.add_argument("--estimators", nargs="+", choices=NAMES, default=NAMES, help="default: all")
    parser.add_argument("--seeds", type=int, default=50, help="default: %(default)s")
    parser.add_argument("--processes", type=int, default=2, help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("runs/ekf_against_smoothing"), help="default: %(default)s")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    jobs = [
        (world, scale, seed, tuple(options.cuts), tuple(options.estimators))
        for world in options.worlds
        for scale in options.scales
        for seed in range(options.seeds)
    ]
    rows = []
    with ProcessPoolExecutor(options.processes) as pool:
        for done, job in zip(pool.map(_one, jobs), jobs, strict=True):
            rows += done
            print(f"{Path(job[0]).stem}, {job[1]:g} x noise, seed {job[2]}", flush=True)
    with (options.out / "rows.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    _print_table([row for row in rows if row["cut"] is None])
    draw_study([{**row, "noise": f"{row['noise']:g} x typical"} for row in rows], options.out)
    print(f"{options.out / 'ekf_against_smoothing.png'} and rows.csv written")
    return 0


def scaled(noise: Noise, scale: float) -> Noise:
    """The same noise with every sigma so many times as large."""
    parts = {}
    for part in fields(noise):
        sensor = getattr(noise, part.name)
        parts[part.name] = replace(sensor, **{one.name: scale * getattr(sensor, one.name) for one in fields(sensor)})
    return replace(noise, **parts)


def _one(job: tuple) -> list[dict]:
    """Rows of one exploration: each estimator on the whole and on each cut of it."""
    world, scale, seed, cuts, names = job
    noise = scaled(TYPICAL, scale)
    settings = ExplorationSettings(world=world, seed=seed, true_noise=noise, believed_noise=noise, figures="none")
    with TemporaryDirectory() as out:
        done = explore(prepare(settings), Path(out))
    rows = []
    for cut, exchanges, records in _cuts(done.records, cuts):
        label = {"world": Path(world).stem, "noise": scale, "seed": seed, "role_exchanges": exchanges, "cut": cut}
        rows += [{**label, "estimator": name, **_scores(name, done, records)} for name in names]
    return rows


def _cuts(records: list[Record], cuts: tuple[int, ...]) -> Iterator[tuple[int | None, int, list[Record]]]:
    """(cut, role exchanges, records) up to the end of the leg before each number of exchanges, and the whole."""
    exchanges, mover, ends = 0, None, {}
    for position, record in enumerate(records):
        if isinstance(record, MoveNote):
            exchanges += mover is not None and record.robot != mover
            mover = record.robot
            ends[exchanges] = position + 1
    for cut in cuts:
        if cut in ends and cut < exchanges:
            yield cut, cut, records[: ends[cut]]
    yield None, exchanges, records


def _scores(name: str, done: Exploration, records: list[Record]) -> dict:
    """Errors and honesty of one estimator; empty when it came to nothing."""
    try:
        replay = run(name, records, done.settings.team.robots, (), EstimatorSettings())
        estimate = replay.estimate
        scores = score_trajectories(estimate, done.truth, bound_on_ate(replay.graph, estimate, done.truth))
        causal = causal_ate_rmse_m(estimate, done.truth) if name != "batch" else None
    except CoopSlamError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return {}
    return {**scores, "causal_ate_rmse_m": causal}


def _print_table(rows: list[dict]) -> None:
    """Whole runs: medians over the seeds, root mean squared ratio to the bound, NEES and its band."""
    print(f"{'world':22s}{'noise':>6s} {'estimator':15s}{'ATE cm':>8s}{'causal':>8s}{'/ bound':>9s}{'NEES':>8s}  band")
    for key in dict.fromkeys((row["world"], row["noise"], row["estimator"]) for row in rows):
        own = [row for row in rows if (row["world"], row["noise"], row["estimator"]) == key and "ate_rmse_m" in row]
        if not own:
            continue
        low, high = chi_square_band(3, len(own))
        ratios = [row["crlb_ratio"] for row in own]
        causal = [row["causal_ate_rmse_m"] for row in own if row["causal_ate_rmse_m"] is not None]
        print(
            f"{key[0]:22s}{key[1]:6g} {key[2]:15s}{100 * np.median([row['ate_rmse_m'] for row in own]):8.2f}"
            f"{100 * np.median(causal) if causal else np.nan:8.2f}{np.sqrt(np.mean(np.square(ratios))):9.3f}"
            f"{np.mean([row['nees_mean'] for row in own]):8.2f}  {low:.2f}..{high:.2f} ({len(own)} seeds)"
        )


if __name__ == "__main__":
    sys.exit(main())
