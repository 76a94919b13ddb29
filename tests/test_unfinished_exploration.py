"""Explorations that do not end well: exit code, the line that says why, and what they leave behind."""

import errno
import re
import subprocess
import sys

import gtsam
import networkx as nx
import pytest
from _exploration import DRIVERS
from explore_script import BARE, FILES, call
from script_calls import SCRIPTS, load, require_one_line

from coopslam.errors import UnderDetermined
from coopslam.io.run_log import read_run_log


@pytest.mark.parametrize(("option", "value"), [("--max-moves", 1), ("--max-moves", 9), ("--max-travel", 12.5)])
def test_out_of_budget_is_exit_code_3_and_everything_is_written(option, value, tmp_path, capsys):
    out = tmp_path / "run"
    assert call("--figures", "none", "--out", out, option, value) == 3
    require_one_line(capsys.readouterr().err, "budget", f"{value:g}")
    assert [name for name in FILES if not (out / name).is_file()] == []
    summary = load(out / "summary.json")
    assert summary["outcome"] == "budget" and summary["triangles"] < summary["triangles_expected"]
    gates = [f for f in load(out / "map.geojson")["features"] if f["properties"]["kind"] == "gate"]
    assert gates and f"{len(gates)} gate" in summary["outcome_reason"]
    read_run_log(out / "log.mcap")
    nx.node_link_graph(load(out / "dual_graph.json"), edges="edges")


def test_a_robot_that_is_never_placed_leaves_a_run_behind(tmp_path, capsys):
    (tmp_path / "blind.toml").write_text("[team]\ntracker_blind_m = 50.0", encoding="utf-8")
    out = tmp_path / "run"
    assert call("--config", tmp_path / "blind.toml", "--out", out) == 3
    require_one_line(capsys.readouterr().err, "stuck", "robot1 has no place yet")
    summary = load(out / "summary.json")
    assert [key for key in BARE if key not in summary] == []
    assert summary["outcome"] == "stuck" and "robot1" in summary["outcome_reason"]
    assert "robot1" in summary["left_out"]["trajectories/robot1.tum"]
    assert (out / "trajectories" / "robot0.tum").is_file() and (out / "report.html").is_file()
    assert summary["triangles"] == 0 and summary["true_triangulation"] is False
    assert not {"vertex_rmse_m", "vertex_nees_mean"} & set(summary)
    assert summary["left_out"]["scores of the vertices"] == "no triangle was found"
    values = gtsam.readG2o(str(out / "pose_graph.g2o"), False)[1]
    assert values.size() == len(load(out / "pose_graph.keys.json"))
    read_run_log(out / "log.mcap")


@pytest.mark.parametrize("updates", [0, 7])
@pytest.mark.parametrize("estimator", ["incremental", "batch"])
def test_an_estimator_that_fails_leaves_a_run_behind(estimator, updates, tmp_path, capsys, monkeypatch):
    """From a certain update on its equations have no solution, for the batch solver neither."""
    driver, left = DRIVERS[estimator], [updates]

    def fail(*arguments):
        raise UnderDetermined("no solution")

    def counted(self, records, update=driver.update):
        left[0] -= 1
        if left[0] < 0:
            monkeypatch.setattr("coopslam.estimation.incremental.Incremental._ask", fail)
            monkeypatch.setattr("coopslam.estimation.batch.solve_batch", fail)
            monkeypatch.setattr("_exploration.solve_robust", fail)
        return update(self, records)

    monkeypatch.setattr(driver, "update", counted)
    out = tmp_path / "run"
    assert call("--estimator", estimator, "--out", out) == 3
    require_one_line(capsys.readouterr().err, "stuck", "no solution")
    summary = load(out / "summary.json")
    assert [key for key in BARE if key not in summary] == []
    assert summary["left_out"]["estimators.batch"] == "no solution" and (out / "report.html").is_file()
    assert (updates == 0) == (not (out / "trajectories" / "robot0.tum").is_file())


TRACKERS = (  # believed to be fifty times as good as they are
    "[believed_noise.tracker]\nrange_sigma_m = 1e-4\nrange_sigma_per_m = 2e-4\nlateral_sigma_m = 1e-4\n"
    "bearing_sigma_rad = 7e-5\nheading_sigma_rad = 7e-4"
)
ODOMETRY = (  # a thousand times, and every sighting is believed
    "[believed_noise.odometry]\ntranslation_sigma_m = 3e-5\ndrift_sigma_rad = 3e-5\nrotation_sigma_rad = 5e-5\n"
    "[gate]\ndistance_sq_max = 1e9\n[robust]\ndistance_sq_max = 1e9"
)


