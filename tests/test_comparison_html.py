"""The report of a replayed log: complete, alone, right where it can be read off, and safe with any text."""

import base64
import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import lfilter
from test_html_report import PIXEL, Page

from coopslam.report.comparison_html import CAPTIONS, write_comparison_report
from coopslam.report.comparison_view import ComparisonView, EstimatorView, RobotErrors
from coopslam.report.number_text import DASH

ROBOTS = [f"robot{k}" for k in range(1, 6)]
DRAWN = ["trajectories.png", "errors.png", "bars.png", "consistency.png", "latency.png", "error_by_exchange.png"]
KINDS = {
    "odometry": {"count": 15_000, "mean_per_dof": 0.71},
    "bearing_range_landmark": {"count": 5_114, "mean_per_dof": 1.34},
    "bearing_range_robot": {"count": 1_920, "mean_per_dof": 0.98},
    "pose_prior": {"count": 1, "mean_per_dof": 0.0},
}
EMPTY = np.zeros(0)


def wandering(rng: np.random.Generator, points: int, size=(15.0, 8.0)) -> np.ndarray:
    """(N, 2) a smooth path that stays in a room."""
    headings = rng.uniform(-np.pi, np.pi) + 0.15 * rng.standard_normal(points).cumsum()
    free = rng.uniform(0, size) + 0.06 * np.stack([np.cos(headings), np.sin(headings)], axis=1).cumsum(axis=0)
    return np.abs((free + size) % (2 * np.array(size)) - size)  # reflected at the walls


def coloured(rng: np.random.Generator, points: int, keeps: float = 0.995) -> np.ndarray:
    """(N,) unit variance, correlated over time: how errors of an estimate look."""
    return lfilter([np.sqrt(1 - keeps**2)], [1, -keeps], rng.standard_normal(points))


def errors_of(rng, truth: np.ndarray, sigma_m: float, overconfident: float, claims=True) -> RobotErrors:
    """A robot whose errors are `overconfident` times what its covariance says."""
    n = len(truth)
    stamps_s = np.linspace(0.0, 1200.0, n)
    sigmas = sigma_m * (0.7 + 0.3 * np.sin(stamps_s / 90 + rng.uniform(0, 6)) ** 2)
    offsets = np.stack([coloured(rng, n) for _ in range(3)], axis=1) * overconfident
    if not claims:
        offsets = rng.standard_normal((n, 3)).cumsum(axis=0) / np.sqrt(n)  # odometry alone walks away
    off_m = offsets[:, :2] * sigmas[:, None]
    nees = (offsets**2).sum(axis=1)
    nees[:1] = np.nan  # the anchored pose
    known = [sigmas, 0.3 * sigmas, nees] if claims else [EMPTY] * 3
    return RobotErrors(stamps_s, truth + off_m, stamps_s, np.hypot(*off_m.T), 0.3 * sigmas * offsets[:, 2], *known)


def estimator_of(rng, name: str, paths, landmarks, sigma_m: float, overconfident=1.0, causal=True) -> EstimatorView:
    robots = {r: errors_of(rng, p, sigma_m, overconfident, name != "dead-reckoning") for r, p in paths.items()}
    rms_m, heading_rad = (
        {name: float(np.sqrt(np.mean(getattr(r, which) ** 2))) for name, r in robots.items()}
        for which in ("position_errors_m", "heading_errors_rad")
    )
    ate_m, rmse_rad = (float(np.sqrt(np.mean(np.square(list(own.values()))))) for own in (rms_m, heading_rad))
    updates = 4800 if causal else 0
    poses = np.linspace(5, 15_000, updates)
    latencies_s = 1e-4 * (1 + poses / 3000) * rng.lognormal(0, 0.5, updates) * (1 + 20 * (rng.random(updates) < 0.01))
    cov = {m: (0.3 * sigma_m) ** 2 * np.array([[2.0, 0.6], [0.6, 1.0]]) for m in landmarks}
    scores = {
        "ate_rmse_m": ate_m,
        "heading_rmse_rad": rmse_rad,
        "rpe": {f"{d} m": {"translation_rmse_m": 0.01 * d, "rotation_rmse_rad": 0.005 * d} for d in (1, 5, 10)},
        "robots": {r: {"ate_rmse_m": rms_m[r], "heading_rmse_rad": heading_rad[r]} for r in robots},
        "wall_seconds": 3.2 * (1 + sigma_m),
        "dropped": {"sightings of unknown barcodes": 12},
    }
    if causal:
        scores |= {"causal_ate_rmse_m": 1.5 * ate_m, "causal_heading_rmse_rad": 1.3 * rmse_rad}
        scores |= {"latency_p50_seconds": 4e-4, "latency_p99_seconds": 3e-3}
    if name != "dead-reckoning":
        nees = np.concatenate([r.nees[1:] for r in robots.values()])
        scores |= {"nis": KINDS} | ({"nees_mean": float(nees.mean())} if len(nees) else {})
    return EstimatorView(
        name,
        scores,
        robots,
        robots if causal else {},
        {m: rng.multivariate_normal(xy, cov[m]) for m, xy in landmarks.items()} if name != "dead-reckoning" else {},
        cov if name != "dead-reckoning" else {},
        latencies_s,
        poses,
        sigma_m * np.sqrt(np.arange(1.0, 40.0)) * rng.lognormal(0, 0.2, 39),
    )


