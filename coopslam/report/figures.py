"""The figures of a run over its floor plan: map, trajectories, dual graph; `draw_all` writes every figure."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coopslam.report import canvas
from coopslam.report.canvas import BLUE, INK, ORANGE, VERMILLION, Sizes, plain
from coopslam.report.charts import draw_uncertainty, draw_vertex_errors
from coopslam.report.ellipses import ellipse_axes, magnification
from coopslam.report.run_view import RunView

# name in RunView.paths -> label, and style of a line; the accurate ones lie inside the wider ones
PATH_STYLES = {
    "true": ("true", {"color": "#9c9c9c", "linewidth": 5.0, "zorder": 2}),
    "dead-reckoning": (
        "odometry alone",
        {"color": VERMILLION, "linewidth": 1.4, "linestyle": (0, (4, 2)), "zorder": 3},
    ),
    "causal": ("as known at each moment (causal)", {"color": ORANGE, "linewidth": 2.4, "zorder": 4}),
    "smoothed": ("smoothed", {"color": BLUE, "linewidth": 1.0, "zorder": 5}),
}
IN_ORDER = ("recognition", "map", "trajectories", "dual_graph", "uncertainty", "vertex_errors")  # of a report
ROOM_FOR_DRIFT = 0.12  # of the world's size on each side, for odometry that leaves the world


def draw_all(view: RunView, directory: Path) -> list[Path]:
    """Write every figure that the run has something for as PNG; the files in the order of a report."""
    directory.mkdir(parents=True, exist_ok=True)
    figures = {
        "map": draw_map(view),
        "trajectories": draw_trajectories(view),
        "dual_graph": draw_dual_graph(view),
        "uncertainty": draw_uncertainty(view),
    }
    if view.true_vertices:
        figures["vertex_errors"] = draw_vertex_errors(view)
    dpi = 200 if len(view.vertices) > canvas.DENSE else 150
    paths = []
    for name, figure in figures.items():
        paths.append(directory / f"{name}.png")
        figure.savefig(paths[-1], dpi=dpi, format="png", facecolor="white")
    return paths


def drawn_in(directory: Path) -> list[Path]:
    """The figures that `draw_all` wrote into a directory, in the order of a report."""
    return [path for name in IN_ORDER if (path := directory / f"{name}.png").exists()]


def draw_map(view: RunView) -> Figure:
    """Mapped walls and vertices with 95 % ellipses over the true world; errors are magnified like the ellipses."""
    sizes = Sizes.for_count(len(view.vertices))
    figure, (axes,) = canvas.plan_figure(f"{plain(view.name)}: map and how well it is known", canvas.extent(view))
    canvas.draw_floor(axes, view)
    if view.true_rings:
        canvas.draw_triangles(axes, view, canvas.MAPPED)
    wall = {"colors": INK, "linewidths": sizes.wall, "zorder": 4}
    gate = {"colors": canvas.GATE, "linewidths": 1.2 * sizes.wall, "linestyles": [canvas.GATE_DASHES], "zorder": 5}
    canvas.draw_edges(axes, view, view.walls, **wall)
    canvas.draw_edges(axes, view, view.gates, capstyle="butt", **gate)
    handles = [Line2D([], [], color=INK, lw=sizes.wall, label="mapped wall")]
    if view.gates:
        handles.append(Line2D([], [], color=canvas.GATE, lw=sizes.wall, ls=canvas.GATE_DASHES, label="open gate"))
    handles += _draw_vertices(axes, view, sizes)
    if view.true_rings:
        handles.insert(1, Line2D([], [], color=canvas.TRUE_WALL, lw=1.7 * sizes.wall, label="true wall"))
        handles.append(Patch(facecolor=canvas.MAPPED, edgecolor=canvas.DIAGONAL, label="free space found"))
    canvas.legend_below(figure, handles + canvas.ground_handles(view))
    return figure


def _draw_vertices(axes: Axes, view: RunView, sizes: Sizes) -> list:
    """Vertices, their ellipses, errors and ids; what the legend says of them."""
    if not view.vertices:
        return []
    ids = list(view.vertices)
    at = np.array([view.vertices[v] for v in ids])
    semi_axes, directions = ellipse_axes(np.array([view.covariances[v] for v in ids]))
    low, high = canvas.extent(view)
    factor = magnification(float(semi_axes.max()), 0.2 * float(max(high - low)) / np.sqrt(len(ids)))
    times = f", enlarged ×{factor:,}" if factor > 1 else ""
    ellipses = EllipseCollection(
        *(2 * factor * semi_axes.T),
        np.degrees(directions),
        units="xy",
        offsets=at,
        offset_transform=axes.transData,
        facecolors=BLUE + "40",
        edgecolors=BLUE,
        linewidths=sizes.thin,
        zorder=6,
    )
    axes.add_collection(ellipses, autolim=False)
    axes.plot(*at.T, "o", color=BLUE, markersize=0.6 * sizes.marker, zorder=8)
    handles = [
        Line2D([], [], color=BLUE, marker="o", ls="", markersize=0.6 * sizes.marker, label="mapped vertex"),
        Patch(facecolor=BLUE + "40", edgecolor=BLUE, label=f"its 95 % ellipse{times}"),
    ]
    if view.true_vertices:
        known = [v for v in ids if v in view.true_vertices]
        true = np.array([view.true_vertices[v] for v in known])
        start = np.array([view.vertices[v] for v in known])
        lines = np.stack([start, start + factor * (true - start)], axis=1)
        axes.add_collection(LineCollection(lines, colors=VERMILLION, linewidths=1.5 * sizes.thin, zorder=7))
        ring = {"marker": "o", "ls": "", "mfc": "none", "mec": INK, "mew": sizes.thin, "markersize": 1.3 * sizes.marker}
        axes.plot(*true.T, **ring, zorder=8)
        handles.append(Line2D([], [], **ring, label="true vertex"))
        handles.append(Line2D([], [], color=VERMILLION, lw=1.5 * sizes.thin, label=f"offset to the true vertex{times}"))
    if len(ids) <= canvas.LABELLED_AT_MOST:
        _label_vertices(axes, view)
    return handles


def _label_vertices(axes: Axes, view: RunView) -> None:
    """Ids beside the corners, each on the side that has most room; in doubt on the solid one."""
    ids = list(view.vertices)
    outward = {v: np.zeros(2) for v in ids}
    for a, b in view.walls:
        way = view.vertices[b] - view.vertices[a]
        right = np.array([way[1], -way[0]]) / max(float(np.hypot(*way)), 1e-9)  # free space is on the left
        outward[a] = outward[a] + right
        outward[b] = outward[b] + right
    low, high = canvas.extent(view)
    points_per_m = 72 * float((np.array([canvas.WIDTH_IN - 0.65, canvas.TALLEST_IN]) / (high - low)).min())
    taken = points_per_m * np.array([view.vertices[v] for v in ids])
    angles = np.arange(16) * np.pi / 8
    offsets_pt = 11 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for v in ids:
        places = points_per_m * view.vertices[v] + offsets_pt
        room = np.hypot(*(places[:, None] - taken).transpose(2, 0, 1)).min(axis=1)
        best = int(np.argmax(np.minimum(room, 11) + 0.1 * offsets_pt @ outward[v]))
        taken = np.vstack([taken, places[best]])
        style = {"fontsize": canvas.SMALL_PT, "color": INK, "ha": "center", "va": "center", "zorder": 9}
        axes.annotate(str(v), view.vertices[v], xytext=offsets_pt[best], textcoords="offset points", **style)


def draw_trajectories(view: RunView) -> Figure:
    """One panel per robot: odometry alone, causal, smoothed and true path. Odometry may leave the picture."""
    robots = list(dict.fromkeys(robot for paths in view.paths.values() for robot in paths))
    figure, panels = canvas.plan_figure(f"{plain(view.name)}: trajectories", _room_for_drift(view), max(len(robots), 1))
    drawn = [kind for kind in PATH_STYLES if any(len(path) for path in view.paths.get(kind, {}).values())]
    longest = max((len(path) for path in view.paths.get("smoothed", {}).values()), default=1)
    scale = float(np.clip(np.sqrt(300 / longest), 0.5, 1.0))
    styles = {kind: {**PATH_STYLES[kind][1], "linewidth": scale * PATH_STYLES[kind][1]["linewidth"]} for kind in drawn}
    for axes, robot in zip(panels, robots, strict=False):
        canvas.draw_floor(axes, view, outline=False)
        axes.set_title(plain(robot), fontsize=canvas.TITLE_PT)
        for kind in drawn:
            path = view.paths[kind].get(robot)
            if path is None or not len(path):
                continue
            axes.plot(*path.T, **styles[kind], solid_joinstyle="round")
            if kind == "smoothed" or "smoothed" not in drawn:
                axes.plot(*path[0], "o", color=canvas.GREEN, markersize=8, mec="white", zorder=7)
                axes.plot(*path[-1], "s", color=INK, markersize=7, mec="white", zorder=7)
    handles = [Line2D([], [], label=PATH_STYLES[kind][0], **PATH_STYLES[kind][1]) for kind in drawn]
    handles.append(Line2D([], [], color=canvas.GREEN, marker="o", ls="", markersize=8, mec="white", label="start"))
    handles.append(Line2D([], [], color=INK, marker="s", ls="", markersize=7, mec="white", label="end"))
    canvas.legend_below(figure, handles + canvas.ground_handles(view), columns=6)
    return figure


def _room_for_drift(view: RunView) -> tuple[np.ndarray, np.ndarray]:
    """Limits of the picture: the world, widened towards where odometry alone goes, up to a margin."""
    low, high = canvas.extent(view)
    margin = ROOM_FOR_DRIFT * float(max(high - low))
    paths = [path for path in view.paths.get("dead-reckoning", {}).values() if len(path)]
    if not paths:
        return low, high
    points = np.vstack(paths)
    edge = 0.15 * margin
    reach_low, reach_high = points.min(axis=0) - edge, points.max(axis=0) + edge
    return np.minimum(low, np.maximum(reach_low, low - margin)), np.maximum(high, np.minimum(reach_high, high + margin))


def draw_dual_graph(view: RunView) -> Figure:
    """The paper's figure 2a: obstacles, triangles and the graph embedded at their centroids, coloured by sigma.

    An edge is straight unless it would leave its two triangles: then it bends inside of its gate.
    """
    sizes = Sizes.for_count(len(view.triangles))
    figure, (axes,) = canvas.plan_figure(
        f"{plain(view.name)}: triangulation and its dual graph", canvas.extent(view), beside_in=0.85
    )
    canvas.draw_floor(axes, view, outline=False)
    canvas.draw_triangles(axes, view, canvas.MAPPED, canvas.DIAGONAL, sizes.thin)
    canvas.draw_edges(axes, view, view.walls, colors=INK, linewidths=1.2 * sizes.wall, zorder=3)
    canvas.draw_edges(
        axes,
        view,
        view.gates,
        colors=canvas.GATE,
        linewidths=1.2 * sizes.wall,
        linestyles=[canvas.GATE_DASHES],
        zorder=4,
    )
    graph = view.dual_graph
    nodes = list(graph.nodes)
    centroid = {node: np.array(graph.nodes[node]["centroid"]) for node in nodes}
    links, widths = [], []
    for a, b, edge in graph.edges(data=True):
        ends = [view.vertices[v] for v in edge["gate"]]
        links.append([centroid[a], crossing(centroid[a], centroid[b], *ends), centroid[b]])
        widths.append(float(np.hypot(*(ends[1] - ends[0]))))
    if links:
        share = np.array(widths) / max(float(np.quantile(widths, 0.95)), 1e-9)
        line_widths = sizes.wall * (0.35 + 1.9 * np.minimum(share, 1.0))
        axes.add_collection(LineCollection(links, colors=canvas.GRAPH, linewidths=line_widths, zorder=5))
    handles = [
        Line2D([], [], color=INK, lw=1.2 * sizes.wall, label="wall"),
        Line2D([], [], color=canvas.DIAGONAL, lw=1.5 * sizes.thin, label="diagonal (gate)"),
        Line2D([], [], color=canvas.GRAPH, lw=1.6 * sizes.wall, label="edge; thicker: wider gate"),
    ]
    if view.gates:
        handles.append(Line2D([], [], color=canvas.GATE, lw=sizes.wall, ls=canvas.GATE_DASHES, label="gate still open"))
    if nodes:
        _draw_nodes(figure, axes, view, np.array(list(centroid.values())), sizes)
    canvas.legend_below(figure, handles + canvas.ground_handles(view))
    return figure


def crossing(start: np.ndarray, end: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Where the way start -> end passes the gate left - right: on the straight line if that is well inside."""
    way, gate, offset = end - start, right - left, start - left
    turning = gate[0] * way[1] - gate[1] * way[0]
    if abs(turning) < 1e-12:
        return (left + right) / 2
    share = (offset[0] * way[1] - offset[1] * way[0]) / turning
    return left + float(np.clip(share, 0.1, 0.9)) * gate


