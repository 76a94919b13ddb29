"""What a calibration does: errors of ranges, bearings and turns, robot by robot, without and with it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coopslam.estimation.calibration import Calibration
from coopslam.estimation.driven_path import DrivenPath
from coopslam.estimation.sensor_residuals import Course, Sightings, constants_of, windows_of
from coopslam.report.canvas import BLUE, LABEL_PT, MUTED, TITLE_PT, VERMILLION, WIDTH_IN, legend_below, plain, tidy

_WINDOW_S = 3.0
_MOST_POINTS = 1500  # of one kind in a panel
_BEFORE, _AFTER = {"color": VERMILLION}, {"color": BLUE}


def draw_calibration(
    path: Path,
    calibration: Calibration,
    sightings: Mapping[str, Sightings],
    paths: Mapping[str, DrivenPath],
    courses: Mapping[str, Course],
) -> Path:
    """PNG with a row for each robot. courses: where the robots were, true or solved."""
    robots = [robot for robot in calibration.robots if robot in courses]
    figure = Figure(figsize=(WIDTH_IN, 1.0 + 1.55 * max(len(robots), 1)), layout="constrained")
    source = "the truth" if calibration.provenance.with_truth else "the log's own smoothed trajectory"
    title = f"{plain(calibration.provenance.log)}: what sensors miss of {source}"
    figure.suptitle(title, fontsize=TITLE_PT + 1)
    grid = figure.subplots(max(len(robots), 1), 3, squeeze=False, sharex="col", sharey="col")
    for row, robot in zip(grid, robots, strict=False):
        if robot in sightings:
            _sightings(row[0], row[1], sightings[robot], calibration, robot)
        if robot in paths and len(paths[robot]):
            _turns(row[2], paths[robot], courses[robot], calibration, robot)
    last = len(grid) - 1
    for k, row in enumerate(grid):
        tidy(row[0], "range (m)" if k == last else "", "range error (m)")
        tidy(row[1], "bearing (deg)" if k == last else "", "bearing error (deg)")
        tidy(row[2], f"turn in {_WINDOW_S:g} s (deg)" if k == last else "", "turn error (deg)")
        for axes in row:
            axes.axhline(0.0, color=MUTED, linewidth=0.6, zorder=1)
        if k < len(robots):
            row[0].annotate(
                plain(robots[k]), (0.02, 0.96), xycoords="axes fraction", va="top", fontsize=LABEL_PT, weight="bold"
            )
    marks = {"marker": "o", "linestyle": "none", "markersize": 4}
    handles = [
        Line2D([], [], **marks, **_BEFORE, label="as measured"),
        Line2D([], [], **marks, **_AFTER, label="set right"),
    ]
    legend_below(figure, handles)
    figure.savefig(path, dpi=150)
    return path


def _sightings(ranges: Axes, bearings: Axes, seen: Sightings, calibration: Calibration, robot: str) -> None:
    of = calibration.of(robot)
    bearing = np.degrees(seen.bearing_rad)
    _dots(ranges, seen.range_m, seen.raw_range_m - seen.range_m, _BEFORE)
    _dots(ranges, seen.range_m, seen.range_residuals(of, calibration.range_is_depth), _AFTER)
    _dots(bearings, bearing, np.degrees(seen.bearing_residuals(type(of)())), _BEFORE)
    _dots(bearings, bearing, np.degrees(seen.bearing_residuals(of)), _AFTER)


def _turns(axes: Axes, path: DrivenPath, course: Course, calibration: Calibration, robot: str) -> None:
    for of, style in ((type(calibration.of(robot))(), _BEFORE), (calibration.of(robot), _AFTER)):
        windows = windows_of(path, course, _WINDOW_S, constants_of(of))
        residuals = windows.residuals(path, constants_of(of))
        _dots(axes, np.degrees(windows.true[:, 2]), np.degrees(residuals[:, 2]), style)


def _dots(axes: Axes, x: np.ndarray, y: np.ndarray, style: Mapping) -> None:
    """A thinned cloud; the axis reaches as far as all but the wildest hundredth."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if not len(x):
        return
    known = np.abs(x - np.median(x)) <= 1.5 * np.quantile(np.abs(x - np.median(x)), 0.99)
    x, y = x[known], y[known]
    step = -(-len(x) // _MOST_POINTS)
    axes.plot(x[::step], y[::step], ".", markersize=1.6, alpha=0.5, rasterized=True, zorder=2, **style)
    reach = 1.3 * float(np.quantile(np.abs(y), 0.98))
    low, high = axes.get_ylim() if len(axes.lines) > 1 else (0.0, 0.0)
    axes.set_ylim(min(low, -reach), max(high, reach))
