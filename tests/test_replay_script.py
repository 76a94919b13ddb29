"""replay.py as a user calls it: every estimator on every kind of log, its files, its options, and what it refuses."""

import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import explore_script
import gtsam
import numpy as np
import pytest
from replay_script import G2O, MRCLAM, PYFG, call_replay, refused_replay, results_in
from script_calls import SCRIPTS, files_of, full_disk_at, load, require_one_line, without_seconds

from coopslam.estimation.estimators import NAMES
from coopslam.io.g2o import read_g2o
from coopslam.io.g2o_log import G2oSource
from coopslam.io.sources import open_log
from coopslam.io.tum import read_tum
from coopslam.records import LandmarkPrior, Odometry, PosePrior

SUMMARY = ["log", "robots", "landmarks", "duration_s", "records", "truth", "estimators", "load_seconds"]


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    """A short exploration, stopped by its budget."""
    out = tmp_path_factory.mktemp("runs") / "explored"
    options = ("--seed", 3, "--max-moves", 8, "--figures", "none", "--out", out)
    assert explore_script.call("--world", "paper_one_obstacle", *options) == 3
    return out


@pytest.fixture
def replayed(tmp_path):
    return results_in(tmp_path, call_replay)


# ---- what a replay leaves ----


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", ["run directory", "log.mcap", "mrclam", "pyfg", "g2o"])
def test_every_estimator_on_every_kind_of_log(request, replayed, name, kind):
    explored = request.getfixturevalue("explored") if kind in ("run directory", "log.mcap") else None
    log = {"run directory": explored, "mrclam": MRCLAM, "pyfg": PYFG, "g2o": G2O}.get(kind) or explored / "log.mcap"
    out = replayed(log, "--estimator", name)
    recorded, summary = open_log(log).read(), load(out / "summary.json")
    assert [key for key in SUMMARY if key not in summary] == []
    assert summary["log"] == str(log) and tuple(summary["robots"]) == recorded.header.robots
    counts = Counter(type(record).__name__ for record in recorded.records)
    assert {kind: number for kind, number in summary["records"].items() if isinstance(number, int) and number} == counts
    scores = summary["estimators"][name]
    assert ("ate_rmse_m" in scores) == (open_log(log).truth() is not None) and scores["wall_seconds"] > 0
    first_s = min(getattr(record, "start_s", record.stamp_s) for record in recorded.records)
    last_s = max(record.stamp_s for record in recorded.records)
    for robot in recorded.header.robots:
        stamps, poses = read_tum(out / "trajectories" / f"{robot}.tum")
        assert len(poses) > 1 and first_s - 1e-6 <= stamps[0] < stamps[-1] <= last_s + 1e-6
        causal = out / "trajectories" / f"{robot}.causal.tum"
        assert causal.exists() or name == "batch"
    for file in ("config.toml", "map.geojson", "pose_graph.g2o", "pose_graph.keys.json", "report.html"):
        assert (out / file).stat().st_size > 0


def test_noise_free_logs_give_their_truth_back(replayed):
    """The small pose graph was made by formula: its vertices are where the edges lead, to the digits in the file."""
    for name in ("batch", "ekf", "incremental"):
        scores = load(replayed(PYFG, "--estimator", name, out=name) / "summary.json")["estimators"][name]
        assert scores["ate_rmse_m"] < 1e-3 and scores["heading_rmse_rad"] < 1e-3


def test_figures_are_drawn_by_default(tmp_path):
    assert call_replay(PYFG, "--out", tmp_path / "out") == 0
    figures = list((tmp_path / "out" / "figures").glob("*.png"))
    assert figures and all(figure.read_bytes().startswith(b"\x89PNG") for figure in figures)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_arguments_give_the_same_results(replayed, name):
    first, second = (replayed(MRCLAM, "--estimator", name, out=out) for out in ("first", "second"))
    one, other = (without_seconds(load(out / "summary.json")) for out in (first, second))
    assert one == other and "wall_seconds" not in str(one)
    for path in first.rglob("*"):
        if path.suffix in (".tum", ".g2o", ".geojson", ".toml"):
            assert path.read_bytes() == (second / path.relative_to(first)).read_bytes()


