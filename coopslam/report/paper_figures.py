"""The figures of Rekleitis, Dudek and Milios (2003) from a run of ours: 2a, 3 and 4."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coopslam.report import canvas
from coopslam.report.canvas import INK, ROBOTS, Sizes, plain
from coopslam.report.figures import crossing
from coopslam.report.run_view import RunView
from coopslam.report.stages import Stage, choose_stages
from coopslam.report.story import sides_of

COLUMN_IN, PAGE_IN, PAGE_TALL_IN = 5.0, 7.2, 9.6  # a figure is at most a page
LEFT_IN, BELOW_IN, GAP_IN, HEADING_IN = 0.5, 1.05, 0.1, 0.5  # around the panels of figure 3
WITHOUT_DATE = {"pdf": {"CreationDate": None}, "png": {}}  # the same run gives the same file
PATH_DASHES = ("-", (0, (4, 1.6)))  # of the first and the other robots: where they drove the same way, both are seen
PAIR = 2  # the first robots explore, the others only watch
TINT = "26"  # opacity of a robot's triangles, two hexadecimal digits


def write_figure(figure: Figure, directory: Path, name: str) -> list[Path]:
    """NAME.png and NAME.pdf."""
    paths = []
    for kind, metadata in WITHOUT_DATE.items():
        paths.append(directory / f"{name}.{kind}")
        figure.savefig(paths[-1], format=kind, dpi=300, facecolor="white", metadata=metadata)
    return sorted(paths, reverse=True)


def draw_triangulated_world(view: RunView) -> Figure:
    """Figure 2a: a polygonal world, its triangulation and the embedded dual graph."""
    sizes = Sizes.for_count(len(view.triangles))
    figure, (axes,) = canvas.plan_figure("", canvas.extent(view), width_in=COLUMN_IN)
    canvas.draw_floor(axes, view, outline=False)
    _draw_map(axes, view, list(view.triangles), view.walls, view.gates, sizes)
    canvas.legend_below(figure, _map_handles(bool(view.gates), sizes))
    return figure


def _draw_map(axes: Axes, view: RunView, triangles: list[int], walls, gates, sizes: Sizes) -> None:
    """Triangles, walls, open gates, and the dual graph with nodes at centroids and edges through gates."""
    canvas.draw_triangles(axes, view, canvas.MAPPED, canvas.DIAGONAL, sizes.thin, only=triangles)
    canvas.draw_edges(axes, view, walls, colors=INK, linewidths=1.1 * sizes.wall, zorder=3)
    _draw_gates(axes, view, gates, sizes)
    nodes, links = embedded_graph(view, triangles)
    axes.add_collection(LineCollection(links, colors=canvas.GRAPH, linewidths=0.8 * sizes.wall, zorder=5))
    axes.plot(*nodes.T, "o", color=canvas.GRAPH, markersize=sizes.marker, mec="white", mew=0.6, zorder=6)


def _draw_gates(axes: Axes, view: RunView, gates, sizes: Sizes) -> None:
    style = {"linewidths": 1.1 * sizes.wall, "linestyles": [canvas.GATE_DASHES], "capstyle": "butt"}
    canvas.draw_edges(axes, view, gates, colors=canvas.GATE, zorder=4, **style)


def embedded_graph(view: RunView, triangles: list[int]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Centroids (N, 2) of some triangles, and a bent line (3, 2) through each gate that two of them share."""
    shown = [t for t in triangles if t in view.triangles]
    centroid = {t: np.mean([view.vertices[v] for v in view.triangles[t]], axis=0) for t in shown}
    beyond = {side: t for t in shown for side in sides_of(view.triangles[t])}
    links = []
    for (a, b), t in beyond.items():
        other = beyond.get((b, a))
        if other is not None and a < b:
            through = crossing(centroid[t], centroid[other], view.vertices[a], view.vertices[b])
            links.append(np.array([centroid[t], through, centroid[other]]))
    return np.reshape(list(centroid.values()), (-1, 2)), links


def _map_handles(gates: bool, sizes: Sizes) -> list:
    handles = [
        Line2D([], [], color=INK, lw=1.1 * sizes.wall, label="wall"),
        Patch(facecolor=canvas.MAPPED, edgecolor=canvas.DIAGONAL, label="triangle"),
        Line2D([], [], color=canvas.GRAPH, lw=0.8 * sizes.wall, marker="o", mec="white", label="dual graph"),
    ]
    if gates:
        handles.append(Line2D([], [], color=canvas.GATE, lw=sizes.wall, ls=canvas.GATE_DASHES, label="open gate"))
    return handles


# figure 3


