"""The options of explore_and_optimize.py, and the settings that they and a config file make."""

from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable
from dataclasses import replace
from math import inf
from pathlib import Path

from _cli import OneLineParser
from _exploration_settings import CAMERAS, DRIVERS, LARGEST_SEED, ExplorationSettings

from coopslam.errors import BadInput, shown
from coopslam.exploration.strategies import STRATEGIES
from coopslam.io.toml import from_mapping, load_toml
from sim.noise import MOST_FALSE, PRESETS, TRACKERS
from sim.team_settings import MOST_ROBOTS
from sim.world import world_names
from tracker.sheets import sheet_names

DEFAULTS = ExplorationSettings()


def parser(description: str) -> OneLineParser:
    """All options, with units and defaults."""
    parser = OneLineParser(prog="explore_and_optimize.py", description=description)
    _add_world_options(parser)
    _add_sensor_options(parser)
    _add_team_options(parser)
    _add_budget_options(parser)
    _add_output_options(parser)
    return parser


def _add_world_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--world",
        metavar="W",
        help=f"a GeoJSON file (one Polygon, holes allowed, metres) or one of: {', '.join(world_names())}; "
        f"default: {DEFAULTS.world}",
    )
    parser.add_argument("--config", metavar="C.toml", type=Path, help="settings from a TOML file; options override it")
    parser.add_argument("--seed", metavar="N", type=_seed, help=f"of all random numbers; default: {DEFAULTS.seed}")
    parser.add_argument(
        "--start-corner",
        metavar="K",
        type=_corner,
        help=f"of the outer ring, in which the first robot starts; default: {DEFAULTS.team.start_corner}",
    )
    parser.add_argument(
        "--resume-map",
        metavar="RUN_DIR",
        type=_path,
        help="wake up in the world of an earlier run, find out where, and extend its map; its world is the default of "
        "--world",
    )


def _add_sensor_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--noise",
        metavar="P",
        choices=[*PRESETS],
        help="none, typical (odometry: 3 cm after 1 m, 2 degrees of drift after 1 m, 3 degrees after a turn; default) "
        "or legged (odometry nearly absent)",
    )
    parser.add_argument(
        "--tracker",
        metavar="T",
        choices=["statistical", *CAMERAS],
        help="how the robots see each other: statistical (errors drawn at random; default), or helix or apriltag: each "
        "look is a picture, rendered and searched by the detector",
    )
    sheets = ", ".join(f"{getattr(DEFAULTS.vision, f'{camera}_sheet')} of {camera}" for camera in CAMERAS)
    parser.add_argument(
        "--tracker-sheet",
        metavar="S",
        help="camera and target of --tracker helix or apriltag: a TOML file or one of: "
        f"{', '.join(sheet_names())}; default: {sheets}",
    )
    parser.add_argument(
        "--tracker-preset",
        metavar="T",
        choices=[*TRACKERS],
        help="errors and limits of the statistical tracker: helix (default), retroreflector (range and bearing, no "
        "heading, up to 30 m) or laser-stripe (precise, up to 4 m)",
    )
    for kind, what in (("outliers", "are reflections"), ("dropouts", "are missed")):
        default = getattr(DEFAULTS.false_sightings, kind)
        parser.add_argument(
            f"--{kind}",
            metavar="F",
            type=_share,
            help=f"fraction of sightings that {what}, 0 to {MOST_FALSE:g}; default: {default:g}",
        )


def _add_team_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--robots",
        metavar="N",
        type=int,
        help=f"2 (default) to {MOST_ROBOTS}: the first two explore, the others watch",
    )
    parser.add_argument(
        "--estimator",
        metavar="E",
        choices=[*DRIVERS],
        help=f"that steers: {', '.join(DRIVERS)}; default: {DEFAULTS.estimator}",
    )
    parser.add_argument(
        "--strategy",
        metavar="S",
        choices=[*STRATEGIES],
        help=f"which waiting gate next: {', '.join(STRATEGIES)}; default: {DEFAULTS.explorer.strategy}",
    )
    parser.add_argument(
        "--no-reobservation",
        action="store_true",
        help="known corners passed on the way are not used as factors; default: they are",
    )


def _add_budget_options(parser: ArgumentParser) -> None:
    budget = DEFAULTS.budget
    parser.add_argument(
        "--max-moves",
        metavar="N",
        type=_moves,
        help=f"stop with outcome budget after so many moves; default: {budget.moves}",
    )
    parser.add_argument(
        "--max-travel",
        metavar="M",
        type=_metres,
        help=f"stop with outcome budget after so many metres, all robots; default: {budget.travel_m:.0f}",
    )


def _add_output_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--out", metavar="DIR", type=_path, help="run directory; default: a new one, runs/WORLD-NOISE-SEED"
    )
    parser.add_argument(
        "--figures",
        metavar="F",
        choices=["none", "static", "all"],
        help="none, static (default) or all: with an animation of up to 25 s, figures/exploration.mp4 and .gif",
    )
    parser.add_argument("--force", action="store_true", help="overwrite a run in --out")


def settings_of(options) -> ExplorationSettings:
    """Config file first, then options. Raises BadInput."""
    settings = ExplorationSettings()
    if options.config is not None:
        settings = from_mapping(ExplorationSettings, load_toml(options.config), str(options.config))
    given = {name: getattr(options, name) for name in ("world", "seed", "noise", "estimator", "figures")}
    settings = replace(settings, **{name: value for name, value in given.items() if value is not None})
    if options.noise is not None:
        settings = replace(settings, true_noise=None, believed_noise=None)
    if options.tracker is not None:
        settings = settings.with_eyes(options.tracker)
    if options.tracker_sheet is not None:
        if settings.tracker not in CAMERAS:
            raise BadInput(f"--tracker-sheet: only with --tracker {' or '.join(CAMERAS)}")
        settings = settings.with_sheet(options.tracker_sheet)
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
    if options.resume_map is not None:
        settings = replace(settings, resume_map=str(options.resume_map))
    if options.start_corner is not None:
        settings = replace(settings, team=replace(settings.team, start_ring=0, start_corner=options.start_corner))
    if options.no_reobservation:
        settings = replace(settings, explorer=replace(settings.explorer, reobserve=False))
    return settings


def _robot_names(count: int) -> tuple[str, ...]:
    if not 2 <= count <= MOST_ROBOTS:
        raise BadInput(f"--robots: 2 to {MOST_ROBOTS} expected, got {count}")
    return tuple(f"robot{k}" for k in range(count))


def _seed(text: str) -> int:
    return _number(int, text, "a whole number from 0 to 2^63 - 1", lambda seed: 0 <= seed <= LARGEST_SEED)


def _corner(text: str) -> int:
    return _number(int, text, "a whole number from 0 on", lambda corner: 0 <= corner <= LARGEST_SEED)


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
