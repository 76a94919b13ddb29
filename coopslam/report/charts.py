"""The figures of a run with plain axes: how uncertainty grows, and how the map's vertices compare with the truth."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coopslam.report import canvas
from coopslam.report.canvas import BLUE, INK, MUTED, ROBOTS, VERMILLION, plain
from coopslam.report.ellipses import CHI_SQUARE_95
from coopslam.report.run_view import RunView

MARKS_AT_MOST = 40  # role exchanges that are marked one by one
NEES_SHOWN = 14.0  # right end of the histogram; chi-square(2) exceeds it once in a thousand


def draw_uncertainty(view: RunView) -> Figure:
    """Position sigma of each robot against role exchanges and against the distance the team has travelled."""
    figure = Figure(figsize=(canvas.WIDTH_IN, 3.9), layout="constrained")
    figure.suptitle(f"{plain(view.name)}: uncertainty of the robots' positions", fontsize=canvas.TITLE_PT + 1)
    by_exchange, by_distance = figure.subplots(1, 2, sharey=True)
    canvas.tidy(
        by_exchange, "role exchanges", "position sigma (cm)", "at each exchange; bars: range since the one before"
    )
    canvas.tidy(by_distance, "distance travelled by the team (m)", "", "after each move")
    if not view.history:
        for axes in (by_exchange, by_distance):
            axes.text(0.5, 0.5, "no moves were made", transform=axes.transAxes, ha="center", color=MUTED)
        return figure
    exchanges = np.array([point.role_exchanges for point in view.history])
    travel_m = np.array([point.travel_m for point in view.history])
    handles = []
    for k, robot in enumerate(view.history[-1].position_sigma_m):
        sigma_cm = 100 * np.array([point.position_sigma_m.get(robot, np.nan) for point in view.history])
        style = {"color": ROBOTS[k % len(ROBOTS)], "linewidth": 1.6, "zorder": 3 - 0.1 * k}
        handles += _by_exchange(by_exchange, exchanges + 0.06 * k, sigma_cm, style | {"label": plain(robot)})
        marks = {"marker": ".", "markersize": 5} if len(travel_m) <= 150 else {"linewidth": 0.8}
        by_distance.plot(travel_m, sigma_cm, **style | marks)
    by_exchange.set_ylim(bottom=0)
    by_exchange.xaxis.get_major_locator().set_params(integer=True)
    for axes in (by_exchange, by_distance):
        axes.grid(color="#e6e6e6", linewidth=0.6)
        axes.set_axisbelow(True)
    turns = np.flatnonzero(np.diff(exchanges) > 0)
    if 0 < len(turns) <= MARKS_AT_MOST:
        marks = [by_distance.axvline(travel_m[k], color=MUTED, lw=0.8, ls=":", label="role exchange") for k in turns]
        handles.append(marks[0])
    canvas.legend_below(figure, handles)
    return figure


def _by_exchange(axes: Axes, exchanges: np.ndarray, sigma_cm: np.ndarray, style: dict) -> list:
    """A line through the last value before each role exchange, and the range of all values between two."""
    counts, first = np.unique(exchanges, return_index=True)
    last = np.append(first[1:], len(exchanges)) - 1
    low, high = np.fmin.reduceat(sigma_cm, first), np.fmax.reduceat(sigma_cm, first)
    few = len(counts) <= 60
    if few:
        axes.vlines(counts, low, high, color=style["color"], alpha=0.25, linewidth=5, zorder=1)
    else:
        axes.fill_between(counts, low, high, color=style["color"], alpha=0.25, linewidth=0.3, zorder=1)
    return axes.plot(
        counts, sigma_cm[last], **style | ({"marker": "o", "markersize": 4} if few else {"linewidth": 0.9})
    )


def draw_vertex_errors(view: RunView) -> Figure:
    """Error of each vertex beside its 3 sigma, and the distribution of NEES; in the frame of the estimate."""
    figure = Figure(figsize=(canvas.WIDTH_IN, 3.9), layout="constrained")
    figure.suptitle(f"{plain(view.name)}: map vertices against the truth", fontsize=canvas.TITLE_PT + 1)
    sorted_errors, histogram = figure.subplots(1, 2)
    _, error_m, sigma_m, nees = vertex_errors(view)
    _draw_sorted(sorted_errors, 100 * error_m, 300 * sigma_m)
    _draw_nees(histogram, nees[np.isfinite(nees)])
    return figure


def vertex_errors(view: RunView) -> tuple[list[int], np.ndarray, np.ndarray, np.ndarray]:
    """Ids of the N vertices with a known truth, their errors (N,) and sigmas (N,), m, and NEES (N,).

    Sigma is that of the worst direction. NEES is NaN where the covariance is singular.
    """
    ids = [v for v in view.vertices if v in view.true_vertices]
    offsets = np.reshape([view.vertices[v] - view.true_vertices[v] for v in ids], (-1, 2))
    variances, directions = np.linalg.eigh(np.reshape([view.covariances[v] for v in ids], (-1, 2, 2)))
    along = np.einsum("nij,ni->nj", directions, offsets)
    regular = variances > 0
    terms = np.divide(along**2, variances, out=np.full_like(along, np.nan), where=regular)
    sigma_m = np.sqrt(np.maximum(variances[:, 1], 0.0))
    return ids, np.hypot(*offsets.T), sigma_m, terms.sum(axis=1)


def _draw_sorted(axes: Axes, error_cm: np.ndarray, bound_cm: np.ndarray) -> None:
    order = np.argsort(bound_cm, kind="stable")
    error_cm, bound_cm = error_cm[order], bound_cm[order]
    rank = np.arange(1, len(order) + 1)
    outside = error_cm > bound_cm
    size = 5 if len(rank) <= 100 else 2.5
    axes.fill_between(rank, bound_cm, step="mid", color=BLUE, alpha=0.15, linewidth=0)
    axes.step(rank, bound_cm, where="mid", color=BLUE, lw=1.2, label="3 sigma, worst direction")
    axes.plot(rank[~outside], error_cm[~outside], "o", color=INK, markersize=size, label="error")
    if outside.any():
        label = f"error beyond 3 sigma ({outside.sum()} of {len(rank)})"
        axes.plot(rank[outside], error_cm[outside], "D", color=VERMILLION, markersize=size + 1, label=label)
    axes.set_ylim(0, 1.25 * max(bound_cm.max(initial=0), error_cm.max(initial=0), 1e-9))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend(loc="upper left", fontsize=canvas.LABEL_PT - 1, frameon=False)
    canvas.tidy(axes, "vertices, from best to worst known", "position error (cm)", "errors beside what was claimed")


def _draw_nees(axes: Axes, nees: np.ndarray) -> None:
    """Histogram as a density over all vertices; those beyond the right end are counted in words."""
    width = 2.0 if len(nees) < 20 else 1.0 if len(nees) < 100 else 0.5
    counts, edges = np.histogram(nees, np.arange(0.0, NEES_SHOWN + width / 2, width))
    density = counts / max(len(nees), 1) / np.diff(edges)
    grid = np.linspace(0, NEES_SHOWN, 200)
    axes.stairs(density, edges, fill=True, color=BLUE, alpha=0.35, label=f"{len(nees)} vertices")
    axes.plot(grid, 0.5 * np.exp(-grid / 2), color=INK, lw=1.5, label="chi-square(2), expected when honest")
    axes.axvline(CHI_SQUARE_95, color=MUTED, lw=1, ls="--", label="95 % of an honest map lie left of this")
    beyond = int((nees > NEES_SHOWN).sum())
    if beyond:
        axes.plot([], [], " ", label=f"beyond {NEES_SHOWN:g}: {beyond} (largest {nees.max():.0f})")
    axes.set_xlim(0, NEES_SHOWN)
    axes.set_ylim(0, 1.1 * max(0.5, density.max(initial=0)))
    axes.legend(loc="upper right", fontsize=canvas.LABEL_PT - 1, framealpha=1.0, edgecolor="white")
    mean = f"{nees.mean():.2f}" if len(nees) else "—"
    canvas.tidy(axes, "NEES of a vertex", "density", f"normalized errors squared: mean {mean}, expected 2")