def _draw_nodes(figure: Figure, axes: Axes, view: RunView, at: np.ndarray, sizes: Sizes) -> None:
    """Nodes coloured by the sigma of their position, with ids while there is room."""
    nodes = view.dual_graph.nodes
    sigma_cm = 100 * np.array([nodes[node].get("position_sigma_m", np.nan) for node in nodes])
    labelled = len(nodes) <= canvas.LABELLED_AT_MOST
    diameter = 13 if labelled else 1.6 * sizes.marker
    dots = axes.scatter(
        *at.T, c=sigma_cm, s=diameter**2, cmap="viridis", edgecolors="white", linewidths=sizes.thin, zorder=6
    )
    bar = figure.colorbar(dots, ax=axes, aspect=35, pad=0.015)
    bar.set_label("sigma of the triangle's position (cm)", fontsize=canvas.LABEL_PT)
    bar.ax.tick_params(labelsize=canvas.LABEL_PT - 1)
    if labelled:
        middle = (np.nanmin(sigma_cm) + np.nanmax(sigma_cm)) / 2
        for node, point, sigma in zip(nodes, at, sigma_cm, strict=True):
            ink = "black" if sigma > middle else "white"
            axes.text(*point, str(node), fontsize=6.5, color=ink, ha="center", va="center_baseline", zorder=7)
