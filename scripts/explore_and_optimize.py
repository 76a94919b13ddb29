"""Two robots explore a polygonal world that they do not know; GTSAM smooths what they sense; out comes a map."""

import os
import re
import sys
import time
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path

from _cli import OneLineParser, run
from _exploration import (
    DRIVERS,
    LARGEST_SEED,
    Exploration,
    ExplorationSettings,
    Prepared,
    conclude,
    draw,
    drive,
    prepare,
)
from rich.console import Console
from rich.live import Live
from rich.progress import track
from rich.table import Table

from coopslam.errors import BadInput, NotWritten, shown
from coopslam.exploration.mission import Progress
from coopslam.exploration.strategies import STRATEGIES
from coopslam.io.toml import from_mapping, load_toml
from coopslam.report import html
from coopslam.report.animation import write_animation
from coopslam.report.figures import drawn_in
from coopslam.report.run_directory import fresh_directory, prepare_run_directory
from coopslam.report.run_view import RunView
from coopslam.report.video import mp4_is_possible
from sim.noise import MOST_FALSE, PRESETS, TRACKERS
from sim.team_settings import MOST_ROBOTS
from sim.world import world_names

PLAIN_LINE_EVERY_S = 2.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, explore, draw, print. Returns the exit code."""
    options = _parser().parse_args(arguments)
    settings = _settings(options)
    ready = _prepare(settings, options)  # whatever the settings get wrong comes before an old run is deleted
    world = ready.world.name
    out = options.out or fresh_directory(Path("runs") / f"{_slug(world)}-{settings.noise_name}-{settings.seed}")
    prepare_run_directory(out, options.force)
    began = time.perf_counter()
    finished = None
    try:
        with ProgressDisplay(world) as display:
            finished = drive(ready, out, display.show)
            conclude(finished, out)
        view = draw(finished, out)
        if settings.figures == "all":
            _animate(view, out)
    except BrokenPipeError:  # nobody reads what is printed
        raise
    except OSError as error:
        reason = f"cannot be written: {error.strerror or error}"
        raise NotWritten(f"--out {str(out)[:200]}: {reason}", done=finished is not None) from error
    _print_result(finished, out, time.perf_counter() - began)
    if finished.mission.outcome != "complete":
        print(f"exploration {finished.mission.outcome}: {finished.mission.reason}", file=sys.stderr)
        return 3
    return 0


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="explore_and_optimize.py", description=__doc__)
    parser.add_argument(
        "--world",
        metavar="W",
        help=f"a GeoJSON file (one Polygon, holes allowed, metres) or one of: {', '.join(world_names())}; "
        f"default: {ExplorationSettings().world}",
    )
    parser.add_argument("--config", metavar="C.toml", type=Path, help="settings from a TOML file; options override it")
    parser.add_argument("--seed", metavar="N", type=_seed, help="of all random numbers; default: 0")
    parser.add_argument(
        "--noise",
        metavar="P",
        choices=[*PRESETS],
        help="none, typical (odometry: 3 cm after 1 m, 2 degrees of drift after 1 m, 3 degrees after a turn; default) "
        "or legged (odometry nearly absent)",
    )
    parser.add_argument(
        "--tracker-preset",
        metavar="T",
        choices=[*TRACKERS],
        help="how the robots see each other: helix (default), retroreflector (range and bearing, no heading, up to "
        "30 m) or laser-stripe (precise, up to 4 m)",
    )
    parser.add_argument(
        "--estimator", metavar="E", choices=[*DRIVERS], help=f"that steers: {', '.join(DRIVERS)}; default: incremental"
    )
    parser.add_argument(
        "--out", metavar="DIR", type=_path, help="run directory; default: a new one, runs/WORLD-NOISE-SEED"
    )
    parser.add_argument(
        "--figures",
        metavar="F",
        choices=["none", "static", "all"],
        help="none, static (default) or all: with an animation of up to 25 s, figures/exploration.mp4 and .gif",
    )
    parser.add_argument(
        "--robots", metavar="N", type=int, help="2 (default) to 6: the first two explore, the others watch"
    )
    parser.add_argument(
        "--strategy", metavar="S", choices=[*STRATEGIES], help=f"which waiting gate next: {', '.join(STRATEGIES)}"
    )
    parser.add_argument(
        "--outliers", metavar="F", type=_share, help="fraction of sightings that are reflections, 0 to 0.5"
    )
    parser.add_argument("--dropouts", metavar="F", type=_share, help="fraction of sightings that are missed, 0 to 0.5")
    parser.add_argument(
        "--no-reobservation", action="store_true", help="known corners passed on the way are not used as factors"
    )
    parser.add_argument("--max-moves", metavar="N", type=_moves, help="stop with outcome budget after so many moves")
    parser.add_argument(
        "--max-travel", metavar="M", type=_metres, help="stop with outcome budget after so many metres, all robots"
    )
    parser.add_argument("--force", action="store_true", help="overwrite a run in --out")
    return parser


def _settings(options) -> ExplorationSettings:
    """Config file first, then options. Raises BadInput."""
    settings = ExplorationSettings()
    if options.config is not None:
        settings = from_mapping(ExplorationSettings, load_toml(options.config), str(options.config))
    given = {name: getattr(options, name) for name in ("world", "seed", "noise", "estimator", "figures")}
    settings = replace(settings, **{name: value for name, value in given.items() if value is not None})
    if options.noise is not None:
        settings = replace(settings, true_noise=None, believed_noise=None)
    if options.tracker_preset is not None:
        settings = settings.with_tracker(options.tracker_preset)
    budget = {"moves": options.max_moves, "travel_m": options.max_travel}
    budget = {name: value for name, value in budget.items() if value is not None}
    settings = replace(settings, budget=replace(settings.budget, **budget))
    false = {name: getattr(options, name) for name in ("outliers", "dropouts") if getattr(options, name) is not None}
    settings = replace(settings, false_sightings=replace(settings.false_sightings, **false))
    if options.robots is not None:
        settings = replace(settings, team=replace(settings.team, robots=_robot_names(options.robots)))
    if options.strategy is not None:
        settings = replace(settings, explorer=replace(settings.explorer, strategy=options.strategy))
    if options.no_reobservation:
        settings = replace(settings, explorer=replace(settings.explorer, reobserve=False))
    return settings


def _prepare(settings: ExplorationSettings, options) -> Prepared:
    """Raises BadInput with the option or the file that a wrong setting comes from."""
    try:
        return prepare(settings)
    except BadInput as error:
        if options.world is not None and str(error).startswith("world: "):
            raise BadInput(f"--{error}") from error
        raise BadInput(f"{options.config or 'default settings'}: {error}") from error


def _robot_names(count: int) -> tuple[str, ...]:
    if not 2 <= count <= MOST_ROBOTS:
        raise BadInput(f"--robots: 2 to {MOST_ROBOTS} expected, got {count}")
    return tuple(f"robot{k}" for k in range(count))


def _animate(view: RunView, out: Path) -> None:
    """The animation, and the report once more with it. It takes longest, so the report without it was written first."""
    films = write_animation(view, out / "figures", _show_frames(Console()))
    if not films:
        print("there is no animation: no robot moved")
    elif not mp4_is_possible():
        print("figures/exploration.mp4 is left out: it needs the package av")
    html.write_report(out / "report.html", view, [*films[:1], *drawn_in(out / "figures")])


def _show_frames(console: Console) -> Callable[[Iterable], Iterable]:
    """A bar on a terminal, one line elsewhere."""
    if console.is_terminal and not os.environ.get("CI"):
        return lambda times: track(times, "drawing the animation", console=console, transient=True)
    print("drawing the animation", flush=True)
    return lambda times: times


def _seed(text: str) -> int:
    return _number(int, text, "a whole number from 0 to 2^63 - 1", lambda seed: 0 <= seed <= LARGEST_SEED)


def _moves(text: str) -> int:
    return _number(int, text, "a whole number from 1 to 2^63 - 1", lambda moves: 1 <= moves <= LARGEST_SEED)


def _metres(text: str) -> float:
    return _number(float, text, "more than zero and finite", lambda metres: 0 < metres < inf)


def _share(text: str) -> float:
    return _number(float, text, f"0 to {MOST_FALSE:g}", lambda share: 0 <= share <= MOST_FALSE)


def _number(kind: type, text: str, expected: str, is_fine: Callable[[float], bool]):
    """The number that an option gives; argparse puts the option's name before the message."""
    try:
        number = kind(text)
    except ValueError:
        raise ArgumentTypeError(f"{expected} expected, got {shown(text)}") from None
    if not is_fine(number):
        raise ArgumentTypeError(f"{expected} expected, got {shown(number)}")
    return number


