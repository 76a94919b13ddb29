"""What all figures share: the palette, sizes that suit small and large worlds, and the floor plan they draw on.

Colours are those of Okabe and Ito, told apart by all common kinds of colour vision. Grey is solid, white is free.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon

from coopslam.report.run_view import RunView

BLUE, ORANGE, VERMILLION, GREEN, PURPLE, SKY = "#0072B2", "#E69F00", "#D55E00", "#009E73", "#CC79A7", "#56B4E9"
SOLID, FREE, MAPPED = "#dcdcdc", "#ffffff", "#eaf2f8"  # obstacles and the outside; free space; found free space
INK, MUTED, TRUE_WALL, DIAGONAL = "#222222", "#707070", "#9a9a9a", "#93a8b8"
ROBOTS = (BLUE, VERMILLION, SKY, PURPLE, ORANGE, GREEN)
GATE, GRAPH, CONTACT = GREEN, PURPLE, ORANGE  # open gates; the dual graph; the line of visual contact
GATE_DASHES = (0, (3, 1.5))

SLIPPERY = {"facecolor": "none", "edgecolor": "#b9a36a", "hatch": "//", "linewidth": 0.0}

LABELLED_AT_MOST = 60  # vertices or triangles; more ids than that would cover the picture
DENSE = 200  # vertices; beyond this figures are drawn with more pixels
TITLE_PT, LABEL_PT, SMALL_PT = 10, 9, 7.5
WIDTH_IN = 9.0  # of every figure
TALLEST_IN = 9.0  # of a panel
SLIMMEST = 5.0  # ratio of a panel's sides


@dataclass(frozen=True, slots=True)
class Sizes:
    """Line widths and marker diameters in points: smaller the more there is to draw."""

    wall: float
    thin: float
    marker: float

    @classmethod
    def for_count(cls, count: int) -> "Sizes":
        """count: vertices or triangles in the picture."""
        scale = float(np.clip(np.sqrt(40 / max(count, 1)), 0.28, 1.0))
        return cls(wall=2.0 * scale, thin=max(0.9 * scale, 0.35), marker=5.5 * scale)


def extent(view: RunView) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner, (2,) each, of the world: of the truth, or else of what was mapped and driven."""
    points = list(view.true_rings) or [np.reshape(list(view.vertices.values()), (-1, 2))]
    if not view.true_rings:
        points += [path for path in view.paths.get("smoothed", {}).values()]
    points = np.vstack([np.zeros((1, 2)), *points]) if not view.true_rings else np.vstack(points)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1e-3)
    return low - margin, high + margin


def plan_figure(
    title: str,
    limits: tuple[np.ndarray, np.ndarray],
    panels: int = 1,
    beside_in: float = 0.0,
    width_in: float = WIDTH_IN,
) -> tuple[Figure, list[Axes]]:
    """A figure of the world's shape with equal, labelled axes in metres; `panels` of them side by side or stacked.

    limits: lower and upper corner of the picture.  beside_in: width to leave for a colour bar, inches.
    """
    low, high = with_surroundings(*limits)
    width, height = high - low
    columns = 1 if panels == 1 or width > 1.6 * height else 2
    rows = -(-panels // columns)
    panel_width = (width_in - 0.55 - beside_in) / columns - 0.1
    panel_height = min(panel_width * height / width, TALLEST_IN * width_in / WIDTH_IN)
    headings_in = 0.25 * (rows - 1) - (0 if title else 0.3)
    figure = Figure(figsize=(width_in, panel_height * rows + headings_in + 1.35), layout="constrained")
    if title:
        figure.suptitle(title, fontsize=TITLE_PT + 1)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for unused in grid.flat[panels:]:
        unused.remove()
    for axes in grid.flat[:panels]:
        plan_axes(axes, low, high)
        axes.label_outer()
    return figure, list(grid.flat[:panels])


def with_surroundings(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Limits that leave a long corridor some room across."""
    spare = np.maximum((high - low).max() / SLIMMEST - (high - low), 0.0) / 2
    return low - spare, high + spare


def plan_axes(axes: Axes, low: np.ndarray, high: np.ndarray) -> None:
    """Axes for a floor plan: grey, equal, in metres."""
    axes.set_facecolor(SOLID)
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    tidy(axes, "x (m)", "y (m)")


def tidy(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Axis names with units, small quiet ticks."""
    axes.set_xlabel(x, fontsize=LABEL_PT)
    axes.set_ylabel(y, fontsize=LABEL_PT)
    axes.set_title(title, fontsize=TITLE_PT)
    axes.tick_params(labelsize=LABEL_PT - 1, color=MUTED)
    for spine in axes.spines.values():
        spine.set_color(TRUE_WALL)


def legend_below(figure: Figure, handles: list, columns: int = 4) -> None:
    """One legend for the figure, outside of the axes so that it covers nothing."""
    if handles:
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=min(columns, len(handles)),
            fontsize=LABEL_PT - 0.5,
            frameon=False,
            handlelength=2.4,
        )


def draw_floor(axes: Axes, view: RunView, outline: bool = True) -> None:
    """The true world, white on grey; without truth the triangles found are what is known to be free.

    outline: draw the true walls as such, to be compared with the mapped ones.
    """
    if not view.true_rings:
        draw_triangles(axes, view, FREE)
        return
    edge = TRUE_WALL if outline else SOLID
    width = 1.7 * Sizes.for_count(sum(map(len, view.true_rings))).wall if outline else 0.5
    outer, *holes = view.true_rings
    floor = Polygon(outer, facecolor=FREE, edgecolor=edge, linewidth=width, zorder=0.5, joinstyle="round")
    axes.add_patch(floor)
    for ring in view.slippery:
        axes.add_patch(Polygon(ring, **SLIPPERY, zorder=1.1, clip_path=floor))
    for hole in holes:
        axes.add_patch(Polygon(hole, facecolor=SOLID, edgecolor=edge, linewidth=width, zorder=1.2, joinstyle="round"))


def ground_handles(view: RunView) -> list[Patch]:
    """What the legend says of the ground."""
    return [Patch(**SLIPPERY, label="slippery ground")] if view.slippery else []


def draw_triangles(
    axes: Axes, view: RunView, face: str, edge: str = "face", width: float = 0.5, only: Iterable[int] | None = None
) -> None:
    """All triangles found, or `only` those with certain ids."""
    shown = view.triangles if only is None else [t for t in only if t in view.triangles]
    corners = [[view.vertices[v] for v in view.triangles[t]] for t in shown]
    axes.add_collection(PolyCollection(corners, facecolors=face, edgecolors=edge, linewidths=width, zorder=1))


def draw_edges(axes: Axes, view: RunView, edges: list[tuple[int, int]], **style) -> None:
    """Straight lines between mapped vertices."""
    lines = [[view.vertices[a], view.vertices[b]] for a, b in edges if a in view.vertices and b in view.vertices]
    axes.add_collection(LineCollection(lines, capstyle=style.pop("capstyle", "round"), **style))


def plain(text: object, at_most: int = 60) -> str:
    """Text of unknown origin for a figure: no mathematics in dollar signs, one line, not endless."""
    text = " ".join(str(text).split())
    text = text if len(text) <= at_most else text[: at_most - 1] + "…"
    return text.replace("$", r"\$")
