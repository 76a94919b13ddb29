import dataclasses
import time

import matplotlib.image
import networkx as nx
import numpy as np
import pytest
from scipy.stats import chi2

from coopslam.report.canvas import GATE, plain
from coopslam.report.charts import draw_uncertainty, vertex_errors
from coopslam.report.ellipses import CHI_SQUARE_95, ellipse_axes, magnification
from coopslam.report.figures import crossing, draw_all, draw_dual_graph, draw_map, draw_trajectories, drawn_in
from coopslam.report.run_view import RunView, UncertaintyPoint
from coopslam.se2 import rotation

FIGURES = ["map.png", "trajectories.png", "dual_graph.png", "uncertainty.png", "vertex_errors.png"]


def strip_view(vertices: int, exchanges: int = 5, truth: bool = True, open_gates: bool = False) -> RunView:
    """A corridor of `vertices` corners, triangulated in a zigzag, with errors drawn from its covariances."""
    rng = np.random.default_rng(1)
    half = vertices // 2
    true = {v: np.array([v // 2, 2.0 * (v % 2)]) + [0.0, 0.5 * np.sin(v // 2)] for v in range(vertices)}
    cov = {v: 1e-4 * (1 + v / vertices) * np.array([[2.0, 0.5], [0.5, 1.0]]) for v in true}
    mapped = {v: rng.multivariate_normal(true[v], cov[v]) for v in true}
    triangles = {t: (t, t + 1, t + 2) if t % 2 else (t + 1, t, t + 2) for t in range(vertices - 2)}
    graph = nx.path_graph(len(triangles))
    for t, corners in triangles.items():
        graph.nodes[t].update(centroid=np.mean([mapped[v] for v in corners], axis=0).tolist())
        graph.nodes[t].update(area_m2=1.0, position_sigma_m=0.01 + 0.001 * t)
    for a, b in graph.edges:
        graph.edges[a, b].update(gate=[b, b + 1], width_m=1.0)
    lower, upper = list(range(0, vertices, 2)), list(range(1, vertices, 2))
    walls = list(zip(lower, lower[1:], strict=False)) + list(zip(upper[1:], upper, strict=False)) + [(1, 0)]
    ring = np.array([true[v] for v in lower + upper[::-1]])
    paths = {}
    for kind, sigma in (("dead-reckoning", 0.3), ("causal", 0.03), ("smoothed", 0.01), ("true", 0.0)):
        drift = sigma * rng.standard_normal((2, half, 2)).cumsum(axis=1)
        paths[kind] = {"robot0": ring[:half] + drift[0], "robot1": ring[half:][::-1] + drift[1]}
    if not truth:
        del paths["true"]
    history = [
        UncertaintyPoint(float(k), k // 3, 2.0 * k, k, {"robot0": 0.01 * np.sqrt(k), "robot1": 0.01 * np.sqrt(k + 1)})
        for k in range(3 * exchanges + 1)
    ]
    last = [(vertices - 2, vertices - 1)]
    return RunView(
        name="strip",
        summary={},
        vertices=mapped,
        covariances=cov,
        triangles=triangles,
        walls=walls if open_gates else walls + last,
        gates=last if open_gates else [],
        dual_graph=graph,
        paths=paths,
        history=history,
        true_rings=[ring] if truth else [],
        true_vertices=true if truth else {},
    )


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return draw_all(strip_view(12), tmp_path_factory.mktemp("run") / "figures")


def share_of_colour(picture: np.ndarray, colour: str) -> float:
    """Of pixels close to a colour like #0072B2."""
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return float((np.abs(picture[..., :3] - wanted).max(axis=-1) < 0.03).mean())


def test_every_figure_is_written_in_order(drawn):
    assert [path.name for path in drawn] == FIGURES
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in drawn)


def test_figures_drawn_before_are_found_in_order(drawn):
    assert drawn_in(drawn[0].parent) == drawn
    assert drawn_in(drawn[0].parent / "elsewhere") == []


def test_open_gates_have_one_colour_in_all_figures():
    for figure in (draw_map(strip_view(12, open_gates=True)), draw_dual_graph(strip_view(12, open_gates=True))):
        labels = {
            text.get_text(): line
            for legend in figure.legends
            for text, line in zip(legend.get_texts(), legend.legend_handles, strict=True)
        }
        (gate,) = [line for label, line in labels.items() if "open" in label]
        assert gate.get_color() == GATE


def test_slippery_ground_is_hatched_in_every_plan_and_named():
    """Two outlines, drawn in each panel; a world without any says nothing of it."""
    dry = strip_view(12)
    patches = [np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), np.array([[2.0, 0.0], [3.0, 0.0], [3.0, 1.0]])]
    wet = dataclasses.replace(dry, slippery=patches)
    for draw in (draw_map, draw_trajectories, draw_dual_graph):
        for view, count in ((dry, 0), (wet, 2)):
            figure = draw(view)
            named = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
            assert named.count("slippery ground") == (count > 0)
            for axes in (axes for axes in figure.axes if axes.get_xlabel() or axes.get_ylabel() == "y (m)"):
                assert sum(patch.get_hatch() is not None for patch in axes.patches) == count


def test_figures_are_not_blank(drawn):
    for path in drawn:
        picture = matplotlib.image.imread(path)
        assert min(picture.shape[:2]) > 400
        assert len(np.unique(picture[::5, ::5].reshape(-1, picture.shape[2]), axis=0)) > 30
        assert 0.02 < (picture[..., :3].min(axis=-1) < 0.9).mean() < 0.95
        edge = np.concatenate([picture[:2].reshape(-1, picture.shape[2]), picture[-2:].reshape(-1, picture.shape[2])])
        assert (edge[:, :3] == 1).all(), f"{path.name} is cut off at its edge"


def test_figures_show_what_they_should(drawn):
    colours = {"map": "#222222", "trajectories": "#E69F00", "dual_graph": "#440154", "uncertainty": "#D55E00"}
    for path in drawn:
        if path.stem in colours:
            assert share_of_colour(matplotlib.image.imread(path), colours[path.stem]) > 1e-4, path.name


def test_the_same_run_gives_the_same_bytes(drawn, tmp_path):
    again = draw_all(strip_view(12), tmp_path)
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in drawn]


def test_without_truth_there_are_no_vertex_errors(tmp_path):
    paths = draw_all(strip_view(12, truth=False, open_gates=True), tmp_path)
    assert [path.name for path in paths] == FIGURES[:-1]


def test_a_run_that_ended_at_once_is_drawn(tmp_path):
    empty = RunView("nothing", {}, {}, {}, {}, [], [], nx.Graph(), {}, [])
    assert len(draw_all(empty, tmp_path)) == 4


def test_a_large_world_is_drawn_without_ids(tmp_path):
    view = strip_view(800, exchanges=600)
    began = time.perf_counter()
    assert len(draw_all(view, tmp_path)) == 5
    assert time.perf_counter() - began < 10  # measured: 3 s
    assert len(draw_map(view).axes[0].texts) == 0
    assert len(draw_dual_graph(view).axes[0].texts) == 0


def test_a_small_world_shows_every_id():
    view = strip_view(12)
    assert {text.get_text() for text in draw_map(view).axes[0].texts} == {str(v) for v in view.vertices}
    assert {text.get_text() for text in draw_dual_graph(view).axes[0].texts} == {str(t) for t in view.triangles}


def test_text_from_outside_is_no_mathematics(tmp_path):
    view = strip_view(12)
    paths = {kind: {"$\\frac{$": path["robot0"]} for kind, path in view.paths.items()}
    hostile = dataclasses.replace(view, name="$\\undefined{$ _ <b>\n$x$", paths=paths)
    draw_all(hostile, tmp_path)
    assert plain("a $ b") == "a \\$ b" and len(plain("x" * 500)) == 60


def test_trajectories_are_limited_to_the_world():
    view = strip_view(12)
    paths = {**view.paths, "dead-reckoning": {"robot0": np.array([[0.0, 0.0], [1e4, -1e4]])}}
    for axes in draw_trajectories(dataclasses.replace(view, paths=paths)).axes:
        assert axes.get_xlim()[1] < 10 and axes.get_ylim()[0] > -2


def test_axes_of_plans_are_equal_and_have_units():
    for figure in (draw_map(strip_view(12)), draw_dual_graph(strip_view(12))):
        axes = figure.axes[0]
        assert axes.get_aspect() == 1.0
        assert axes.get_xlabel().endswith("(m)") and axes.get_ylabel().endswith("(m)")


@pytest.mark.parametrize(("exchanges", "marked"), [(5, 5), (600, 0)])
def test_role_exchanges_are_marked_while_they_are_few(exchanges, marked):
    by_distance = draw_uncertainty(strip_view(12, exchanges=exchanges)).axes[1]
    assert sum(line.get_linestyle() == ":" for line in by_distance.lines) == marked


def test_ellipse_axes_are_those_of_the_construction():
    turn = rotation(0.7)
    cov = turn @ np.diag([0.09, 0.04]) @ turn.T
    semi_axes, direction = ellipse_axes(cov[None])
    assert semi_axes[0] == pytest.approx(np.sqrt(CHI_SQUARE_95) * np.array([0.3, 0.2]))
    assert np.sin(direction[0] - 0.7) == pytest.approx(0, abs=1e-12)  # an axis has no sign


def test_ellipse_holds_95_percent_of_draws():
    cov = np.array([[0.5, 0.3], [0.3, 0.4]])
    (semi_axes,), (direction,) = ellipse_axes(cov[None])
    points = np.random.default_rng(0).multivariate_normal([0, 0], cov, 40_000) @ rotation(direction)
    inside = ((points / semi_axes) ** 2).sum(axis=1) <= 1
    assert inside.mean() == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / 40_000))
    assert pytest.approx(chi2.ppf(0.95, 2), abs=1e-3) == CHI_SQUARE_95


