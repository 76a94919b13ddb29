"""The robot tracker calibrated by pictures at known distances, after figure 1b of the paper."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FormatStrFormatter, LogLocator, NullFormatter, ScalarFormatter

from coopslam.report.canvas import BLUE, INK, MUTED, TITLE_PT, VERMILLION, WIDTH_IN, legend_below, plain, tidy

_BEFORE, _AFTER = {"color": VERMILLION}, {"color": BLUE}
_ENDS = (("lower end", "o"), ("upper end", "s"))
_DASHES, _DOTS = (5, 2), (1, 1.5)
_QUANTITIES = (("range error (cm)", 100.0), ("bearing error (deg)", 180 / np.pi), ("heading error (deg)", 180 / np.pi))
_TICKS_M = (0.3, 0.5, 1, 2, 3, 5, 10, 20)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationCurve:
    """What there is to draw: n pictures, R ranges, the lower and the upper end of the pattern."""

    title: str
    distances_m: np.ndarray  # (n,)
    before_px: np.ndarray  # (n, 2) by how much lower the ends are than the nominal sheet says; NaN: not found
    after_px: np.ndarray  # (n, 2) than the calibrated sheet says
    ranges_m: np.ndarray  # (R,)
    nominal_rows_px: np.ndarray  # (R, 2) straight ahead
    rows_px: np.ndarray  # (R, 2) calibrated
    measured_rows_px: np.ndarray  # (n, 2) in the pictures, as they were straight ahead
    sigmas: np.ndarray  # (R, 2, 3) of range, bearing, heading; by edges alone, and with the calibration's
    range_errors: Mapping[str, np.ndarray]  # "before", "after": (n,) of pictures that took no part, m; or empty


def draw_calibration_curve(view: CalibrationCurve, path: Path) -> Path:
    """PNG: rows of the ends against distance, what is left of them, and expected errors against range."""
    figure = Figure(figsize=(WIDTH_IN, 7.6), layout="constrained")
    figure.suptitle(plain(view.title), fontsize=TITLE_PT + 1)
    grid = figure.add_gridspec(6, 2)
    rows, left = figure.add_subplot(grid[:4, 0]), figure.add_subplot(grid[4:, 0])
    _draw_rows(rows, view)
    _draw_left(left, view)
    for k, (label, factor) in enumerate(_QUANTITIES):
        _draw_expected(figure.add_subplot(grid[2 * k : 2 * k + 2, 1]), view, k, label, factor)
    legend_below(figure, _handles(bool(len(view.range_errors))), columns=4)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, facecolor="white")
    return path


def _draw_rows(axes: Axes, view: CalibrationCurve) -> None:
    for end, (_, marker) in enumerate(_ENDS):
        axes.plot(view.ranges_m, view.nominal_rows_px[:, end], **_BEFORE, lw=1.2, dashes=_DASHES)
        axes.plot(view.ranges_m, view.rows_px[:, end], **_AFTER, lw=1.2)
        axes.plot(view.distances_m, view.measured_rows_px[:, end], marker, color=INK, ms=4, mfc="none")
    axes.invert_yaxis()
    tidy(axes, "", "row in the picture (px)", "ends of the pattern")
    _scale(axes, view)


def _draw_left(axes: Axes, view: CalibrationCurve) -> None:
    axes.axhline(0.0, color=MUTED, linewidth=0.6, zorder=1)
    for end, (_, marker) in enumerate(_ENDS):
        for errors, style in ((view.before_px, _BEFORE), (view.after_px, _AFTER)):
            axes.plot(view.distances_m, errors[:, end], marker, **style, ms=4, mfc="none")
    axes.set_yscale("symlog", linthresh=0.1)
    tidy(axes, "distance (m)", "left over (px)")
    _scale(axes, view)


def _draw_expected(axes: Axes, view: CalibrationCurve, k: int, label: str, factor: float) -> None:
    axes.plot(view.ranges_m, factor * view.sigmas[:, 0, k], color=MUTED, lw=1.2, dashes=_DOTS)
    axes.plot(view.ranges_m, factor * view.sigmas[:, 1, k], **_AFTER, lw=1.2)
    if k == 0:
        for name, style in (("before", _BEFORE), ("after", _AFTER)):
            if name in view.range_errors:
                axes.plot(view.distances_m, factor * np.abs(view.range_errors[name]), "x", **style, ms=5)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if k == 1 else (1,)))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    last, first = k == len(_QUANTITIES) - 1, k == 0
    tidy(axes, "range (m)" if last else "", label, "expected errors, one sigma" if first else "")
    _scale(axes, view)


def _scale(axes: Axes, view: CalibrationCurve) -> None:
    axes.set_xscale("log")
    axes.set_xlim(view.ranges_m[0], view.ranges_m[-1])
    axes.xaxis.set_major_locator(FixedLocator(_TICKS_M))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(True, color="#e6e6e6", lw=0.6)
    axes.set_axisbelow(True)


def _handles(has_errors: bool) -> list[Line2D]:
    marks = {"linestyle": "none", "ms": 4, "mfc": "none"}
    handles = [Line2D([], [], color=INK, marker=marker, label=f"{name}, measured", **marks) for name, marker in _ENDS]
    handles.append(Line2D([], [], **_BEFORE, lw=1.2, dashes=_DASHES, label="nominal sheet"))
    handles.append(Line2D([], [], **_AFTER, lw=1.2, label="calibrated"))
    handles.append(Line2D([], [], color=MUTED, lw=1.2, dashes=_DOTS, label="noise of one picture alone"))
    if has_errors:
        cross = {"linestyle": "none", "marker": "x", "ms": 5}
        handles.append(Line2D([], [], **cross, **_BEFORE, label="held out, nominal, less the tape"))
        handles.append(Line2D([], [], **cross, **_AFTER, label="held out, calibrated, less the tape"))
    return handles
