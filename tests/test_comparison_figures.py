"""Figures of replayed logs: drawn for whatever a log has, without a warning, and right where it can be read off."""

import dataclasses
import warnings
from itertools import product

import matplotlib.image
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from scipy.stats import chi2
from test_comparison_html import DRAWN, EMPTY, bare, failed, sample_view, view_of, without_truth

from coopslam.report import comparison_figures
from coopslam.report.comparison_figures import best_estimator, draw_bars, draw_comparison, draw_study
from coopslam.report.comparison_panels import NEES_BAND, common_band, evenly, running, thinned
from coopslam.report.comparison_view import ComparisonView, RobotErrors


def study_rows(seeds=20) -> list[dict]:
    rng = np.random.default_rng(5)
    rows = []
    levels = (("typical", 1.0), ("twice typical", 2.0), ("legged", 12.0))
    for (noise, sigma), exchanges, seed in product(levels, (2, 4, 8, 16, 32), range(seeds)):
        for estimator, worse in (("ekf", 1.0 + 0.05 * sigma), ("fixed-lag", 1.1), ("batch", 1.0)):
            ate_m = 0.01 * sigma * worse * np.sqrt(exchanges) * rng.lognormal(0, 0.4)
            row = {"seed": seed, "noise": noise, "role_exchanges": exchanges, "estimator": estimator}
            row |= {"ate_rmse_m": ate_m, "causal_ate_rmse_m": ate_m * (1 if estimator == "ekf" else 1.3)}
            row |= {"nees_mean": rng.chisquare(3 * 30) / 30 * worse**2, "crlb_ratio": worse * rng.lognormal(0.02, 0.3)}
            rows.append(row)
    return rows


@pytest.fixture(scope="module")
def view() -> ComparisonView:
    return sample_view(points=200)


@pytest.fixture(scope="module")
def long_view() -> ComparisonView:
    return sample_view()


@pytest.fixture(scope="module")
def drawn(long_view, tmp_path_factory):
    return draw_comparison(long_view, tmp_path_factory.mktemp("replay") / "figures")


def only(view: ComparisonView, *names: str) -> ComparisonView:
    return dataclasses.replace(view, estimators=[e for e in view.estimators if e.name in names])


def quietly(view: ComparisonView, folder) -> list[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return [path.name for path in draw_comparison(view, folder)]


def test_every_figure_is_written_in_order_and_not_cut_off(drawn):
    assert [path.name for path in drawn] == DRAWN
    for path in drawn:
        picture = matplotlib.image.imread(path)
        assert min(picture.shape[:2]) > 400
        assert 0.02 < (picture[..., :3].min(axis=-1) < 0.9).mean() < 0.95
        rim = [picture[:2], picture[-2:], picture[:, :2].swapaxes(0, 1), picture[:, -2:].swapaxes(0, 1)]
        assert all((side[..., :3] == 1).all() for side in rim), f"{path.name} is cut off at its edge"


def test_the_same_log_gives_the_same_bytes(view, tmp_path):
    once, again = (draw_comparison(only(view, "ekf"), tmp_path / name) for name in ("once", "again"))
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in once]


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (lambda v: only(v, "batch"), DRAWN),
        (lambda v: only(v, "dead-reckoning"), [name for name in DRAWN if name != "consistency.png"]),
        (without_truth, ["trajectories.png", "consistency.png", "latency.png"]),
        (lambda v: only(without_truth(v), "dead-reckoning"), ["trajectories.png", "latency.png"]),
        (lambda v: dataclasses.replace(v, estimators=[failed(), *v.estimators]), DRAWN),
        (lambda v: dataclasses.replace(v, estimators=[failed()]), []),
        (lambda v: dataclasses.replace(v, estimators=[]), []),
        (lambda v: only(sample_view(points=40, robots=1, landmarks=0), "ekf"), DRAWN),
        (lambda v: only(sample_view(points=1, robots=1, landmarks=1), "ekf", "batch"), DRAWN),
        (lambda v: dataclasses.replace(only(v, "batch"), log="$\\frac{$ _ <b>\n", summary={}), DRAWN),
    ],
)
def test_every_kind_of_log_is_drawn_without_a_warning(view, change, names, tmp_path):
    assert quietly(change(view), tmp_path) == names
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)