def draw_stages(view: RunView) -> Figure:
    """Figure 3: one row a stage; the world as perceived by each robot, and the map up to that point."""
    stages = choose_stages(view.story)
    limits = canvas.with_surroundings(*canvas.extent(view))
    columns = len(view.robots[:PAIR]) + 1
    figure, panels = _grid_of_panels(limits, len(stages), columns)
    sizes = Sizes.for_count(2 * len(view.triangles))
    for k, stage in enumerate(stages):
        above = panels[k, 0].get_position().y1 + 0.2 / figure.get_figheight()
        caption = {"fontsize": canvas.SMALL_PT + 0.5, "ha": "center", "va": "bottom", "color": INK}
        figure.text(0.5, above, _caption(k, stage, view), **caption)
        for n, axes in enumerate(panels[k]):
            seen = plain(view.robots[n], 24) if n < columns - 1 else "map"
            axes.set_title(f"({_letter(k * columns + n)}) {seen}", fontsize=canvas.SMALL_PT, pad=3)
            if n < columns - 1:
                _draw_robots_view(axes, view, view.robots[n], stage, sizes)
            else:
                story = view.story
                known = (story.triangles_at(stage.time_s), story.walls_at(stage.time_s), story.gates_at(stage.time_s))
                _draw_map(axes, view, *known, sizes)
    style = {"fontsize": canvas.SMALL_PT, "frameon": False, "handlelength": 2.2, "columnspacing": 1.6}
    figure.legend(handles=_stage_handles(view, sizes), loc="lower center", ncols=4, **style)
    return figure


