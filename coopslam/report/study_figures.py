"""The figures of a parameter study: errors, honesty and success against each axis and against the size of the worlds.

Errors are medians with the range between the quartiles, over the runs that succeeded; success rates have 95 %
intervals after Wilson (1927).
"""

import re
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coopslam.report import canvas
from coopslam.report.canvas import MUTED, plain
from coopslam.report.study_panels import (
    ERROR,
    HUES,
    LOG_FROM,
    MARKERS,
    NEES,
    ODOMETRY_DASHES,
    SECONDS,
    SUCCESS,
    TRAVEL,
    VERTICES,
    StudyResults,
    dodged,
    draw_medians,
    draw_rates,
    finish,
    log_scale,
    places_of,
    say_nothing,
    set_places,
    styles,
    wilson,
)

SIZES_AT_LEAST = 3  # of worlds, for figures against it
FIGURES_AT_MOST = 8  # of one axis, one for each combination of the others; beyond, the others are pooled


def draw_study(results: StudyResults, directory: Path) -> list[Path]:
    """Write every figure that the study has something for as PNG, instead of those of an earlier sweep."""
    directory.mkdir(parents=True, exist_ok=True)
    for old in directory.glob("study_*.png"):
        old.unlink()
    figures = {}
    for k, dimension in enumerate(results.dimensions):
        if len(dimension.labels) > 1 and (k > 0 or len(set(dimension.places)) >= SIZES_AT_LEAST):
            figures |= _along(results, k)
    if len(results.dimensions[0].labels) > 1:
        figures["worlds"] = draw_worlds(results)
    if not figures:
        figures["runs"] = draw_runs(results)
    paths = []
    for name, figure in figures.items():
        paths.append(directory / f"study_{_slug(name)}.png")
        figure.savefig(paths[-1], dpi=150, format="png", facecolor="white")
    return paths


def _along(results: StudyResults, k: int) -> dict[str, Figure]:
    """Figures against dimension k: colours are a second dimension, and there is a figure for each value of the rest."""
    hue = _hue(results, k)
    others = [j for j, d in enumerate(results.dimensions) if j not in (k, hue) and len(d.labels) > 1]
    combinations = list(product(*(range(len(results.dimensions[j].labels)) for j in others)))
    name = "world_size" if k == 0 else results.dimensions[k].name
    everything = np.ones(len(results.index), bool)
    if len(combinations) > FIGURES_AT_MOST:
        pooled = ", ".join(results.dimensions[j].name for j in others)
        return {name: draw_against(results, k, hue, everything, f"all values of {pooled} together")}
    figures = {}
    for values in combinations:
        chosen = (results.index[:, others] == values).all(axis=1) if others else everything
        labels = [results.dimensions[j].labels[v] for j, v in zip(others, values, strict=True)]
        said = ", ".join(f"{results.dimensions[j].name} {label}" for j, label in zip(others, labels, strict=True))
        figures["-".join([name, *labels])] = draw_against(results, k, hue, chosen, said)
    return figures


def _hue(results: StudyResults, k: int) -> int | None:
    """The first other dimension that has as many values as there are colours, or fewer."""
    fit = [j for j, d in enumerate(results.dimensions) if j != k and 1 < len(d.labels) <= len(HUES)]
    return fit[0] if fit else None


def draw_against(results: StudyResults, k: int, hue: int | None, chosen: np.ndarray, said: str = "") -> Figure:
    """Panels against dimension k of the `chosen` (R,) runs; hue: index of the dimension that has the colours."""
    shown = [ERROR, VERTICES, NEES, SUCCESS] if k else [ERROR, VERTICES, NEES, SUCCESS, TRAVEL, SECONDS]
    rows = len(shown) // 2
    figure = Figure(figsize=(canvas.WIDTH_IN, 2.9 * rows + 1.1), layout="constrained")
    figure.get_layout_engine().set(h_pad=0.08, w_pad=0.08)
    dimension = results.dimensions[k]
    places, log = places_of(dimension)
    groups = _groups(results, hue, chosen)
    for axes, quantity in zip(figure.subplots(rows, 2).flat, shown, strict=True):
        canvas.tidy(axes, plain(dimension.title), quantity.title)
        set_places(axes, dimension, places, log, len(groups))
        for g, (_, members) in enumerate(groups):
            cells = [members & (results.index[:, k] == value) for value in range(len(places))]
            beside = dodged(places, log, g, len(groups))
            if quantity is SUCCESS:
                draw_rates(axes, results, cells, beside, g, joined=k > 0)
            else:
                draw_medians(axes, results, quantity, cells, places if k else beside, g, joined=k > 0)
        finish(axes, quantity)
    _head(figure, plain(results.name) + (f": {plain(said, 90)}" if said else ""), results, hue, groups)
    canvas.legend_below(figure, _legend(bands=k > 0), columns=3)
    return figure