def test_figures_of_an_earlier_replay_go(view, tmp_path):
    for name in DRAWN:
        (tmp_path / name).touch()
    quietly(dataclasses.replace(view, estimators=[failed()]), tmp_path)
    assert list(tmp_path.iterdir()) == []


def layouts(view: ComparisonView) -> dict:
    names = [name for name in vars(comparison_figures) if name.startswith("draw_") and "comparison" not in name]
    return {name: getattr(comparison_figures, name)(view) for name in names if name != "draw_study"}


@pytest.mark.parametrize("change", [lambda v: v, without_truth, lambda v: only(v, "ekf"), lambda v: sample_view(50, 1)])
def test_nothing_overlaps_and_nothing_leaves_the_figure(view, change):
    for name, figure in layouts(change(view)).items():
        if figure is None:
            continue
        renderer = FigureCanvasAgg(figure).get_renderer()
        figure.draw(renderer)
        boxes = [axes.get_tightbbox(renderer) for axes in figure.axes if axes.axison]
        boxes += [legend.get_window_extent(renderer) for legend in figure.legends]
        boxes.append(figure._suptitle.get_window_extent(renderer))
        for box in boxes:
            assert box.x0 >= 0 and box.y0 >= 0, name
            assert box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height, name
        assert [k for k, box in enumerate(boxes) for other in boxes[:k] if box.overlaps(other)] == [], name
        for axes in (axes for axes in figure.axes if axes.axison):
            words = [text for text in [*axes.texts, *axes.get_yticklabels(), axes.yaxis.label] if text.get_text()]
            extents = [text.get_window_extent(renderer) for text in words]
            assert not any(a.overlaps(b) for k, a in enumerate(extents) for b in extents[:k]), name


def test_thinning_keeps_the_outline_and_the_ends_of_dots():
    curve = np.random.default_rng(0).standard_normal(12_000).cumsum()
    shown = thinned(curve, 300)
    assert len(shown) <= 300 and (np.diff(shown) > 0).all()
    for stretch in np.array_split(np.arange(12_000), 150):  # 80 points each, as 12 000 / 150 divides without a rest
        inside = curve[shown[(shown >= stretch[0]) & (shown <= stretch[-1])]]
        assert {inside.min(), inside.max()} == {curve[stretch].min(), curve[stretch].max()}
    assert list(thinned(curve[:7])) == list(range(7)) and len(thinned(EMPTY)) == 0
    assert len(evenly(12_000, 300)) == 300 and {0, 11_999} <= set(evenly(12_000, 300))


def test_running_statistics_are_those_of_the_stretches():
    at, values = np.arange(40.0), np.repeat([1.0, 5.0, 2.0, 4.0], 10) + np.tile([-0.5, 0.5], 20)
    centres, means = running(at, values, np.mean)
    assert centres == pytest.approx(39 * np.array([1, 3, 5, 7]) / 8)
    assert means == pytest.approx([1, 5, 2, 4])
    gap = (at < 10) | (at >= 20)
    assert running(at[gap], values[gap], np.max)[1] == pytest.approx([1.5, 2.5, 4.5])
    assert [len(array) for array in running(EMPTY, EMPTY, np.mean)] == [0, 0]


def test_the_band_of_several_robots_is_that_of_those_who_are_there():
    early = (np.array([0.0, 10.0]), np.array([1.0, 2.0]))
    late = (np.array([5.0, 15.0]), np.array([3.0, 3.0]))
    moments_s, low, high = common_band([early, late])
    assert (moments_s[0], moments_s[-1]) == (0, 15)
    assert [np.interp(t, moments_s, low) for t in (2, 8, 12)] == pytest.approx([1.2, 1.8, 3], abs=0.01)
    assert [np.interp(t, moments_s, high) for t in (2, 8, 12)] == pytest.approx([1.2, 3, 3], abs=0.01)


