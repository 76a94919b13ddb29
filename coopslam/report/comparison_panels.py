"""The panels that compare estimators: errors beside what was claimed, NEES, NIS, time per update, and bars with values.

Long logs are thinned for drawing only: every number that is printed is taken from all points.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection

from coopslam.evaluation.consistency import chi_square_band
from coopslam.report import canvas
from coopslam.report.canvas import BLUE, GREEN, INK, MUTED, SMALL_PT, VERMILLION, plain
from coopslam.report.comparison_view import ComparisonView, EstimatorView, RobotErrors
from coopslam.report.ellipses import ellipse_axes, magnification
from coopslam.report.number_text import count, digits, length
from coopslam.report.study_panels import (
    HUES,
    LOG_FROM,
    Quantity,
    StudyResults,
    dodged,
    draw_medians,
    log_scale,
    places_of,
    set_places,
)

POINTS_AT_MOST = 1500  # of all curves of a panel, or of one robot's dots
NEES_SHOWN_FROM = 0.03  # 1 in 700 honest values is smaller, and tells nothing
STRETCHES = 60  # over which running means and quantiles are taken
MOMENTS = 600  # at which bands of several robots are compared
LOG_BARS_FROM = 20.0  # ratio of largest to smallest
NEES_BAND = chi_square_band(3, 1)  # two-sided, 95 %, of one pose
TRUE_PATH = "#c9c9c9"
CROWDED = 3000  # points of a path; lines get thinner towards it
SIGMAS = 3.0  # of the landmarks' ellipses
BAND, BAND_OF_SOME = "#cfd6db", "#e9edf0"
STUDIED = (
    Quantity("ATE (cm)", "ate_rmse_m", 100, beside="causal_ate_rmse_m"),
    Quantity("ATE / Cramér-Rao bound", "crlb_ratio", ideal=1.0),
    Quantity("NEES, mean of a run", "nees_mean", ideal=3.0),
)
NIS_SHOWN_FROM = 0.02  # smaller means end there and have their value printed


@dataclass(frozen=True, slots=True)
class ErrorKind:
    """Position or heading: what an error panel shows, and in which unit."""

    name: str
    errors: Callable[[RobotErrors], np.ndarray]
    sigmas: Callable[[RobotErrors], np.ndarray]
    signed: bool


POSITION = ErrorKind("position", lambda r: r.shown_position_errors_m, lambda r: r.error_sigmas_m, signed=False)
HEADING = ErrorKind("heading", lambda r: r.shown_heading_errors_rad, lambda r: r.heading_sigmas_rad, signed=True)


def number(scores: Mapping, key: str) -> float | None:
    """A score; None where it is absent or no number."""
    value = scores.get(key)
    return float(value) if isinstance(value, int | float) and isfinite(value) else None


def thinned(values: np.ndarray, at_most: int = POINTS_AT_MOST) -> np.ndarray:
    """Ascending indices of at most so many points that keep the outline of a curve: extremes of each stretch."""
    if len(values) <= at_most:
        return np.arange(len(values))
    starts = np.linspace(0, len(values), at_most // 2 + 1).astype(int)
    stretches = [(start, values[start:end]) for start, end in zip(starts, starts[1:], strict=False)]
    return np.unique([[start + part.argmin(), start + part.argmax()] for start, part in stretches])


def evenly(number: int, at_most: int = POINTS_AT_MOST) -> np.ndarray:
    """Indices of at most so many of a number of points, evenly: for dots, whose distribution must stay."""
    return np.arange(number) if number <= at_most else np.linspace(0, number - 1, at_most).astype(int)


def running(
    at: np.ndarray, values: np.ndarray, of: Callable[[np.ndarray], float], each: int = 10
) -> tuple[np.ndarray, np.ndarray]:
    """(S,) centres and (S,) statistics of stretches of equal length along `at`, of about `each` values or more."""
    if not len(at):
        return np.zeros(0), np.zeros(0)
    stretches = int(np.clip(len(at) // each, 1, STRETCHES))
    edges = np.linspace(at.min(), at.max(), stretches + 1)
    which = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, stretches - 1)
    held = np.unique(which)
    return (edges[held] + edges[held + 1]) / 2, np.array([of(values[which == one]) for one in held])


def unit_of(largest_m: float) -> tuple[float, str]:
    """Factor and name of the unit that suits lengths up to one."""
    return (1.0, "m") if largest_m >= 2 else (100.0, "cm") if largest_m >= 0.005 else (1000.0, "mm")


def beyond(robot: RobotErrors, kind: ErrorKind) -> np.ndarray:
    """(M,) bool: where the error is larger than 3 of its own sigmas; nowhere without covariances."""
    errors, sigmas = np.abs(kind.errors(robot)), kind.sigmas(robot)
    return errors > 3 * sigmas if len(sigmas) else np.zeros(len(errors), bool)


def draw_paths(
    axes: Axes, view: ComparisonView, estimator: EstimatorView, colours: Mapping[str, str], size_m: float
) -> str:
    """Truth, paths and landmarks of one estimator in a picture so many metres large; the panel's title."""
    longest = max(len(robot.path) for robot in estimator.robots.values())
    scale = float(np.clip(np.sqrt(300 / max(longest, 1)), np.sqrt(300 / CROWDED), 1.0))
    for path in view.true_paths.values():
        axes.plot(*path.T, color=TRUE_PATH, linewidth=4.0 * max(scale, 0.5), zorder=2, solid_joinstyle="round")
    for name, robot in estimator.robots.items():
        if not len(robot.path):
            continue
        axes.plot(*robot.path.T, color=colours[name], linewidth=1.5 * scale, zorder=3, solid_joinstyle="round")
        for point, style in ((robot.path[0], {"marker": "o"}), (robot.path[-1], {"marker": "s"})):
            axes.plot(*point, **style, color=colours[name], markersize=6, mec="white", mew=0.8, zorder=6)
    times = _draw_landmarks(axes, view, estimator, size_m)
    ate = number(estimator.scores, "ate_rmse_m")
    said = plain(estimator.name, 24) + ("" if ate is None else f": ATE {length(ate)}")
    return said + (f", landmarks ×{times:,}" if times > 1 else "")


