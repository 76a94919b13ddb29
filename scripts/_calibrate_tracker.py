"""What calibrate_tracker.py reads and shows: pictures with their distances, tables, the figure's numbers."""

from collections.abc import Sequence
from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np
from _replay_options import print_table
from _track_source import read_image, read_table
from rich.table import Table

from coopslam.errors import BadInput, shown
from coopslam.report.calibration_curve import CalibrationCurve
from tracker.calibration import FEWEST_PICTURES, Calibrated
from tracker.calibration_accuracy import HeldOut, expected_curve
from tracker.calibration_curve import end_errors, end_rows
from tracker.calibration_fit import Shot
from tracker.calibration_parameters import known_parameters, tolerances_of, values_of
from tracker.data_sheet import dump_data_sheet

CSV = "distances.csv"
FARTHEST_M = 100.0
CURVE_POINTS = 25
SUSPICIOUS_PX = 0.5  # left of edges; what is measured well leaves less


def read_shots(folder: Path, distance_sigma_m: float) -> tuple[list[Shot], list[np.ndarray]]:
    """The pictures that `distances.csv` names, and what it says of them.

    Raises BadInput with file and line for a missing column or file, a number that cannot be, or too few pictures.
    """
    if not folder.is_dir():
        raise BadInput(f"{str(folder)[:200]}: not there; expected a folder with images and {CSV}")
    table = folder / CSV
    rows = read_table(table, ("file", "distance_m"))
    shots, images, seen = [], [], set()
    for line, row in rows:
        where, name = f"{table}:{line}", row["file"] or ""
        if not name or name in seen:
            raise BadInput(f"{where}: file: a name that is not there twice expected, got {shown(name)}")
        seen.add(name)
        distance = _number(row, "distance_m", where)
        if distance is None or not 0 < distance <= FARTHEST_M:
            raise BadInput(f"{where}: distance_m: more than zero and at most {FARTHEST_M:g} expected, got {distance}")
        angles = [_number(row, column, where) for column in ("bearing_deg", "heading_deg")]
        for column, angle in zip(("bearing_deg", "heading_deg"), angles, strict=True):
            if angle is not None and abs(angle) > 360:
                raise BadInput(f"{where}: {column}: -360 to 360 expected, got {angle:g}")
        image = _image(folder, name, where)
        bearing, heading = (None if angle is None else radians(angle) for angle in angles)
        shots.append(Shot(name, distance, bearing, heading, distance_sigma_m))
        images.append(image)
    if len(shots) < FEWEST_PICTURES:
        raise BadInput(f"{table}: {len(shots)} pictures; at least {FEWEST_PICTURES}, at several distances, expected")
    return shots, images


def _number(row: dict, column: str, where: str) -> float | None:
    text = (row.get(column) or "").strip()
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise BadInput(f"{where}: {column}: a number expected, got {shown(text)}")
    return value


def _image(folder: Path, name: str, where: str) -> np.ndarray:
    path = folder / name
    if not path.is_file():
        raise BadInput(f"{where}: file: {shown(name)} is not in {folder}; expected a picture")
    image = read_image(path)
    if image is None:
        raise BadInput(f"{path}: cannot be read as a picture; expected PNG, JPEG or the like")
    return image


def sheet_text(calibrated: Calibrated, folder: Path, nominal: str) -> str:
    """TOML with what was done in comments."""
    said = [f"Calibrated from {nominal} by {len(calibrated.shots)} pictures in {folder}.", *calibrated.weak]
    lines = ["# " + " ".join(line.split()) for line in said]
    return "\n".join(lines) + "\n\n" + dump_data_sheet(calibrated.sheet)


def show(calibrated: Calibrated, held: Sequence[HeldOut]) -> None:
    """Tables: parameters, and ranges of pictures that were held out; words for what is not observable."""
    names, known = calibrated.names, known_parameters(calibrated.nominal)
    table = Table(title=f"{len(calibrated.shots)} pictures; what is left of edges: {_rms(calibrated):.3f} px")
    for column in ("", "unit", "nominal", "tolerance", "calibrated", "sigma"):
        table.add_column(column, justify="left" if column in ("", "unit") else "right")
    before, tolerances = values_of(calibrated.nominal, names), tolerances_of(calibrated.nominal, names)
    for k, name in enumerate(names):
        numbers = (before[k], tolerances[k], calibrated.fit.values[k], calibrated.sigmas[k])
        table.add_row(name, known[name].unit, *(f"{number:.5f}" for number in numbers))
    print_table(table)
    for line in calibrated.weak:
        print(line)
    if _rms(calibrated) > SUSPICIOUS_PX:
        print(f"edges are left {_rms(calibrated):.1f} px off: something is wrong that is not among {', '.join(names)}")
    if calibrated.lost:
        print(f"not used, no target or too few clear edges in them: {', '.join(calibrated.lost)}")
    if held:
        _show_held_out(held, calibrated.shots[0].distance_sigma_m)


def _show_held_out(held: Sequence[HeldOut], distance_sigma_m: float) -> None:
    table = Table(title="ranges of pictures that took no part: error, cm")
    for column in ("picture", "distance, m", "nominal sheet", "calibrated by the others", "sigma, tape included"):
        table.add_column(column, justify="left" if column == "picture" else "right")
    for one in held:
        errors = [
            None if range_m is None else 100 * (range_m - one.distance_m) for range_m in (one.before_m, one.after_m)
        ]
        sigma = None if one.sigma_m is None else 100 * float(np.hypot(one.sigma_m, distance_sigma_m))
        cells = ["-" if cell is None else f"{cell:.2f}" for cell in (*errors, sigma)]
        table.add_row(one.name, f"{one.distance_m:.3f}", *cells)
    table.add_row("root mean square", "", *(_rms_cell(held, field) for field in ("before_m", "after_m")), "")
    print_table(table)


def _rms_cell(held: Sequence[HeldOut], field: str) -> str:
    errors = range_errors(held, field)
    errors = errors[np.isfinite(errors)]
    return f"{100 * np.sqrt(np.mean(errors**2)):.2f}" if len(errors) else "-"


def range_errors(held: Sequence[HeldOut], field: str) -> np.ndarray:
    """(n,) m; NaN where the range is unknown. field: before_m or after_m."""
    ranges = [getattr(one, field) for one in held]
    return np.array([np.nan if r is None else r - one.distance_m for r, one in zip(ranges, held, strict=True)])


def curve_of(calibrated: Calibrated, held: Sequence[HeldOut], title: str) -> CalibrationCurve:
    """What the figure shows."""
    distances = np.array([shot.distance_m for shot in calibrated.shots])
    ranges = np.geomspace(0.9 * distances.min(), 1.1 * distances.max(), CURVE_POINTS)
    errors = end_errors(calibrated)
    errors_m = {"before": range_errors(held, "before_m"), "after": range_errors(held, "after_m")} if held else {}
    return CalibrationCurve(
        title,
        distances,
        errors.before_px,
        errors.after_px,
        ranges,
        end_rows(calibrated.nominal, ranges),
        end_rows(calibrated.sheet, ranges),
        end_rows(calibrated.sheet, distances) + errors.after_px,
        expected_curve(calibrated, ranges),
        errors_m,
    )


def without_note(sheet):
    """The sheet as one that may be calibrated again."""
    return replace(sheet, calibration=None)


def _rms(calibrated: Calibrated) -> float:
    return calibrated.fit.residual_rms_px