def ten_poses(errors_m, sigma_m=0.1) -> RobotErrors:
    n, stamps_s = len(errors_m), np.arange(float(len(errors_m)))
    sigmas = np.full(n, sigma_m)
    path = np.stack([stamps_s, stamps_s], axis=1)
    return RobotErrors(stamps_s, path, stamps_s, np.array(errors_m), 0.1 * sigmas, sigmas, sigmas, sigmas * 30)


def test_errors_are_drawn_in_named_units_and_those_beyond_3_sigma_are_marked():
    errors_m = [0.1, 0.2, 0.29, 0.31, 0.2, 0.1, 0.4, 0.5, 0.1, 0.0]
    figure = comparison_figures.draw_errors(view_of(bare("ekf", {"a": ten_poses(errors_m)})))
    position, heading = figure.axes
    curves = {tuple(np.round(line.get_ydata(), 9)): line for line in position.lines}
    assert tuple(np.round(100 * np.array(errors_m), 9)) in curves and "(cm)" in position.get_ylabel()
    (ticks,) = [line for line in position.lines if line.get_marker() == "|"]
    assert list(ticks.get_xdata()) == [3, 6, 7]
    assert position.get_title("left") == "position: rms 26.5 cm, largest 50.0 cm, 30 % beyond 3σ"
    assert heading.get_title("left") == "heading: rms 0.573°, largest 0.573°, 0 % beyond 3σ"
    assert position.get_ylim()[0] == 0 and position.get_ylim()[1] > 50
    assert heading.get_ylim()[0] < -0.57 and "(°)" in heading.get_ylabel()


def test_errors_that_may_be_compared_with_sigmas_are_preferred():
    robot = ten_poses([0.1] * 10)
    figure = comparison_figures.draw_errors(view_of(bare("ekf", {"a": robot})))
    assert "after alignment" in figure.get_suptitle() and "0 % beyond" in figure.axes[0].get_title("left")
    robot = dataclasses.replace(
        robot, anchored_position_errors_m=np.full(10, 0.5), anchored_heading_errors_rad=np.full(10, -0.4)
    )
    figure = comparison_figures.draw_errors(view_of(bare("ekf", {"a": robot})))
    assert "relative to the first robot's start" in figure.get_suptitle()
    position, heading = (axes.get_title("left") for axes in figure.axes)
    assert position == "position: rms 50.0 cm, largest 50.0 cm, 100 % beyond 3σ"
    assert heading == "heading: rms 22.9°, largest 22.9°, 100 % beyond 3σ"


def test_a_heading_error_that_passes_180_degrees_is_no_line_across_the_panel():
    robot = dataclasses.replace(ten_poses([0.1] * 10), heading_errors_rad=np.radians([170.0] * 5 + [-170.0] * 5))
    heading = comparison_figures.draw_errors(view_of(bare("ekf", {"a": robot}))).axes[1]
    (curve,) = [line for line in heading.lines if len(line.get_xdata()) == 11]
    assert np.flatnonzero(np.isnan(curve.get_ydata())).tolist() == [5]


def test_a_single_wild_error_does_not_hide_the_others():
    errors_m = np.full(1000, 0.05)
    errors_m[500] = 40.0
    axes = comparison_figures.draw_errors(view_of(bare("ekf", {"a": ten_poses(errors_m)}))).axes[0]
    assert axes.get_ylim()[1] < 40
    assert "largest 40.0 m" in axes.get_title("left")


def test_the_band_of_nees_is_that_of_three_degrees_of_freedom(view):
    assert pytest.approx(chi2.ppf([0.025, 0.975], 3)) == NEES_BAND
    axes = comparison_figures.draw_consistency(only(view, "ekf")).axes[0]
    nees = np.concatenate([robot.nees[1:] for robot in only(view, "ekf").estimators[0].robots.values()])
    inside = ((nees > chi2.ppf(0.025, 3)) & (nees < chi2.ppf(0.975, 3))).mean()
    title = axes.get_title("left")
    assert f"mean {nees.mean():.2f} " in title and f"{100 * inside:.0f} % inside" in title
    band = axes.patches[0].get_bbox()
    assert (band.y0, band.y1) == pytest.approx(NEES_BAND) and axes.get_yscale() == "log"


