"""Joint against independent covariances: what the width of a gate is known to, and what it really errs by.

Whole explorations with different seeds. Of each gate that most of them found: its sigma from the joint covariance of
its two ends (`width_sigma_m` of the dual graph), the sigma from their two marginals as if they were independent, and
the root mean square of the true errors over the seeds. Then all gates of all runs: the mean square of errors over
sigmas, 1 expected of an honest one.
"""

import sys
import tempfile
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _exploration import ExplorationSettings, explore, prepare

from coopslam.planning.map_graph import MapGraph

SHOWN = 12  # gates of a table
Row = tuple[tuple[int, int], float, float, float]  # true corners, error, joint sigma, independent sigma; m


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="slippery_hall")
    parser.add_argument("--noise", default="typical", choices=["typical", "legged"])
    parser.add_argument("--seeds", type=int, default=60)
    options = parser.parse_args()
    rows = [row for seed in range(options.seeds) for row in gates_of_run(options.world, options.noise, seed)]
    _report(rows, options.seeds)
    return 0


def gates_of_run(world: str, noise: str, seed: int) -> list[Row]:
    """Error and both sigmas of every gate's width in one exploration."""
    ready = prepare(ExplorationSettings(world=world, noise=noise, seed=seed, figures="none"))
    with tempfile.TemporaryDirectory() as out:
        run = explore(ready, Path(out))
        map_graph = MapGraph.load(Path(out) / "dual_graph.json")
    corner_of, points = run.truth.corner_of, run.world.points
    rows = []
    for *_, edge in map_graph.graph.edges(data=True):
        a, b = edge["gate"]
        along = map_graph.vertices[b].xy - map_graph.vertices[a].xy
        ahead = along / np.hypot(*along)
        alone = [ahead @ map_graph.vertices[v].cov[:2, :2] @ ahead for v in (a, b)]
        true = float(np.hypot(*(points[corner_of[b]] - points[corner_of[a]])))
        corners = tuple(sorted((corner_of[a], corner_of[b])))
        rows.append((corners, edge["width_m"] - true, edge["width_sigma_m"], float(np.sqrt(sum(alone)))))
    return rows


def _report(rows: list[Row], seeds: int) -> None:
    by_gate: dict[tuple[int, int], list[Row]] = {}
    for row in rows:
        by_gate.setdefault(row[0], []).append(row)
    found = []
    for corners, some in by_gate.items():
        if len(some) >= seeds / 2:
            error, joint, alone = (np.sqrt(np.mean(np.square([row[k] for row in some]))) for k in (1, 2, 3))
            found.append((alone / joint, corners, len(some), error, joint, alone))
    print("gate between true corners   runs   true error mm   joint mm   independent mm   independent over joint")
    for factor, corners, runs, error, joint, alone in sorted(found, reverse=True)[:SHOWN]:
        print(
            f"{corners[0]:12d} - {corners[1]:3d} {runs:14d} {1e3 * error:15.1f} {1e3 * joint:10.1f} "
            f"{1e3 * alone:16.1f} {factor:24.1f}"
        )
    errors, joint, alone = (np.array([row[k] for row in rows]) for k in (1, 2, 3))
    for name, sigmas in (("joint", joint), ("independent", alone)):
        square = np.mean((errors / sigmas) ** 2)
        print(f"{len(rows)} gates of {seeds} runs, {name}: mean of (error / sigma)^2 {square:.3f}")


if __name__ == "__main__":
    sys.exit(main())
