"""Does uncertainty grow with the role exchanges, or with the sightings? (Section 2 of the paper.)

Runs of one world with several numbers of sightings per leg. After each leg the position of the robot that stands is
compared with the truth, and its sigma is noted; both are fitted by  c * exchanges^p * sightings^q  (least squares in
logarithms; the standard errors take the seeds as independent, by leaving out one at a time). A growth with the number
of samples would be q > 0.
"""

import csv
import sys
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _exploration import ExplorationSettings, explore, prepare

from coopslam.evaluation.trajectory_error import interpolate_se2
from coopslam.records import MoveNote
from coopslam.report.exchange_figure import draw_exchanges
from coopslam.se2 import position
from sim.team import TeamSettings

FIRST_FITTED = 2  # exchanges; before, the growth has not begun


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="zigzag_corridor", help="name or GeoJSON file; default: %(default)s")
    parser.add_argument(
        "--sightings", type=int, nargs="+", default=[10, 100, 1000], help="per leg; default: 10 100 1000"
    )
    parser.add_argument("--seeds", type=int, default=10, help="default: %(default)s")
    parser.add_argument("--processes", type=int, default=2, help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("runs/role_exchanges"), help="default: %(default)s")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    jobs = [(options.world, s, seed) for s in sorted(options.sightings) for seed in range(options.seeds)]
    rows = []
    with ProcessPoolExecutor(options.processes) as pool:
        for done in pool.map(_one, jobs):
            rows += done
            print(f"{done[-1][0]:5d} sightings per leg, seed {done[-1][1]}: {done[-1][2]} exchanges", flush=True)
    with (options.out / "exchanges.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["sightings_per_leg", "seed", "exchanges", "sightings", "sigma_m", "error_m"])
        writer.writerows(rows)
    table = np.array(rows)
    for name, column in (("sigma", 4), ("rms error", 5)):
        _fit(name, table, column)
    draw_exchanges(table, options.out / "exchanges.png")
    print(f"{options.out / 'exchanges.png'} and exchanges.csv written")
    return 0


def _one(job: tuple[str, int, int]) -> list[tuple]:
    """(sightings per leg, seed, exchanges so far, sightings so far, sigma in m, error in m) after each leg."""
    world, sightings, seed = job
    team = TeamSettings(sightings_per_leg=sightings, sighting_period_s=1e-3)  # as often as it takes
    with TemporaryDirectory() as out:
        run = explore(prepare(ExplorationSettings(world=world, seed=seed, team=team, figures="none")), Path(out))
    track_of, fixes, rows = run.truth.tracks, 0, []
    origin = track_of[team.robots[0]].poses[0]
    causal = {robot: run.mission.estimate.causal_trajectory(robot) for robot in team.robots}
    moves = [record for record in run.records if isinstance(record, MoveNote)]
    for progress, move in zip(run.mission.history, moves, strict=True):
        fixes, stander = progress.sightings, move.watcher
        known = causal[stander]
        k = int(np.searchsorted(known.stamps_s, progress.stamp_s + 1e-6)) - 1
        really = interpolate_se2(track_of[stander].stamps_s, track_of[stander].poses, known.stamps_s[k : k + 1])[0]
        error = float(np.hypot(*(position(known.poses[k]) - position(origin.between(really)))))
        rows.append((sightings, seed, progress.role_exchanges, fixes, progress.position_sigma_m[stander], error))
    return rows


def _curves(table: np.ndarray, column: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N,) exchanges, sightings per leg, and the root mean square of a column over legs and seeds."""
    groups = {}
    for row in table:
        if row[2] >= FIRST_FITTED:
            groups.setdefault((row[2], row[0]), []).append(row[column])
    keys = np.array(list(groups))
    return keys[:, 0], keys[:, 1], np.array([np.sqrt(np.mean(np.square(values))) for values in groups.values()])


def _fit(name: str, table: np.ndarray, column: int) -> None:
    """Print the exponents with their standard errors: a jackknife over the seeds."""
    solution, r_squared, points = _exponents(table, column)
    seeds = np.unique(table[:, 1])
    without = np.array([_exponents(table[table[:, 1] != seed], column)[0] for seed in seeds])
    errors = np.sqrt((len(seeds) - 1) * without.var(axis=0)) if len(seeds) > 1 else np.full(3, np.nan)
    print(
        f"{name:10s} ~ exchanges^({solution[1]:.2f} +- {errors[1]:.2f}) * sightings per leg^({solution[2]:.2f} +- "
        f"{errors[2]:.2f}), R^2 {r_squared:.3f}, {points} points"
    )


def _exponents(table: np.ndarray, column: int) -> tuple[np.ndarray, float, int]:
    """(constant, exponent of exchanges, exponent of sightings), R^2, and the number of points fitted."""
    exchanges, sightings, values = _curves(table, column)
    design = np.column_stack([np.ones(len(values)), np.log(exchanges), np.log(sightings)])
    solution, _, _, _ = np.linalg.lstsq(design, np.log(values), rcond=None)
    rest = np.log(values) - design @ solution
    return solution, float(1 - rest.var() / np.log(values).var()), len(values)


if __name__ == "__main__":
    sys.exit(main())
