"""scripts/calibrate.py, and what replay.py and compare.py do with its files, on a simulated log as of MR.CLAM."""

import json
import os
import subprocess
import sys
from pathlib import Path

import calibrate
import compare
import explore_and_optimize
import numpy as np
import pytest
import replay
from miscalibrated_world import PLANTED, STEP_S, miscalibrated_world
from script_calls import exit_code, require_refused

from coopslam.estimation.calibration import PARAMETERS, Calibration
from coopslam.io.toml import from_mapping, load_toml
from coopslam.records import Odometry

NUMBERS = {"a": 1, "b": 2}
WRONG = {robot: PLANTED[robot] for robot in NUMBERS}


def write_mrclam(world, folder: Path) -> Path:
    """Commands, sightings and truth of a simulated world, its stamps 1 000 s later."""
    folder.mkdir()
    subjects = NUMBERS | {name: 6 + k for k, name in enumerate(world.landmarks)}
    lines = {f"Robot{n}_{kind}.dat": [] for n in NUMBERS.values() for kind in ("Odometry", "Measurement")}
    for record in world.records:
        if isinstance(record, Odometry):
            step, name = record.T_start_now, f"Robot{NUMBERS[record.robot]}_Odometry.dat"
            turn = step.theta()
            forward = np.hypot(step.x(), step.y()) / np.sinc(turn / 2 / np.pi)
            lines[name].append(f"{1000 + record.start_s:.4f} {forward / STEP_S:.6f} {turn / STEP_S:.6f}")
        else:
            name, seen = f"Robot{NUMBERS[record.observer]}_Measurement.dat", subjects[record.target]
            lines[name].append(f"{1000 + record.stamp_s:.4f} {seen} {record.range_m:.5f} {record.bearing_rad:.5f}")
    lines["Barcodes.dat"] = [f"{subject} {subject}" for subject in subjects.values()]
    lines["Landmark_Groundtruth.dat"] = [
        f"{subjects[name]} {x:.6f} {y:.6f} 0.0001 0.0001" for name, (x, y) in world.landmarks.items()
    ]
    for robot, track in world.truth.items():
        lines[f"Robot{NUMBERS[robot]}_Groundtruth.dat"] = [
            f"{1000 + stamp:.4f} {pose.x():.6f} {pose.y():.6f} {pose.theta():.6f}"
            for stamp, pose in zip(track.stamps_s.tolist(), track.poses, strict=True)
        ]
    for name, text in lines.items():
        (folder / name).write_text("\n".join(text) + "\n", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_mrclam(miscalibrated_world(2, WRONG, duration_s=150.0), tmp_path_factory.mktemp("logs") / "simulated")


def call(script, *arguments) -> int:
    """Exit code of a script in this process."""
    return exit_code(script.main, *arguments)


def load(path) -> Calibration:
    return from_mapping(Calibration, load_toml(path), str(path))


def ate(out: Path) -> float:
    (scores,) = json.loads((out / "summary.json").read_text(encoding="utf-8"))["estimators"].values()
    return scores["ate_rmse_m"]


@pytest.fixture(scope="module")
def with_truth(log, tmp_path_factory):
    path = tmp_path_factory.mktemp("calibrated") / "c.toml"
    assert call(calibrate, log, "--with-truth", "--to", 75, "--out", path) == 0
    return path


def test_the_file_holds_what_was_planted(with_truth):
    found = load(with_truth)
    assert found.range_is_depth and found.camera
    assert found.odometry is None  # 75 s of two robots are too few windows to read a noise from
    assert (found.provenance.log, found.provenance.with_truth) == ("simulated", True)
    assert (found.provenance.from_s, found.provenance.to_s) == (0.0, 75.0)
    for robot, number in NUMBERS.items():
        one, sigmas = found.robots[f"robot{number}"], found.provenance.sigmas[f"robot{number}"]
        for name, true in zip(PARAMETERS[:8], PLANTED[robot], strict=True):
            assert getattr(one, name) == pytest.approx(true, abs=5 * sigmas[name]), name
    assert with_truth.with_suffix(".png").stat().st_size > 10_000


def test_on_the_other_half_calibrated_sensors_do_better(log, with_truth, tmp_path):
    options = ("--from", 75, "--figures", "none")
    assert call(replay, log, *options, "--out", tmp_path / "plain") == 0
    assert call(replay, log, *options, "--calibration", with_truth, "--out", tmp_path / "calibrated") == 0
    assert call(replay, log, *options, "--calibrate", "--out", tmp_path / "self") == 0
    assert ate(tmp_path / "calibrated") < 0.5 * ate(tmp_path / "plain")
    assert ate(tmp_path / "self") < ate(tmp_path / "plain")
    assert not (tmp_path / "calibrated" / "calibration.toml").exists()
    own = load(tmp_path / "self" / "calibration.toml")
    assert not own.provenance.with_truth
    summary = json.loads((tmp_path / "self" / "summary.json").read_text(encoding="utf-8"))
    assert summary["calibration"] == "self" and summary["calibration_seconds"] > 0
    assert summary["duration_s"] == pytest.approx(75, abs=1)
    # the effective settings, calibration included, give the same again
    config = tmp_path / "calibrated" / "config.toml"
    assert call(replay, log, "--config", config, "--out", tmp_path / "again") == 0
    assert ate(tmp_path / "again") == ate(tmp_path / "calibrated")


def test_a_comparison_calibrates_once_for_all(log, tmp_path):
    out = tmp_path / "out"
    options = ("--estimators", "dead-reckoning,batch", "--figures", "none", "--to", 75)
    assert call(compare, log, *options, "--calibrate", "--out", out) == 0
    estimators = json.loads((out / "summary.json").read_text(encoding="utf-8"))["estimators"]
    assert list(estimators) == ["dead-reckoning", "batch"]
    assert (out / "calibration.toml").exists()


def test_without_truth(log, tmp_path, capsys):
    path = tmp_path / "c.toml"
    assert call(calibrate, log, "--out", path, "--figures", "none") == 0
    found = load(path)
    assert found.range_is_depth and not found.provenance.with_truth
    scales = np.array([[one.odometry_scale, one.range_scale] for one in found.robots.values()]).mean(axis=0)
    assert scales[0] == pytest.approx(scales[1], abs=1e-9)
    said = capsys.readouterr().out
    assert "round 4 of 4" in said and "turn_scale" in said and "calibrated by itself" in said
    assert not path.with_suffix(".png").exists()


def test_the_log_of_an_exploration(tmp_path, capsys):
    assert call(explore_and_optimize, "--figures", "none", "--out", tmp_path / "run") == 0
    capsys.readouterr()
    options = ("--out", tmp_path / "c.toml", "--figures", "none")
    assert call(calibrate, tmp_path / "run" / "log.mcap", *options) == 0
    assert "size of the world: not observable" in capsys.readouterr().out
    assert call(calibrate, tmp_path / "run", *options, "--hold", "odometry_scale, turn_scale") == 0
    assert "not observable" not in capsys.readouterr().out
    for one in load(tmp_path / "c.toml").robots.values():
        assert (one.odometry_scale, one.turn_scale) == (1.0, 1.0) and one.heading_offset_rad != 0.0


def refused(capsys, *arguments, script=calibrate) -> str:
    """The one line of a command that ends with exit code 2."""
    return require_refused(script.main, capsys, *arguments)


def test_bad_arguments_are_one_line(log, with_truth, tmp_path, capsys):
    assert "--out" in refused(capsys, log)
    out = ("--out", tmp_path / "c.toml")
    assert "--hold" in refused(capsys, log, "--with-truth", "--hold", "delay_s", *out)
    assert "hold: 'dely_s'" in refused(capsys, log, "--hold", "dely_s", *out)
    assert "does not exist" in refused(capsys, tmp_path / "nowhere", "--out", tmp_path / "c.toml")
    assert "directory that exists" in refused(capsys, log, "--out", tmp_path / "no" / "c.toml")
    (tmp_path / "notes.toml").write_text("thoughts = 1\n", encoding="utf-8")
    assert "holds something else" in refused(capsys, log, "--out", tmp_path / "notes.toml")
    assert "no records from 5000 s" in refused(capsys, log, "--from", 5000, "--out", tmp_path / "c.toml")
    out = ("--out", tmp_path / "out")
    line = refused(capsys, log, "--calibration", tmp_path / "notes.toml", *out, script=replay)
    assert "notes.toml" in line and "thoughts" in line
    both = ("--calibrate", "--calibration", with_truth)
    assert "not allowed with" in refused(capsys, log, *both, *out, script=replay)
    assert "to_s" in refused(capsys, log, "--from", 9, "--to", 5, *out, script=replay)
    assert not (tmp_path / "out").exists()


def test_ranges_are_not_taken_for_depths_twice(log, with_truth, tmp_path, capsys):
    (tmp_path / "depth.toml").write_text("[mrclam]\nrange_is_depth = true\n", encoding="utf-8")
    options = ("--config", tmp_path / "depth.toml", "--calibration", with_truth, "--out", tmp_path / "out")
    assert "expected one" in refused(capsys, log, *options, script=replay)


def test_a_closed_pipe_is_no_traceback(log, tmp_path):
    """Like `calibrate.py ... | head -c 1`."""
    script = Path(__file__).parents[1] / "scripts" / "calibrate.py"
    command = [sys.executable, str(script), str(log), "--out", str(tmp_path / "c.toml"), "--figures", "none"]
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed:
        done = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (141, "")


def test_without_a_truth_beside_the_log_it_says_so(log, tmp_path, capsys):
    (tmp_path / "log").mkdir()
    for file in log.iterdir():
        if "Groundtruth" not in file.name:
            os.link(file, tmp_path / "log" / file.name)
    line = refused(capsys, tmp_path / "log", "--with-truth", "--out", tmp_path / "c.toml")
    assert "no truth" in line and not (tmp_path / "c.toml").exists()
