"""The figures of a replayed log, and of a study that compares estimators over many logs."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coopslam.report import canvas, comparison_panels
from coopslam.report.canvas import GREEN, INK, MUTED, ROBOTS, plain
from coopslam.report.comparison_panels import (
    BAND,
    BAND_OF_SOME,
    HEADING,
    POSITION,
    TRUE_PATH,
    judged_poses,
    number,
    unit_of,
)
from coopslam.report.comparison_view import ComparisonView, EstimatorView, study_of
from coopslam.report.number_text import digits, length
from coopslam.report.study_panels import HUES, MARKERS, ODOMETRY_DASHES, log_scale

DPI = 150
ROW_IN = 1.75  # height of a panel over time
ROOM_FOR_DRIFT = 0.12  # of the picture's size on each side, for estimates that leave the truth


def draw_comparison(view: ComparisonView, folder: Path) -> list[Path]:
    """Write every figure that the log has something for as PNG; the files in the order of a report."""
    figures = {
        "trajectories": draw_trajectories(view),
        "errors": draw_errors(view),
        "bars": draw_bars(view),
        "consistency": draw_consistency(view),
        "latency": draw_latency(view),
        "error_by_exchange": draw_error_by_exchange(view),
    }
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        path.unlink(missing_ok=True)  # of an earlier replay, which may have had more to show
        if figure is not None:
            figure.savefig(path, dpi=DPI, format="png", facecolor="white")
            paths.append(path)
    return paths


def best_estimator(view: ComparisonView) -> EstimatorView | None:
    """The one with the lowest ATE; without truth the first that has a path; None when there is none."""
    drawable = [estimator for estimator in view.estimators if estimator.robots]
    judged = [estimator for estimator in drawable if number(estimator.scores, "ate_rmse_m") is not None]
    if judged:
        return min(judged, key=lambda estimator: estimator.scores["ate_rmse_m"])
    return drawable[0] if drawable else None


def robot_colours(view: ComparisonView) -> dict[str, str]:
    """By name; the same in every figure of a log."""
    names = [*view.summary.get("robots", ()), *view.true_paths, *(r for e in view.estimators for r in e.robots)]
    return {name: ROBOTS[k % len(ROBOTS)] for k, name in enumerate(dict.fromkeys(names))}


def draw_trajectories(view: ComparisonView) -> Figure | None:
    """Final paths over the true ones, a panel for each estimator at one scale; landmarks with 3-sigma ellipses."""
    shown = [e for e in view.estimators if any(len(robot.path) for robot in e.robots.values())]
    if not shown:
        return None
    best = best_estimator(view)
    low, high = canvas.with_surroundings(*_limits(view, best, shown))
    columns = min(len(shown), 2)
    rows = -(-len(shown) // columns)
    width_in = (canvas.WIDTH_IN - 0.6) / columns
    height_in = min(width_in * float((high - low)[1] / (high - low)[0]), canvas.TALLEST_IN / columns**0.5)
    figure = Figure(figsize=(canvas.WIDTH_IN, rows * (height_in + 0.25) + 1.5), layout="constrained")
    figure.suptitle(f"{plain(view.log)}: final trajectories", fontsize=canvas.TITLE_PT + 1)
    grid = figure.subplots(rows, columns, squeeze=False)
    for unused in grid.flat[len(shown) :]:
        unused.remove()
    for k, (axes, estimator) in enumerate(zip(grid.flat, shown, strict=False)):
        canvas.plan_axes(axes, low, high)
        axes.set_facecolor("white")
        title = comparison_panels.draw_paths(axes, view, estimator, robot_colours(view), float(max(high - low)))
        ranked = len(shown) > 1 and estimator is best and number(best.scores, "ate_rmse_m") is not None
        axes.set_title(title, fontsize=canvas.TITLE_PT, fontweight="bold" if ranked else "normal")
        if k % columns:
            axes.set_ylabel("")
        if k + columns < len(shown):
            axes.set_xlabel("")
    canvas.legend_below(figure, _path_handles(view, shown), columns=5)
    return figure


def _limits(view: ComparisonView, best: EstimatorView, shown: Sequence[EstimatorView]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the picture: what is true, or else the best estimate; widened, up to a margin, to where others go."""
    core = [*view.true_paths.values(), *(np.reshape(xy, (1, 2)) for xy in view.true_landmarks.values())]
    core = [points for points in core if len(points)] or [*_points_of(best)]
    low, high = np.vstack(core).min(axis=0), np.vstack(core).max(axis=0)
    size = max(float((high - low).max()), 0.5)
    points = np.vstack([points for estimator in shown for points in _points_of(estimator)])
    low = np.minimum(low, np.maximum(points.min(axis=0), low - ROOM_FOR_DRIFT * size))
    high = np.maximum(high, np.minimum(points.max(axis=0), high + ROOM_FOR_DRIFT * size))
    return low - 0.05 * size, high + 0.05 * size


