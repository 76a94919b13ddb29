"""compare.py as a user calls it: one log or several, through some estimators or all."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from replay_script import G2O, MRCLAM, PYFG, call_compare, call_replay, refused_compare, results_in
from script_calls import files_of, full_disk_at, load, without_seconds

from coopslam.estimation.estimators import NAMES


@pytest.fixture
def compared(tmp_path):
    return results_in(tmp_path, call_compare)


@pytest.fixture
def silent(tmp_path) -> Path:
    """A log in which nobody sees anybody."""
    log = Path(shutil.copytree(MRCLAM, tmp_path / "silent"))
    for path in log.glob("*_Measurement.dat"):
        path.write_text("")
    return log


def test_one_log_through_all_estimators(compared, tmp_path):
    """Each as replay.py runs it alone."""
    out = compared(MRCLAM)
    summary = load(out / "summary.json")
    assert tuple(summary["estimators"]) == NAMES and summary["log"] == str(MRCLAM)
    for name in NAMES:
        alone = tmp_path / name
        assert call_replay(MRCLAM, "--estimator", name, "--figures", "none", "--out", alone) == 0
        own = load(alone / "summary.json")
        assert without_seconds(own["estimators"][name]) == without_seconds(summary["estimators"][name])
        assert own["records"] == summary["records"]
        for path in (alone / "trajectories").iterdir():
            assert (out / "trajectories" / name / path.name).read_bytes() == path.read_bytes()


def test_several_logs_and_their_spread(compared):
    """numpy says the quartiles of what each log's own summary holds."""
    logs = [MRCLAM, PYFG, G2O]
    out = compared(*logs, "--estimators", "ekf,batch")
    summary = load(out / "summary.json")
    assert [one["log"] for one in summary["logs"]] == [str(log) for log in logs]
    folders = sorted(path for path in out.iterdir() if path.is_dir())
    assert [path.name[:3] for path in folders] == ["000", "001", "002"]
    assert [load(folder / "summary.json") for folder in folders] == summary["logs"]
    assert all((folder / "trajectories" / "ekf").is_dir() and (folder / "report.html").exists() for folder in folders)
    for name in ("ekf", "batch"):
        scores = [one["estimators"][name] for one in summary["logs"]]
        for key in ("ate_rmse_m", "pose_variables", "wall_seconds"):
            numbers = [own[key] for own in scores if key in own]
            low, middle, high = np.quantile(numbers, [0.25, 0.5, 0.75])
            expected = {"median": middle, "q25": low, "q75": high, "count": len(numbers)}
            assert summary["estimators"][name][key] == pytest.approx(expected)
        assert summary["estimators"][name]["logs"] == 3
        assert summary["estimators"][name]["ate_rmse_m"]["count"] == 2  # a g2o file has no truth


def test_the_same_arguments_give_the_same_summary(compared):
    logs = (MRCLAM, PYFG)
    first, second = (load(compared(*logs, out=out) / "summary.json") for out in ("first", "second"))
    assert without_seconds(first) == without_seconds(second) and "_seconds" not in str(without_seconds(first))


def test_the_configuration_reproduces_the_run(compared):
    first = compared(PYFG, "--loss", "squares", "--period", "1", "--random-start", "3", out="first")
    second = compared(PYFG, "--config", first / "config.toml", out="second")
    assert (first / "config.toml").read_bytes() == (second / "config.toml").read_bytes()
    assert without_seconds(load(first / "summary.json")) == without_seconds(load(second / "summary.json"))


def test_the_same_log_twice_has_two_places(compared):
    out = compared(PYFG, PYFG, "--estimators", "batch")
    summary = load(out / "summary.json")
    assert without_seconds(summary["logs"][0]) == without_seconds(summary["logs"][1])
    ate = summary["estimators"]["batch"]["ate_rmse_m"]
    assert ate["q25"] == ate["median"] == ate["q75"]


