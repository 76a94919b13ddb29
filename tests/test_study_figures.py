"""The figures of a study: drawn without a warning for all kinds of axes, and right where it can be read off."""

import warnings
from itertools import product

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from coopslam.report.study_figures import draw_against, draw_runs, draw_study, draw_worlds
from coopslam.report.study_panels import Dimension, StudyResults

WORLDS = Dimension("world", "vertices of the world", ("small", "wide", "large"), (12.0, 30.0, 240.0))
NOISE = Dimension("noise", "noise", ("none", "typical", "legged"), None)
SCALE = Dimension("sigmas", "sigmas (times typical)", ("x0.5", "x1", "x10"), (0.5, 1.0, 10.0))
ONE = Dimension("world", "vertices of the world", ("small",), (12.0,))
SEEDS = 4


def results(*dimensions: Dimension, success: str = "true") -> StudyResults:
    """Errors of 1, 2, 3, .. cm per seed, times the ranks of the values."""
    rows, index = [], []
    for values in product(*(range(len(d.labels)) for d in dimensions)):
        for seed in range(SEEDS):
            error_m = 0.01 * (seed + 1) * float(np.prod(np.array(values) + 1))
            row = {"success": success, "batch.ate_rmse_m": error_m, "dead-reckoning.ate_rmse_m": 40 * error_m}
            row |= {"vertex_rmse_m": error_m, "batch.nees_mean": 3.1, "seconds": 0.5, "travel_over_perimeter": ""}
            rows.append({name: str(value) for name, value in row.items()})
            index.append(values)
    return StudyResults("study with $ and _", dimensions, np.array(index), rows)


@pytest.mark.parametrize("success", ["true", "false"])
@pytest.mark.parametrize(
    ("dimensions", "names"),
    [
        ((ONE,), ["runs"]),
        ((ONE, NOISE), ["noise"]),
        ((WORLDS, SCALE), ["world_size", "sigmas", "worlds"]),
        (
            (ONE, NOISE, SCALE, Dimension("a b", "a", ("1", "2"), (1.0, 2.0))),
            [*(f"noise-{k}" for k in "12"), *(f"sigmas-{k}" for k in "12"), "a_b-x0_5", "a_b-x1", "a_b-x10"],
        ),
    ],
)
def test_every_kind_of_study_has_its_figures(dimensions, names, success, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = draw_study(results(*dimensions, success=success), tmp_path)
    assert [path.name for path in paths] == [f"study_{name}.png" for name in names]
    assert all(path.stat().st_size > 10_000 for path in paths)


def test_figures_of_an_earlier_sweep_go_and_others_stay(tmp_path):
    (tmp_path / "study_gone.png").touch()
    (tmp_path / "mine.png").touch()
    draw_study(results(ONE, NOISE), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.png", "study_noise.png"]


def test_the_panels_show_medians_over_successes_and_rates():
    data = results(ONE, SCALE)
    data.rows[-1]["success"] = "false"  # the largest error of x10
    error, vertices, _, success = draw_against(data, 1, None, np.ones(len(data.index), bool)).axes
    assert (error.get_xscale(), error.get_yscale()) == ("log", "log") and "cm" in error.get_ylabel()
    smoothed, odometry = error.lines
    assert list(smoothed.get_xdata()) == [0.5, 1, 10]
    assert smoothed.get_ydata() == pytest.approx([2.5, 5, 6])
    assert odometry.get_ydata() == pytest.approx([100, 200, 240])
    assert vertices.lines[0].get_ydata() == pytest.approx([2.5, 5, 6])
    assert success.lines[0].get_ydata() == pytest.approx([100, 100, 75])


@pytest.mark.parametrize(
    "figure",
    [
        lambda: draw_against(results(WORLDS, SCALE), 1, 0, np.ones(36, bool), "said"),
        lambda: draw_against(results(WORLDS, SCALE), 0, 1, np.ones(36, bool)),
        lambda: draw_worlds(results(WORLDS, SCALE)),
        lambda: draw_runs(results(ONE)),
    ],
)
def test_legends_and_titles_cover_no_panel(figure):
    figure = figure()
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    panels = [axes.get_tightbbox(renderer) for axes in figure.axes]
    above = [legend.get_window_extent(renderer) for legend in figure.legends]
    above += [figure._suptitle.get_window_extent(renderer)] if figure._suptitle else []
    for k, box in enumerate(above):
        assert box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height
        assert [other for other in [*panels, *above[k + 1 :]] if box.overlaps(other)] == []
    assert [(a, b) for i, a in enumerate(panels) for b in panels[:i] if a.overlaps(b)] == []