def _path(text: str) -> Path:
    if not text.strip():
        raise ArgumentTypeError("a directory expected, got nothing")
    return Path(text)


def _slug(name: str) -> str:
    """A world's name as part of a path."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).lstrip(".")[:60] or "world"


class ProgressDisplay:
    """A live table on a terminal, plain lines elsewhere."""

    def __init__(self, world: str):
        self._world = world
        self._console = Console()
        self._live = None
        if self._console.is_terminal and not os.environ.get("CI"):
            self._live = Live(console=self._console, refresh_per_second=8, transient=True)
        self._next_line_s = time.monotonic() + PLAIN_LINE_EVERY_S

    def __enter__(self) -> "ProgressDisplay":
        if self._live:
            self._live.__enter__()
        else:
            print(f"exploring {self._world}", flush=True)
        return self

    def __exit__(self, *error) -> None:
        if self._live:
            self._live.__exit__(*error)

    def show(self, progress: Progress) -> None:
        """Show where the mission stands."""
        if self._live:
            self._live.update(_table(self._world, progress))
        elif time.monotonic() >= self._next_line_s:
            print(_line(progress), flush=True)
            self._next_line_s = time.monotonic() + PLAIN_LINE_EVERY_S


def _line(progress: Progress) -> str:
    sigma = 100 * max(progress.position_sigma_m.values())
    return (
        f"{progress.triangles} triangles, {progress.open_gates} open gates, {progress.role_exchanges} role exchanges, "
        f"{progress.travel_m:.1f} m, position sigma {sigma:.1f} cm"
    )


def _table(world: str, progress: Progress) -> Table:
    table = Table(title=f"exploring {world}", show_header=False)
    table.add_row("triangles", str(progress.triangles))
    table.add_row("open gates", str(progress.open_gates))
    table.add_row("role exchanges", str(progress.role_exchanges))
    table.add_row("travelled", f"{progress.travel_m:.1f} m")
    for robot, sigma in progress.position_sigma_m.items():
        table.add_row(f"position sigma of {robot}", f"{100 * sigma:.1f} cm")
    return table


def _print_result(finished: Exploration, out: Path, seconds: float) -> None:
    summary = finished.summary
    print(f"{summary['outcome']}: {summary['outcome_reason']}")
    found = f"{summary['vertices']} vertices, {summary['holes']} holes, {summary['triangles']} triangles"
    if "covered_fraction" in summary:
        found += (
            f" (expected {summary['triangles_expected']}), covered {summary['covered_fraction']:.6f}, "
            f"overlap {summary['overlap_fraction']:.1e}"
        )
    print(found)
    driven = f"{sum(summary['travel_m'].values()):.1f} m travelled, {summary['role_exchanges']} role exchanges"
    if summary.get("vertex_rmse_m") is not None and summary.get("vertex_nees_mean") is not None:
        driven += (
            f", vertex rmse {100 * summary['vertex_rmse_m']:.2f} cm, "
            f"vertex NEES {summary['vertex_nees_mean']:.2f} (ideal 2)"
        )
    print(driven)
    for name, scores in summary["estimators"].items():
        if None not in (scores["ate_rmse_m"], scores["nees_mean"]):
            ate, nees = 100 * scores["ate_rmse_m"], scores["nees_mean"]
            print(f"{name:>14}: ATE {ate:7.2f} cm, pose NEES {nees:.2f} (ideal 3)")
    if "left_out" in summary:
        print(f"left out (reasons are in summary.json): {', '.join(summary['left_out'])}")
    print(f"{out / 'report.html'} and the run directory {out} written in {seconds:.1f} s")


if __name__ == "__main__":
    sys.exit(run(main))
