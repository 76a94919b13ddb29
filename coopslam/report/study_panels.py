"""The panels of a study's figures: medians with quartiles, success rates with intervals, axes that suit the values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from coopslam.report import canvas
from coopslam.report.canvas import BLUE, GREEN, MUTED, ORANGE, PURPLE, SKY, VERMILLION, plain

HUES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
MARKERS = "osD^vP"
DODGE = 0.022  # between the bars of two groups, of the axis
LOG_FROM = 8.0  # ratio of largest to smallest
Z_95 = 1.959964  # two-sided, of a normal


@dataclass(frozen=True, slots=True)
class Dimension:
    """What a study varies: its worlds or an axis."""

    name: str
    title: str  # with its unit
    labels: tuple[str, ...]
    places: tuple[float, ...] | None  # where the values stand, if each has a number


@dataclass(frozen=True)
class StudyResults:
    """The runs of a study; each one's place along all dimensions, the first of which is the world."""

    name: str
    dimensions: tuple[Dimension, ...]
    index: np.ndarray  # (R, D) which value of each dimension a run has
    rows: Sequence[Mapping[str, str]]  # (R) results as text, "" where there is none

    @cached_property
    def success(self) -> np.ndarray:
        """(R,) bool."""
        return np.array([row["success"] == "true" for row in self.rows])

    def column(self, name: str) -> np.ndarray:
        """(R,) numbers; NaN where a run has none."""
        return np.array([float(row.get(name) or "nan") for row in self.rows])


@dataclass(frozen=True, slots=True)
class Quantity:
    """What a panel shows of each run."""

    title: str
    column: str
    factor: float = 1.0
    beside: str = ""  # a column to compare with, drawn dashed
    ideal: float | None = None


ERROR = Quantity("ATE of all poses (cm)", "batch.ate_rmse_m", 100, beside="dead-reckoning.ate_rmse_m")
VERTICES = Quantity("map vertices, rmse (cm)", "vertex_rmse_m", 100)
NEES = Quantity("NEES of poses, mean of a run", "batch.nees_mean", ideal=3.0)
TRAVEL = Quantity("distance travelled / perimeter", "travel_over_perimeter")
SECONDS = Quantity("time of a run (s)", "seconds")
SUCCESS = Quantity("complete and true maps (%)", "success", 100)
ODOMETRY_DASHES = (0, (3, 2))


def wilson(successes: int, runs: int) -> tuple[float, float]:
    """95 % interval of a success rate. (0, 1) without runs."""
    if not runs:
        return 0.0, 1.0
    share, z2 = successes / runs, Z_95**2 / runs
    middle, half = share + z2 / 2, Z_95 * np.sqrt(share * (1 - share) / runs + z2 / (4 * runs))
    return float(max((middle - half) / (1 + z2), 0.0)), float(min((middle + half) / (1 + z2), 1.0))


def places_of(dimension: Dimension) -> tuple[np.ndarray, bool]:
    """Where the values stand along the axis, and whether it is logarithmic; ranks for values without numbers."""
    if dimension.places is None:
        return np.arange(float(len(dimension.labels))), False
    places = np.array(dimension.places)
    return places, bool(places.min() > 0 and places.max() >= LOG_FROM * places.min())


def set_places(axes: Axes, dimension: Dimension, places: np.ndarray, log: bool, groups: int) -> None:
    """Ticks at the values, if their labels have room; a margin on both sides, for the bars of so many groups."""
    if log:
        axes.set_xscale("log")
    scaled = np.log(places) if log else places
    spread = max(float(np.ptp(scaled)), 1e-9)
    margin = (0.05 + 0.5 * DODGE * groups) * spread
    low, high = scaled.min() - margin, scaled.max() + margin
    axes.set_xlim(*(np.exp([low, high]) if log else (low, high)))
    ordered = np.unique(scaled)
    labels = [f"{place:g}" for place in places] if dimension.places else [plain(x, 24) for x in dimension.labels]
    room = np.diff(ordered).min(initial=spread) / spread
    if not dimension.places or room > 0.016 * max(map(len, labels)):
        axes.set_xticks(places, labels)
        axes.xaxis.set_minor_locator(NullLocator())
        if sum(map(len, labels)) > 45:
            axes.tick_params(axis="x", labelrotation=25)
    elif log:
        log_scale(axes, "x")


