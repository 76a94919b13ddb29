"""How well the robot tracker measures: random poses, lights, surroundings, blur and noise, from 0.5 to 10 m.

A table for each target and picture size: detected, errors, honesty of the covariance, and errors over the Cramer-Rao
bound that the noise of the pixels sets. `aruco` is the library's pose of the largest tag in the pictures of the cube.
Written: samples.csv (a line for each picture and method), summary.json (the tables), accuracy.png.
"""

import json
import os
import sys
from argparse import ArgumentTypeError, Namespace
from collections.abc import Sequence
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _accuracy import Job, Sample, sampled
from _accuracy_table import line_of, table_of
from _cli import OneLineParser, run
from _files import make_directory, without_nan, write_csv
from _jobs import count, in_processes, whole
from _scenes import BACKGROUNDS, RANGES_M, SIZES, TARGETS

from coopslam.report.tracker_figures import draw_tracker_accuracy

OUT = Path("runs/tracker_accuracy")


def main(arguments: Sequence[str] | None = None) -> int:
    """Take and measure all pictures, print the tables. Returns the exit code."""
    options = _parser().parse_args(arguments)
    make_directory(options.out)
    found = in_processes(sampled, _jobs(options), options.processes, "pictures")
    samples = [sample for pair in found for sample in pair]
    write_csv(options.out / "samples.csv", samples)
    tables = _tables(samples)
    for table in tables:
        kind = ", partly hidden" if table["occluded"] else ""
        print(f"\n{table['method']} at {table['size']}{kind}, seed {options.seed}")
        print(table_of([*table["lines"], *table["backgrounds"], table["all"]]), flush=True)
    text = json.dumps(without_nan({"seed": options.seed, "tables": tables}), indent=1, allow_nan=False)
    (options.out / "summary.json").write_text(text + "\n", encoding="utf-8")
    shown = [table for table in tables if table["occluded"] == options.occluded]
    print(f"\n{draw_tracker_accuracy(shown, options.out / 'accuracy.png')}")
    return 0


def _jobs(options: Namespace) -> list[Job]:
    """Ranges in turns, so that a progress bar tells the truth."""
    jobs = []
    for target in options.targets:
        for size in options.sizes:
            for k in range(options.poses):
                number, place = divmod(k, len(RANGES_M))
                bounded = number < options.bounds
                jobs.append(Job(target, size, place, number, options.seed, options.occluded, bounded))
    return jobs


def _tables(samples: Sequence[Sample]) -> list[dict]:
    """For each method and size a line for each range, for each kind of background, and for everything."""
    groups = dict.fromkeys((s.method, s.size, s.occluded) for s in samples)
    tables = []
    for method, size, occluded in groups:
        own = [s for s in samples if (s.method, s.size, s.occluded) == (method, size, occluded)]
        bins = [r for r in RANGES_M if any(s.bin_m == r for s in own)]
        lines = [{"range": r} | line_of([s for s in own if s.bin_m == r]) for r in bins]
        kinds = [kind for kind in BACKGROUNDS if any(s.background == kind for s in own)]
        backgrounds = [{"range": kind} | line_of([s for s in own if s.background == kind]) for kind in kinds]
        table = {"method": method, "size": size, "occluded": occluded, "lines": lines, "backgrounds": backgrounds}
        tables.append(table | {"all": {"range": "all"} | line_of(own)})
    return tables


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="tracker_accuracy.py", description=__doc__)
    parser.add_argument("--targets", type=_some_of(TARGETS), default=TARGETS, help="default: helix,tag_cube")
    parser.add_argument("--sizes", type=_some_of(SIZES), default=SIZES, help="pixels; default: 640x480,1280x960")
    parser.add_argument("--poses", type=count, default=504, help="of each target and size; default: %(default)s")
    parser.add_argument("--bounds", type=whole, default=1000, help="pictures of a range with a bound; default: all")
    parser.add_argument("--occluded", action="store_true", help="hide 10 to 40 %% of the target in each picture")
    parser.add_argument("--seed", type=whole, default=0, help="of all random numbers; default: %(default)s")
    parser.add_argument("--processes", type=count, default=2, help="default: %(default)s")
    help_out = "directory of the files, which are replaced; default: %(default)s"
    parser.add_argument("--out", metavar="DIR", type=Path, default=OUT, help=help_out)
    return parser


def _some_of(names: Sequence[str]):
    """Reads names with commas between them."""

    def read(text: str) -> tuple[str, ...]:
        chosen = tuple(text.split(","))
        if not set(chosen) <= set(names):
            raise ArgumentTypeError(f"{', '.join(names)} expected, with commas between them, got {text[:60]!r}")
        return chosen

    return read


if __name__ == "__main__":
    sys.exit(run(main))