def test_the_configuration_reproduces_the_run(replayed):
    options = ["--loss", "huber", "--period", 0.5, "--to", 7.5, "--random-start", 1]
    first = replayed(MRCLAM, "--estimator", "incremental", *options, out="first")
    second = replayed(MRCLAM, "--estimator", "incremental", "--config", first / "config.toml", out="second")
    assert (first / "config.toml").read_bytes() == (second / "config.toml").read_bytes()
    one, other = (without_seconds(load(out / "summary.json")) for out in (first, second))
    assert one == other and one["duration_s"] <= 7.5


def test_ignored_sightings_are_counted_and_not_used(replayed):
    recorded = open_log(MRCLAM).read()
    targets = Counter(
        record.target in recorded.header.robots for record in recorded.records if hasattr(record, "target")
    )
    robots = load(replayed(MRCLAM, "--ignore", "robots", out="robots", code=3) / "summary.json")
    assert robots["records"]["ignored"] == targets[True] > 0
    landmarks = replayed(MRCLAM, "--ignore", "landmarks", out="landmarks")
    assert load(landmarks / "summary.json")["records"]["ignored"] == targets[False] > 0
    assert load(landmarks / "map.geojson")["features"] == []
    assert "VERTEX_XY" not in (landmarks / "pose_graph.g2o").read_text()


def test_losses_lead_to_the_same_where_there_is_no_noise(replayed):
    tracks = []
    for loss in ("squares", "huber", "cauchy"):
        out = replayed(PYFG, "--loss", loss, out=loss)
        assert f'kind = "{loss}"' in (out / "config.toml").read_text()
        tracks.append([[pose.x(), pose.y()] for pose in read_tum(out / "trajectories" / "A.tum")[1]])
    np.testing.assert_allclose(tracks, np.broadcast_to(tracks[0], np.shape(tracks)), atol=1e-3)


def test_random_starts_differ_but_lead_to_the_same(replayed):
    first, again = (replayed(MRCLAM, "--random-start", 5, out=out) for out in ("first", "again"))
    assert without_seconds(load(first / "summary.json")) == without_seconds(load(again / "summary.json"))
    ates, origins = [], set()
    for seed in range(4):
        summary = load(replayed(MRCLAM, "--random-start", seed, out=f"seed{seed}") / "summary.json")
        ates.append(summary["estimators"]["batch"]["ate_rmse_m"])
        origins.add(summary["robots"][0])
    assert origins == {"robot1", "robot2"}
    np.testing.assert_allclose(ates, ates[0], atol=1e-3)  # a millimetre: the log's numbers are rounded to a tenth of it


@pytest.mark.parametrize("log", [MRCLAM, PYFG, G2O])
def test_the_pose_graph_reads_back_with_its_names(replayed, log):
    out, recorded = replayed(log), open_log(log).read()
    read, again = read_g2o(out / "pose_graph.g2o"), G2oSource(out / "pose_graph.g2o").read()
    seen = Counter(record.target for record in recorded.records if hasattr(record, "target"))
    twice = tuple(name for name in recorded.header.landmarks if seen[name] > 1)  # what is seen once is no landmark yet
    assert again.header.robots == recorded.header.robots and again.header.landmarks == twice
    lines = [line.split()[0] for line in (out / "pose_graph.g2o").read_text().splitlines()]
    assert sum(tag.startswith("EDGE") for tag in lines) == len(read.edges)
    assert len(again.records) == len(read.edges) and not again.dropped
    if log != MRCLAM:  # each record is an edge; in MR.CLAM, odometry between sightings is put together
        used = [
            r for r in recorded.records if getattr(r, "target", None) not in {*recorded.header.landmarks} - {*twice}
        ]
        assert len(read.edges) == sum(not isinstance(record, PosePrior | LandmarkPrior) for record in used)
    fixes = Counter((r.observer, r.target) for r in recorded.records if hasattr(r, "target"))
    fixes = Counter({pair: number for pair, number in fixes.items() if pair[1] in (*again.header.robots, *twice)})
    assert fixes == Counter((r.observer, r.target) for r in again.records if hasattr(r, "target"))
    for robot in recorded.header.robots:
        stamps = read_tum(out / "trajectories" / f"{robot}.tum")[0]
        driven = {r.stamp_s for r in again.records if isinstance(r, Odometry) and r.robot == robot}
        np.testing.assert_allclose(sorted(driven), stamps[1:], atol=1e-6)


