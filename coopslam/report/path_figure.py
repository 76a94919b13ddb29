"""Planned paths over the map: where they go, and how well a robot knows its place along them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coopslam.planning.belief_paths import Route
from coopslam.planning.map_graph import MapGraph
from coopslam.report import canvas
from coopslam.report.canvas import INK, LABEL_PT, MUTED, Sizes, plain
from coopslam.report.ellipses import ellipse_axes, magnification
from coopslam.report.number_text import length, percent
from coopslam.report.run_view import RunView

STYLES = {"shortest": canvas.BLUE, "safest": canvas.VERMILLION, "widest": canvas.GREEN}
OTHERS = (canvas.PURPLE, canvas.SKY, canvas.ORANGE, INK, MUTED)
LINE_PT = (6.4, 1.8)  # of the first path drawn and the last one: where they run together, all are seen
ELLIPSES = 10  # along a path, the goal's included
GROUND, DARKEST = "YlOrBr", 0.3  # the lighter part of a colour map: the rest would hide the paths
EVEN = 1.02  # ground whose sigmas differ by a smaller factor is drawn in one colour


@dataclass(frozen=True, slots=True, eq=False)
class NamedRoute:
    """A path and what it was planned for."""

    name: str
    route: Route


def draw_routes(map_graph: MapGraph, named: Sequence[NamedRoute], title: str) -> Figure:
    """All paths over one map with the 95 % ellipses of their positions, and what odometry did on the ground."""
    view = _view(map_graph)
    sizes = Sizes.for_count(len(view.triangles))
    uneven = _is_uneven(map_graph)
    limits = canvas.extent(view)
    figure, (axes,) = canvas.plan_figure(plain(title, 110), limits, beside_in=0.85 if uneven else 0.0)
    canvas.draw_triangles(axes, view, "none" if uneven else canvas.MAPPED, canvas.DIAGONAL, 0.7 * sizes.thin)
    if uneven:
        _draw_ground(figure, axes, map_graph)
    wall = {"colors": INK, "linewidths": sizes.wall, "zorder": 3}
    canvas.draw_edges(axes, view, view.walls, **wall)
    gate = {"colors": canvas.GATE, "linewidths": 1.2 * sizes.wall, "linestyles": [canvas.GATE_DASHES], "zorder": 3}
    canvas.draw_edges(axes, view, view.gates, capstyle="butt", **gate)
    told, factor = [], _magnification(named, limits)
    for (one, colour), line_pt in zip(_coloured(named), np.linspace(*LINE_PT, max(len(named), 2)), strict=False):
        _draw_route(axes, one.route, colour, float(line_pt), factor)
        told.append(Line2D([], [], color=colour, lw=2.4, label=_told(one)))
    start, goal = named[0].route.bends[0], named[0].route.bends[-1]
    axes.plot(*start, "o", color=INK, markersize=7, mec="white", zorder=9)
    axes.plot(*goal, "*", color=INK, markersize=13, mec="white", zorder=9)
    marks = [
        Line2D([], [], color=INK, marker="o", ls="", markersize=7, mec="white", label="start"),
        Line2D([], [], color=INK, marker="*", ls="", markersize=11, mec="white", label="goal"),
        Patch(facecolor=MUTED + "40", edgecolor=MUTED, label=f"95 % of the robot's place{_enlarged(factor)}"),
    ]
    if view.gates:
        marks.append(Line2D([], [], color=canvas.GATE, lw=sizes.wall, ls=canvas.GATE_DASHES, label="open gate"))
    rows = max(len(told), len(marks))  # two columns, filled one after the other
    blank = Line2D([], [], ls="", label=" ")
    canvas.legend_below(figure, told + [blank] * (rows - len(told)) + marks + [blank] * (rows - len(marks)), columns=2)
    return figure


def _view(map_graph: MapGraph) -> RunView:
    """The map as other figures draw it."""
    return RunView(
        name="",
        summary={},
        vertices={v: vertex.xy for v, vertex in map_graph.vertices.items()},
        covariances={v: vertex.cov[:2, :2] for v, vertex in map_graph.vertices.items()},
        triangles=map_graph.triangles,
        walls=list(map_graph.walls),
        gates=list(map_graph.gates),
        dual_graph=map_graph.graph,
        paths={},
        history=[],
    )


def _ground_sigmas_cm(map_graph: MapGraph) -> np.ndarray:
    """(t,) odometry error recorded in each triangle, cm per sqrt(m)."""
    return 100 * np.array([map_graph.odometry_law(t).translation_sigma_per_m for t in map_graph.triangles])


def _is_uneven(map_graph: MapGraph) -> bool:
    sigmas = _ground_sigmas_cm(map_graph)
    return float(sigmas.max()) > EVEN * float(sigmas.min())


def _draw_ground(figure: Figure, axes: Axes, map_graph: MapGraph) -> None:
    """Triangles coloured by the odometry error that was recorded in them."""
    sigmas = _ground_sigmas_cm(map_graph)
    patches = PolyCollection(list(map_graph.corners.values()), array=sigmas, cmap=GROUND, zorder=0.9)
    patches.set_clim(0.0, float(sigmas.max()) / DARKEST)
    axes.add_collection(patches)
    bar = figure.colorbar(patches, ax=axes, aspect=35, pad=0.015)
    bar.ax.set_ylim(0.0, 1.02 * float(sigmas.max()))
    bar.set_label("odometry error recorded (cm after 1 m)", fontsize=LABEL_PT)
    bar.ax.tick_params(labelsize=LABEL_PT - 1)


def _coloured(named: Sequence[NamedRoute]) -> list[tuple[NamedRoute, str]]:
    spare = iter(OTHERS * len(named))
    return [(one, STYLES.get(one.name) or next(spare)) for one in named]


def _draw_route(axes: Axes, route: Route, colour: str, line_pt: float, factor: int) -> None:
    axes.plot(*route.bends.T, color=colour, linewidth=line_pt, solid_joinstyle="round", zorder=6)
    picked = _spread(route.points)
    semi_axes, directions = ellipse_axes(route.covariances[picked][:, :2, :2])
    ellipses = EllipseCollection(
        *(2 * factor * semi_axes.T),
        np.degrees(directions),
        units="xy",
        offsets=route.points[picked],
        offset_transform=axes.transData,
        facecolors=colour + "30",
        edgecolors=colour,
        linewidths=0.8,
        zorder=5,
    )
    axes.add_collection(ellipses, autolim=False)


def _spread(points: np.ndarray) -> list[int]:
    """Indices of points at about equal distances along (k, 2) points, the last one included, the first one not."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    wanted = along[-1] * np.arange(1, ELLIPSES + 1) / ELLIPSES
    return sorted(set(np.abs(along[:, None] - wanted).argmin(axis=0).tolist()))


def _magnification(named: Sequence[NamedRoute], limits: tuple[np.ndarray, np.ndarray]) -> int:
    """One for all paths, so that they can be compared."""
    largest = max(float(ellipse_axes(one.route.covariances[:, :2, :2])[0].max()) for one in named)
    return magnification(largest, 0.08 * float(np.max(limits[1] - limits[0])))


def _enlarged(factor: int) -> str:
    return f", enlarged ×{factor:,}" if factor > 1 else ""


def _told(one: NamedRoute) -> str:
    route = one.route
    return (
        f"{one.name}: {length(route.length_m)}, known to {length(route.final_sigma_m)} at the goal, "
        f"touches a wall: {percent(float(f'{route.touching_probability:.2g}'))}"
    )
