"""What exploration costs: metres against what no team can do without, role exchanges against the number of vertices."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from coopslam.report import canvas

MULTIPLES = (1, 2, 4)  # of the bound that are drawn as lines
MARKERS = "o^sDv"


def draw_cost(rows: Sequence[Mapping], path: Path) -> None:
    """rows: one a run, with strategy, walls_bound_m, metres, n, role_exchanges. Written as PNG."""
    figure = Figure(figsize=(canvas.WIDTH_IN, 4.6), layout="constrained")
    figure.suptitle("Cost of exploration, one mark a world", fontsize=canvas.TITLE_PT + 1)
    metres, exchanges = figure.subplots(1, 2)
    handles = []
    for k, strategy in enumerate(dict.fromkeys(row["strategy"] for row in rows)):
        style = {
            "color": canvas.ROBOTS[k % len(canvas.ROBOTS)],
            "marker": MARKERS[k % len(MARKERS)],
            "lw": 0,
            "ms": 4.5,
            "mfc": "none",
        }
        mine = [row for row in rows if row["strategy"] == strategy]
        metres.plot(_column(mine, "walls_bound_m"), _column(mine, "metres"), **style)
        exchanges.plot(_column(mine, "n"), _column(mine, "role_exchanges"), **style)
        handles.append(Line2D([], [], **style, label=strategy))
    handles += _multiples(metres, _column(rows, "walls_bound_m"))
    canvas.tidy(metres, "lower bound of teams that follow every wall (m)", "metres driven by the team")
    canvas.tidy(exchanges, "vertices of the world", "role exchanges")
    for axes in (metres, exchanges):
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(ScalarFormatter())
            axis.set_minor_formatter(NullFormatter())
        axes.grid(True, color="#e6e6e6", lw=0.6)
        axes.set_axisbelow(True)
    canvas.legend_below(figure, handles, columns=5)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, facecolor="white")


def _multiples(axes: Axes, bounds: np.ndarray) -> list[Line2D]:
    """Lines at multiples of the bound; what the legend says of them."""
    ends, handles = np.array([bounds.min(), bounds.max()]), []
    for times, dashes in zip(MULTIPLES, ((), (6, 2), (2, 2)), strict=True):
        style = {"color": canvas.MUTED, "lw": 1.0, "dashes": dashes} if dashes else {"color": canvas.MUTED, "lw": 1.0}
        axes.plot(ends, times * ends, zorder=1, **style)
        handles.append(Line2D([], [], label="the bound" if times == 1 else f"{times} times the bound", **style))
    return handles


def _column(rows: Sequence[Mapping], key: str) -> np.ndarray:
    return np.array([float(row[key]) for row in rows])