def sample_view(points=3000, robots=5, landmarks=15) -> ComparisonView:
    """Four estimators on a log like MR.CLAM's."""
    rng = np.random.default_rng(3)
    paths = {robot: wandering(rng, points) for robot in ROBOTS[:robots]}
    points_xy = {f"landmark{k}": rng.uniform((0, 0), (15, 8)) for k in range(landmarks)}
    estimators = [
        estimator_of(rng, "dead-reckoning", paths, points_xy, 2.4),
        estimator_of(rng, "ekf", paths, points_xy, 0.06, overconfident=2.2),
        estimator_of(rng, "incremental", paths, points_xy, 0.05),
        estimator_of(rng, "batch", paths, points_xy, 0.04, causal=False),
    ]
    counts = {"Odometry": 60_000, "BearingRangeFix": 7034, "ignored": 0, "dropped": {"no such barcode": 31}}
    summary = {"log": "/data/log6", "robots": list(paths), "landmarks": list(points_xy), "duration_s": 1200.0}
    summary |= {"records": counts, "truth": list(paths), "estimators": {e.name: e.scores for e in estimators}}
    return ComparisonView("MRCLAM_Dataset6", summary, estimators, paths, points_xy)


def without_truth(view: ComparisonView) -> ComparisonView:
    """The same log when nobody measured where the robots really were."""

    def blind(robot: RobotErrors) -> RobotErrors:
        return RobotErrors(robot.stamps_s, robot.path, *[EMPTY] * 6)

    judged = ("ate", "heading", "causal", "nees", "rpe", "robots")
    estimators = [
        dataclasses.replace(
            e,
            scores={k: v for k, v in e.scores.items() if not k.startswith(judged)},
            robots={name: blind(robot) for name, robot in e.robots.items()},
            causal={name: blind(robot) for name, robot in e.causal.items()},
            exchange_errors_m=EMPTY,
        )
        for e in view.estimators
    ]
    summary = {**view.summary, "truth": []}
    return ComparisonView(view.log, summary, estimators, {}, {})


def failed(name="weighted") -> EstimatorView:
    return EstimatorView(name, {}, {}, {}, {}, {}, EMPTY, EMPTY, note="nothing ties robot3 down")


def view_of(*estimators: EstimatorView) -> ComparisonView:
    return ComparisonView("log", {}, list(estimators), {}, {})


def bare(name: str, robots=None, **others) -> EstimatorView:
    parts = {"scores": {}, "causal": {}, "landmarks": {}, "landmark_covariances": {}}
    parts |= {"latencies_s": EMPTY, "latency_poses": EMPTY} | others
    return EstimatorView(name, robots=robots or {}, **parts)


SCORES = {
    "ate_rmse_m": 0.0321,
    "heading_rmse_rad": np.pi / 180,
    "causal_ate_rmse_m": 0.05,
    "rpe": {"1 m": {"translation_rmse_m": 0.012, "rotation_rmse_rad": 0.02}},
    "robot_to_robot": {"translation_rmse_m": 0.04, "rotation_rmse_rad": np.pi / 90, "pairs": {}},
    "nees_mean": 3.14,
    "nis": {"odometry": {"count": 3, "mean_per_dof": 1.0}, "range_robot": {"count": 1, "mean_per_dof": 3.0}},
    "wall_seconds": 2.5,
    "robots": {"robot1": {"ate_rmse_m": 0.02, "heading_rmse_rad": np.pi / 360}},
    "dropped": {"too late": 4},
}
SUMMARY = {
    "robots": ["robot1", "robot2"],
    "landmarks": ["m1"],
    "duration_s": 12.5,
    "records": {"Odometry": 1200, "RangeFix": 34, "ignored": 5, "dropped": {"no such barcode": 2}},
    "truth": ["robot1"],
}


def report(tmp_path, view: ComparisonView, drawn=()) -> Page:
    write_comparison_report(tmp_path / "report.html", view, list(drawn))
    return Page((tmp_path / "report.html").read_text(encoding="utf-8"))


def small_view(**scores) -> ComparisonView:
    estimators = (bare("ekf", scores=SCORES | scores), bare("dead-reckoning", scores={"ate_rmse_m": 2.0}))
    return dataclasses.replace(view_of(*estimators), log="log 6", summary=SUMMARY)


@pytest.fixture
def figures(tmp_path):
    paths = [tmp_path / name for name in (*DRAWN, "something_new.png")]
    for k, path in enumerate(paths):
        path.write_bytes(PIXEL + bytes([k]))
    return paths


def row_of(page: Page, title: str, name: str, length: int) -> list[str]:
    """The texts of a table's row, found by the heading of the table and the name of the row."""
    start = page.texts.index(name, page.texts.index(title))
    return page.texts[start : start + length]