def draw_worlds(results: StudyResults) -> Figure:
    """The worlds by name from small to large: every run, the median, and the success rate."""
    hue = _hue(results, 0)
    world = results.dimensions[0]
    order = np.argsort(world.places, kind="stable")[::-1]
    groups = _groups(results, hue, np.ones(len(results.index), bool))
    figure = Figure(figsize=(canvas.WIDTH_IN, 0.36 * len(order) + 0.12 * len(groups) + 1.9), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for axes, quantity in zip(panels, (ERROR, VERTICES, SUCCESS), strict=True):
        canvas.tidy(axes, quantity.title, "")
        for g, (_, members) in enumerate(groups):
            heights = np.arange(len(order)) + 0.6 * (0.5 - (g + 0.5) / len(groups))
            cells = [members & (results.index[:, 0] == value) for value in order]
            if quantity is SUCCESS:
                draw_rates(axes, results, cells, heights, g, joined=False, across=True)
                continue
            for height, cell in zip(heights, cells, strict=True):
                for column, style in styles(quantity):
                    values = quantity.factor * results.column(column)[cell & results.success]
                    axes.plot(values, np.full(len(values), height), ".", color=HUES[g], alpha=0.3, markersize=4)
                    if len(values):
                        look = {"markerfacecolor": "white"} if style else {}
                        axes.plot(np.median(values), height, MARKERS[g], color=HUES[g], markersize=6, zorder=4, **look)
        finish(axes, quantity, across=True)
    panels[0].set_yticks(range(len(order)), [f"{plain(world.labels[v])} ({world.places[v]:g})" for v in order])
    handles = [Line2D([], [], color=MUTED, marker="o", ls="", label="median, smoothed")]
    handles += [Line2D([], [], color=MUTED, marker="o", mfc="white", ls="", label="median, odometry alone")]
    handles += [Line2D([], [], color=MUTED, marker=".", ls="", alpha=0.5, label="one run that succeeded")]
    _head(figure, f"{plain(results.name)}: worlds by number of vertices", results, hue, groups)
    canvas.legend_below(figure, handles, columns=3)
    return figure


def draw_runs(results: StudyResults) -> Figure:
    """Distributions over the runs of a study that has one combination only."""
    successes, runs = int(results.success.sum()), len(results.rows)
    low, high = wilson(successes, runs)
    figure = Figure(figsize=(canvas.WIDTH_IN, 6.2), layout="constrained")
    figure.get_layout_engine().set(h_pad=0.08, w_pad=0.08)
    rate = f"{successes} of {runs} runs complete and true ({100 * low:.1f} to {100 * high:.1f} % at 95 %)"
    figure.suptitle(f"{plain(results.name)}: {rate}", fontsize=canvas.TITLE_PT + 1)
    for axes, quantity in zip(figure.subplots(2, 2).flat, (ERROR, VERTICES, NEES, SECONDS), strict=True):
        canvas.tidy(axes, quantity.title, "runs that succeeded")
        drawn = {column: quantity.factor * results.column(column)[results.success] for column, _ in styles(quantity)}
        drawn = {column: values[np.isfinite(values) & (values > 0)] for column, values in drawn.items()}
        everything = np.concatenate(list(drawn.values()))
        if not len(everything):
            say_nothing(axes)
            continue
        wide = everything.max() > LOG_FROM * everything.min()
        space = np.geomspace if wide else np.linspace
        edges = space(0.98 * everything.min(), 1.02 * everything.max(), int(np.clip(np.sqrt(runs) * 1.5, 8, 50)))
        for column, values in drawn.items():
            odometry = column == quantity.beside
            label = f"median {np.median(values):.3g}" if quantity.ideal is None else f"mean {np.mean(values):.3g}"
            if quantity.beside:
                label = f"{'odometry alone' if odometry else 'smoothed'}: {label}"
            axes.hist(values, edges, color=HUES[odometry], alpha=0.55, label=label)
        if wide:
            log_scale(axes, "x")
        if quantity.ideal:
            axes.axvline(quantity.ideal, color=MUTED, ls="--", lw=1.2, label=f"honest: {quantity.ideal:g}")
        axes.yaxis.get_major_locator().set_params(integer=True)
        beside = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": 2, "frameon": False}
        axes.legend(fontsize=canvas.SMALL_PT, handlelength=1.4, columnspacing=1.2, **beside)
    return figure


def _groups(results: StudyResults, hue: int | None, chosen: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """(label, members (R,)) of each colour."""
    if hue is None:
        return [("", chosen)]
    return [(label, chosen & (results.index[:, hue] == k)) for k, label in enumerate(results.dimensions[hue].labels)]


def _head(figure: Figure, title: str, results: StudyResults, hue: int | None, groups: list) -> None:
    """Title, and below it what the colours are."""
    if hue is None:
        figure.suptitle(title, fontsize=canvas.TITLE_PT + 1)
        return
    labels = [plain(label, 30) for label, _ in groups]
    handles = [Line2D([], [], color=HUES[g], marker=MARKERS[g], label=label) for g, label in enumerate(labels)]
    legend = figure.legend(
        handles=handles,
        title=f"{title}\ncolours: {plain(results.dimensions[hue].title if hue else 'world')}",
        loc="outside upper center",
        ncols=len(handles) if sum(map(len, labels)) < 90 else 3,
        fontsize=canvas.LABEL_PT - 0.5,
        title_fontsize=canvas.TITLE_PT,
        frameon=False,
    )
    legend.get_title().set_multialignment("center")


def _legend(bands: bool) -> list:
    spread = "between its quartiles"
    return [
        Line2D([], [], color=MUTED, marker="o", label="median of the runs that succeeded"),
        Patch(facecolor=MUTED, alpha=0.3, label=spread) if bands else Line2D([], [], color=MUTED, lw=1, label=spread),
        Line2D([], [], color=MUTED, marker="o", mfc="white", ls=ODOMETRY_DASHES, label="odometry alone"),
        Line2D([], [], color=MUTED, ls="--", label="NEES of an honest estimate"),
        Line2D([], [], color=MUTED, marker="o", ls="", label="success rate, bar: its 95 % interval"),
    ]


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name)[:80].strip("_") or "axis"
