"""What the robot tracker said over time: range, bearing and heading with bands of three standard deviations.

The bands of a good tracker are narrower than the line; beside each panel is how wide they are.
"""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from coopslam.report import canvas
from coopslam.se2 import wrap

SIGMAS = 3.0
ROWS = (("range", "m", 1.0), ("bearing", "deg", 180 / np.pi), ("heading", "deg", 180 / np.pi))
GAP = 2.5  # times the usual time between pictures; longer, and the line is broken


def draw_track(path: Path, title: str, stamps_s: np.ndarray, values: np.ndarray, sigmas: np.ndarray) -> None:
    """stamps_s: (N,).  values, sigmas: (N, 3) range (m), bearing and heading (rad); NaN where nothing was measured."""
    figure = Figure(figsize=(canvas.WIDTH_IN, 6.6), layout="constrained")
    figure.suptitle(title, fontsize=canvas.TITLE_PT + 1)
    panels = figure.subplots(3, 2, sharex=True, width_ratios=(2, 1))
    for k, (name, unit, factor) in enumerate(ROWS):
        known, (left, right) = np.isfinite(values[:, k]), panels[k]
        _draw_line(left, stamps_s[known], factor * values[known, k], factor * sigmas[known, k], is_angle=k > 0)
        right.plot(stamps_s[known], SIGMAS * factor * sigmas[known, k], ".", color=canvas.BLUE, ms=3)
        right.set_yscale("log")
        right.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        right.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        right.yaxis.set_minor_formatter(NullFormatter())
        missed = stamps_s[~np.isfinite(values[:, 0])]
        ticks = {"color": canvas.VERMILLION, "ms": 6, "transform": left.get_xaxis_transform()}
        left.plot(missed, np.zeros(len(missed)), "|", **ticks)
        time = "time (s)" if k == len(ROWS) - 1 else ""
        canvas.tidy(left, time, f"{name} ({unit})")
        canvas.tidy(right, time, f"three sigmas ({unit})")
        for axes in (left, right):
            axes.grid(True, color="#e6e6e6", lw=0.6)
            axes.set_axisbelow(True)
    handles = [
        Line2D([], [], color=canvas.BLUE, lw=1.0, marker=".", ms=4, label="measured"),
        Patch(color=canvas.SKY, alpha=0.5, lw=0, label="three sigmas on both sides"),
        Line2D([], [], color=canvas.VERMILLION, lw=0, marker="|", ms=6, label="target not found"),
    ]
    canvas.legend_below(figure, handles)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, facecolor="white")


def _draw_line(axes: Axes, stamps_s: np.ndarray, values: np.ndarray, sigmas: np.ndarray, is_angle: bool) -> None:
    """Broken where measurements are missing, and where an angle comes round."""
    steps = np.diff(stamps_s)
    broken = steps > GAP * np.median(steps) if len(steps) else np.zeros(0, bool)
    if is_angle:
        broken |= np.abs(np.diff(values) - np.degrees(wrap(np.radians(np.diff(values))))) > 1.0
    for part in np.split(np.arange(len(values)), np.flatnonzero(broken) + 1):
        low, high = values[part] - SIGMAS * sigmas[part], values[part] + SIGMAS * sigmas[part]
        axes.fill_between(stamps_s[part], low, high, color=canvas.SKY, alpha=0.5, lw=0)
        axes.plot(stamps_s[part], values[part], color=canvas.BLUE, lw=1.0, marker=".", ms=3)