def test_gtsam_reads_the_pose_graph(replayed):
    """Relative poses only: gtsam's reader skips the rest."""
    out = replayed(G2O)
    graph, values = gtsam.readG2o(str(out / "pose_graph.g2o"), False)
    lines = (out / "pose_graph.g2o").read_text().splitlines()
    assert graph.size() == sum(line.startswith("EDGE_SE2 ") for line in lines) == 9
    assert values.size() == sum(line.startswith("VERTEX") for line in lines) == 8


def test_a_replay_of_a_pose_graph_of_a_replay(replayed):
    first = replayed(PYFG, out="first")
    second = replayed(first / "pose_graph.g2o", out="second")
    for robot in "AB":
        poses = [read_tum(out / "trajectories" / f"{robot}.tum")[1] for out in (first, second)]
        places = [[[pose.x(), pose.y(), pose.theta()] for pose in track] for track in poses]
        np.testing.assert_allclose(*places, atol=1e-2)  # without the prior on a landmark, which g2o has no edge for


# ---- output directories ----


def test_results_are_left_alone_without_force(replayed, capsys):
    out = replayed(PYFG)
    before = files_of(out)
    refused_replay(capsys, PYFG, "--out", out, words=["--out", "--force"])
    assert files_of(out) == before


def test_force_leaves_nothing_of_an_older_replay(replayed):
    out = replayed(MRCLAM)
    (out / "notes.txt").write_text("mine")
    replayed(PYFG, "--force")
    assert {path.name for path in out.glob("trajectories/*")} == {"A.tum", "B.tum"}
    assert (out / "notes.txt").read_text() == "mine"


def test_a_failed_replay_leaves_no_older_trajectories(replayed, tmp_path):
    out, log = replayed(MRCLAM), Path(shutil.copytree(MRCLAM, tmp_path / "log"))
    for path in log.glob("*_Measurement.dat"):
        path.write_text("")
    replayed(log, "--force", code=3)
    assert not list(out.rglob("*.tum")) and "failed" in load(out / "summary.json")["estimators"]["batch"]


def test_a_log_is_never_overwritten_by_its_replay(explored, capsys, tmp_path):
    run = Path(shutil.copytree(explored, tmp_path / "run"))
    before = files_of(run)
    for log in (run, run / "log.mcap"):
        refused_replay(capsys, log, "--out", run, "--force", "--figures", "none", words=["--out", "another directory"])
    assert files_of(run) == before
    assert call_replay(PYFG, "--out", tmp_path / "out") == 0
    graph = tmp_path / "out" / "pose_graph.g2o"
    before = files_of(tmp_path / "out")
    refused_replay(capsys, graph, "--out", tmp_path / "out", "--force", words=["--out", "another directory"])
    assert files_of(tmp_path / "out") == before


def test_a_calibration_beside_the_results_is_kept_while_it_is_used(replayed, capsys):
    out = replayed(MRCLAM, "--calibrate")
    before = files_of(out)
    arguments = ("--force", "--calibration", out / "calibration.toml", "--out", out)
    refused_replay(capsys, MRCLAM, *arguments, words=["calibration.toml", "another directory"])
    assert files_of(out) == before
    replayed(MRCLAM, "--force")
    assert not (out / "calibration.toml").exists()  # it would pass for what was used


def test_without_out_each_replay_has_a_new_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert call_replay(PYFG, "--figures", "none") == 0
    assert len(list((tmp_path / "runs").glob("*/summary.json"))) == 2