def test_nis_reaches_from_1_to_its_mean():
    nis = {"odometry": {"count": 3, "mean_per_dof": 0.5}, "range_robot": {"count": 9, "mean_per_dof": 4.0}}
    (axes,) = comparison_figures.draw_consistency(view_of(bare("ekf", scores={"nis": nis}))).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["range robot", "odometry"]
    spans = sorted(tuple(sorted((bar.get_x(), bar.get_x() + bar.get_width()))) for bar in axes.patches)
    assert spans == [(0.5, 1.0), (1.0, 4.0)]
    assert axes.get_title("left") == "ekf: NIS per degree of freedom (count)"  # without NEES beside it
    assert {text.get_text() for text in axes.texts} >= {"0.500 (3)", "4.00 (9)"}


def test_bars_have_their_values_and_a_logarithm_when_they_differ_by_much():
    scores = [{"ate_rmse_m": 0.02, "heading_rmse_rad": 0.01}, {"ate_rmse_m": 3.0, "heading_rmse_rad": 0.1}]
    far = draw_bars(view_of(*(bare(f"e{k}", scores=one) for k, one in enumerate(scores))))
    assert [axes.get_xscale() for axes in far.axes] == ["log", "linear"]
    assert [text.get_text() for text in far.axes[0].texts] == ["2.00 cm", "3.00 m"]
    assert [text.get_text() for text in far.axes[1].texts] == ["0.573°", "5.73°"]
    ends = [bar.get_x() + bar.get_width() for bar in far.axes[0].patches]
    assert ends == pytest.approx([0.02, 3.0])


def test_latencies_have_their_quantiles_and_batch_its_total_time():
    latencies_s = np.random.default_rng(1).lognormal(-7, 1, 200)
    causal = bare("ekf", latencies_s=latencies_s, latency_poses=np.arange(200.0), scores={"wall_seconds": 1.5})
    figure = comparison_figures.draw_latency(view_of(causal, bare("batch", scores={"wall_seconds": 80.0})))
    updates, totals = figure.axes
    median, slow = np.percentile(1000 * latencies_s, [50, 99])
    assert updates.get_title() == f"ekf\nmedian {median:.3f} ms, p99 {slow:.2f} ms"
    assert updates.lines[-1].get_ydata() == pytest.approx([slow])  # too few for more than one stretch
    assert [label.get_text() for label in totals.get_yticklabels()] == ["ekf", "batch (all at once)"]
    assert [text.get_text() for text in totals.texts] == ["1.50 s", "80.0 s"]
    assert totals.get_xscale() == "log" and updates.get_yscale() == "log"


def test_all_trajectories_have_one_scale_and_the_best_is_named(view):
    figure = comparison_figures.draw_trajectories(view)
    limits = {(*axes.get_xlim(), *axes.get_ylim()) for axes in figure.axes}
    assert len(limits) == 1 and all(axes.get_aspect() == 1 for axes in figure.axes)
    (bold,) = [axes.get_title() for axes in figure.axes if axes.title.get_fontweight() == "bold"]
    best = min(view.estimators, key=lambda e: e.scores["ate_rmse_m"])
    assert bold.startswith(best.name) and best_estimator(view) is best
    assert best_estimator(without_truth(view)).name == "dead-reckoning"
    assert best_estimator(view_of(failed())) is None


def test_an_estimate_that_runs_away_is_cut_off(view):
    lost = dataclasses.replace(view.estimators[0], robots={"robot1": ten_poses(np.zeros(10))})
    lost.robots["robot1"].path[:] = 1e6
    figure = comparison_figures.draw_trajectories(dataclasses.replace(view, estimators=[*view.estimators, lost]))
    assert figure.axes[0].get_xlim()[1] < 20


