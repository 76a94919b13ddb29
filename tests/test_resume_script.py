"""explore_and_optimize.py --resume-map, as a black box."""

import json
import shutil

import pytest
from explore_script import call, summary_of
from script_calls import load, require_one_line

from coopslam.io.run_log import read_run_log

QUICK = ("--figures", "none")


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    """A run that ended early: 9 of 13 triangles or so."""
    path = tmp_path_factory.mktemp("resume") / "old"
    assert call("--max-moves", 16, "--seed", 3, "--out", path, *QUICK) == 3
    return path


@pytest.fixture(scope="module")
def resumed(old):
    path = old.parent / "resumed"
    assert call("--resume-map", old, "--start-corner", 5, "--seed", 4, "--out", path) == 0
    return path


def test_the_map_is_completed(old, resumed):
    before, after = summary_of(old), summary_of(resumed)
    assert before["outcome"] == "budget" and after["outcome"] == "complete"
    assert after["triangles"] == after["triangles_expected"] > before["triangles"]
    assert after["true_triangulation"] and after["corners_misnamed"] == 0
    assert after["covered_fraction"] == pytest.approx(1.0) and after["overlap_fraction"] < 1e-9
    assert after["robots"] == ["past1-robot0", "past1-robot1", "robot0", "robot1"]
    assert after["resumed"]["verdict"] == "recognized" and after["resumed"]["alternatives"] == 0
    assert "left_out" not in after


def test_what_was_known_keeps_its_ids(old, resumed):
    triangles = [
        {f["properties"]["id"]: f["properties"]["vertices"] for f in found}
        for found in map(triangles_of, (old, resumed))
    ]
    assert triangles[0].items() <= triangles[1].items()


def triangles_of(path):
    return [f for f in load(path / "map.geojson")["features"] if f["properties"]["kind"] == "triangle"]


def test_the_log_holds_both_sessions(old, resumed):
    header, records = read_run_log(resumed / "log.mcap")
    _, before = read_run_log(old / "log.mcap")
    assert list(header.robots) == summary_of(resumed)["robots"]
    assert len(records) > len(before)
    assert [record.stamp_s for record in records[: len(before)]] == [record.stamp_s for record in before]
    assert min(record.stamp_s for record in records[len(before) :]) > before[-1].stamp_s
    assert (resumed / "figures" / "recognition.png").stat().st_size > 10_000


def test_a_complete_map_is_complete_again(resumed, capsys):
    out = resumed.parent / "third"
    assert call("--resume-map", resumed, "--start-corner", 2, "--seed", 5, "--out", out, *QUICK) == 0
    assert "the map was complete" in summary_of(out)["outcome_reason"] and summary_of(out)["moves"] < 10
    assert summary_of(out)["robots"][:2] == ["past1-robot0", "past1-robot1"]
    capsys.readouterr()
    assert call("--resume-map", out, "--out", resumed.parent / "fourth", *QUICK) == 2
    require_one_line(capsys.readouterr().err, "--resume-map", "6 robots")


def test_another_world_is_said_to_be_another(old, capsys):
    out = old.parent / "other"
    assert call("--resume-map", old, "--world", "symmetric_cross", "--out", out, *QUICK) == 3
    assert "remains open: none" in capsys.readouterr().err
    summary = summary_of(out)
    assert summary["outcome"] == "stuck" and summary["resumed"]["verdict"] == "none"
    assert summary["robots"] == ["robot0", "robot1"] and summary["triangles"] == 10  # what it found so far is written


@pytest.mark.parametrize("file", ["log.mcap", "dual_graph.json"])
def test_a_damaged_run_is_named(old, file, tmp_path, capsys):
    broken = tmp_path / "broken"
    shutil.copytree(old, broken)
    content = (broken / file).read_bytes()
    (broken / file).write_bytes(content[: len(content) // 2])
    assert call("--resume-map", broken, "--out", tmp_path / "out", *QUICK) == 2
    require_one_line(capsys.readouterr().err, file)
    (broken / file).unlink()
    assert call("--resume-map", broken, "--out", tmp_path / "out", *QUICK) == 2
    require_one_line(capsys.readouterr().err, file)
    assert not (tmp_path / "out").exists()


def test_a_graph_of_another_run_is_refused(old, resumed, tmp_path, capsys):
    mixed = tmp_path / "mixed"
    shutil.copytree(old, mixed)
    (mixed / "dual_graph.json").write_text((resumed / "dual_graph.json").read_text())
    assert call("--resume-map", mixed, "--out", tmp_path / "out", *QUICK) == 2
    require_one_line(capsys.readouterr().err, "dual_graph.json", "log.mcap")


def test_the_old_run_is_never_overwritten(old, capsys):
    before = json.dumps(summary_of(old))
    assert call("--resume-map", old, "--out", old, "--force", *QUICK) == 2
    require_one_line(capsys.readouterr().err, "resumed")
    assert json.dumps(summary_of(old)) == before