def test_where_nothing_can_be_written(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below", "/proc/none", tmp_path / ("x" * 300)):
        refused_replay(capsys, PYFG, "--out", out, words=["--out"])


@pytest.mark.parametrize(("blocked", "code"), [("config.toml", 2), ("map.geojson", 3), ("pose_graph.g2o", 3)])
def test_a_disk_that_fails_on_the_way(capsys, tmp_path, monkeypatch, blocked, code):
    """Before an estimator has run that is 2, afterwards 3; what was written until then stays."""
    full_disk_at(monkeypatch, blocked)
    arguments = (PYFG, "--figures", "none", "--out", tmp_path / "out")
    refused_replay(capsys, *arguments, words=["--out", "No space left on device"], code=code)
    assert (tmp_path / "out" / "summary.json").exists() == (code == 3)


# ---- options that cannot be ----


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ["LOG"]),
        ((PYFG, "--estimator", "best"), ["--estimator", "best", "ekf"]),
        ((PYFG, "--period", "nan"), ["period_s", "nan"]),
        ((PYFG, "--period", "-1"), ["period_s", "-1"]),
        ((PYFG, "--period", "soon"), ["--period", "soon"]),
        ((PYFG, "--from", "1000"), ["two_robots.pyfg", "1000"]),
        ((PYFG, "--from", "nan"), ["from_s", "nan"]),
        ((PYFG, "--from", "3", "--to", "2"), ["to_s", "2"]),
        ((PYFG, "--random-start", "-1"), ["random_start", "-1"]),
        ((PYFG, "--random-start", "1" * 5000), ["--random-start"]),
        ((PYFG, "--random-start", "99999999999999999999"), ["random_start"]),
        ((PYFG, "--ignore", "everybody"), ["--ignore", "everybody"]),
        ((PYFG, "--config", "nowhere.toml"), ["nowhere.toml"]),
        ((PYFG, "--calibration", "nowhere.toml"), ["nowhere.toml"]),
        ((PYFG, "--calibrate", "--calibration", "c.toml"), ["--calibrat"]),
        ((PYFG, "--source", "nowhere.py:Reader"), ["--source", "nowhere.py"]),
        ((PYFG, "--source", "Reader"), ["--source", "FILE.py:CLASS"]),
        (("nowhere.mcap",), ["nowhere.mcap", "does not exist"]),
        (("",), ["expected"]),
        (("a\0b.pyfg",), ["expected"]),
        (("x" * 5000,), ["expected"]),
        ((Path(__file__),), ["test_replay_script.py", "expected"]),
        ((SCRIPTS,), ["scripts", "expected"]),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(capsys, tmp_path, arguments, words):
    refused_replay(capsys, *arguments, *(["--out", tmp_path / "out"] if arguments else []), words=words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("period_s = 1", ["period_s", "known keys"]),
        ("[estimation]\nperiod_s = 'x'", ["estimation.period_s", "number"]),
        ("ignore = 'nobody'", ["ignore", "landmarks"]),
        ("not toml", ["line 1"]),
        ("from_s = nan", ["from_s"]),
        ("[estimation.timeline]\nrandom_start = -1", ["random_start"]),
    ],
)
def test_a_wrong_config_is_named(capsys, tmp_path, text, words):
    config = tmp_path / "c.toml"
    config.write_text(text)
    refused_replay(capsys, PYFG, "--config", config, "--out", tmp_path / "out", words=[*words, "c.toml"])


# ---- as processes ----


def test_the_benchmarks_run(tmp_path):
    """With as little to do as they can be given."""
    run = {"capture_output": True, "text": True, "timeout": 100, "env": {**os.environ, "MPLBACKEND": "agg"}}
    starts = [sys.executable, SCRIPTS / "benchmarks" / "random_starts.py", MRCLAM, "--draws", "2"]
    done = subprocess.run(list(map(str, starts)), **run)
    assert done.returncode == 0 and done.stdout.count("draw ") == 2, done.stderr
    command = [sys.executable, SCRIPTS / "benchmarks" / "ekf_against_smoothing.py", "--seeds", "1", "--processes", "1"]
    command += ["--cuts", "1", "--estimators", "ekf", "batch", "--out", tmp_path]
    done = subprocess.run(list(map(str, command)), **run)
    assert done.returncode == 0, done.stderr
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 1 + 2 * 2  # a cut and the whole, two estimators


def test_a_process_ends_with_the_exit_code(tmp_path):
    command = [sys.executable, SCRIPTS / "replay.py", tmp_path / "nowhere.mcap"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    require_one_line(done.stderr, "nowhere.mcap", "does not exist")