def test_ellipses_of_landmarks_are_3_sigma_times_the_factor_in_the_title():
    cov = np.array([[4e-4, 1e-4], [1e-4, 2e-4]])
    landmark = {"landmarks": {"m": np.array([5.0, 5.0])}, "landmark_covariances": {"m": cov}}
    axes = comparison_figures.draw_trajectories(view_of(bare("ekf", {"a": ten_poses(np.zeros(10))}, **landmark))).axes[
        0
    ]
    factor = int(axes.get_title().split("×")[1])
    (ellipses,) = [c for c in axes.collections if hasattr(c, "get_widths")]
    sigmas = np.sqrt(np.linalg.svd(cov, compute_uv=False))
    assert factor > 1
    assert [ellipses.get_widths()[0], ellipses.get_heights()[0]] == pytest.approx(2 * 3 * factor * sigmas)


def row(noise, exchanges, estimator, seed, **figures) -> dict:
    return {"noise": noise, "role_exchanges": exchanges, "estimator": estimator, "seed": seed, **figures}


def panels_of_study(monkeypatch, rows, folder):
    """The figure that `draw_study` saved."""
    saved = []
    save = comparison_figures.Figure.savefig
    monkeypatch.setattr(
        comparison_figures.Figure, "savefig", lambda self, *a, **k: (saved.append(self), save(self, *a, **k))
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (path,) = draw_study(rows, folder)
    assert path.name == "ekf_against_smoothing.png"
    return saved[0].axes


def test_a_study_shows_medians_and_quartiles_per_noise(monkeypatch, tmp_path):
    rows = [
        row(noise, exchanges, estimator, seed, ate_rmse_m=0.01 * noise * exchanges * seed, nees_mean=3.0 * seed)
        for noise, exchanges, estimator, seed in product((2.0, 1.0), (1, 2, 4), ("ekf", "batch"), (1, 2, 3, 4, 10))
    ]
    low_ate, high_ate, low_nees, high_nees = panels_of_study(monkeypatch, rows, tmp_path)
    assert [low_ate.get_title(), high_ate.get_title()] == ["noise: 1.0", "noise: 2.0"]
    curves = [line for line in high_ate.lines if len(line.get_xdata()) == 3 and line.get_marker() != "None"]
    assert len(curves) == 2
    assert list(curves[0].get_xdata()) == [1, 2, 4]
    assert curves[0].get_ydata() == pytest.approx([6, 12, 24])
    edges = high_ate.collections[0].get_paths()[0].vertices
    assert {round(y, 6) for x, y in edges if x == 4} == {16, 32, *({24} & set(edges[:, 1]))}
    assert low_ate.get_ylim() == high_ate.get_ylim()
    assert "NEES" in low_nees.get_ylabel() and low_nees.lines[-1].get_ydata()[0] == 3 and high_nees.get_ylabel() == ""


def test_a_study_with_many_numbers_of_exchanges_groups_them(monkeypatch, tmp_path):
    rows = [row("typical", n, "ekf", n, ate_rmse_m=0.01) for n in range(1, 101)]
    (axes,) = panels_of_study(monkeypatch, rows, tmp_path)
    assert [len(line.get_xdata()) for line in axes.lines] == [8]
    assert axes.lines[0].get_ydata() == pytest.approx(np.ones(8))


def test_a_study_of_failures_draws_nothing(tmp_path):
    assert draw_study([], tmp_path) == []
    assert draw_study([row("typical", 3, "ekf", 1, ate_rmse_m=None), row("typical", None, "ekf", 2)], tmp_path) == []


def test_a_whole_study_is_drawn(monkeypatch, tmp_path):
    axes = panels_of_study(monkeypatch, study_rows(seeds=5), tmp_path)
    assert len(axes) == 9
    renderer = FigureCanvasAgg(axes[0].figure).get_renderer()
    (legend,) = axes[0].figure.legends
    box = legend.get_window_extent(renderer)
    assert box.x0 >= 0 and box.x1 <= axes[0].figure.bbox.width
    assert not any(box.overlaps(panel.get_tightbbox(renderer)) for panel in axes)
