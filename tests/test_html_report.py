import base64
from html.parser import HTMLParser

import networkx as nx
import numpy as np
import pytest

from coopslam.report.html import write_report
from coopslam.report.number_text import DASH, digits, length, percent
from coopslam.report.run_view import RunView

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mP8z8BQDwAEhQGAhKmMIQAAAABJRU5ErkJggg=="
)
VOID = {"meta", "img", "br", "link", "hr", "input"}
SUMMARY = {
    "world": "two rooms",
    "seed": 7,
    "noise": "typical",
    "estimator": "incremental",
    "outcome": "complete",
    "outcome_reason": "no gate is open",
    "vertices": 3,
    "holes": 0,
    "triangles": 1,
    "triangles_expected": 1,
    "role_exchanges": 1234,
    "travel_m": {"robot0": 12.34, "robot1": 5.6},
    "travel_over_perimeter": 1.5,
    "covered_fraction": 1.0,
    "overlap_fraction": 2e-16,
    "vertex_rmse_m": 0.0123,
    "vertex_nees_mean": 1.9,
    "estimators": {
        "dead-reckoning": {"ate_rmse_m": 0.5, "heading_rmse_rad": 0.1, "wall_seconds": 0.01},
        "incremental": {"ate_rmse_m": 0.0125, "heading_rmse_rad": np.pi / 180, "crlb_ratio": None, "nees_mean": 3.1},
    },
    "total_seconds": 2.5,
}


