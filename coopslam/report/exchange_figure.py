"""Uncertainty against role exchanges, for several numbers of sightings per leg."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coopslam.report import canvas


def draw_exchanges(table: np.ndarray, path: Path) -> None:
    """table: (N, 6) rows of sightings per leg, seed, exchanges, sightings so far, sigma in m, error in m.

    Before the first exchange the standing robot is the origin; nothing is drawn of that.
    """
    table = table[table[:, 2] > 0]
    figure = Figure(figsize=(canvas.WIDTH_IN, 4.9), layout="constrained")
    figure.suptitle("How well the standing robot's position is known", fontsize=canvas.TITLE_PT + 1)
    left, right = figure.subplots(1, 2, sharey=True)
    handles = []
    for sightings, colour in zip(np.unique(table[:, 0]), canvas.ROBOTS, strict=False):
        rows = table[table[:, 0] == sightings]
        for axes, column in ((left, 2), (right, 3)):
            at = np.unique(rows[:, 2])
            groups = [rows[rows[:, 2] == exchanges] for exchanges in at]
            x = at if column == 2 else np.array([group[:, column].mean() for group in groups])
            axes.plot(x, _rms(groups, 4), color=colour, lw=2.0)
            axes.plot(x, _rms(groups, 5), color=colour, lw=0, marker="o", ms=3.5)
        handles.append(Line2D([], [], color=colour, lw=2.0, label=f"{sightings:.0f} sightings per leg"))
    handles.append(Line2D([], [], color=canvas.INK, lw=2.0, label="sigma (largest axis)"))
    handles.append(Line2D([], [], color=canvas.INK, lw=0, marker="o", ms=3.5, label="true error, rms over seeds"))
    canvas.tidy(left, "role exchanges so far", "position sigma and error (cm)")
    canvas.tidy(right, "sightings so far", "")
    right.set_xscale("log")
    left.set_xscale("log")
    left.set_yscale("log")
    for axes in (left, right):
        axes.grid(True, color="#dddddd", lw=0.5)
    canvas.legend_below(figure, handles, columns=3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def _rms(groups: list[np.ndarray], column: int) -> np.ndarray:
    """(len(groups),) cm."""
    return np.array([100 * np.sqrt(np.mean(group[:, column] ** 2)) for group in groups])