def test_what_fails_is_said_and_the_others_are_kept(capsys, silent, tmp_path):
    out = tmp_path / "out"
    arguments = (silent, PYFG, "--estimators", "ekf,batch", "--figures", "none", "--out", out)
    refused_compare(capsys, *arguments, words=["ekf", "batch", "robot2"], code=3)
    summary = load(out / "summary.json")
    assert {name: scores["logs"] for name, scores in summary["estimators"].items()} == {"ekf": 1, "batch": 1}
    assert all("failed" in scores for scores in summary["logs"][0]["estimators"].values())
    assert summary["estimators"]["batch"]["ate_rmse_m"]["count"] == 1
    assert not list(out.glob("000-*/**/*.tum")) and list(out.glob("001-*/**/*.tum"))


def test_when_all_fail_there_is_a_summary(compared, silent):
    out = compared(silent, code=3)
    summary = load(out / "summary.json")
    assert set(summary["estimators"]) == set(NAMES) and (out / "report.html").exists()
    assert all("robot2" in scores["failed"] for scores in summary["estimators"].values())


def test_nothing_of_an_older_comparison_is_left(compared):
    out = compared(PYFG, MRCLAM, PYFG, "--estimators", "ekf,batch")
    (out / "notes.txt").write_text("mine")
    compared(G2O, "--estimators", "batch", "--force")
    assert sorted(path.name for path in out.rglob("*.tum")) == ["a.tum", "b.tum"]
    assert len(list(out.rglob("summary.json"))) == 1 and (out / "notes.txt").read_text() == "mine"


def test_results_are_left_alone_without_force(compared, capsys):
    out = compared(PYFG, "--estimators", "batch")
    before = files_of(out)
    refused_compare(capsys, PYFG, "--out", out, words=["--out", "--force"])
    assert files_of(out) == before


def test_figures_are_drawn_by_default(tmp_path):
    assert call_compare(PYFG, "--estimators", "ekf,batch", "--out", tmp_path / "out") == 0
    figures = list((tmp_path / "out" / "figures").glob("*.png"))
    assert figures and all(figure.read_bytes().startswith(b"\x89PNG") for figure in figures)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ["LOG"]),
        ((PYFG, "--estimators", "ekf,best"), ["--estimators", "best", "fixed-lag"]),
        ((PYFG, "--estimators", ""), ["--estimators", "expected"]),
        ((PYFG, "--estimators", ",,"), ["--estimators", "expected"]),
        ((PYFG, "nowhere.mcap"), ["nowhere.mcap"]),
        ((PYFG, MRCLAM, "--from", "5"), ["two_robots.pyfg", "5"]),
        ((PYFG, "--period", "nan"), ["period_s", "nan"]),
        ((PYFG, "--source", "nowhere.py:Reader"), ["--source", "nowhere.py"]),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(capsys, tmp_path, arguments, words):
    """Before anything is written, whichever log it is."""
    refused_compare(capsys, *arguments, *(["--out", tmp_path / "out"] if arguments else []), words=words)
    assert not (tmp_path / "out").exists()


def test_where_nothing_can_be_written(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below", "/proc/none"):
        refused_compare(capsys, PYFG, "--out", out, words=["--out"])


@pytest.mark.parametrize(("blocked", "code"), [("config.toml", 2), ("robot2.tum", 3)])
def test_a_disk_that_fails_on_the_way(capsys, tmp_path, monkeypatch, blocked, code):
    full_disk_at(monkeypatch, blocked)
    arguments = (PYFG, MRCLAM, "--estimators", "batch", "--figures", "none", "--out", tmp_path / "out")
    refused_compare(capsys, *arguments, words=["--out", "No space left on device"], code=code)


def test_a_file_where_a_log_of_several_has_its_place(capsys, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "001-two_robots_mrclam").write_text("")
    arguments = (PYFG, MRCLAM, "--estimators", "batch", "--figures", "none", "--out", tmp_path / "out")
    refused_compare(capsys, *arguments, words=["--out", "File exists"], code=3)
