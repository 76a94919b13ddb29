"""What does each strategy cost? Worlds x strategies x seeds: metres by kind, role exchanges, time, uncertainty.

A table by strategy (medians over the runs that succeeded), and how metres and role exchanges grow with the vertices n,
the holes h, perimeter and area: least squares in logarithms, over all strategies. --out writes a row per run as CSV.
"""

import csv
import sys
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _exploration import Exploration, ExplorationSettings, explore, prepare
from _study import is_success

from coopslam.evaluation.lower_bound import corners_bound_m, walls_bound_m
from coopslam.exploration.explorer import ExplorerSettings
from coopslam.exploration.strategies import STRATEGIES
from coopslam.records import CornerDecision, MoveNote
from coopslam.report.cost_figure import draw_cost
from sim.world import world_names

BACK_TO_A_CORNER = ("end of a known wall", "found where it should be")  # evidence after a move of the travel
KIND = {"FollowWall": "wall", "ReturnAlongContact": "return", "DriveAway": "doorway", "GoToCorner": "known_edge"}
KINDS = (*KIND.values(), "travel")
ENOUGH_WORLDS = 12  # for a fit of five numbers
COLUMNS = {  # of the table by strategy -> key of a row
    "m/perim": "over_perimeter",
    "m/corners": "over_corners_bound",
    "m/walls": "over_walls_bound",
    "m/m2": "metres_per_m2",
    **{kind: f"{kind}_over_perimeter" for kind in KINDS},
    "exch/tri": "exchanges_per_triangle",
    "s": "simulated_s",
    "sigma cm": "largest_sigma_cm",
}


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("worlds", nargs="*", help="names or GeoJSON files; default: all worlds of the repository")
    parser.add_argument("--strategies", nargs="+", default=list(STRATEGIES), choices=list(STRATEGIES))
    parser.add_argument("--seeds", type=int, default=1, help="default: %(default)s")
    parser.add_argument("--noise", default="none", choices=["none", "typical", "legged"])
    parser.add_argument("--processes", type=int, default=2, help="default: %(default)s")
    parser.add_argument("--out", type=Path, help="CSV with a row per run; a picture beside it")
    options = parser.parse_args()
    worlds = options.worlds or world_names()
    jobs = [
        (world, strategy, seed, options.noise)
        for world in worlds
        for strategy in options.strategies
        for seed in range(options.seeds)
    ]
    rows = []
    with ProcessPoolExecutor(options.processes) as pool:
        for row in pool.map(_one, jobs):
            rows.append(row)
            _print_run(row)
            if options.out:
                _append(options.out, row, is_first=len(rows) == 1)
    good = [row for row in rows if row["success"]]
    _print_table(rows, options.strategies)
    _print_fit(good)
    if options.out and good:
        draw_cost(good, options.out.with_suffix(".png"))
    return len(good) < len(rows)


def _one(job: tuple[str, str, int, str]) -> dict:
    world, strategy, seed, noise = job
    settings = ExplorationSettings(
        world=world, seed=seed, noise=noise, figures="none", explorer=ExplorerSettings(strategy=strategy)
    )
    with TemporaryDirectory() as out:
        return _row(explore(prepare(settings), Path(out)))


def _row(run: Exploration) -> dict:
    """The figures of one run; lengths in m, sigmas of the final estimate."""
    world, summary, mission = run.world, run.summary, run.mission
    metres, triangles = sum(mission.travel_m.values()), max(len(mission.explorer.free_map.triangles), 1)
    step_m = run.settings.team.start_step_m
    bounds = {"corners": corners_bound_m(world.polygon, step_m), "walls": walls_bound_m(world.polygon, step_m)}
    by_kind = metres_by_kind(run)
    sigmas = [run.final.vertex_belief(v).position_sigma_m for v in run.final.vertices]
    return {
        "world": world.name,
        "strategy": run.settings.explorer.strategy,
        "seed": run.settings.seed,
        "noise": run.settings.noise_name,
        "success": is_success(summary),
        "outcome": summary["outcome"],
        "outcome_reason": summary["outcome_reason"],
        "n": world.n,
        "holes": world.holes,
        "perimeter_m": world.perimeter_m,
        "area_m2": world.area_m2,
        "triangles": triangles,
        "metres": metres,
        **{f"{kind}_m": by_kind[kind] for kind in KINDS},
        **{f"{kind}_over_perimeter": by_kind[kind] / world.perimeter_m for kind in KINDS},
        **{f"{name}_bound_m": bound for name, bound in bounds.items()},
        **{f"over_{name}_bound": metres / bound for name, bound in bounds.items()},
        "over_perimeter": metres / world.perimeter_m,
        "metres_per_m2": metres / world.area_m2,
        "moves": mission.moves,
        "role_exchanges": mission.role_exchanges,
        "exchanges_per_triangle": mission.role_exchanges / triangles,
        "simulated_s": mission.history[-1].stamp_s if mission.history else 0.0,
        "largest_sigma_cm": 100 * max(sigmas, default=np.nan),
        "mean_sigma_cm": 100 * float(np.mean(sigmas)) if sigmas else np.nan,
        "vertex_rmse_cm": 100 * summary.get("vertex_rmse_m", np.nan),
    }