def dodged(places: np.ndarray, log: bool, group: int, groups: int) -> np.ndarray:
    """Places moved a little, so that the bars of several groups stand side by side."""
    scaled = np.log(places) if log else places
    moved = scaled + DODGE * max(float(np.ptp(scaled)), 1e-9) * (group - (groups - 1) / 2)
    return np.exp(moved) if log else moved


def styles(quantity: Quantity) -> list[tuple[str, dict]]:
    """Columns of a panel, and how the one that is compared with differs."""
    beside = [(quantity.beside, {"linestyle": ODOMETRY_DASHES, "linewidth": 1.1, "markersize": 3.5})]
    return [(quantity.column, {}), *(beside if quantity.beside else [])]


def draw_medians(axes: Axes, results: StudyResults, quantity: Quantity, cells, places, group: int, joined: bool):
    """Medians with quartiles: a line and a band, or bars when the places have nothing between them."""
    for column, style in styles(quantity):
        values = quantity.factor * results.column(column)
        quartiles = np.full((3, len(cells)), np.nan)
        for i, cell in enumerate(cells):
            some = values[cell & results.success & np.isfinite(values)]
            if len(some):
                quartiles[:, i] = np.quantile(some, [0.25, 0.5, 0.75])
        low, middle, high = quartiles
        order = np.argsort(places, kind="stable")
        look = {"color": HUES[group], "marker": MARKERS[group], "markersize": 5, "linewidth": 1.7, "zorder": 3} | style
        if style:
            look["markerfacecolor"] = "white"
        if joined:
            axes.plot(places[order], middle[order], **look)
            if not style:
                axes.fill_between(places[order], low[order], high[order], color=HUES[group], alpha=0.18, linewidth=0)
        else:
            axes.errorbar(places, middle, [middle - low, high - middle], **{**look, "linestyle": "", "elinewidth": 1})


def draw_rates(axes: Axes, results: StudyResults, cells, places, group: int, joined: bool, across: bool = False):
    """Success rates with Wilson's interval, %; across: rates to the right."""
    counts = [(int((cell & results.success).sum()), int(cell.sum())) for cell in cells]
    rate = np.array([100 * good / runs if runs else np.nan for good, runs in counts])
    low, high = 100 * np.array([wilson(*count) for count in counts]).T
    bars = [np.maximum(rate - low, 0), np.maximum(high - rate, 0)]
    look = {"color": HUES[group], "marker": MARKERS[group], "markersize": 5, "elinewidth": 1.2, "capsize": 2.5}
    if across:
        axes.errorbar(rate, places, xerr=bars, linestyle="", **look)
        return
    order = np.argsort(places)
    bars = [bar[order] for bar in bars]
    axes.errorbar(places[order], rate[order], bars, linestyle="-" if joined else "", linewidth=1.0, **look)


def finish(axes: Axes, quantity: Quantity, across: bool = False) -> None:
    """Scale and grid of the axis that has the quantity."""
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    name, limits = ("x", axes.set_xlim) if across else ("y", axes.set_ylim)
    if quantity is SUCCESS:
        limits(-4, 104)
        return
    data = np.concatenate([np.ravel(line.get_xdata() if across else line.get_ydata()) for line in axes.lines] or [[]])
    data = data[np.isfinite(data.astype(float))]
    if not len(data):
        say_nothing(axes)
        return
    if quantity.ideal is not None:
        (axes.axvline if across else axes.axhline)(quantity.ideal, color=MUTED, ls="--", lw=1.2, zorder=1)
        data = np.append(data, quantity.ideal)
    if data.min() > 0 and data.max() > LOG_FROM * data.min():
        log_scale(axes, name, narrow=across)
    else:
        limits(0, 1.12 * max(float(axes.dataLim.ymax if not across else axes.dataLim.xmax), float(data.max())))


def log_scale(axes: Axes, name: str, narrow: bool = False) -> None:
    """Logarithmic, with plain numbers: at 1, 2 and 5 where they have room."""
    (axes.set_xscale if name == "x" else axes.set_yscale)("log")
    low, high = axes.get_xlim() if name == "x" else axes.get_ylim()
    wide = high / low > (20 if narrow else 200 if name == "x" else 2000)
    axis = axes.xaxis if name == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0), numticks=12))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_locator(NullLocator())


def say_nothing(axes: Axes) -> None:
    axes.text(
        0.5, 0.5, "no run succeeded", transform=axes.transAxes, ha="center", color=MUTED, fontsize=canvas.LABEL_PT
    )
