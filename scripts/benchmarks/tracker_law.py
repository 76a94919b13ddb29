"""The noise law of the helix tracker as it is in the field: with what its calibration leaves of a rig's errors.

Rigs are built with random errors, calibrated by twelve pictures at distances that a tape measure knows to 5 mm (see
_rigs.py), and then measure random scenes. Errors of all rigs are pooled; a law in the terms of
`sim.noise.TrackerNoise` is fitted to them (_law.py), its own uncertainty by bootstrap over rigs. Not in it: errors of
the camera's yaw and of where the helix starts, which pictures without known bearings and headings cannot tell.
Rigs whose calibration calibrate_tracker.py warns of are left out of the first table, and are in the second.
Written: samples.csv (a line for each picture), summary.json (tables and laws).
"""

import json
import os
import sys
from argparse import ArgumentTypeError, Namespace
from collections.abc import Sequence
from dataclasses import asdict
from math import isfinite
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

import numpy as np
from _cli import OneLineParser, run
from _files import make_directory, without_nan, write_csv
from _jobs import count, in_processes, whole
from _law import Line, fitted_line, normalized_square, resampled, rms, robust_sigma, share_between
from _rigs import CALIBRATED, PERFECT, SIZE, BuildErrors, RigJob, RigResult, Sighting, used_rig
from _scenes import RANGES_M, sheet_of

from coopslam.errors import UnderDetermined
from tracker.calibration_parameters import require_known, usual_parameters

OUT = Path("runs/tracker_law")
DRAWS = 200  # of the bootstrap
# Of a law: the field of TrackerNoise, its error, whether at range zero or per metre. Heading has no slope.
FIELDS = (
    ("range_sigma_m", "range_error_m", "floor"),
    ("range_sigma_per_m", "range_error_m", "slope"),
    ("lateral_sigma_m", "across_error_m", "floor"),
    ("bearing_sigma_rad", "across_error_m", "slope"),
    ("heading_sigma_rad", "heading_error_rad", "floor"),
)
ERRORS = tuple(dict.fromkeys(error for _, error, _ in FIELDS))


def main(arguments: Sequence[str] | None = None) -> int:
    """Build and use all rigs, print tables and laws. Returns the exit code."""
    options = _parser().parse_args(arguments)
    sheet = sheet_of("helix", SIZE)
    estimated = require_known(sheet, options.estimate or usual_parameters(sheet))
    make_directory(options.out)
    errors = BuildErrors(options.tolerances, options.focal_sigma, options.ring_sigma)
    jobs = [RigJob(k, options.pictures, options.seed, options.perfect, estimated, errors) for k in range(options.rigs)]
    rigs = in_processes(used_rig, jobs, options.processes, "rigs")
    sightings = [sighting for rig in rigs for sighting in rig.sightings]
    write_csv(options.out / "samples.csv", sightings)
    summary = _settings(options, estimated, errors) | {"rigs_left": _left(rigs)}
    print(_rigs_text(rigs, summary["rigs_left"]))
    for title, own in _kinds(rigs, sightings):
        if not any(sighting.detected for sighting in own):
            raise UnderDetermined(f"{title}: no picture shows the target")
        summary[title] = law_of(own, options.seed)
        print(f"\n{title}: {SIZE}, seed {options.seed}\n{table_of(summary[title])}", flush=True)
    text = json.dumps(without_nan(summary), indent=1, allow_nan=False)
    (options.out / "summary.json").write_text(text + "\n", encoding="utf-8")
    return 0


def _kinds(rigs: Sequence[RigResult], sightings: Sequence[Sighting]) -> list[tuple[str, list[Sighting]]]:
    """What gets a table. Rigs with a warning would be mended by who reads it; with them there is another one."""
    warned = {rig.rig for rig in rigs if rig.warning is not None}
    calibrated, perfect = ([s for s in sightings if s.sheet == kind] for kind in (CALIBRATED, PERFECT))
    kinds = [("calibrated", [s for s in calibrated if s.rig not in warned])]
    if warned:
        kinds.append(("calibrated, with warned ones", calibrated))
    return kinds + ([("perfect", perfect)] if perfect else [])


