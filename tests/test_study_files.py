"""The directory of a study: faults of the file system in one line, one study in it, and no trace of a sweep ended."""

import ctypes
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import sweep
from script_calls import SCRIPTS, exit_code, require_one_line, rows_of

STUDY = """
name = "small"
seeds = 2
worlds = ["symmetric_cross"]
[axes]
noise = ["typical", "legged"]
"""
ROW = {"outcome": "complete", "success": True, "seconds": 0.5, "batch.ate_rmse_m": 0.01}


@pytest.fixture
def study(tmp_path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(STUDY, encoding="utf-8")
    return path


@pytest.fixture
def made(monkeypatch) -> list[str]:
    """Keys of the runs made; they take no time."""
    keys = []

    def at_once(jobs, processes, run):
        for job in jobs:
            keys.append(job["key"])
            yield job, ROW

    monkeypatch.setattr(sweep, "run_in_pool", at_once)
    return keys


def call(*arguments) -> int:
    """Exit code of the script in this process."""
    return exit_code(sweep.main, *arguments)


@pytest.mark.parametrize("name", ["sweep.lock", "study.toml", "results.new", "study.new", "results.csv"])
def test_a_directory_where_a_file_is_due(name, tmp_path, study, made, capsys):
    (tmp_path / "out" / name).mkdir(parents=True)
    for more in ([], ["--force"]):
        assert call(study, "--out", tmp_path / "out", *more) == 2
        require_one_line(capsys.readouterr().err, name, "Is a directory")
    assert made == []


@pytest.mark.parametrize(("name", "more"), [("figures", []), ("runs", ["--keep-runs"])])
def test_a_file_where_a_directory_is_due(name, more, tmp_path, study, made, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).touch()
    assert call(study, "--out", tmp_path / "out", *more) == 2
    require_one_line(capsys.readouterr().err, name, "File exists")
    assert made == []


def test_a_figure_that_cannot_be_replaced(tmp_path, study, made, capsys):
    (tmp_path / "out" / "figures" / "study_noise.png").mkdir(parents=True)
    assert call(study, "--out", tmp_path / "out") == 2
    said = capsys.readouterr()
    require_one_line(said.err, "study_noise.png", "cannot be written")
    assert "medians over the runs" in said.out and len(rows_of(tmp_path / "out" / "results.csv")) == 4


def obey_permissions() -> None:
    """Root's next program may do what the mode of a file says, no more."""
    for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH; 24 is PR_CAPBSET_DROP
        ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="prctl")
def test_permissions(tmp_path, study):
    out = tmp_path / "out"
    header = ",".join(sweep.columns_of(sweep.load_study(study), "study")) + "\n"
    out.mkdir()
    (out / "results.csv").write_text(header, encoding="utf-8")
    command = [sys.executable, str(SCRIPTS / "sweep.py"), str(study), "--out", str(out)]
    for directory_mode, file_mode, name in ((0o555, 0o666, "sweep.lock"), (0o777, 0o444, "results.csv")):
        (out / "results.csv").chmod(file_mode)
        out.chmod(directory_mode)
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, preexec_fn=obey_permissions)
        out.chmod(0o777)
        assert done.returncode == 2
        require_one_line(done.stderr, name, "Permission denied")
        assert (out / "results.csv").read_text(encoding="utf-8") == header


def test_out_wants_a_name(study, capsys):
    for nothing in ("", " "):
        assert call(study, "--out", nothing) == 2
        require_one_line(capsys.readouterr().err, "--out", "a directory expected, got nothing")


def test_another_study_is_added_on_demand_only(tmp_path, study, made, capsys):
    out = tmp_path / "out"
    assert call(study, "--out", out) == 0
    before = (out / "results.csv").read_bytes()
    other = tmp_path / "other.toml"
    other.write_text(STUDY.replace('"small"', '"large"').replace('"legged"', '"none"'), encoding="utf-8")
    capsys.readouterr()
    assert call(other, "--out", out) == 2
    require_one_line(capsys.readouterr().err, str(out), "'small'", "'large'", "--force")
    assert (out / "results.csv").read_bytes() == before and len(made) == 4
    assert call(other, "--out", out, "--force") == 0
    assert (out / "results.csv").read_bytes().startswith(before)
    noise = sorted(row["noise"] for row in rows_of(out / "results.csv"))
    assert noise == ["legged"] * 2 + ["none"] * 2 + ["typical"] * 2
    assert call(other, "--out", out) == 0 and len(made) == 6


def test_a_study_of_the_directory_that_says_nothing(tmp_path, study, made, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "study.toml").write_text("name = ", encoding="utf-8")
    assert call(study, "--out", out) == 2
    require_one_line(capsys.readouterr().err, "study.toml", "not valid TOML")
    assert call(study, "--out", out, "--force") == 0 and len(made) == 4


def test_the_help_says_what_identifies_a_row(capsys):
    assert call("--help") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "settings, world, seed and the version of the program" in said and "use a new directory" in said


def test_sigterm_leaves_what_is_done_and_nothing_else(tmp_path, study):
    """The script in earnest, ended with two workers under way."""
    study.write_text(STUDY.replace("seeds = 2", "seeds = 500"), encoding="utf-8")
    out, scratch = tmp_path / "out", tmp_path / "tmp"
    scratch.mkdir()
    command = [sys.executable, str(SCRIPTS / "sweep.py"), str(study), "--out", str(out), "--processes", "2"]
    environment = os.environ | {"TMPDIR": str(scratch)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    sweeping = subprocess.Popen(command, env=environment, **quiet)
    try:
        end = time.monotonic() + 60
        while not ((out / "results.csv").exists() and len(rows_of(out / "results.csv")) >= 2):
            assert time.monotonic() < end and sweeping.poll() is None
            time.sleep(0.1)
        assert [path.name for path in scratch.iterdir() if path.name.startswith("coopslam-sweep-")] != []
        sweeping.send_signal(signal.SIGTERM)
        said = sweeping.communicate(timeout=30)[1]
    finally:
        sweeping.kill()
        sweeping.wait()
    assert sweeping.returncode == 130
    require_one_line(said, "interrupted")
    assert [path.name for path in scratch.iterdir() if re.match("coopslam-sweep-|run-", path.name)] == []
    assert 2 <= len(rows_of(out / "results.csv")) < 1000
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