class Page(HTMLParser):
    """What a browser would see: balanced tags, texts, attributes."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.tags, self.texts = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open and data.strip():
            self.texts.append(data.strip())

    def all(self, tag: str) -> list[dict]:
        return [attrs for name, attrs in self.tags if name == tag]


def small_view(name="two rooms", truth=True, **changes) -> RunView:
    vertices = {0: np.zeros(2), 1: np.array([1.0, 0.0]), 2: np.array([0.0, 1.0])}
    return RunView(
        name,
        SUMMARY | changes,
        vertices,
        {v: np.diag([4e-4, 1e-4]) for v in vertices},
        {0: (0, 1, 2)},
        [(0, 1), (1, 2), (2, 0)],
        [],
        nx.Graph(),
        {},
        [],
        true_vertices={v: point + [0.01, 0.0] for v, point in vertices.items()} if truth else {},
    )


@pytest.fixture
def figures(tmp_path):
    paths = [tmp_path / f"{name}.png" for name in ("map", "dual_graph", "something_new")]
    for k, path in enumerate(paths):
        path.write_bytes(PIXEL + bytes([k]))
    return paths


def report(tmp_path, view, figures=()) -> Page:
    write_report(tmp_path / "report.html", view, list(figures))
    return Page((tmp_path / "report.html").read_text(encoding="utf-8"))


def test_every_figure_is_inside_the_file(tmp_path, figures):
    images = report(tmp_path, small_view(), figures).all("img")
    prefix = "data:image/png;base64,"
    assert [base64.b64decode(image["src"].removeprefix(prefix)) for image in images] == [
        path.read_bytes() for path in figures
    ]
    assert all(image["alt"] for image in images)


def test_a_film_is_inside_the_file_and_can_be_played(tmp_path):
    film = tmp_path / "exploration.mp4"
    film.write_bytes(b"not really a film")
    page = report(tmp_path, small_view(), [film])
    (video,) = page.all("video")
    assert base64.b64decode(video["src"].removeprefix("data:video/mp4;base64,")) == film.read_bytes()
    assert "controls" in video and video["aria-label"] == "The exploration as a film"
    assert page.all("img") == []


def test_nothing_is_fetched_from_elsewhere(tmp_path, figures):
    page = report(tmp_path, small_view(), figures)
    links = [attrs[key] for _, attrs in page.tags for key in ("src", "href", "action", "data") if key in attrs]
    assert len(links) == 3 and all(link.startswith("data:") for link in links)
    assert page.all("script") == [] and page.all("link") == []
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "url(" not in text and "@import" not in text


def test_key_figures_are_shown_with_units(tmp_path):
    texts = report(tmp_path, small_view()).texts
    for expected in (
        "two rooms",
        "complete",
        "no gate is open",
        "1,234",
        "12.3 m",
        "1.23 cm",
        "100 %",
        "0 %",
        "2.50 s",
    ):
        assert expected in texts


def test_table_of_estimators(tmp_path):
    texts = report(tmp_path, small_view()).texts
    row = texts[texts.index("incremental (drove)") :][:7]
    assert row == ["incremental (drove)", "1.25", "1.00", DASH, "3.10", DASH, DASH]


def test_vertices_are_folded_and_complete(tmp_path):
    page = report(tmp_path, small_view())
    assert len(page.all("details")) == 1 and "open" not in page.all("details")[0]
    start = page.texts.index("All 3 map vertices")
    assert page.texts[start + 9 : start + 17] == ["0", "0.000", "0.000", "2.00", "1.00", "0", "1.00", "0.250"]


def test_hostile_text_is_shown_and_not_run(tmp_path, figures):
    evil = "<script>alert('&\"')</script>"
    view = small_view(
        evil, outcome=evil, outcome_reason=evil, noise=evil, travel_m={evil: 1.0}, estimators={evil: {}}, seed=evil
    )
    hostile = tmp_path / '"><img onerror=x>.png'
    hostile.write_bytes(PIXEL)
    page = report(tmp_path, view, [*figures, hostile])
    assert page.all("script") == []
    assert evil in page.texts
    assert len(page.all("img")) == 4 and not any("onerror" in attrs for _, attrs in page.tags)


def test_without_truth_what_is_missing_is_a_dash(tmp_path):
    view = small_view(truth=False, estimators={"batch": {"wall_seconds": 0.1}})
    for key in ("triangles_expected", "covered_fraction", "overlap_fraction", "vertex_rmse_m", "vertex_nees_mean"):
        del view.summary[key]
    page = report(tmp_path, view)
    assert page.texts.count("not known") == 4
    assert "error (cm)" not in page.texts
    start = page.texts.index("batch")
    assert page.texts[start : start + 7] == ["batch", DASH, DASH, DASH, DASH, DASH, "0.100"]


def test_an_empty_run_makes_a_report(tmp_path):
    page = report(tmp_path, RunView("nothing", {}, {}, {}, {}, [], [], nx.Graph(), {}, []))
    assert page.texts.count("nothing") == 1 and page.all("img") == []


@pytest.mark.parametrize("outcome", ["stuck", "budget"])
def test_an_unfinished_run_says_so_first(tmp_path, outcome):
    page = report(tmp_path, small_view(outcome=outcome, outcome_reason="gate (3, 4) is open"))
    assert {"class": f"notice {'bad' if outcome == 'stuck' else 'fair'}", "role": "alert"} in page.all("div")
    assert page.texts.index("gate (3, 4) is open") < page.texts.index("Key figures")


def test_a_complete_run_raises_no_alarm(tmp_path):
    page = report(tmp_path, small_view())
    assert {"class": "badge good"} in page.all("span")
    assert not any(attrs.get("role") == "alert" for attrs in page.all("div"))


def test_numbers_have_sensible_digits():
    values = [0, 0.0123456, 1.5, 123.456, 1234567.0, 1.4e-6, None, float("nan"), True, "x"]
    assert [digits(value) for value in values] == [
        "0", "0.0123", "1.50", "123", "1,234,567", "1.40e-6", DASH, DASH, DASH, DASH,
    ]  # fmt: skip
    assert [length(value) for value in (12.3, 0.5, 0.0004, 0.0, None)] == [
        "12.3 m",
        "50.0 cm",
        "0.400 mm",
        "0 mm",
        DASH,
    ]


def test_a_gap_in_coverage_is_never_rounded_away():
    assert [percent(value) for value in (1.0, 1 - 1e-12, 1 - 1e-7, 0.99999, 0.5, 2e-7, 1e-16, None)] == [
        "100 %", "100 %", "> 99.9999 %", "99.999 %", "50 %", "2.00e-5 %", "0 %", DASH,
    ]  # fmt: skip