def law_of(sightings: Sequence[Sighting], seed: int) -> dict:
    """A line of errors for each range, the law, its sigma by bootstrap over rigs, and how well it fits.

    Raises UnderDetermined for too few sightings.
    """
    columns = {error: _columns(sightings, error) for error in ERRORS}
    fits = {error: fitted_line(values, ranges, error == ERRORS[2]) for error, (values, ranges, _) in columns.items()}
    sigmas = {}
    for error, (values, ranges, groups) in columns.items():

        def refitted(rows: np.ndarray, error=error, values=values, ranges=ranges) -> tuple[float, float]:
            line = fitted_line(values[rows], ranges[rows], error == ERRORS[2])
            return line.floor, line.slope

        drawn = resampled(refitted, groups, np.random.default_rng(seed), DRAWS)
        sigmas[error] = dict(zip(("floor", "slope"), drawn.std(axis=0).tolist(), strict=True))
    bins = [r for r in RANGES_M if any(s.bin_m == r for s in sightings)]
    lines = [{"range": r} | _line([s for s in sightings if s.bin_m == r], fits) for r in bins]
    return {
        "law": {name: getattr(fits[error], part) for name, error, part in FIELDS},
        "law_sigma": {name: sigmas[error][part] for name, error, part in FIELDS},
        "lines": lines,
        "all": {"range": "all"} | _line(sightings, fits),
    }


def _line(sightings: Sequence[Sighting], fits: dict[str, Line]) -> dict:
    """Of some sightings: what was seen, how large errors are, how they compare with the law."""
    seen = [s for s in sightings if s.detected]
    line = {
        "n": len(sightings),
        "detected": len(seen) / len(sightings),
        "heading_known": sum(s.heading_known for s in seen) / len(sightings),
        "elsewhere": sum(s.elsewhere for s in seen),
    }
    seen = [s for s in seen if not s.elsewhere]
    percents = np.array([100 * s.range_error_m / s.range_m for s in seen])
    bearings = np.array([s.bearing_error_rad for s in seen])
    for name, values in (("range_error_percent", percents), ("bearing_error_rad", bearings)):
        line |= {f"{name}_rms": rms(values), f"{name}_robust": robust_sigma(values)}
    for error, fit in fits.items():
        values, ranges, groups = _columns(sightings, error)
        line |= {
            f"{error}_rms": rms(values),
            f"{error}_robust": robust_sigma(values),
            f"{error}_over_law": normalized_square(values, ranges, fit),
            f"{error}_share_of_rig": share_between(values, groups),
        }
    return line


def _columns(sightings: Sequence[Sighting], error: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N,) errors, ranges and rigs of the sightings of the target that have such an error."""
    own = [s for s in sightings if s.detected and not s.elsewhere and isfinite(getattr(s, error))]
    return tuple(np.array([getattr(s, name) for s in own]) for name in (error, "range_m", "rig"))


def table_of(summary: dict) -> str:
    """Text: errors as rms (robust), the mean square over the law, and a rig's share of it."""
    head = f"{'range':>6}{'n':>6}{'seen':>6}{'head':>6}{'range':>18}{'range':>16}{'across':>16}{'bearing':>18}"
    head += f"{'heading':>16}{'elsewhere':>10}{'squares over law':>18}{'share of rig':>16}"
    unit = f"{'m':>6}{'':>6}{'%':>6}{'%':>6}{'m':>18}{'%':>16}{'mm':>16}{'deg':>18}{'deg':>16}"
    unit += "".join(f"{text:>{width}}" for text, width in (("", 10), ("r / a / h", 18), ("r / a / h, %", 16)))
    rows = [head, unit, *map(_row, [*summary["lines"], summary["all"]])]
    law, sigma = summary["law"], summary["law_sigma"]
    rows += ["", "TrackerNoise (+- of rigs)"]
    for name, value in law.items():
        angle = f"  ({np.degrees(value):.4f} deg)" if name.endswith("_rad") else ""
        rows.append(f"    {name:<20} {value:.6f} +- {sigma[name]:.6f}{angle}")
    return "\n".join(rows)