def _draw_landmarks(axes: Axes, view: ComparisonView, estimator: EstimatorView, size_m: float) -> int:
    """Landmarks with ellipses and lines to the true ones, both enlarged by the factor that is returned."""
    names = list(estimator.landmarks)
    for xy in view.true_landmarks.values():
        axes.plot(*xy, "o", mfc="none", mec=INK, mew=0.8, markersize=6, zorder=4)
    if not names:
        return 1
    at = np.array([estimator.landmarks[name] for name in names])
    axes.plot(*at.T, "+", color=INK, markersize=5, mew=1.0, zorder=5)
    known = [name for name in names if name in estimator.landmark_covariances]
    factor = 1
    if known:
        covariances = np.array([estimator.landmark_covariances[name] for name in known])
        semi_axes, directions = ellipse_axes(covariances, SIGMAS**2)
        factor = magnification(float(np.median(semi_axes[:, 0])), 0.04 * size_m)
        ellipses = EllipseCollection(
            *(2 * factor * semi_axes.T),
            np.degrees(directions),
            units="xy",
            offsets=np.array([estimator.landmarks[name] for name in known]),
            offset_transform=axes.transData,
            facecolors=GREEN + "30",
            edgecolors=GREEN,
            linewidths=0.9,
            zorder=3.5,
        )
        axes.add_collection(ellipses, autolim=False)
    judged = [name for name in names if name in view.true_landmarks]
    starts = np.array([estimator.landmarks[name] for name in judged]).reshape(-1, 2)
    truth = np.array([view.true_landmarks[name] for name in judged]).reshape(-1, 2)
    lines = np.stack([starts, starts + factor * (truth - starts)], axis=1)
    axes.add_collection(LineCollection(lines, colors=INK, linewidths=0.9, zorder=4.5), autolim=False)
    return factor