def _points_of(estimator: EstimatorView) -> list[np.ndarray]:
    landmarks = np.reshape(list(estimator.landmarks.values()), (-1, 2))
    return [*(robot.path for robot in estimator.robots.values()), landmarks]


def _path_handles(view: ComparisonView, shown: Sequence[EstimatorView]) -> list:
    drawn = {name for estimator in shown for name in estimator.robots}
    handles = _robot_handles(view, drawn, 2.0)
    if view.true_paths:
        handles.append(Line2D([], [], color=TRUE_PATH, lw=4.0, label="true path"))
    handles += [
        Line2D([], [], color=MUTED, marker=marker, ls="", ms=6, mec="white", label=label)
        for marker, label in (("o", "start"), ("s", "end"))
    ]
    if any(estimator.landmarks for estimator in shown):
        handles.append(Line2D([], [], color=INK, marker="+", ls="", label="landmark"))
    if any(estimator.landmark_covariances for estimator in shown):
        handles.append(Patch(facecolor=GREEN + "30", edgecolor=GREEN, label="its 3-sigma ellipse"))
    if view.true_landmarks:
        handles.append(Line2D([], [], color=INK, marker="o", mfc="none", ls="", label="true landmark"))
        handles.append(Line2D([], [], color=INK, lw=0.9, label="offset to it, same factor"))
    return handles


def _robot_handles(view: ComparisonView, drawn: set[str], width: float) -> list[Line2D]:
    colours = robot_colours(view)
    return [Line2D([], [], color=colours[name], lw=width, label=plain(name, 20)) for name in colours if name in drawn]


def draw_errors(view: ComparisonView) -> Figure | None:
    """Position and heading errors over time beside 3 sigma, a row for each estimator."""
    shown = [e for e in view.estimators if any(len(robot.error_stamps_s) for robot in e.robots.values())]
    if not shown:
        return None
    figure = Figure(figsize=(canvas.WIDTH_IN, (ROW_IN + 0.25) * len(shown) + 1.4), layout="constrained")
    anchored = all(r.is_anchored for e in shown for r in e.robots.values() if len(r.error_stamps_s))
    frame = "relative to the first robot's start" if anchored else "after alignment"
    figure.suptitle(f"{plain(view.log)}: errors {frame}, beside 3σ", fontsize=canvas.TITLE_PT + 1)
    grid = figure.subplots(len(shown), 2, squeeze=False, sharex=True)
    colours = robot_colours(view)
    for row, estimator in zip(grid, shown, strict=True):
        for axes, kind in zip(row, (POSITION, HEADING), strict=True):
            comparison_panels.draw_errors(axes, estimator.robots, colours, kind)
        _name_row(row[0], estimator)
    for axes in grid[-1]:
        axes.set_xlabel("time (s)", fontsize=canvas.LABEL_PT)
    drawn = {name for e in shown for name, robot in e.robots.items() if len(robot.error_stamps_s)}
    handles = _robot_handles(view, drawn, 1.5)
    if any(len(robot.error_sigmas_m) for e in shown for robot in e.robots.values()):
        several = len(drawn) > 1
        edge = {"facecolor": BAND, "edgecolor": INK, "linewidth": 0.8}
        handles.append(Patch(**edge, label="inside 3σ" + (" of every robot" if several else "")))
        if several:
            handles.append(Patch(facecolor=BAND_OF_SOME, label="inside 3σ of some robots"))
        tick = {"color": MUTED, "marker": "|", "ls": "", "ms": 6}
        handles.append(Line2D([], [], **tick, label="robot beyond its own 3σ"))
    canvas.legend_below(figure, handles, columns=4)
    return figure