def _row(line: dict) -> str:
    def both(name: str, scale: float, digits: int) -> str:
        return f"{scale * line[f'{name}_rms']:.{digits}f} ({scale * line[f'{name}_robust']:.{digits}f})"

    def each(name: str, text: str, scale: float = 1.0) -> str:
        return "/".join(format(scale * line[f"{error}_{name}"], text) for error in ERRORS)

    degrees = np.degrees(1.0)
    cells = (
        (str(line["range"]), 6),
        (str(line["n"]), 6),
        (f"{100 * line['detected']:.0f}", 6),
        (f"{100 * line['heading_known']:.0f}", 6),
        (both("range_error_m", 1, 4), 18),
        (both("range_error_percent", 1, 3), 16),
        (both("across_error_m", 1e3, 2), 16),
        (both("bearing_error_rad", degrees, 4), 18),
        (both("heading_error_rad", degrees, 3), 16),
        (str(line["elsewhere"]), 10),
        (each("over_law", ".2f"), 18),
        (each("share_of_rig", ".0f", 100), 16),
    )
    return "".join(text.rjust(width) for text, width in cells)


def _left(rigs: Sequence[RigResult]) -> dict:
    """Root mean squares of the parameters' errors before and after calibration."""
    done = [rig for rig in rigs if rig.failure is None]
    return {
        "calibrated": len(done),
        "failures": {rig.rig: rig.failure for rig in rigs if rig.failure is not None},
        "warnings": {rig.rig: rig.warning for rig in rigs if rig.warning is not None},
        "before": {name: rms(np.array([rig.errors[name] for rig in rigs])) for name in rigs[0].errors},
        "after": {name: rms(np.array([rig.left[name] for rig in done])) for name in (done[0].left if done else ())},
    }


def _rigs_text(rigs: Sequence[RigResult], left: dict) -> str:
    lines = [f"{left['calibrated']} of {len(rigs)} rigs calibrated; rms errors of the sheet before and after"]
    for name, before in left["before"].items():
        after = f"{left['after'][name]:.6f}" if name in left["after"] else "-"
        lines.append(f"    {name:<8} {before:.6f}  {after}")
    return "\n".join(
        [*lines, *(f"rig {rig}: {failure}" for rig, failure in (left["failures"] | left["warnings"]).items())]
    )


def _settings(options: Namespace, estimated: Sequence[str], errors: BuildErrors) -> dict:
    names = ("rigs", "pictures", "seed")
    return {name: getattr(options, name) for name in names} | {"estimated": list(estimated)} | asdict(errors)


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="tracker_law.py", description=__doc__)
    parser.add_argument("--rigs", type=count, default=10, help="default: %(default)s")
    parser.add_argument("--pictures", type=count, default=50, help="of each rig; default: %(default)s")
    parser.add_argument("--perfect", action="store_true", help="measure all pictures with the true sheet, too")
    help_names = "parameters to calibrate, comma between them; default: those of calibrate_tracker.py"
    parser.add_argument("--estimate", metavar="NAMES", type=_names, help=help_names)
    errors = BuildErrors()
    help_tolerances = "sigmas of what is built, a share of the tolerances of calibration; default: %(default)s"
    parser.add_argument("--tolerances", metavar="SHARE", type=_up_to(2.0), help=help_tolerances)
    help_focal = "sigma of the true focal length, a share; default: %(default)s"
    parser.add_argument("--focal-sigma", metavar="SHARE", type=_up_to(0.1), help=help_focal)
    help_ring = "sigma of the rings' width, m; default: %(default)s"
    parser.add_argument("--ring-sigma", metavar="M", type=_up_to(0.01), help=help_ring)
    parser.set_defaults(
        tolerances=errors.tolerance_share, focal_sigma=errors.focal_sigma, ring_sigma=errors.ring_sigma_m
    )
    parser.add_argument("--seed", type=whole, default=0, help="of all random numbers; default: %(default)s")
    parser.add_argument("--processes", type=count, default=2, help="default: %(default)s")
    help_out = "directory of the files, which are replaced; default: %(default)s"
    parser.add_argument("--out", metavar="DIR", type=Path, default=OUT, help=help_out)
    return parser


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


def _up_to(most: float):
    """Reads a number of the command line that is zero or more."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = -1.0
        if not 0 <= value <= most:
            raise ArgumentTypeError(f"0 to {most:g} expected, got {text[:60]!r}")
        return value

    return read


if __name__ == "__main__":
    sys.exit(run(main))
