"""Draw the paper's figures 2a, 3 and 4 from simulated explorations, as PNG and PDF."""

import sys
import tempfile
from argparse import ArgumentTypeError
from collections.abc import Sequence
from pathlib import Path

from _cli import OneLineParser, run
from _exploration import Exploration, ExplorationSettings, explore, prepare
from _exploration_output import view_of

from coopslam.errors import BadInput
from coopslam.report.paper_figures import draw_paths, draw_stages, draw_triangulated_world, write_figure
from sim.noise import PRESETS
from sim.world import world_names

WORLD = "paper_one_obstacle"  # of figures 2a, 3 and 4a
SECOND_WORLD = "paper_two_occluders"  # of figure 4b
OUT = Path("runs/paper_figures")


def main(arguments: Sequence[str] | None = None) -> int:
    """Explore both worlds, draw, print what was written. Returns the exit code."""
    options = _parser().parse_args(arguments)
    worlds = dict.fromkeys([options.world, SECOND_WORLD])
    ready = [prepare(ExplorationSettings(world, options.seed, options.noise)) for world in worlds]
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        finished = [_explore(each) for each in ready]
        views = [view_of(each) for each in finished]
        drawn = {
            "figure_2a": draw_triangulated_world(views[0]),
            "figure_3": draw_stages(views[0]),
            "figure_4": draw_paths(views),
        }
        for name, figure in drawn.items():
            for path in write_figure(figure, options.out, name):
                print(path)
    except OSError as error:
        raise BadInput(f"--out {str(options.out)[:200]}: cannot be written: {error.strerror or error}") from error
    unfinished = [each for each in finished if each.mission.outcome != "complete"]
    for each in unfinished:
        print(f"exploration of {each.world.name} {each.mission.outcome}: {each.mission.reason}", file=sys.stderr)
    return 3 if unfinished else 0


def _explore(ready) -> Exploration:
    """A whole run; its run directory is not kept."""
    print(f"exploring {ready.world.name}", flush=True)
    with tempfile.TemporaryDirectory() as directory:
        return explore(ready, Path(directory))


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="figures.py", description=__doc__)
    parser.add_argument(
        "--world",
        metavar="W",
        default=WORLD,
        help=f"of figures 2a, 3 and 4a: a GeoJSON file (one Polygon, holes allowed, metres) or one of: "
        f"{', '.join(world_names())}; default: {WORLD}; figure 4b shows {SECOND_WORLD}",
    )
    parser.add_argument("--seed", metavar="N", type=_seed, default=0, help="of all random numbers; default: 0")
    parser.add_argument(
        "--noise", metavar="P", choices=[*PRESETS], default="typical", help="none, typical (default) or legged"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=_path,
        default=OUT,
        help=f"directory for the files, which are replaced; default: {OUT}",
    )
    return parser


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise ArgumentTypeError(f"a whole number of zero or more expected, got {text!r}")
    return int(text)


def _path(text: str) -> Path:
    if not text.strip():
        raise ArgumentTypeError("a directory expected, got nothing")
    return Path(text)


if __name__ == "__main__":
    sys.exit(run(main))