def _name_row(axes: Axes, estimator: EstimatorView) -> None:
    """The estimator's name left of its row."""
    beside = {"xytext": (-52, 0), "textcoords": "offset points", "rotation": 90, "ha": "right", "va": "center"}
    axes.annotate(
        plain(estimator.name, 22), (0, 0.5), xycoords="axes fraction", fontsize=canvas.TITLE_PT, weight="bold", **beside
    )


def draw_bars(view: ComparisonView) -> Figure | None:
    """Root mean square errors of position and heading, side by side."""
    shown = [e for e in view.estimators if number(e.scores, "ate_rmse_m") is not None]
    if not shown:
        return None
    figure = Figure(figsize=(canvas.WIDTH_IN, 0.52 * len(shown) + 1.7), layout="constrained")
    figure.suptitle(f"{plain(view.log)}: errors of all robots together", fontsize=canvas.TITLE_PT + 1)
    positions, headings = figure.subplots(1, 2, sharey=True)
    names, colours = [e.name for e in shown], [estimator_colour(view, e) for e in shown]
    final = {"color": colours}
    causal = {"facecolor": "white", "edgecolor": colours, "hatch": "////", "linewidth": 0.8}
    for axes, prefix, title, factor, say in (
        (positions, "ate_rmse_m", "ATE: position error", 1.0, length),
        (headings, "heading_rmse_rad", "heading error", 180 / np.pi, lambda value: f"{digits(value)}°"),
    ):
        groups = {}
        for group, key, style in (("final", prefix, final), ("causal", f"causal_{prefix}", causal)):
            values = [number(e.scores, key) for e in shown]
            if any(value is not None for value in values):
                groups[group] = ([None if v is None else factor * v for v in values], style)
        if groups:
            comparison_panels.draw_bars(axes, names, groups, say)
        scale = ", logarithmic" if axes.get_xscale() == "log" else ""
        unit = "m" if factor == 1 else "°"
        canvas.tidy(axes, f"{title}, rms ({unit}{scale})", "")
    handles = [Patch(facecolor=MUTED, label="final: with all records")]
    if any(number(e.scores, "causal_ate_rmse_m") is not None for e in shown):
        handles.append(Patch(facecolor="white", edgecolor=MUTED, hatch="////", label="causal: as known at each moment"))
    canvas.legend_below(figure, handles)
    return figure


def estimator_colour(view: ComparisonView, estimator: EstimatorView) -> str:
    """The same in every figure of a log."""
    return HUES[view.estimators.index(estimator) % len(HUES)]


def draw_consistency(view: ComparisonView) -> Figure | None:
    """NEES over time, and normalized squares of measurements by kind: a row for each estimator that has either."""
    with_nees = [e for e in view.estimators if any(len(judged_poses(r)[0]) for r in e.robots.values())]
    shown = [e for e in view.estimators if e in with_nees or e.scores.get("nis")]
    if not shown:
        return None
    columns = [width for width, there in ((1.5, with_nees), (1.0, any(e.scores.get("nis") for e in shown))) if there]
    heights = [max(ROW_IN, 0.2 * len(e.scores.get("nis") or ()) + 0.7) for e in shown]
    figure = Figure(figsize=(canvas.WIDTH_IN, sum(heights) + 0.25 * len(shown) + 1.4), layout="constrained")
    figure.suptitle(f"{plain(view.log)}: are the covariances honest?", fontsize=canvas.TITLE_PT + 1)
    grid = figure.subplots(
        len(shown), len(columns), squeeze=False, gridspec_kw={"width_ratios": columns, "height_ratios": heights}
    )
    over_time = _draw_nees_column(view, grid[:, 0], shown) if with_nees else []
    limits = comparison_panels.nis_limits([e.scores["nis"] for e in shown if e.scores.get("nis")])
    for axes, estimator in zip(grid[:, -1], shown, strict=True):
        if estimator.scores.get("nis"):
            comparison_panels.draw_nis(axes, estimator.scores["nis"], limits)
        elif len(columns) == 2:
            axes.remove()
        if not with_nees:  # the names of kinds stand where that of the row would be
            axes.set_title(
                f"{plain(estimator.name, 22)}: {axes.get_title('left')}", fontsize=canvas.LABEL_PT, loc="left"
            )
    for axes, estimator in zip(grid[:, 0], shown if with_nees else (), strict=False):
        _name_row(axes, estimator)
    drawn = {name for e in with_nees for name, robot in e.robots.items() if len(judged_poses(robot)[0])}
    handles = _robot_handles(view, drawn, 3.0)
    if over_time:
        handles.append(Line2D([], [], color=INK, lw=1.5, label="running mean of all robots"))
        handles.append(Line2D([], [], color=MUTED, lw=1.0, ls="--", label="expected"))
        handles.append(Patch(facecolor=BAND, label="95 % of honest values"))
    canvas.legend_below(figure, handles, columns=5)
    return figure