@pytest.mark.parametrize(
    ("largest", "wanted", "factor"), [(1, 0.5, 1), (1, 1.9, 1), (1, 2, 2), (0.1, 1, 10), (3e-4, 1, 2000), (0, 1, 1)]
)
def test_magnification_is_round(largest, wanted, factor):
    assert magnification(largest, wanted) == factor


def test_vertex_errors_agree_with_the_definition():
    view = strip_view(40)
    ids, errors, sigmas, nees = vertex_errors(view)
    assert ids == list(view.vertices)
    for k, v in enumerate(ids):
        offset = view.vertices[v] - view.true_vertices[v]
        assert errors[k] == pytest.approx(np.linalg.norm(offset))
        assert sigmas[k] ** 2 == pytest.approx(np.linalg.norm(view.covariances[v], 2))
        assert nees[k] == pytest.approx(offset @ np.linalg.inv(view.covariances[v]) @ offset)


def test_an_exactly_known_vertex_has_no_nees():
    view = strip_view(12)
    view.covariances[3] = np.zeros((2, 2))
    nees = vertex_errors(view)[3]
    assert np.isnan(nees).tolist() == [v == 3 for v in view.vertices]


def test_an_edge_of_the_dual_graph_bends_only_when_it_must():
    left, right = np.array([0.0, 0.0]), np.array([0.0, 2.0])
    assert crossing(np.array([-1.0, 0.5]), np.array([1.0, 1.5]), left, right) == pytest.approx([0, 1])
    assert crossing(np.array([-1.0, 3.0]), np.array([1.0, 4.0]), left, right) == pytest.approx([0, 1.8])
    assert crossing(np.array([0.0, 3.0]), np.array([0.0, 4.0]), left, right) == pytest.approx([0, 1])