def test_every_figure_is_inside_the_file_and_nothing_is_fetched(tmp_path, figures):
    page = report(tmp_path, small_view(), figures)
    prefix = "data:image/png;base64,"
    inside = [base64.b64decode(image["src"].removeprefix(prefix)) for image in page.all("img")]
    assert inside == [path.read_bytes() for path in figures]
    links = [attrs[key] for _, attrs in page.tags for key in ("src", "href", "action", "data") if key in attrs]
    assert len(links) == len(figures) and page.all("script") == [] and page.all("link") == []


def test_every_figure_has_a_caption_of_one_sentence():
    assert {name.removesuffix(".png") for name in DRAWN} | {"ekf_against_smoothing"} == set(CAPTIONS)
    for title, caption in CAPTIONS.values():
        assert not title.endswith((".", "?"))
        assert caption.endswith(".") and ". " not in caption


def test_the_table_of_estimators_has_units_and_no_empty_column(tmp_path):
    page = report(tmp_path, small_view())
    headings = ["ATE (cm)", "heading rmse (°)", "causal ATE (cm)", "RPE over 1 m (cm)", "NEES (3 expected)"]
    headings += ["NIS per dof", "time (s)"]
    start = page.texts.index("Estimators")
    assert page.texts[start + 1 : start + 8] == headings
    assert row_of(page, "Estimators", "ekf", 8) == ["ekf", "3.21", "1.00", "5.00", "1.20", "3.14", "1.50", "2.50"]
    assert row_of(page, "Estimators", "dead-reckoning", 8) == ["dead-reckoning", "200", *[DASH] * 6]


def test_relative_errors_robots_and_nis_have_tables(tmp_path):
    page = report(tmp_path, small_view())
    assert row_of(page, "Relative errors", "ekf", 5) == ["ekf", "1.20", "1.15", "4.00", "2.00"]
    assert row_of(page, "Robots", "robot1", 3) == ["robot1", "2.00", "0.500"]
    assert row_of(page, "NIS per degree of freedom (count)", "range robot", 2) == ["range robot", "3.00 (1)"]


def test_what_the_log_holds_and_what_was_dropped(tmp_path):
    page = report(tmp_path, small_view())
    assert row_of(page, "Records", "Odometry", 4) == ["Odometry", "1,200", "RangeFix", "34"]
    assert row_of(page, "Records", "ignored, as asked", 2)[1] == "5"
    start = page.texts.index("Records that were dropped")
    expected = ["reason", "reader", "ekf", "no such barcode", "2", DASH, "too late", DASH, "4"]
    assert page.texts[start + 1 : start + 10] == expected


def test_key_figures(tmp_path):
    texts = report(tmp_path, small_view()).texts
    for pair in (("robots", "2"), ("landmarks", "1"), ("duration", "12.5 s"), ("records", "1,234")):
        assert pair in list(pairwise(texts))
    assert "Truth is known of robot1." in " ".join(texts)


def test_an_estimator_that_failed_says_so_first(tmp_path):
    view = small_view()
    page = report(tmp_path, dataclasses.replace(view, estimators=[*view.estimators, failed()]))
    assert page.texts.index("nothing ties robot3 down") < page.texts.index("Key figures")
    assert {"class": "notice bad", "role": "alert"} in page.all("div")
    assert row_of(page, "Estimators", "weighted", 8) == ["weighted", *[DASH] * 7]
    assert not any(attrs.get("role") == "alert" for attrs in report(tmp_path, view).all("div"))


def test_hostile_text_is_shown_and_not_run(tmp_path, figures):
    evil = "<script>alert('&\"')</script>"
    scores = SCORES | {"robots": {evil: {}}, "nis": {evil: SCORES["nis"]["odometry"]}, "dropped": {evil: 1}}
    scores |= {"rpe": {evil: SCORES["rpe"]["1 m"]}}
    estimators = [bare(evil, scores=scores), dataclasses.replace(failed(evil), note=evil)]
    records = {evil: 1, "dropped": {evil: 2}}
    summary = SUMMARY | {"records": records, "truth": [evil]}
    page = report(tmp_path, ComparisonView(evil, summary, estimators, {evil: np.zeros((1, 2))}, {}), figures)
    assert page.all("script") == [] and evil in page.texts


def test_without_truth_the_report_says_so(tmp_path):
    page = report(tmp_path, without_truth(sample_view(points=10)))
    assert any("There is no truth" in text for text in page.texts)
    assert "ATE (cm)" not in page.texts and "Robots" not in page.texts


def test_an_empty_comparison_makes_a_report(tmp_path):
    page = report(tmp_path, ComparisonView("nothing", {}, [], {}, {}))
    assert page.texts.count("nothing") == 1 and page.texts.count("not known") >= 3
    assert page.all("img") == [] and page.all("table") == []


def test_a_whole_log_makes_a_report(tmp_path):
    view = sample_view(points=10)
    assert len(view.estimators[-1].latencies_s) == len(EMPTY)
    page = report(tmp_path, view)
    assert len(page.all("table")) == 6