def _draw_nees_column(view: ComparisonView, column: Sequence[Axes], shown: Sequence[EstimatorView]) -> list[Axes]:
    """Panels over time on common axes; a row without NEES says so."""
    drawn = []
    for axes, estimator in zip(column, shown, strict=True):
        if any(len(judged_poses(robot)[0]) for robot in estimator.robots.values()):
            comparison_panels.draw_nees(axes, estimator.robots, robot_colours(view))
            drawn.append(axes)
        else:
            axes.set_axis_off()
            style = {"ha": "center", "color": MUTED, "fontsize": canvas.LABEL_PT}
            axes.text(0.5, 0.5, "no NEES: no covariances or no truth", transform=axes.transAxes, **style)
    for name in ("x", "y"):
        limits = np.array([getattr(axes, f"get_{name}lim")() for axes in drawn])
        for axes in drawn:
            getattr(axes, f"set_{name}lim")(limits[:, 0].min(), limits[:, 1].max())
    for axes in drawn[:-1]:
        axes.tick_params(labelbottom=False)
    drawn[-1].set_xlabel("time (s)", fontsize=canvas.LABEL_PT)
    return drawn


def draw_latency(view: ComparisonView) -> Figure | None:
    """Time of an update against the number of poses, for each estimator that has updates; total times of all."""
    causal = [e for e in view.estimators if (e.latencies_s > 0).any()]
    timed = [e for e in view.estimators if number(e.scores, "wall_seconds") is not None]
    panels = len(causal) + bool(timed)
    if not panels:
        return None
    columns = 2 if panels == 4 else min(panels, 3)
    rows = -(-panels // columns)
    height_in = 2.5 * rows if causal else 0.4 * len(timed) + 0.3
    figure = Figure(figsize=(canvas.WIDTH_IN, height_in + 1.3), layout="constrained")
    figure.suptitle(f"{plain(view.log)}: computing time", fontsize=canvas.TITLE_PT + 1)
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for unused in grid[panels:]:
        unused.remove()
    for axes, estimator in zip(grid, causal, strict=False):
        colour = estimator_colour(view, estimator)
        comparison_panels.draw_latency(axes, estimator.name, estimator.latency_poses, estimator.latencies_s, colour)
    _finish_latency(grid[: len(causal)], columns)
    if timed:
        axes = grid[panels - 1]
        names = [e.name if len(e.latencies_s) else f"{e.name} (all at once)" for e in timed]
        style = {"color": [estimator_colour(view, e) for e in timed]}
        times_s = [number(e.scores, "wall_seconds") for e in timed]
        comparison_panels.draw_bars(axes, names, {"total": (times_s, style)}, lambda value: f"{digits(value)} s")
        scale = ", logarithmic" if axes.get_xscale() == "log" else ""
        canvas.tidy(axes, f"total time (s{scale})", "")
        axes.set_title("whole log", fontsize=canvas.LABEL_PT)
    if causal:
        lines = (("-", "running median"), ((0, (3, 1.2)), "running 99 % quantile"))
        handles = [Line2D([], [], color=INK, lw=1.4, ls=dashes, label=label) for dashes, label in lines]
        handles.append(Line2D([], [], color=MUTED, marker=".", ls="", label="one update"))
        canvas.legend_below(figure, handles)
    return figure


def _finish_latency(grid: Sequence[Axes], columns: int) -> None:
    """Common axes, names where there is nothing below or left."""
    if not grid:
        return
    lines = [line for axes in grid for line in axes.lines]
    times_ms = np.concatenate([line.get_ydata() for line in lines])
    most = max(float(np.max(line.get_xdata())) for line in lines)
    for k, axes in enumerate(grid):
        axes.set_yscale("log")
        axes.set_ylim(0.6 * times_ms.min(), 1.6 * times_ms.max())
        axes.set_xlim(0, 1.04 * max(most, 1))
        log_scale(axes, "y")
        axes.grid(color="#e6e6e6", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.set_xlabel("poses so far", fontsize=canvas.LABEL_PT)
        if k % columns == 0:
            axes.set_ylabel("time of an update (ms)", fontsize=canvas.LABEL_PT)


def draw_error_by_exchange(view: ComparisonView) -> Figure | None:
    """Error of the robot that moved, at the end of each of its legs, against role exchanges so far."""
    shown = [e for e in view.estimators if len(e.exchange_errors_m)]
    if not shown:
        return None
    figure = Figure(figsize=(canvas.WIDTH_IN, 4.2), layout="constrained")
    figure.suptitle(f"{plain(view.log)}: error against role exchanges", fontsize=canvas.TITLE_PT + 1)
    axes = figure.subplots()
    everything = np.concatenate([e.exchange_errors_m for e in shown])
    factor, unit = unit_of(float(everything.max()))
    for estimator in shown:
        k = view.estimators.index(estimator) % len(HUES)
        exchanges = np.arange(1, len(estimator.exchange_errors_m) + 1)
        marks = {"marker": MARKERS[k], "markersize": 4} if len(exchanges) <= 60 else {}
        label = plain(estimator.name, 24)
        axes.plot(exchanges, factor * estimator.exchange_errors_m, color=HUES[k], lw=1.4, label=label, **marks)
    canvas.tidy(axes, "role exchanges so far", f"position error of the robot that moved ({unit})")
    axes.xaxis.get_major_locator().set_params(integer=True)
    positive = everything[everything > 0]
    if len(positive) and positive.max() > comparison_panels.LOG_BARS_FROM * np.median(positive):
        log_scale(axes, "y")
    else:
        axes.set_ylim(bottom=0)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    canvas.legend_below(figure, axes.get_legend_handles_labels()[0], columns=6)
    return figure


def draw_study(rows: Sequence[Mapping], folder: Path) -> list[Path]:
    """Write ekf_against_smoothing.png: errors against role exchanges, a column for each noise, a line per estimator.

    rows: one for each estimator on each run, with log or seed, noise, role_exchanges, estimator, ate_rmse_m,
    causal_ate_rmse_m, crlb_ratio, nees_mean; None or absent where there is none. Medians with quartiles over the runs.
    """
    study = study_of(rows)
    shown = comparison_panels.quantities_of(study)
    if not shown:
        return []
    noises, exchanges, estimators = study.dimensions
    columns = len(noises.labels)
    width_in = max(canvas.WIDTH_IN, 2.6 * columns)
    figure = Figure(figsize=(width_in, 2.5 * len(shown) + 1.6), layout="constrained")
    figure.get_layout_engine().set(h_pad=0.06, w_pad=0.06)
    figure.suptitle("Filtering against smoothing", fontsize=canvas.TITLE_PT + 1)
    grid = figure.subplots(len(shown), columns, squeeze=False, sharey="row")
    for row, quantity in zip(grid, shown, strict=True):
        for k, axes in enumerate(row):
            canvas.tidy(axes, "role exchanges", quantity.title, f"noise: {plain(noises.labels[k], 30)}")
            comparison_panels.draw_against_exchanges(axes, study, quantity, k)
            axes.label_outer()
        comparison_panels.finish_row(row, quantity)
    for axes in grid[1:].flat:
        axes.set_title("")
    handles = [
        Line2D([], [], color=HUES[g % len(HUES)], marker=MARKERS[g % len(MARKERS)], label=plain(label, 24))
        for g, label in enumerate(estimators.labels)
    ]
    handles.append(Patch(facecolor=MUTED, alpha=0.3, label="between the quartiles of the runs"))
    if any(quantity.beside for quantity in shown):
        style = {"color": MUTED, "marker": "o", "mfc": "white", "ls": ODOMETRY_DASHES}
        handles.append(Line2D([], [], **style, label="causal: as known at each moment"))
    handles.append(Line2D([], [], color=MUTED, ls="--", lw=1.2, label="expected when honest and efficient"))
    canvas.legend_below(figure, handles, columns=3)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "ekf_against_smoothing.png"
    figure.savefig(path, dpi=DPI, format="png", facecolor="white")
    return [path]
