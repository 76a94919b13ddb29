"""A run as a film: the robots, their line of contact, and the triangles as they are decided."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch
from PIL import Image

from coopslam.report import canvas
from coopslam.report.canvas import INK, Sizes, plain
from coopslam.report.ellipses import ellipse_axes, magnification
from coopslam.report.paper_figures import colour_of, robot_marker
from coopslam.report.run_view import RunView
from coopslam.report.video import FRAMES_PER_S, GifWriter, Mp4Writer, mp4_is_possible, palette_of

WIDTH_IN, DPI = 7.2, 100  # 720 pixels wide
FRAMES_AT_MOST, FRAMES_AT_LEAST = 275, 25  # without those that hold the last picture
HOLD_FRAMES = 25  # of the last picture: 2 s
REAL_TIME_FACTOR = 4.0  # a short run is shown so many times faster than it was driven; a long one faster
RECENT_FRAMES = 12  # how long the way behind a robot is drawn thick
NEWEST = "#c9e2f2"  # the triangle found last


def write_animation(
    view: RunView, directory: Path, watch: Callable[[Sequence[float]], Iterable[float]] = iter
) -> list[Path]:
    """exploration.mp4, when the package av is there, and exploration.gif. Empty when nothing moved.

    watch: hands the moments of the frames on one by one, and may show how far it is.
    """
    times = frame_times(view)
    if len(times) == 0:
        return []
    directory.mkdir(parents=True, exist_ok=True)
    film = Film(view)
    paths = [directory / "exploration.gif"]
    writers = [GifWriter(paths[0], film.palette(), hold=HOLD_FRAMES)]
    if mp4_is_possible():
        paths.insert(0, directory / "exploration.mp4")
        writers.append(Mp4Writer(paths[0], hold=HOLD_FRAMES))
    try:
        for time_s in watch(times.tolist()):
            picture = film.frame(time_s)
            for writer in writers:
                writer.add(picture)
        for writer in writers:
            writer.close()
    except BaseException:  # whatever it was, an interruption too: half a film is none; the error goes on
        for path in paths:
            path.unlink(missing_ok=True)
        raise
    return paths


def frame_times(view: RunView) -> np.ndarray:
    """(N,) moments of the run, evenly spaced: a time lapse that is no longer than FRAMES_AT_MOST."""
    if not view.story.moves or not any(view.track("smoothed", robot) for robot in view.robots):
        return np.zeros(0)
    start_s, end_s = view.story.moves[0].start_s, view.story.end_s
    wanted = int((end_s - start_s) / REAL_TIME_FACTOR * FRAMES_PER_S) + 1
    return np.linspace(start_s, end_s, min(max(wanted, FRAMES_AT_LEAST), FRAMES_AT_MOST))


class Film:
    """One figure that is drawn again and again: what never changes is drawn once and kept as a picture."""

    def __init__(self, view: RunView):
        self.view = view
        self.sizes = Sizes.for_count(len(view.triangles))
        self.tracks = {robot: track for robot in view.robots if (track := view.track("smoothed", robot))}
        self.ghosts = {robot: track for robot in self.tracks if (track := view.track("dead-reckoning", robot))}
        times = frame_times(view)
        self._recent_s = RECENT_FRAMES * float(times[1] - times[0])
        self._prepare_ellipses()
        title = f"{plain(view.name)}: cooperative exploration\n "  # the second line tells the time
        self.figure, (self.axes,) = canvas.plan_figure(title, canvas.extent(view), width_in=WIDTH_IN)
        self.heading = self.figure.suptitle(title, fontsize=canvas.TITLE_PT, linespacing=1.5)
        self.figure.set_dpi(DPI)
        self._canvas = FigureCanvasAgg(self.figure)
        canvas.draw_floor(self.axes, view, outline=False)
        canvas.legend_below(self.figure, self._handles())
        for _ in range(2):  # the first layout does not yet know how tall the legend is
            self._canvas.draw()
        self.figure.set_layout_engine("none")
        self._make_artists()
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self.figure.bbox)

    def _prepare_ellipses(self) -> None:
        """Ellipse sizes of all poses, and one magnification for the film."""
        self._ellipses = {
            robot: ellipse_axes(cov) for robot, cov in self.view.path_covariances.items() if robot in self.tracks
        }
        lengths = [float(length) for axes, _ in self._ellipses.values() for length in axes[:, 0]]
        low, high = canvas.extent(self.view)
        self.factor = magnification(float(np.quantile(lengths or [0.0], 0.9)), 0.06 * float(max(high - low)))

    def _make_artists(self) -> None:
        """Everything that changes, in the order in which it is drawn."""
        add, wall = self.axes.add_collection, self.sizes.wall
        under = self.heading.get_window_extent().y0 / self.figure.bbox.height
        style = {"fontsize": canvas.LABEL_PT, "family": "monospace", "ha": "center", "va": "bottom", "color": INK}
        self.text = self.figure.text(0.5, under, "", **style)
        self.triangles = add(PolyCollection([], edgecolors=canvas.DIAGONAL, linewidths=self.sizes.thin))
        self.walls = add(LineCollection([], colors=INK, linewidths=1.1 * wall, capstyle="round"))
        dashes = {"linestyles": [canvas.GATE_DASHES], "capstyle": "butt"}
        self.gates = add(LineCollection([], colors=canvas.GATE, linewidths=1.3 * wall, **dashes))
        self.robots = {robot: self._robot_artists(robot) for robot in self.tracks}
        (self.contact,) = self.axes.plot([], [], color=canvas.CONTACT, lw=1.6)
        self._changing = [self.text, self.triangles, *self._of_robots("way"), self.walls, self.gates]
        self._changing += [*self._of_robots("ghost_way", "ghost"), self.contact]
        self._changing += self._of_robots("recent", "ellipse", "stander", "mover")
        for artist in self._changing:
            artist.set_animated(True)

    def _of_robots(self, *names: str) -> list:
        return [parts[name] for name in names for parts in self.robots.values() if name in parts]

    def _robot_artists(self, robot: str) -> dict:
        colour, wall = colour_of(self.view, robot), max(self.sizes.wall, 0.9)
        parts = {}

        def line(**style):
            return self.axes.plot([], [], **style)[0]

        if robot in self.ghosts:
            parts["ghost_way"] = line(color=colour, alpha=0.35, lw=0.6 * wall, ls=(0, (1, 1.5)))
            parts["ghost"] = line(marker="o", ls="", mfc="#ffffff80", mec=colour, alpha=0.5, markersize=7)
        parts["way"] = line(color=colour, alpha=0.45, lw=0.6 * wall)
        parts["recent"] = line(color=colour, lw=1.3 * wall, solid_capstyle="round")
        if robot in self._ellipses:
            parts["ellipse"] = self.axes.add_patch(Ellipse((0, 0), 0, 0, facecolor=colour + "30", edgecolor=colour))
        parts["mover"] = line(**robot_marker(colour, True, 10))
        parts["stander"] = line(**robot_marker(colour, False, 10))
        return parts

    def palette(self) -> Image.Image:
        """The colours of a GIF of this film."""
        colours = [colour_of(self.view, robot) for robot in self.tracks]
        lines = [INK, canvas.GATE, canvas.CONTACT, canvas.DIAGONAL, canvas.MUTED, *colours]
        return palette_of([canvas.FREE, canvas.SOLID, canvas.MAPPED, NEWEST], lines)

    def frame(self, time_s: float) -> np.ndarray:
        """(height, width, 3) picture of a moment, bytes, of even size."""
        self._show_map(time_s)
        self._show_robots(time_s)
        self._canvas.restore_region(self._still)
        for artist in self._changing:
            self.figure.draw_artist(artist)
        picture = np.array(self._canvas.buffer_rgba())
        height, width, _ = picture.shape
        return picture[: height // 2 * 2, : width // 2 * 2, :3]

    def _show_map(self, time_s: float) -> None:
        view, story, at = self.view, self.view.story, self.view.vertices
        known = [t for t in story.triangles_at(time_s) if t in view.triangles]
        self.triangles.set_verts([[at[v] for v in view.triangles[t]] for t in known])
        self.triangles.set_facecolors([canvas.MAPPED] * (len(known) - 1) + [NEWEST])
        gates = story.gates_at(time_s)
        for lines, edges in ((self.walls, story.walls_at(time_s)), (self.gates, gates)):
            lines.set_segments([[at[a], at[b]] for a, b in edges if a in at and b in at])
        move = story.move_at(time_s)
        self.text.set_text(
            f"t = {time_s:5.0f} s   triangles {len(known):3d}   open gates {len(gates):2d}   "
            f"role exchanges {move.role_exchanges:3d}"
        )

    def _show_robots(self, time_s: float) -> None:
        move = self.view.story.move_at(time_s)
        places = {robot: track.at(time_s) for robot, track in self.tracks.items()}
        for robot, parts in self.robots.items():
            track, place = self.tracks[robot], places[robot]
            start_s = float(track.stamps_s[0])
            parts["way"].set_data(*track.between(start_s, max(time_s, start_s)).T)
            since_s = max(time_s - self._recent_s, start_s)
            parts["recent"].set_data(*track.between(since_s, max(time_s, since_s)).T)
            for look in ("mover", "stander"):
                parts[look].set_data(*place[:, None])
                parts[look].set_visible((look == "mover") == (robot == move.robot))
            if robot in self.ghosts:
                ghost = self.ghosts[robot]
                parts["ghost"].set_data(*ghost.at(time_s)[:, None])
                parts["ghost_way"].set_data(*ghost.between(min(since_s, time_s), time_s).T)
            if "ellipse" in parts:
                self._show_ellipse(parts["ellipse"], robot, time_s, place)
        self.contact.set_visible(move.watched and {move.robot, move.watcher} <= set(places))
        if self.contact.get_visible():
            self.contact.set_data(*np.array([places[move.robot], places[move.watcher]]).T)

    def _show_ellipse(self, ellipse: Ellipse, robot: str, time_s: float, place: np.ndarray) -> None:
        semi_axes, directions = self._ellipses[robot]
        k = max(int(np.searchsorted(self.view.stamps_s["smoothed"][robot], time_s, side="right")) - 1, 0)
        ellipse.set_center(place)
        ellipse.width, ellipse.height = 2 * self.factor * semi_axes[k]
        ellipse.angle = float(np.degrees(directions[k]))

    def _handles(self) -> list:
        handles = []
        for robot in self.tracks:
            handles.append(
                Line2D([], [], color=colour_of(self.view, robot), lw=2, label=f"{plain(robot, 24)}, smoothed")
            )
        grey, times = canvas.MUTED, f", enlarged ×{self.factor:,}" if self.factor > 1 else ""
        handles += [
            Line2D([], [], **robot_marker(grey, True, 9), label="mover"),
            Line2D([], [], **robot_marker(grey, False, 8), label="stander, a landmark"),
            Line2D([], [], color=canvas.CONTACT, lw=1.6, label="line of contact"),
            Line2D([], [], color=canvas.GATE, lw=2, ls=canvas.GATE_DASHES, label="open gate"),
        ]
        if self._ellipses:
            handles.append(Patch(facecolor=grey + "30", edgecolor=grey, label=f"95 % ellipse{times}"))
        if self.ghosts:
            ghost = {"marker": "o", "ls": (0, (1, 1.5)), "lw": 1, "mfc": "#ffffff80", "mec": grey, "markersize": 7}
            handles.append(Line2D([], [], color=grey, alpha=0.6, label="odometry alone", **ghost))
        return handles
