"""The robot tracker calibrated by pictures of its target at known distances: a data sheet in, a better one out.

IMAGES is a folder with pictures and distances.csv: file, distance_m between the reference points of the two robots,
and where they are known bearing_deg and heading_deg of the target robot. Ten pictures from near to far, with the target
left, right and in the middle, and turned differently, are plenty.
"""

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from _calibrate_tracker import curve_of, read_shots, sheet_text, show, without_note
from _cli import OneLineParser, require_out_file, run
from _target_sheet import write_target

from coopslam.errors import BadInput, NotWritten, require_positive
from coopslam.report.calibration_curve import draw_calibration_curve
from tracker.calibration import calibrate_tracker
from tracker.calibration_accuracy import held_out
from tracker.calibration_parameters import INTRINSICS, require_known, usual_parameters
from tracker.data_sheet import DataSheet, load_data_sheet
from tracker.sheets import load_sheet, sheet_names

HELD_OUT_AT_MOST = 30  # pictures, unless it is asked for


def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrate, write the sheet, show what was found. Returns the exit code."""
    options = _parsed(arguments)
    sheet = without_note(load_sheet(options.sheet))
    if options.print_target is not None:
        write_target(options.print_target, sheet)
        print(f"{options.print_target} written")
        if options.images is None:
            return 0
    if options.images is None or options.out is None:
        raise BadInput("IMAGES and --out expected, or --print-target alone")
    require_positive(10.0, distance_sigma=options.distance_sigma)
    names = _names(options, sheet)
    require_out_file(options.out, "a data sheet", load_data_sheet)
    shots, images = read_shots(options.images, options.distance_sigma)
    calibrated = calibrate_tracker(sheet, names, shots, images, partial(print, flush=True))
    wanted = options.held_out or len(calibrated.shots) <= HELD_OUT_AT_MOST
    held = held_out(calibrated) if wanted else []
    show(calibrated, held)
    try:
        options.out.write_text(sheet_text(calibrated, options.images, options.sheet), encoding="utf-8")
        written = [options.out]
        if options.figures is not None:
            title = f"{options.images.name}: robot tracker calibrated by {len(calibrated.shots)} pictures"
            view = curve_of(calibrated, held, title)
            written.append(draw_calibration_curve(view, options.figures / "calibration.png"))
    except OSError as error:
        raise NotWritten(f"{error.filename}: cannot be written: {error.strerror}", done=True) from error
    print(f"{' and '.join(map(str, written))} written")
    return 0


def _parsed(arguments: Sequence[str] | None):
    parser = OneLineParser(prog="calibrate_tracker.py", description=__doc__)
    parser.add_argument("images", metavar="IMAGES", nargs="?", type=Path, help="folder with pictures and distances.csv")
    known = ", ".join(sheet_names())
    parser.add_argument(
        "--sheet", metavar="NOMINAL.toml", required=True, help=f"what is known before: a TOML file or one of: {known}"
    )
    parser.add_argument("--out", metavar="CALIBRATED.toml", type=Path, help="the calibrated data sheet")
    parser.add_argument("--figures", metavar="DIR", type=Path, help="for calibration.png; default: no figure")
    parser.add_argument(
        "--estimate",
        metavar="NAMES",
        help="comma between them; default: height,tilt,radius,top,pitch of a helix, height,tilt,tag of a tag cube; "
        "heights count from the pattern's lower end unless `bottom` is estimated too",
    )
    parser.add_argument("--intrinsics", action="store_true", help=f"estimate {','.join(INTRINSICS)} as well")
    parser.add_argument(
        "--distance-sigma", metavar="M", type=float, default=0.002, help="of the distances, m; default: 0.002"
    )
    parser.add_argument(
        "--held-out",
        action="store_true",
        help=f"errors of each picture by a calibration without it, for more than {HELD_OUT_AT_MOST} pictures too",
    )
    parser.add_argument(
        "--print-target", metavar="T.svg", type=Path, help="write the pattern on paper, at true scale, with cut marks"
    )
    return parser.parse_args(arguments)


def _names(options, sheet: DataSheet) -> tuple[str, ...]:
    names = list(usual_parameters(sheet))
    if options.estimate is not None:
        names = [name.strip() for name in options.estimate.split(",")]
    if options.intrinsics:
        names += [name for name in INTRINSICS if name not in names]
    return require_known(sheet, names)


if __name__ == "__main__":
    sys.exit(run(main))
