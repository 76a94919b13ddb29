"""Sensors of a log's robots: what they measure wrongly, from the log itself or against its truth; for other logs, too.

Without truth the size of the world is open, and the mean scale of odometry is held equal to the mean scale of ranges.
"""

import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from _calibration import calibrate_itself, part_of, read_calibration, with_part, write_calibration
from _cli import OneLineParser, require_out_file, run
from _replay import ReplaySettings, without_ignored
from _replay_options import add_part_options, print_table
from rich.table import Table

from coopslam.errors import BadInput
from coopslam.estimation.calibration import PARAMETERS, Calibration
from coopslam.estimation.driven_path import driven_paths
from coopslam.estimation.sensor_residuals import Course, sightings_of
from coopslam.estimation.truth_calibration import course_of, truth_calibrate
from coopslam.io.bounds import bounded, require_bounded_truth
from coopslam.io.log import Log, Truth
from coopslam.io.mrclam import MrclamSource
from coopslam.io.sources import open_log
from coopslam.io.toml import from_mapping, load_toml
from coopslam.records import Record
from coopslam.report.calibration_figure import draw_calibration

RESIDUALS = {  # name in the file -> what the table says, factor to its unit
    "range_m": ("range, cm", 100.0),
    "bearing_rad": ("bearing, mrad", 1000.0),
    "forward_m": ("forward in 5 s, cm", 100.0),
    "turn_rad": ("turn in 5 s, mrad", 1000.0),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrate, write the file, show what was found."""
    options = _parsed(arguments)
    settings = ReplaySettings()
    if options.config is not None:
        settings = from_mapping(ReplaySettings, load_toml(options.config), str(options.config))
    from_s = settings.from_s if options.from_s is None else options.from_s
    to_s = settings.to_s if options.to_s is None else options.to_s
    require_out_file(options.out, "a calibration", read_calibration)
    if options.hold is not None and options.with_truth:
        raise BadInput("--hold: not with --with-truth, which measures every constant")
    source = open_log(options.log)
    is_mrclam = isinstance(source, MrclamSource)
    if is_mrclam:
        source = MrclamSource(options.log, settings.mrclam)
    log, truth = source.read(), source.truth() if options.with_truth else None
    log = replace(log, records=bounded(log.records, log.dropped, str(options.log)))
    require_bounded_truth(truth, str(options.log))
    print(f"{log.name}: {len(log.records)} records of {len(log.header.robots)} robots read", flush=True)
    records = without_ignored(log.records, log.header, options.ignore or settings.ignore)
    records, not_told = part_of(records, from_s, to_s, str(options.log)), ()
    if options.with_truth:
        calibration, courses, landmarks = _against_truth(log, records, truth, options.log)
    else:
        timeline, own, tell = settings.estimation.timeline, settings.self_calibration, partial(print, flush=True)
        hold = None if options.hold is None else tuple(name.strip() for name in options.hold.split(","))
        found = calibrate_itself(log, records, is_mrclam, timeline, own, tell, options.rounds, hold)
        not_told = found.not_told
        calibration, courses, landmarks = found.calibration, found.solution.courses, found.solution.landmarks
    calibration = with_part(calibration, from_s, to_s)
    write_calibration(options.out, calibration)
    _show(calibration)
    for line in not_told:
        print(line)
    written = [options.out]
    if options.figures != "none":
        sightings = sightings_of(records, courses, landmarks)
        written.append(options.out.with_suffix(".png"))
        draw_calibration(written[-1], calibration, sightings, driven_paths(records), courses)
    print(f"{' and '.join(map(str, written))} written")
    return 0


def _parsed(arguments: Sequence[str] | None) -> Namespace:
    parser = OneLineParser(prog="calibrate.py", description=__doc__)
    parser.add_argument("log", metavar="LOG", type=Path, help="a run directory, .mcap, MR.CLAM directory or .pyfg")
    parser.add_argument("--out", metavar="C.toml", type=Path, required=True, help="the calibration; units in its keys")
    parser.add_argument("--with-truth", action="store_true", help="against the truth beside the log")
    add_part_options(parser)
    parser.add_argument(
        "--ignore", choices=["nothing", "landmarks", "robots"], help="do not use sightings of these; default: nothing"
    )
    parser.add_argument(
        "--rounds", metavar="N", type=int, default=4, help="of smoothing and calibrating, without truth; default: 4"
    )
    parser.add_argument(
        "--hold",
        metavar="NAMES",
        help="constants that are known to be right, comma between them, without truth: a scale that is held tells how "
        f"large the world is; known: {', '.join(PARAMETERS)}",
    )
    parser.add_argument("--config", metavar="S.toml", type=Path, help="settings, as of replay.py")
    parser.add_argument("--figures", choices=["none", "static"], default="static", help="default: static, beside --out")
    return parser.parse_args(arguments)


def _against_truth(
    log: Log, records: Sequence[Record], truth: Truth | None, path: Path
) -> tuple[Calibration, Mapping[str, Course], Mapping]:
    if truth is None:
        raise BadInput(f"{path}: no truth beside this log; expected one, or calibrate without --with-truth")
    calibration = truth_calibrate(records, log.header.robots, truth.robots, truth.landmarks, log=log.name)
    tracks = {robot: course_of(truth.robots[robot]) for robot in calibration.robots}
    return calibration, tracks, truth.landmarks


def _show(calibration: Calibration) -> None:
    """Two tables: the constants with their standard deviations, and how large residuals are."""
    robots, provenance = list(calibration.robots), calibration.provenance
    against = "against truth" if provenance.with_truth else "by itself"
    table = Table(title=f"{provenance.log} calibrated {against}: constant (standard deviation)")
    table.add_column("", no_wrap=True)
    for robot in robots:
        table.add_column(robot, justify="right")
    for name in PARAMETERS:
        cells = []
        for robot in robots:
            sigma = provenance.sigmas.get(robot, {}).get(name)
            value = getattr(calibration.robots[robot], name)
            cells.append(f"{value:.4f}" if sigma is None else f"{value:.4f} ({sigma:.4f})")
        table.add_row(name, *cells)
    print_table(table)
    table = Table(title="residuals, 1.48 median absolute value: before -> after")
    table.add_column("", no_wrap=True)
    for robot in robots:
        table.add_column(robot, justify="right")
    for name, (said, factor) in RESIDUALS.items():
        both = [[sizes.get(robot, {}).get(name) for sizes in _residuals(calibration)] for robot in robots]
        table.add_row(said, *(" -> ".join("-" if x is None else f"{factor * x:.1f}" for x in pair) for pair in both))
    print_table(table)
    meant = "depths along the camera's axis" if calibration.range_is_depth else "ranges"
    print(f"measured ranges are taken for {meant}; noise in {'the file' if calibration.camera else 'the records'}")


def _residuals(calibration: Calibration) -> tuple[Mapping, Mapping]:
    return calibration.provenance.residuals_before, calibration.provenance.residuals_after


if __name__ == "__main__":
    sys.exit(run(main))