def _grid_of_panels(limits: tuple[np.ndarray, np.ndarray], rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """A page of equal panels (rows, columns), all of one scale, with room for captions above and a legend below."""
    low, high = limits
    ratio = float((high - low)[1] / (high - low)[0])
    wide_in = (PAGE_IN - LEFT_IN - 0.1) / max(columns, 3) - GAP_IN
    tall_in = min(wide_in * ratio, (PAGE_TALL_IN - BELOW_IN) / max(rows, 5) - HEADING_IN)
    wide_in = tall_in / ratio
    width_in = max(LEFT_IN + columns * (wide_in + GAP_IN) + 0.1, 5.6)
    height_in = BELOW_IN + rows * (tall_in + HEADING_IN)
    figure = Figure(figsize=(width_in, height_in))
    margin_in = (width_in - columns * (wide_in + GAP_IN) + GAP_IN + LEFT_IN - 0.1) / 2
    panels = np.empty((rows, columns), dtype=object)
    for k, n in np.ndindex(rows, columns):
        left_in = margin_in + n * (wide_in + GAP_IN)
        bottom_in = BELOW_IN + (rows - 1 - k) * (tall_in + HEADING_IN)
        place = np.array([left_in / width_in, bottom_in / height_in, wide_in / width_in, tall_in / height_in])
        axes = panels[k, n] = figure.add_axes(place)
        canvas.plan_axes(axes, low, high)
        axes.xaxis.label.set_fontsize(canvas.SMALL_PT)
        axes.yaxis.label.set_fontsize(canvas.SMALL_PT)
        axes.tick_params(labelsize=canvas.SMALL_PT - 1, length=2, pad=1.5)
        if k < rows - 1:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
        if n > 0:
            axes.set_ylabel("")
            axes.tick_params(labelleft=False)
    return figure, panels


def _letter(number: int) -> str:
    return chr(ord("a") + number) if number < 26 else str(number + 1)


def _caption(row: int, stage: Stage, view: RunView) -> str:
    move = view.story.move_at(stage.time_s)
    exchanges = move.role_exchanges if move else 0
    triangles = f"{stage.triangles} triangle" + ("s" if stage.triangles != 1 else "")
    return (
        f"stage {row + 1} ({stage.title}): after {triangles}, t = {stage.time_s:.0f} s, "
        f"{exchanges} role exchange" + ("s" if exchanges != 1 else "")
    )


def _draw_robots_view(axes: Axes, view: RunView, robot: str, stage: Stage, sizes: Sizes) -> None:
    """What one robot did and saw until a moment: its way, corners and walls; the other one where it sees it now."""
    story, time_s, colour = view.story, stage.time_s, colour_of(view, robot)
    known = story.triangles_at(time_s)
    own = [t for t in known if story.triangles[t].robot == robot]
    canvas.draw_triangles(axes, view, canvas.FREE, only=known)
    canvas.draw_triangles(axes, view, colour + TINT, edge="none", width=0.0, only=own)
    walls = [wall.vertices for wall in story.walls if wall.stamp_s <= time_s and wall.robot == robot]
    canvas.draw_edges(axes, view, walls, colors=INK, linewidths=1.1 * sizes.wall, zorder=3)
    corners = {c.vertices[0] for c in story.corners if c.stamp_s <= time_s and c.robot == robot}
    at = np.reshape([view.vertices[v] for v in sorted(corners) if v in view.vertices], (-1, 2))
    axes.plot(*at.T, "o", color=INK, markersize=0.55 * sizes.marker, zorder=4)
    tracks = {name: track for name in view.robots if (track := view.track("smoothed", name))}
    if robot in tracks:
        way = tracks[robot].between(tracks[robot].stamps_s[0], time_s)
        axes.plot(*way.T, color=colour, lw=0.65 * sizes.wall, zorder=5, solid_joinstyle="round")
    move = story.move_at(time_s)
    if move is not None and move.watched and {move.robot, move.watcher} <= set(tracks):
        ends = np.array([tracks[name].at(time_s) for name in (move.robot, move.watcher)])
        axes.plot(*ends.T, color=canvas.CONTACT, lw=0.75 * sizes.wall, zorder=6)
    for name, track in tracks.items():
        moving = move is not None and move.robot == name
        marker = robot_marker(colour_of(view, name), moving, max(1.4 * sizes.marker, 4.0))
        axes.plot(*track.at(time_s), **marker, zorder=8 if moving else 7)


def colour_of(view: RunView, robot: str) -> str:
    """The same colour for a robot in all figures."""
    return ROBOTS[view.robots.index(robot) % len(ROBOTS)]


def robot_marker(colour: str, moving: bool, size: float) -> dict:
    """The mover is a filled circle, the stander a landmark: an empty square."""
    if moving:  # smaller: where both stand in one corner, both are seen
        return {"ls": "", "marker": "o", "mfc": colour, "mec": "white", "markersize": 0.85 * size, "mew": 0.1 * size}
    return {"ls": "", "marker": "s", "mfc": "white", "mec": colour, "markersize": size, "mew": 0.24 * size}


def _stage_handles(view: RunView, sizes: Sizes) -> list:
    names = [plain(name, 24) for name in view.robots[:PAIR]]
    colours = [colour_of(view, name) for name in view.robots[:PAIR]]
    pairs = list(zip(names, colours, strict=True))
    handles = [Line2D([], [], color=colour, lw=sizes.wall, label=f"way of {name}") for name, colour in pairs]
    handles += [Patch(facecolor=colour + TINT, edgecolor="none", label=f"swept by {name}") for name, colour in pairs]
    if len(pairs) % 2:
        handles.append(Line2D([], [], ls="", label=" "))
    handles += [
        Line2D([], [], color=canvas.CONTACT, lw=1.5, label="line of contact"),
        Line2D([], [], color=INK, marker="o", ls="", markersize=3, label="corner it sighted"),
        Line2D([], [], **robot_marker(canvas.MUTED, True, 6), label="mover"),
        Line2D([], [], **robot_marker(canvas.MUTED, False, 6), label="stander, a landmark"),
    ]
    return handles + _map_handles(True, Sizes.for_count(1))


# figure 4


def draw_paths(views: list[RunView]) -> Figure:
    """Figure 4: the paths of the robots after the exploration, one panel a world."""
    limits = [canvas.with_surroundings(*canvas.extent(view)) for view in views]
    aspects = [float((high - low)[0] / (high - low)[1]) for low, high in limits]
    tall_in = min((PAGE_IN - 0.6 * len(views)) / sum(aspects), PAGE_TALL_IN / 2)
    figure = Figure(figsize=(PAGE_IN, tall_in + 1.15), layout="constrained")
    panels = figure.subplots(1, len(views), squeeze=False, width_ratios=aspects)
    for n, (axes, view) in enumerate(zip(panels.flat, views, strict=True)):
        canvas.plan_axes(axes, *limits[n])
        axes.set_title(f"({_letter(n)}) {plain(view.name)}", fontsize=canvas.LABEL_PT)
        canvas.draw_floor(axes, view, outline=False)
        width = max(Sizes.for_count(len(view.vertices)).wall, 1.0)
        for k, robot in enumerate(view.robots):
            path = view.paths.get("smoothed", {}).get(robot)
            if path is None or not len(path):
                continue
            colour = colour_of(view, robot)
            axes.plot(*path.T, color=colour, lw=width, ls=PATH_DASHES[min(k, 1)], zorder=4 + k)
            axes.plot(*path[0], "o", color=colour, markersize=7, mec="white", zorder=8)
            axes.plot(*path[-1], "D", color=colour, markersize=9 - 3 * k, mec="white", zorder=8 + k)
    canvas.legend_below(figure, _path_handles(views[0]), columns=6)
    return figure


def _path_handles(view: RunView) -> list:
    handles = []
    for k, robot in enumerate(view.robots):
        style = {"color": colour_of(view, robot), "ls": PATH_DASHES[min(k, 1)], "lw": 2.0}
        handles.append(Line2D([], [], label=plain(robot, 24), **style))
    handles.append(Line2D([], [], color=canvas.MUTED, marker="o", ls="", markersize=7, mec="white", label="start"))
    handles.append(Line2D([], [], color=canvas.MUTED, marker="D", ls="", markersize=6, mec="white", label="end"))
    return handles