def draw_errors(axes: Axes, robots: Mapping[str, RobotErrors], colours: Mapping[str, str], kind: ErrorKind) -> None:
    """Error of each robot over time, the band that all of them claim, the wider one of some, and who left their own."""
    judged = {name: robot for name, robot in robots.items() if len(robot.error_stamps_s)}
    errors = np.abs(np.concatenate([kind.errors(robot) for robot in judged.values()]))
    factor, unit = unit_of(float(errors.max())) if not kind.signed else (180 / np.pi, "°")
    claims = [(robot.error_stamps_s, 3 * kind.sigmas(robot)) for robot in judged.values() if len(kind.sigmas(robot))]
    moments_s, low, high = common_band(claims)
    for band, colour in ((high, BAND_OF_SOME), (low, BAND)):
        lower = -factor * band if kind.signed else np.zeros(len(band))
        axes.fill_between(moments_s, lower, factor * band, color=colour, linewidth=0, zorder=1)
    for edge in (-factor * low, factor * low) if kind.signed else (factor * low,):
        axes.plot(moments_s, edge, color="white", linewidth=2.0, alpha=0.7, zorder=2.4)
        axes.plot(moments_s, edge, color=INK, linewidth=0.8, zorder=2.5)
    for name, robot in judged.items():
        shown = thinned(kind.errors(robot), max(POINTS_AT_MOST // len(judged), 300))
        style = {"marker": "."} if len(shown) == 1 else {"linewidth": 0.8}
        curve, stamps_s = kind.errors(robot)[shown], robot.error_stamps_s[shown]
        turns = np.flatnonzero(np.abs(np.diff(curve)) > np.pi) + 1 if kind.signed else []  # from 180° to -180°: no line
        curve, stamps_s = factor * np.insert(curve, turns, np.nan), np.insert(stamps_s, turns, np.nan)
        axes.plot(stamps_s, curve, color=colours[name], alpha=0.9, zorder=2, **style)
    top = factor * _top(errors, high)
    marks = _mark_beyond(axes, judged, colours, kind)
    axes.set_ylim(-top if kind.signed else 0.0, top + marks * (2 if kind.signed else 1) * top)
    if kind.signed:
        axes.axhline(0, color=MUTED, linewidth=0.6, zorder=1.5)
    canvas.tidy(axes, "", f"{kind.name} error ({unit})")
    axes.set_title(_said_of_errors(judged, errors, bool(claims), kind), fontsize=canvas.LABEL_PT, loc="left")


def common_band(claims: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Moments (T,), and the narrowest and widest (T,) of several bands there.

    claims: stamps (N,), s, and half-widths (N,) of each robot. A robot takes part from its first stamp to its last.
    """
    if not claims:
        return (np.zeros(0),) * 3
    ends = [stamps_s[[0, -1]] for stamps_s, _ in claims]
    moments_s = np.linspace(np.min(ends), np.max(ends), MOMENTS)
    bands = np.array([np.interp(moments_s, *claim, left=np.nan, right=np.nan) for claim in claims])
    return moments_s, np.fmin.reduce(bands), np.fmax.reduce(bands)


def _top(errors: np.ndarray, high: np.ndarray) -> float:
    """Where an axis of errors ends: nearly all errors fit; bands fit unless they are many times as wide."""
    usual = float(np.quantile(errors, 0.995))
    largest = float(errors.max()) if errors.max() <= 3 * usual else 1.5 * usual
    claimed = high[np.isfinite(high)]
    band = float(np.quantile(claimed, 0.98)) if len(claimed) else 0.0
    return 1.08 * max(largest, min(band, 4 * largest), 1e-9)


def _mark_beyond(axes: Axes, judged: Mapping[str, RobotErrors], colours: Mapping[str, str], kind: ErrorKind) -> float:
    """A row of ticks on top for each robot, where it is beyond its own 3 sigma; the share of the axis this takes."""
    left = {name: robot.error_stamps_s[beyond(robot, kind)] for name, robot in judged.items()}
    left = {name: stamps_s for name, stamps_s in left.items() if len(stamps_s)}
    step = min(0.045, 0.3 / max(len(left), 1))
    for row, (name, stamps_s) in enumerate(left.items()):
        distinct = stamps_s[np.unique(np.round(stamps_s / max(np.ptp(stamps_s), 1e-9) * 600), return_index=True)[1]]
        height = np.full(len(distinct), 0.985 - step * (row + 0.5))
        style = {"transform": axes.get_xaxis_transform(), "markersize": 95 * step, "markeredgewidth": 0.8}
        axes.plot(distinct, height, "|", color=colours[name], zorder=3, **style)
    reserved = step * len(left)
    return 1.1 * reserved / (1 - reserved)


def _said_of_errors(judged: Mapping[str, RobotErrors], errors: np.ndarray, claimed: bool, kind: ErrorKind) -> str:
    say = (lambda value: f"{digits(np.degrees(value))}°") if kind.signed else length
    rms, left = float(np.sqrt(np.mean(errors**2))), sum(int(beyond(robot, kind).sum()) for robot in judged.values())
    own = sum(len(kind.sigmas(robot)) for robot in judged.values())
    honesty = f"{digits(100 * left / max(own, 1), 2)} % beyond 3σ" if claimed else "no covariances"
    return f"{kind.name}: rms {say(rms)}, largest {say(errors.max())}, {honesty}"


def draw_nees(axes: Axes, robots: Mapping[str, RobotErrors], colours: Mapping[str, str]) -> None:
    """NEES of all poses as dots, its running mean, and the two-sided 95 % band of 3 degrees of freedom."""
    axes.set_yscale("log")
    axes.axhspan(*NEES_BAND, color=BAND, linewidth=0, zorder=0)
    axes.axhline(3.0, color=MUTED, linewidth=1.0, linestyle="--", zorder=1)
    judged = {name: judged_poses(robot) for name, robot in robots.items()}
    stamps_s = np.concatenate([stamps for stamps, _ in judged.values()])
    nees = np.concatenate([values for _, values in judged.values()])
    for name, (when_s, values) in judged.items():
        shown = evenly(len(values))
        axes.plot(when_s[shown], values[shown], ".", color=colours[name], markersize=2, alpha=0.5, zorder=2, mew=0)
    mean_at, mean = running(stamps_s, nees, np.mean)
    axes.plot(mean_at, mean, color="white", linewidth=3.0, zorder=2.9)
    axes.plot(mean_at, mean, color=INK, linewidth=1.5, marker="" if len(mean) > 1 else "o", zorder=3)
    axes.set_ylim(NEES_SHOWN_FROM, max(1.5 * nees.max(), 30.0))
    inside = np.mean((nees >= NEES_BAND[0]) & (nees <= NEES_BAND[1]))
    said = f"NEES: mean {digits(nees.mean())} (3 expected), {100 * inside:.0f} % inside the band"
    canvas.tidy(axes, "", "NEES")
    axes.set_title(said, fontsize=canvas.LABEL_PT, loc="left")


def judged_poses(robot: RobotErrors) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (K,) and NEES (K,) of the poses that have one: the anchored pose has none."""
    if not len(robot.nees):
        return np.zeros(0), np.zeros(0)
    known = np.isfinite(robot.nees) & (robot.nees > 0)
    return robot.error_stamps_s[known], robot.nees[known]


def nis_limits(tables: Sequence[Mapping[str, Mapping]]) -> tuple[float, float]:
    """Ends of an axis that holds the means of all tables, and the words beside them."""
    means = [one["mean_per_dof"] for table in tables for one in table.values()]
    drawn = [mean for mean in means if mean >= NIS_SHOWN_FROM]
    low, high = 0.7 * min([0.5, *drawn]), 1.4 * max([2.0, *drawn])
    return low, high * (high / low) ** 0.6


def nis_text(one: Mapping) -> str:
    """Mean and count; means below 1e-9 count as arithmetic."""
    mean = one["mean_per_dof"]
    return f"{digits(mean if mean > 1e-9 else 0)} ({count(one['count'])})"


def draw_nis(axes: Axes, nis: Mapping[str, Mapping], limits: tuple[float, float]) -> None:
    """Mean squared normalized residual of each kind per degree of freedom, as bars from 1, with counts."""
    kinds = sorted(nis, key=lambda kind: -nis[kind]["count"])
    heights = np.arange(len(kinds))[::-1]
    axes.set_xscale("log")
    axes.set_xlim(*limits)
    axes.axvline(1.0, color=INK, linewidth=1.0, zorder=3)
    for height, kind in zip(heights, kinds, strict=True):
        mean = nis[kind]["mean_per_dof"]
        colour = VERMILLION if mean > 1 else BLUE
        if mean >= NIS_SHOWN_FROM:
            axes.barh(height, mean - 1, left=1, height=0.5, color=colour, zorder=2)
            axes.plot(mean, height, "o", color=colour, markersize=4, zorder=4)
        words = nis_text(nis[kind])
        beside = {"xytext": (6, 0), "textcoords": "offset points", "va": "center", "fontsize": SMALL_PT, "color": INK}
        axes.annotate(words, (max(mean, 1.0), height), **beside)
    axes.set_ylim(-0.6, len(kinds) - 0.4)
    axes.set_yticks(heights, [plain(kind.replace("_", " "), 26) for kind in kinds])
    log_scale(axes, "x")
    canvas.tidy(axes, "", "")
    axes.tick_params(axis="y", labelsize=SMALL_PT, length=0)
    axes.set_title("NIS per degree of freedom (count)", fontsize=canvas.LABEL_PT, loc="left")


def draw_latency(axes: Axes, name: str, poses: np.ndarray, latencies_s: np.ndarray, colour: str) -> None:
    """Time of each update against the number of poses then, with running median and 99 % quantile."""
    timed = latencies_s > 0
    poses, latencies_ms = poses[timed], 1000 * latencies_s[timed]
    shown = np.union1d(thinned(latencies_ms, POINTS_AT_MOST // 2), evenly(len(poses)))
    axes.plot(poses[shown], latencies_ms[shown], ".", color=colour, markersize=2.5, alpha=0.35, mew=0, zorder=2)
    for share, dashes, each in ((50, "-", 20), (99, (0, (3, 1.2)), 300)):
        line = running(poses, latencies_ms, lambda values, share=share: float(np.percentile(values, share)), each)
        axes.plot(*line, color="white", linewidth=3.0, zorder=2.9)
        axes.plot(*line, color=INK, linewidth=1.4, linestyle=dashes, zorder=3)
    median, slow = (digits(value) for value in np.percentile(latencies_ms, [50, 99]))
    canvas.tidy(axes, "", "")
    axes.set_title(f"{plain(name, 24)}\nmedian {median} ms, p99 {slow} ms", fontsize=canvas.LABEL_PT)


def draw_bars(axes: Axes, labels: Sequence[str], groups: Mapping[str, tuple], say: Callable[[float], str]) -> None:
    """Horizontal bars with their values beside them; logarithmic when they differ by much.

    labels: of the rows, from the top.  groups: style name -> (values with None where there is none, bar style).
    """
    heights = np.arange(len(labels))[::-1]
    thickness = 0.76 / len(groups)
    known = [value for values, _ in groups.values() for value in values if value is not None]
    positive = [value for value in known if value > 0]
    log = bool(positive) and max(positive) > LOG_BARS_FROM * min(positive)
    low, high = (0.4 * min(positive), max(positive)) if log else (0.0, max([*known, 1e-12]))
    if log:
        axes.set_xscale("log")
    axes.set_xlim(low, high * (high / low) ** 0.35 if log else 1.3 * high)
    for g, (values, style) in enumerate(groups.values()):
        at = heights + thickness * ((len(groups) - 1) / 2 - g)
        for k, value in enumerate(values):
            if value is None:
                continue
            look = {name: given[k] if isinstance(given, list) else given for name, given in style.items()}
            axes.barh(at[k], max(value, low) - low, left=low, height=0.92 * thickness, zorder=2, **look)
            beside = {"xytext": (3, 0), "textcoords": "offset points", "va": "center", "fontsize": SMALL_PT}
            axes.annotate(say(value), (max(value, low), at[k]), color=INK, **beside)
    axes.set_yticks(heights, [plain(label, 24) for label in labels])
    axes.set_ylim(-0.55, len(labels) - 0.45)
    axes.grid(axis="x", color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    if log:
        log_scale(axes, "x", narrow=True)


def quantities_of(study: StudyResults) -> list[Quantity]:
    """What the study has values of; beside it only what has values too."""
    known = {name for q in STUDIED for name in (q.column, q.beside) if np.isfinite(study.column(name)).any()}
    return [q if q.beside in known else replace(q, beside="") for q in STUDIED if q.column in known]


def draw_against_exchanges(axes: Axes, study: StudyResults, quantity: Quantity, noise: int) -> None:
    """Medians with quartiles of each estimator at one level of noise."""
    _, exchanges, estimators = study.dimensions
    places, log = places_of(exchanges)
    set_places(axes, exchanges, places, log, len(estimators.labels))
    for g in range(len(estimators.labels)):
        chosen = (study.index[:, 0] == noise) & (study.index[:, 2] == g) & np.isfinite(study.column(quantity.column))
        held = np.unique(study.index[chosen, 1])
        cells = [chosen & (study.index[:, 1] == place) for place in held]
        joined = len(places) > 1
        at = places if joined else dodged(places, log, g, len(estimators.labels))
        draw_medians(axes, study, quantity, cells, at[held], g % len(HUES), joined)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    if quantity.ideal is not None:
        axes.axhline(quantity.ideal, color=MUTED, linestyle="--", linewidth=1.2, zorder=1)


def finish_row(row: Sequence[Axes], quantity: Quantity) -> None:
    """The common scale of panels that show one quantity."""
    drawn = [np.asarray(line.get_ydata(), float) for axes in row for line in axes.lines]
    values = np.concatenate([*drawn, [] if quantity.ideal is None else [quantity.ideal]])
    values = values[np.isfinite(values)]
    if values.min() > 0 and values.max() > LOG_FROM * values.min():
        row[0].set_ylim(0.7 * values.min(), 1.4 * values.max())
        log_scale(row[0], "y")
    else:
        row[0].set_ylim(0, 1.12 * max(values.max(), max(float(axes.dataLim.ymax) for axes in row)))
