"""Paths over the map of a finished run: shortest, safest, widest, or the front of length against uncertainty.

Places are in the frame of the map, whose origin is the first robot's start. The shortest path is exact in the mapped
polygon; with a radius, in what the polygon leaves to the robot's centre, corners rounded to 1 mm. It grazes every
corner around which it bends, so that a robot on it touches the wall there with about even odds, however well it knows
its place: plan with a larger radius than the robot's for room to err.
"""

import sys
from argparse import ArgumentTypeError, Namespace
from collections.abc import Sequence
from math import degrees, isfinite
from pathlib import Path

from _cli import OneLineParser, run
from _plan import (
    FIGURE,
    OBJECTIVES,
    PATHS,
    PLAN,
    cannot_write,
    named_routes,
    prepare_plan_directory,
    told,
    write_paths,
)
from _replay_options import print_table
from rich.table import Table

from coopslam.planning.map_graph import MapGraph
from coopslam.planning.shortest import Unreachable
from coopslam.planning.traversal import MODELS, model_named
from coopslam.report.number_text import percent
from coopslam.report.path_figure import NamedRoute, draw_routes
from coopslam.report.run_directory import fresh_directory, write_json

GRAZING_M = 0.005  # a path with less clearance touches walls by construction


def main(arguments: Sequence[str] | None = None) -> int:
    """Plan, write, show. Exit code 3 when no path leads to the goal."""
    options = _parser().parse_args(_joined(sys.argv[1:] if arguments is None else arguments))
    map_graph = MapGraph.load(options.run / "dual_graph.json")
    out = options.out or fresh_directory(options.run / "plans" / "-".join(options.objective))
    plan = {
        "start": list(options.start),
        "goal": list(options.goal),
        "model": options.model,
        "robot_radius_m": options.robot_radius_m,
    }
    found = (map_graph, options.objective, options.start, options.goal)
    try:
        named = named_routes(*found, model_named(options.model), options.robot_radius_m)
    except Unreachable as error:
        _write(out, options.force, plan | {"outcome": "unreachable", "outcome_reason": str(error), "paths": {}})
        raise
    _write(out, options.force, plan | {"outcome": "found", "paths": {one.name: told(one) for one in named}})
    try:
        write_paths(out / PATHS, named)
        if options.figures == "static":
            draw_routes(map_graph, named, _title(options)).savefig(out / FIGURE, dpi=150)
    except OSError as error:
        raise cannot_write(out, error, done=True) from error
    _show(named, _title(options), options.robot_radius_m)
    print(f"{out / PATHS} and what belongs to it written")
    return 0


def _write(out: Path, force: bool, plan: dict) -> None:
    """plan.json in a directory made for it."""
    prepare_plan_directory(out, force)
    try:
        write_json(out / PLAN, plan)
    except OSError as error:
        raise cannot_write(out, error, done=True) from error


def _title(options: Namespace) -> str:
    size = f", robot of {options.robot_radius_m:g} m radius" if options.robot_radius_m else ""
    name = options.run.resolve().name
    ways = {"odometry": "on odometry", "corners": "on odometry and corners", "escorted": "escorted by a partner"}
    return f"{name}: {ways[options.model]}{size}"


def _show(named: Sequence[NamedRoute], title: str, radius_m: float) -> None:
    table = Table(title=title)
    table.add_column("path", no_wrap=True)
    for column in (
        "length m",
        "position sigma at goal cm",
        "heading deg",
        "clearance m",
        "touches a wall",
        "triangles",
    ):
        table.add_column(column, justify="right")
    for one in named:
        figures = told(one)
        table.add_row(
            one.name,
            f"{figures['length_m']:.3f}",
            f"{100 * figures['final_sigma_m']:.2f}",
            f"{degrees(figures['final_heading_sigma_rad']):.2f}",
            f"{round(figures['clearance_m'], 3) + 0.0:.3f}",  # not -0.000
            percent(float(f"{figures['touching_probability']:.2g}")),
            str(len(figures["triangles"])),
        )
    print_table(table)
    grazing = [one.name for one in named if one.route.clearance_m < GRAZING_M]
    if grazing:
        radius = "a radius" if not radius_m else f"a radius larger than {radius_m:g} m"
        print(f"{', '.join(grazing)}: about even odds to touch wherever a wall is grazed; {radius} gives room to err")


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="plan.py", description=__doc__)
    parser.add_argument("run", metavar="RUN_DIR", type=Path, help="directory of a finished run; its dual_graph.json")
    for name in ("start", "goal"):
        parser.add_argument(f"--{name}", metavar="X,Y", type=_place, required=True, help="m, frame of the map")
    parser.add_argument(
        "--objective",
        metavar="O",
        type=_objectives,
        default=("shortest",),
        help=f"{', '.join(OBJECTIVES)}, several of them with commas, or all; default: shortest",
    )
    parser.add_argument(
        "--model", choices=MODELS, default=MODELS[0], help=f"how the robot keeps track of itself; default: {MODELS[0]}"
    )
    parser.add_argument(
        "--robot-radius", dest="robot_radius_m", metavar="M", type=_radius, default=0.0, help="m; default: 0, a point"
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: a new directory in RUN_DIR/plans")
    parser.add_argument("--force", action="store_true", help="overwrite a plan in --out")
    parser.add_argument("--figures", choices=["none", "static"], default="static", help="default: static")
    return parser


def _joined(arguments: Sequence[str]) -> list[str]:
    """`--start -1,2` as `--start=-1,2`: argparse takes -1,2 for an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in ("--start", "--goal"):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _place(text: str) -> tuple[float, float]:
    try:
        x, y = (float(number) for number in text.split(","))
    except ValueError:
        x = y = float("nan")
    if not (isfinite(x) and isfinite(y)):
        raise ArgumentTypeError(f"two finite numbers X,Y expected, m, got {text!r}")
    return x, y


def _radius(text: str) -> float:
    try:
        radius_m = float(text)
    except ValueError:
        radius_m = -1.0
    if not (isfinite(radius_m) and radius_m >= 0):
        raise ArgumentTypeError(f"a number of zero or more expected, m, got {text!r}")
    return radius_m


def _objectives(text: str) -> tuple[str, ...]:
    names = OBJECTIVES if text == "all" else tuple(dict.fromkeys(text.split(",")))
    unknown = [name for name in names if name not in OBJECTIVES]
    if unknown:
        raise ArgumentTypeError(f"names of {', '.join(OBJECTIVES)} expected, with commas, or all, got {text!r}")
    return names


if __name__ == "__main__":
    sys.exit(run(main))
