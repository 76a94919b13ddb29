"""Path figures: what is drawn where, read back from the artists."""

from functools import cache

import numpy as np
import pytest
from explorations import run
from matplotlib.collections import EllipseCollection

from coopslam.planning.belief_paths import shortest, widest
from coopslam.planning.dual_graph import dual_graph
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.recorded_odometry import RecordedOdometry
from coopslam.planning.traversal import model_named
from coopslam.report.path_figure import STYLES, NamedRoute, draw_routes


@cache
def drawn():
    done = run("paper_one_obstacle", "typical", 1)
    smoothed = done.smoothed()
    map_graph = MapGraph.from_graph(dual_graph(done.free_map, smoothed, RecordedOdometry(done.driver.graph, smoothed)))
    arguments = (map_graph, (1.0, 1.0), (6.0, 4.0), model_named("odometry"))
    named = [NamedRoute("shortest", shortest(*arguments)), NamedRoute("widest", widest(*arguments))]
    return named, draw_routes(map_graph, named, "two $paths$")


def test_every_path_is_drawn_from_start_to_goal():
    named, figure = drawn()
    lines = {line.get_color(): line.get_xydata() for line in figure.axes[0].lines if len(line.get_xydata()) > 1}
    for one in named:
        assert np.array_equal(lines[STYLES[one.name]], one.route.bends)


def test_ellipses_are_those_of_the_covariances():
    """Their axes are 2 sqrt(5.991 lambda), one scale for all, the goal's among them."""
    named, figure = drawn()
    found = [c for c in figure.axes[0].collections if isinstance(c, EllipseCollection)]
    scales = []
    for one, ellipses in zip(named, found, strict=True):
        offsets = ellipses.get_offsets()
        assert offsets[-1] == pytest.approx(one.route.points[-1]) and 5 <= len(offsets) <= 10
        for offset, width, height in zip(offsets, ellipses.get_widths(), ellipses.get_heights(), strict=True):
            (k,) = np.flatnonzero((one.route.points == offset).all(axis=1))
            variances = np.linalg.eigvalsh(one.route.covariances[k][:2, :2])
            scales += [width / np.sqrt(variances[1]), height / np.sqrt(variances[0])]
    times = np.array(scales) / (2 * np.sqrt(5.991))
    assert times == pytest.approx(np.round(times[0]), rel=1e-9)


def test_the_legend_says_how_long_and_how_sure():
    named, figure = drawn()
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    for one in named:
        (said,) = (text for text in texts if text.startswith(f"{one.name}: "))
        assert f"{one.route.length_m:.2f} m" in said and "known to" in said and "touches a wall" in said
    assert {"start", "goal"} <= set(texts)
    assert figure.get_suptitle() == r"two \$paths\$"


def test_nothing_is_drawn_outside_of_the_page(tmp_path):
    _, figure = drawn()
    figure.savefig(tmp_path / "f.png", dpi=50)
    (legend,) = figure.legends
    box, page = legend.get_window_extent(), figure.bbox
    assert page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1
