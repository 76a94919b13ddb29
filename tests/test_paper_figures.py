"""The story of a run, moment by moment, and the paper's figures drawn from it."""

import subprocess
import sys

import figures as script
import matplotlib.image
import numpy as np
import pytest
import shapely
from _exploration import Exploration, ExplorationSettings, explore, prepare
from _exploration_output import view_of
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from script_calls import SCRIPTS

from coopslam.exploration.mission import run_mission
from coopslam.records import MoveNote, TriangleDecision, WallDecision
from coopslam.report.paper_figures import draw_paths, draw_stages, draw_triangulated_world, embedded_graph
from coopslam.report.run_view import Track
from coopslam.report.stages import bifurcation, choose_stages
from coopslam.report.story import Found, Story, StoryMove, story_of


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Exploration:
    return explore(prepare(ExplorationSettings("paper_one_obstacle")), tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def view(run):
    return view_of(run)


def story(triangles: int) -> Story:
    """A fan of triangles around vertex 0, one each second, every outer side a wall."""
    move = StoryMove(0.0, float(triangles), "a", "b", "FollowWall", "corner", True, 0)
    walls = [Found(k, "a", (k, k + 1)) for k in range(triangles + 1)] + [Found(triangles, "a", (triangles + 1, 0))]
    found = {k - 1: Found(k, "a", (0, k, k + 1)) for k in range(1, triangles + 1)}
    return Story((move,), (), tuple(walls), found)


# the story


@pytest.mark.parametrize("world", ["paper_one_obstacle", "rooms_with_doors", "cave"])
def test_gates_of_a_moment_are_those_the_explorer_had_open(world):
    """Noted in the explorer itself whenever it decided something."""
    ready = prepare(ExplorationSettings(world))
    records, open_gates = [], {}

    def keep(record):
        records.append(record)
        if isinstance(record, TriangleDecision | WallDecision):
            open_gates[record.stamp_s] = sorted(ready.explorer.free_map.gates)

    mission = run_mission(ready.team, ready.driver, ready.explorer, keep)
    told = story_of(records)
    assert mission.outcome == "complete" and len(open_gates) > 10
    assert {stamp_s: told.gates_at(stamp_s) for stamp_s in open_gates} == open_gates
    assert max(map(len, open_gates.values())) > 1 and told.gates_at(told.end_s) == []


def test_the_story_ends_with_what_the_mission_counted(run, view):
    moves, mission = view.story.moves, run.mission
    assert len(moves) == mission.moves and moves[-1].role_exchanges == mission.role_exchanges
    assert [move.role_exchanges for move in moves] == [progress.role_exchanges for progress in mission.history]
    assert len(view.story.triangles_at(view.story.end_s)) == len(mission.explorer.free_map.triangles)
    assert sorted(view.story.walls_at(view.story.end_s)) == sorted(mission.explorer.free_map.walls())


def test_moves_follow_each_other_without_gaps(view):
    moves = view.story.moves
    assert moves[0].start_s == 0.0
    assert [move.start_s for move in moves[1:]] == [move.end_s for move in moves[:-1]]
    assert all(view.story.move_at(move.end_s).end_s == move.end_s for move in moves)


def test_robots_that_only_watch_exchange_no_roles():
    moves = [MoveNote(k, robot, "b", "FollowWall()", "corner") for k, robot in enumerate("aabcbac")]
    assert [move.role_exchanges for move in story_of(moves, pair=("a", "b")).moves] == [0, 0, 1, 1, 1, 2, 2]
    assert [move.role_exchanges for move in story_of(moves).moves] == [0, 0, 1, 2, 3, 4, 5]


def test_a_story_without_moves():
    assert story_of([]).gates_at(0.0) == [] and story_of([]).move_at(0.0) is None


def test_a_robot_stands_until_its_move_begins():
    track = Track.with_departures(np.array([0.0, 10.0]), np.array([[0.0, 0.0], [4.0, 0.0]]), [8.0])
    assert [track.at(t).tolist() for t in (-1, 5, 8, 9, 11)] == [[0, 0], [0, 0], [0, 0], [2, 0], [4, 0]]
    assert track.between(9, 12).tolist() == [[2, 0], [4, 0], [4, 0]]


def test_while_another_moves_a_robot_is_drawn_where_it_stands(view):
    for robot in view.robots:
        smoothed, true = view.track("smoothed", robot), view.track("true", robot)
        others = [move for move in view.story.moves if move.robot != robot]
        moments = [share * move.start_s + (1 - share) * move.end_s for move in others for share in (0.1, 0.5, 0.9)]
        assert max(np.hypot(*(smoothed.at(t) - true.at(t))) for t in moments) < 0.1  # m; walls are metres long


# the stages


def test_stages_are_those_of_the_paper(view):
    stages = choose_stages(view.story)
    assert [stage.triangles for stage in stages[:2]] == [3, 6] and stages[-1].title == "complete"
    assert stages[-1].triangles == 13 and len(stages) == 5
    assert [stage.time_s for stage in stages] == sorted(stage.time_s for stage in stages)
    fork = next(stage for stage in stages if "bifurcates" in stage.title)
    move = view.story.move_at(fork.time_s)
    assert (move.kind, move.ended) == ("ReturnAlongContact", "corner")  # the robot lost contact and met what hid it
    before = view.story.gates_at(np.nextafter(fork.time_s, 0))
    assert len(view.story.gates_at(fork.time_s)) == len(before) + 1


@pytest.mark.parametrize("triangles", [0, 1, 2, 3, 4, 5, 6, 7, 40])
def test_small_runs_have_fewer_stages(triangles):
    stages = choose_stages(story(triangles))
    counts = [stage.triangles for stage in stages]
    assert len(counts) == min(max(triangles, 1), 5) and counts == sorted(set(counts)) and counts[-1] == triangles
    assert bifurcation(story(triangles)) is None


def test_an_unfinished_run_is_not_called_complete():
    whole = story(8)
    part = Story(whole.moves, (), whole.walls[:5], {k: found for k, found in whole.triangles.items() if k < 4})
    assert choose_stages(part)[-1].title == "the end, with open gates"


# the figures


def polygons(axes) -> list[np.ndarray]:
    return [path.vertices for c in axes.collections if isinstance(c, PolyCollection) for path in c.get_paths()]


def test_panels_show_what_was_known_at_their_stage(run, view):
    figure = draw_stages(view)
    stages = choose_stages(view.story)
    panels = np.reshape(figure.axes, (len(stages), 3))
    decided = [record for record in run.records if isinstance(record, TriangleDecision)]
    for stage, (first, second, chart) in zip(stages, panels, strict=True):
        known = [record for record in decided if record.stamp_s <= stage.time_s]
        assert len(polygons(chart)) == len(known) == stage.triangles
        swept = len(polygons(first)) - len(known), len(polygons(second)) - len(known)  # tinted over the white ones
        assert sum(swept) == len(known) and min(swept) >= 0
    assert [axes.get_title().split()[0] for axes in figure.axes] == [f"({letter})" for letter in "abcdefghijklmno"]
    captions = [text.get_text() for text in figure.texts]
    assert captions[0].startswith("stage 1") and "after 3 triangles, t = " in captions[0]


def test_captions_titles_and_panels_do_not_overlap(view):
    figure = draw_stages(view)
    FigureCanvasAgg(figure).draw()
    parts = [*figure.texts, *figure.legends, *(part for axes in figure.axes for part in (axes.title, axes.patch))]
    boxes = [shapely.box(*part.get_window_extent().extents) for part in parts]
    page = shapely.box(*figure.bbox.extents)
    assert [part for part, box in zip(parts, boxes, strict=True) if not page.buffer(1).contains(box)] == []
    assert [(a, b) for a in range(len(boxes)) for b in range(a) if boxes[a].intersection(boxes[b]).area > 1] == []


def test_the_embedded_graph_is_the_dual_graph(run, view):
    nodes, links = embedded_graph(view, list(view.triangles))
    assert len(nodes) == run.dual_graph.number_of_nodes() and len(links) == run.dual_graph.number_of_edges()
    solid = [shapely.Polygon([view.vertices[v] for v in triangle]) for triangle in view.triangles.values()]
    free = shapely.union_all(solid, grid_size=1e-9)
    assert all(free.buffer(1e-6).contains(shapely.LineString(link)) for link in links)


def test_the_triangulated_world_has_every_triangle(view):
    assert len(polygons(draw_triangulated_world(view).axes[0])) == 13


def test_paths_are_those_of_the_estimate(view):
    panels = draw_paths([view, view]).axes
    assert len(panels) == 2
    for robot, line in zip(view.robots, [line for line in panels[0].lines if len(line.get_xdata()) > 1], strict=True):
        assert np.column_stack(line.get_data()) == pytest.approx(view.paths["smoothed"][robot])


# the script


def test_the_script_writes_and_names_every_figure(tmp_path):
    options = ["--out", str(tmp_path / "a"), "--noise", "none", "--seed", "4"]
    command = [sys.executable, str(SCRIPTS / "figures.py"), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stderr == ""
    names = [f"figure_{number}.{kind}" for number in ("2a", "3", "4") for kind in ("png", "pdf")]
    assert [line for line in done.stdout.splitlines() if "figure_" in line] == [str(tmp_path / "a" / n) for n in names]
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == sorted(names)
    for name in names:
        path = tmp_path / "a" / name
        if name.endswith("pdf"):
            assert path.read_bytes().startswith(b"%PDF") and b"CreationDate" not in path.read_bytes()
        else:
            picture = matplotlib.image.imread(path)
            assert min(picture.shape[:2]) > 900 and (picture[[0, -1], :, :3] == 1).all()  # nothing cut off


@pytest.mark.parametrize(
    "arguments",
    [
        ["--seed", "-1"],
        ["--seed", "x"],
        ["--noise", "loud"],
        ["--world", "nowhere"],
        ["--out", ""],
        ["--out", __file__],
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_2(arguments, capsys):
    try:
        code = script.run(script.main, arguments)
    except SystemExit as end:
        code = end.code
    printed = capsys.readouterr()
    assert code == 2 and printed.out == "" and len(printed.err.strip().splitlines()) == 1, printed