def metres_by_kind(run: Exploration) -> dict[str, float]:
    """Metres of a run by what they were driven for.

    wall: following a wall during a sweep.  return: back along the line of contact.  doorway: straight on, away from
    the partner.  known_edge: along a known gate during a sweep.  travel: over mapped triangles to a gate.
    """
    metres, kind, k, before = dict.fromkeys(KINDS, 0.0), None, -1, 0.0
    driven = 0.0
    for record in run.records:
        if isinstance(record, MoveNote):
            k += 1
            after = run.mission.history[k].travel_m if k < len(run.mission.history) else before
            driven, before = after - before, after
            kind = "travel" if "keep_contact=True" in record.move else KIND[record.move.split("(")[0]]
            metres[kind] += driven
        elif isinstance(record, CornerDecision) and record.evidence in BACK_TO_A_CORNER and kind != "travel":
            metres[kind] -= driven
            metres["travel"] += driven
            kind = "travel"
    return metres


def _print_run(row: dict) -> None:
    print(
        f"{row['world'][:24]:24s} {row['strategy']:15s} seed {row['seed']:2d}  n {row['n']:4d}  h {row['holes']:2d}  "
        f"{'good' if row['success'] else row['outcome_reason'][:40]:5s} m/perimeter {row['over_perimeter']:5.2f}  "
        f"exchanges {row['role_exchanges']:4d}  sigma {row['largest_sigma_cm']:7.3g} cm",
        flush=True,
    )


def _print_table(rows: list[dict], strategies: list[str]) -> None:
    print("\nmedians; metres by kind are over the perimeter")
    print(f"{'strategy':15s} {'good':>7s} " + "".join(f"{name:>{_width(name)}s}" for name in COLUMNS))
    for strategy in strategies:
        mine = [row for row in rows if row["strategy"] == strategy]
        good = [row for row in mine if row["success"]]
        line = f"{strategy:15s} {f'{len(good)}/{len(mine)}':>7s} "
        for name, key in COLUMNS.items():
            median = float(np.median([row[key] for row in good])) if good else np.nan
            digits = ".0f" if abs(median) >= 1000 else ".3g"
            line += f"{median:{_width(name)}{digits}}"
        print(line)
    _print_paired(rows, strategies)


def _width(name: str) -> int:
    return max(8, len(name) + 2)


def _print_paired(rows: list[dict], strategies: list[str]) -> None:
    """Each strategy against the first one on the same world and seed."""
    of = {(row["strategy"], row["world"], row["seed"]): row for row in rows if row["success"]}
    print(f"\nagainst {strategies[0]} on the same world and seed (geometric means)")
    for strategy in strategies[1:]:
        pairs = [(row, of.get((strategies[0], *key[1:]))) for key, row in of.items() if key[0] == strategy]
        pairs = [(row, first) for row, first in pairs if first]
        if not pairs:
            continue
        ratio = np.array([row["metres"] / first["metres"] for row, first in pairs])
        exchanges = [row["role_exchanges"] / max(first["role_exchanges"], 1) for row, first in pairs]
        sigma = [row["largest_sigma_cm"] / first["largest_sigma_cm"] for row, first in pairs]
        print(
            f"{strategy:15s} metres x {_mean(ratio):.3f} (fewer in {np.mean(ratio < 1 - 1e-6):4.0%}, more in "
            f"{np.mean(ratio > 1 + 1e-6):4.0%}, worst x {ratio.max():.2f})  exchanges x {_mean(exchanges):.3f}  "
            f"largest sigma x {_mean(sigma):.3f}"
        )


def _mean(ratios) -> float:
    """Geometric; what is zero does not count."""
    ratios = np.asarray(ratios, float)
    return float(np.exp(np.mean(np.log(ratios[ratios > 0])))) if (ratios > 0).any() else np.nan


def _print_fit(rows: list[dict]) -> None:
    """Powers of n, h + 1, perimeter and area in metres and role exchanges."""
    rows = [row for row in rows if row["role_exchanges"] > 0]
    if len({row["world"] for row in rows}) < ENOUGH_WORLDS:
        print("\ntoo few worlds for a fit")
        return
    column = {name: np.array([row[name] for row in rows], float) for name in ("n", "holes", "perimeter_m", "area_m2")}
    logs = np.log(np.column_stack([column["n"], column["holes"] + 1, column["perimeter_m"], column["area_m2"]]))
    print("\nleast squares in logarithms over all good runs")
    for name, design in (
        ("metres", logs),
        ("metres", logs[:, 1:3]),
        ("role_exchanges", logs),
        ("role_exchanges", logs[:, :1]),
    ):
        wanted = np.log([row[name] for row in rows])
        full = np.column_stack([np.ones(len(rows)), design])
        powers, *_ = np.linalg.lstsq(full, wanted, rcond=None)
        r_squared = 1 - np.sum((wanted - full @ powers) ** 2) / np.sum((wanted - wanted.mean()) ** 2)
        terms = {4: ("n", "(h+1)", "perimeter", "area"), 2: ("(h+1)", "perimeter"), 1: ("n",)}[design.shape[1]]
        law = "  ".join(f"{term}^{power:.2f}" for term, power in zip(terms, powers[1:], strict=True))
        print(f"{name:15s} {np.exp(powers[0]):8.3g}  {law:60s} R^2 {r_squared:.3f}")


def _append(path: Path, row: dict, is_first: bool) -> None:
    """What is done is on the disk, whatever interrupts the rest."""
    with path.open("w" if is_first else "a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, row)
        if is_first:
            writer.writeheader()
        writer.writerow(row)


if __name__ == "__main__":
    sys.exit(main())
