"""The error of the robot tracker against range: what it reaches, and what the noise of pixels allows."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter

from coopslam.report import canvas

QUANTITIES = (("range", "percent", "range error (%)"), ("bearing", "deg", "bearing error (deg)"))
QUANTITIES += (("heading", "deg", "heading error (deg)"),)
COLOURS = {"helix": canvas.BLUE, "tag_cube": canvas.VERMILLION, "aruco": canvas.MUTED}
LABELS = {"helix": "helix", "tag_cube": "tag cube", "aruco": "tag cube, pose of the library"}
MARKERS = {"helix": "o", "tag_cube": "s", "aruco": "^"}
MEDIAN_OF_SIGMA = 0.6745  # median of |e| of a Gaussian of sigma 1
DASHES, DOTS = (5, 2), (1, 1.5)


def draw_tracker_accuracy(tables: Sequence[Mapping], path: Path) -> Path:
    """Written as PNG; tables as for `tracker_accuracy_figure`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tracker_accuracy_figure(tables).savefig(path, dpi=150, facecolor="white")
    return path


def tracker_accuracy_figure(tables: Sequence[Mapping]) -> Figure:
    """A column for each picture size, a row each for range, bearing and heading.

    tables: method, size, lines; a line has `range` (m) and, for each quantity, {quantity}_error_{unit}_median, ..._95
    and {quantity}_bound_{unit} (Cramer-Rao, one sigma).  NaN or None is a gap.
    """
    sizes = list(dict.fromkeys(table["size"] for table in tables))
    columns = max(len(sizes), 1)
    figure = Figure(figsize=(canvas.WIDTH_IN if columns > 1 else 6.5, 8.4), layout="constrained")
    figure.suptitle("Errors of the robot tracker against range", fontsize=canvas.TITLE_PT + 1)
    grid = figure.subplots(len(QUANTITIES), columns, squeeze=False, sharex=True, sharey="row")
    for r, (quantity, unit, label) in enumerate(QUANTITIES):
        for c, size in enumerate(sizes):
            axes = grid[r, c]
            for table in tables:
                if table["size"] == size:
                    _draw(axes, table, quantity, unit)
            x = "range (m)" if r == len(grid) - 1 else ""
            canvas.tidy(axes, x, label if c == 0 else "", f"{size} pixels" if r == 0 else "")
            _scale(axes, tables)
    canvas.legend_below(figure, _handles(tables), columns=3 if columns > 1 else 2)
    return figure


def _draw(axes: Axes, table: Mapping, quantity: str, unit: str) -> None:
    """Median, 95 % and the median that the bound allows."""
    method = table["method"]
    ranges = np.array([float(line["range"]) for line in table["lines"]])
    style = {"color": COLOURS[method], "lw": 1.4}
    axes.plot(ranges, _column(table, f"{quantity}_error_{unit}_median"), **style, marker=MARKERS[method], ms=4)
    axes.plot(ranges, _column(table, f"{quantity}_error_{unit}_95"), **style | {"lw": 1.0}, dashes=DASHES)
    if method != "aruco":  # the bound of the tag cube is that of its library's pose, too
        axes.plot(ranges, MEDIAN_OF_SIGMA * _column(table, f"{quantity}_bound_{unit}"), **style, dashes=DOTS)


def _column(table: Mapping, key: str) -> np.ndarray:
    values = np.array([np.nan if line[key] is None else line[key] for line in table["lines"]], dtype=float)
    return np.where(values > 0, values, np.nan)


def _scale(axes: Axes, tables: Sequence[Mapping]) -> None:
    ranges = sorted({float(line["range"]) for table in tables for line in table["lines"]})
    axes.set_xscale("log")
    axes.set_yscale("log")
    if ranges:
        axes.xaxis.set_major_locator(FixedLocator(ranges))
        axes.set_xlim(0.9 * ranges[0], 1.1 * ranges[-1])
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(True, color="#e6e6e6", lw=0.6)
    axes.set_axisbelow(True)


def _handles(tables: Sequence[Mapping]) -> list[Line2D]:
    methods = [method for method in LABELS if any(table["method"] == method for table in tables)]
    handles = [Line2D([], [], color=COLOURS[m], marker=MARKERS[m], ms=4, lw=1.4, label=LABELS[m]) for m in methods]
    styles = (("median", {}), ("95 % of errors are smaller", {"dashes": DASHES}))
    styles += (("median at the Cramer-Rao bound", {"dashes": DOTS}),)
    return handles + [Line2D([], [], color=canvas.INK, lw=1.2, label=label, **style) for label, style in styles]