@pytest.mark.parametrize(
    ("belief", "doubt"),
    [
        (TRACKERS, r"\d+ of \d+ sightings of robots by robots look false"),
        (ODOMETRY, r"does not explain the records \(chi-square per degree of freedom:"),
    ],
)
def test_an_estimate_that_contradicts_the_records_is_not_complete(belief, doubt, tmp_path, capsys):
    (tmp_path / "sure.toml").write_text(belief, encoding="utf-8")
    out = tmp_path / "run"
    arguments = ("--config", tmp_path / "sure.toml", "--max-moves", 9, "--figures", "none", "--out", out)
    assert call(*arguments) == 3
    require_one_line(capsys.readouterr().err, "stuck")
    summary = load(out / "summary.json")
    assert summary["outcome"] == "stuck" and summary["noise"] == "custom"
    assert re.search(doubt, summary["outcome_reason"])


@pytest.mark.parametrize("table", ["true_noise", "believed_noise"])
def test_the_largest_sigmas_end_in_one_line(table, tmp_path, capsys):
    odometry = "translation_sigma_m = 1e3\ndrift_sigma_rad = 1e3\nrotation_sigma_rad = 1e3"
    (tmp_path / "c.toml").write_text(f"[{table}.odometry]\n{odometry}", encoding="utf-8")
    code = call("--config", tmp_path / "c.toml", "--max-moves", 20, "--figures", "none", "--out", tmp_path / "run")
    assert code == 3
    require_one_line(capsys.readouterr().err, "exploration")
    assert [key for key in BARE if key not in load(tmp_path / "run" / "summary.json")] == []


SMALL_DISK = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
sys.path.insert(0, {scripts!r})
from _cli import run
from explore_and_optimize import main
sys.exit(run(main, ["--figures", "none", "--out", {out!r}]))
"""


def test_a_full_disk_ends_the_run_in_one_line_and_keeps_what_was_recorded(tmp_path):
    """The operating system takes 20 kB of a file and no more."""
    pytest.importorskip("resource")
    out = tmp_path / "run"
    code = SMALL_DISK.format(scripts=str(SCRIPTS), out=str(out))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    require_one_line(done.stderr, f"--out {out}: cannot be written: ")
    header, records = read_run_log(out / "log.mcap", allow_truncated=True)
    assert header.robots == ("robot0", "robot1") and len(records) > 50


@pytest.mark.parametrize("function", ["write_run", "html.write_report"])
def test_results_that_cannot_be_written_are_exit_code_3(function, tmp_path, capsys, monkeypatch):
    def fail(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(f"_exploration.{function}", fail)
    out = tmp_path / "run"
    assert call("--max-moves", 3, "--figures", "none", "--out", out) == 3
    require_one_line(capsys.readouterr().err, f"--out {out}: cannot be written: No space left on device")
    read_run_log(out / "log.mcap")


def test_without_gate_and_limit_every_sighting_counts(tmp_path, capsys):
    (tmp_path / "c.toml").write_text("[gate]\ndistance_sq_max = inf\n[robust]\ndistance_sq_max = inf", encoding="utf-8")
    arguments = ("--max-moves", 9, "--outliers", 0.2, "--figures", "none", "--out")
    assert call("--config", tmp_path / "c.toml", *arguments, tmp_path / "run") == 3
    require_one_line(capsys.readouterr().err, "exploration")
    sightings = load(tmp_path / "run" / "summary.json")["sightings"]
    assert sightings["fixes"] > 9
    assert sightings == {"fixes": sightings["fixes"], "refused": 0, "thrown_out": 0, "taken_back": 0}
    text = (tmp_path / "run" / "config.toml").read_text(encoding="utf-8")
    assert text.count("distance_sq_max = inf") == 2
    assert call("--config", tmp_path / "run" / "config.toml", *arguments, tmp_path / "again") == 3
    assert (tmp_path / "again" / "config.toml").read_text(encoding="utf-8") == text


def test_without_a_limit_what_the_gate_refused_stays_out(tmp_path):
    (tmp_path / "c.toml").write_text("[robust]\ndistance_sq_max = inf", encoding="utf-8")
    arguments = ("--max-moves", 9, "--outliers", 0.2, "--figures", "none", "--out", tmp_path / "run")
    assert call("--config", tmp_path / "c.toml", *arguments) == 3
    sightings = load(tmp_path / "run" / "summary.json")["sightings"]
    assert sightings["refused"] > 0 == sightings["thrown_out"] == sightings["taken_back"]
