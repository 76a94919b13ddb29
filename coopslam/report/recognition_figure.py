"""Where in a stored map a small one was recognized, and where else it would fit."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coopslam.planning.corner_map import UNKNOWN, CornerMap, turned
from coopslam.planning.map_fit import Fit
from coopslam.planning.place_recognition import Recognition
from coopslam.report import canvas
from coopslam.report.canvas import Sizes
from coopslam.se2 import xytheta

FIRST, OTHER = canvas.ORANGE, canvas.PURPLE


def draw_recognition(stored: CornerMap, small: CornerMap, answer: Recognition, name: str) -> Figure:
    """The stored map, and on it the small one at the best of its places and at the others, dashed."""
    sizes = Sizes.for_count(len(stored.ids))
    low, high = stored.places.min(axis=0), stored.places.max(axis=0)
    margin = 0.05 * float((high - low).max())
    title = f"{canvas.plain(name)}: {answer.verdict}, {canvas.plain(answer.reason, 90)}"
    figure, (axes,) = canvas.plan_figure(title, (low - margin, high + margin))
    axes.add_collection(PolyCollection(stored.places[stored.triangles], facecolors=canvas.FREE, edgecolors="face"))
    axes.add_collection(_lines(stored.places, _walls(stored), colors=canvas.INK, linewidths=sizes.wall, zorder=4))
    gates = {"colors": canvas.GATE, "linewidths": sizes.wall, "linestyles": [canvas.GATE_DASHES], "zorder": 4}
    axes.add_collection(_lines(stored.places, stored.gates.tolist(), **gates))
    for one in answer.places[:0:-1]:
        _draw_place(axes, small, one, OTHER, sizes, "--")
    if answer.places:
        best = answer.places[0]
        _draw_place(axes, small, best, FIRST, sizes, "-")
        axes.plot(
            *stored.places[[j for _, j in best.pairs]].T, lw=0, marker="o", ms=sizes.marker, color=FIRST, zorder=6
        )
    canvas.legend_below(figure, _handles(stored, answer, sizes), columns=3)
    return figure


def _draw_place(axes: Axes, small: CornerMap, one: Fit, colour: str, sizes: Sizes, style: str) -> None:
    """Triangles, walls and the robot in whose frame the small map is."""
    x, y, turn = xytheta(one.T_stored_small)
    places = turned(turn, small.places) + (x, y)
    axes.add_collection(PolyCollection(places[small.triangles], facecolors=colour, alpha=0.25, zorder=2))
    walls = {"colors": colour, "linewidths": sizes.wall, "linestyles": style, "zorder": 5}
    axes.add_collection(_lines(places, _walls(small), **walls))
    axes.plot(x, y, marker=(3, 0, np.degrees(turn) - 90), ms=2 * sizes.marker, color=colour, mec=canvas.INK, zorder=7)


def _handles(stored: CornerMap, answer: Recognition, sizes: Sizes) -> list:
    handles = [Line2D([], [], color=canvas.INK, lw=sizes.wall, label="stored map")]
    if len(stored.gates):
        handles.append(Line2D([], [], color=canvas.GATE, lw=sizes.wall, ls=canvas.GATE_DASHES, label="open gate"))
    if answer.places:
        probability = f"probability {answer.places[0].probability:.2g}"
        handles.append(Patch(facecolor=FIRST, alpha=0.5, label=f"explored since, best place ({probability})"))
        handles.append(Line2D([], [], lw=0, marker="o", color=FIRST, label="corners taken for the same"))
        robot = {"marker": (3, 0, 0), "color": FIRST, "mec": canvas.INK, "ms": 2 * sizes.marker}
        handles.append(Line2D([], [], lw=0, **robot, label="robot"))
    if answer.alternatives:
        label = f"other places that fit as well: {answer.alternatives}"
        handles.append(Line2D([], [], color=OTHER, lw=sizes.wall, ls="--", label=label))
    return handles


def _walls(corners: CornerMap) -> list[tuple[int, int]]:
    return [(start, int(end)) for start, end in enumerate(corners.leaving) if end != UNKNOWN]


def _lines(places: np.ndarray, ends: list, **style) -> LineCollection:
    return LineCollection([places[list(pair)] for pair in ends], **style)
