"""scripts/sweep.py: a study from its file to table and figures, and what may happen to it on the way."""

import json
import os
import re
import signal
import sys
import tomllib
from pathlib import Path

import pytest
import sweep
from _exploration import prepare
from _study import load_study
from _study_files import only_sweep
from _study_run import job_of, run_job
from script_calls import SCRIPTS, exit_code, require_one_line, rows_of

STUDY = """
name = "small"
description = "ends early, so that it is quick"
seeds = 2
worlds = ["symmetric_cross"]
[base]
budget.moves = 4
[axes]
noise = ["typical", "legged"]
"""


def call(*arguments) -> int:
    """Exit code of the script in this process."""
    return exit_code(sweep.main, *arguments)


def at_once(jobs, processes, run):
    """Instead of the pool: the same in this process."""
    for job in jobs:
        yield job, run(job)


@pytest.fixture
def study(tmp_path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(STUDY, encoding="utf-8")
    return path


@pytest.fixture
def here(monkeypatch):
    """Runs are made in this process, where imports are paid already; the keys of those made."""
    made = []

    def noted(job):
        made.append(job["key"])
        return run_job(job)

    monkeypatch.setattr(sweep, "run_in_pool", at_once)
    monkeypatch.setattr(sweep, "run_job", noted)
    monkeypatch.setattr(sweep, "draw_study", lambda results, directory: [])
    return made


def timeless(rows: list[dict]) -> list[dict]:
    return sorted(({k: v for k, v in row.items() if k != "seconds"} for row in rows), key=lambda row: row["key"])


def test_a_study_in_one_and_two_processes(tmp_path, study, capsys):
    """The pool in earnest, with a complete exploration among them."""
    study.write_text(STUDY.replace("budget.moves = 4", ""), encoding="utf-8")
    for processes in (1, 2):
        assert call(study, "--out", tmp_path / str(processes), "--processes", processes) == 0
    first, second = (rows_of(tmp_path / name / "results.csv") for name in "12")
    assert timeless(first) == timeless(second)
    varied = sorted((row["noise"], row["seed"]) for row in first)
    assert varied == [(noise, seed) for noise in ("legged", "typical") for seed in "01"]
    assert all(row["outcome"] == "complete" and row["success"] == "true" for row in first)
    assert all(float(row["world_vertices"]) == 12 and float(row["world_holes"]) == 0 for row in first)
    ate = {row["noise"]: float(row["dead-reckoning.ate_rmse_m"]) for row in first}
    assert ate["legged"] > ate["typical"] > max(float(row["batch.ate_rmse_m"]) for row in first)
    said = capsys.readouterr().out
    assert "4 of 4 runs, 4 succeeded" in said and "symmetric_cross  legged" in said and "per second" in said
    assert (tmp_path / "2" / "figures" / "study_noise.png").read_bytes().startswith(b"\x89PNG")


def test_it_continues_after_an_interruption(tmp_path, study, here, capsys):
    out = tmp_path / "out"
    assert call(study, "--out", out) == 0
    whole = (out / "results.csv").read_bytes()
    before, lines = rows_of(out / "results.csv"), whole.splitlines(keepends=True)
    assert len(here) == len(before) == 4
    for left in (whole[:-9], b"".join(lines[:2]) + lines[3][:40], lines[0][:20], b""):
        (out / "results.csv").write_bytes(left)
        here.clear()
        kept = sum(line in left for line in lines[1:])
        assert call(study, "--out", out) == 0
        assert len(here) == 4 - kept
        assert timeless(rows_of(out / "results.csv")) == timeless(before)
    here.clear()
    assert call(out / "study.toml", "--out", out) == 0 and here == []
    assert "torn" in capsys.readouterr().out


def test_a_changed_study_extends_the_table(tmp_path, study, here):
    out = tmp_path / "out"
    assert call(study, "--out", out) == 0
    changed = '[axes]\nnoise = ["typical"]\n"team.speed_m_per_s" = [0.5, 1.0]\n'
    study.write_text(STUDY.split("[axes]")[0] + changed, encoding="utf-8")
    here.clear()
    assert call(study, "--out", out) == 0
    rows = rows_of(out / "results.csv")
    assert len(here) == 2 and len(rows) == 6  # the default speed is 0.5 m/s; legged rows stay
    speeds = sorted((row["noise"], row["team.speed_m_per_s"]) for row in rows)
    assert speeds == [("legged", "")] * 2 + [("typical", "0.5")] * 2 + [("typical", "1.0")] * 2


def test_a_crash_is_a_row_and_not_the_end(tmp_path, study, monkeypatch, here, capsys):
    """An exploration that fails in a way nobody thought of."""

    def explode_at_seed_1(settings):
        if settings.seed == 1:
            raise ZeroDivisionError("an unthinkable case\nin two lines")
        return prepare(settings)

    monkeypatch.setattr("_study_run.prepare", explode_at_seed_1)
    out = tmp_path / "out"
    assert call(study, "--out", out) == 3
    require_one_line(capsys.readouterr().err, "2 of 4 runs crashed", "in two lines")
    rows = rows_of(out / "results.csv")
    assert [(row["seed"], row["outcome"]) for row in rows] == [("0", "budget")] * 2 + [("1", "crash")] * 2
    assert all(row["world_vertices"] == "12" and row["success"] == "false" for row in rows)
    monkeypatch.setattr("_study_run.prepare", prepare)
    assert call(study, "--out", out) == 3
    assert call(study, "--out", out, "--retry-crashed") == 0
    assert [row["outcome"] for row in rows_of(out / "results.csv")] == ["budget"] * 4 and len(here) == 6


def die_once(job: dict) -> dict:
    """Kills its process the first time that it is called for seed 1."""
    if job["settings"]["seed"] == 1:
        died = Path(os.environ["SWEEP_TEST_DIED"])
        if not died.exists():
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return run_job(job)


def test_a_killed_worker_loses_nothing(tmp_path, study, monkeypatch):
    monkeypatch.setattr(sweep, "run_job", die_once)
    monkeypatch.setenv("SWEEP_TEST_DIED", str(tmp_path / "died"))
    out = tmp_path / "out"
    assert call(study, "--out", out, "--processes", 1) == 0
    assert (tmp_path / "died").exists()
    assert [row["outcome"] for row in rows_of(out / "results.csv")] == ["budget"] * 4
    assert len({row["key"] for row in rows_of(out / "results.csv")}) == 4


def test_a_run_is_kept_on_request_and_own_worlds_travel(tmp_path, study, here):
    from sim.world import load_world

    (tmp_path / "mine.geojson").write_text(json.dumps(load_world("symmetric_cross").to_geojson()), encoding="utf-8")
    study.write_text(STUDY.replace("symmetric_cross", "mine.geojson").replace("seeds = 2", "seeds = [7]"), "utf-8")
    out = tmp_path / "out"
    assert call(study, "--out", out, "--keep-runs") == 0
    for row in rows_of(out / "results.csv"):
        summary = json.loads((out / "runs" / row["key"] / "summary.json").read_text(encoding="utf-8"))
        assert (row["world"], summary["seed"], row["outcome"]) == ("mine", 7, summary["outcome"])
        assert float(row["batch.ate_rmse_m"]) == summary["estimators"]["batch"]["ate_rmse_m"]


def test_a_worker_with_another_version_says_so(tmp_path, study):
    job = job_of(load_study(study).runs[0], tmp_path)
    assert run_job(job)["outcome"] == "budget"
    results = run_job(job | {"key": "0123456789abcdef"})
    assert results["outcome"] == "crash" and "another version" in results["error"]


@pytest.mark.parametrize(
    ("text", "arguments", "words"),
    [
        (STUDY + "[bass]\n", [], ["small.toml", "'bass'", "known keys", "seeds"]),
        (STUDY.replace("noise =", "nose ="), [], ["'nose'", "known keys", "noise"]),
        (STUDY.replace("noise =", "outcome ="), [], ["'outcome'", "known keys"]),
        ("name = ", [], ["small.toml", "not valid TOML"]),
        (STUDY, ["--processes", "0"], ["--processes", "1 or more"]),
        (STUDY, ["--processes", "x"], ["--processes", "x"]),
        (STUDY, ["--sped"], ["--sped"]),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(text, arguments, words, tmp_path, study, capsys):
    study.write_text(text, encoding="utf-8")
    assert call(study, "--out", tmp_path / "out", *arguments) == 2
    require_one_line(capsys.readouterr().err, *words)
    assert not (tmp_path / "out").exists()


def test_bad_directories(tmp_path, study, capsys):
    (tmp_path / "file").touch()
    assert call(study, "--out", tmp_path / "file") == 2
    require_one_line(capsys.readouterr().err, "--out", "directory")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "results.csv").write_text("mine,and\nnot,yours\n", encoding="utf-8")
    assert call(study, "--out", tmp_path / "out") == 2
    require_one_line(capsys.readouterr().err, "results.csv", "key")
    assert (tmp_path / "out" / "results.csv").read_text(encoding="utf-8") == "mine,and\nnot,yours\n"
    assert call(tmp_path / "missing.toml", "--out", tmp_path / "out") == 2
    require_one_line(capsys.readouterr().err, "missing.toml")


def test_one_sweep_at_a_time(tmp_path, study, here, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "sweep.lock").write_text("1", encoding="utf-8")  # of a process that holds nothing
    with only_sweep(out):
        assert call(study, "--out", out) == 2
        require_one_line(capsys.readouterr().err, "another sweep", str(os.getpid()))
        assert here == []
    assert call(study, "--out", out) == 0 and len(here) == 4


def test_an_axis_with_the_name_of_a_column_is_refused(tmp_path, study, capsys):
    axis = '[[axes]]\nname = "success"\nsetting = "noise"\nvalues = ["none"]\n'
    study.write_text(STUDY.split("[axes]")[0] + axis, encoding="utf-8")
    assert call(study, "--out", tmp_path / "out") == 2
    require_one_line(capsys.readouterr().err, "small.toml", "'success'", "column")


def test_an_interrupt_keeps_what_is_done(tmp_path, study, monkeypatch, here, capsys):
    def interrupted(job):
        if here:
            raise KeyboardInterrupt
        here.append(job["key"])
        return run_job(job)

    monkeypatch.setattr(sweep, "run_job", interrupted)
    out = tmp_path / "out"
    assert call(study, "--out", out) == 130
    require_one_line(capsys.readouterr().err, "interrupted")
    assert len(rows_of(out / "results.csv")) == 1


def test_without_dask_or_scheduler_it_says_so_in_one_line(tmp_path, study, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert call(study, "--out", tmp_path / "out", "--dask", "tcp://127.0.0.1:9") == 2
    require_one_line(capsys.readouterr().err, "make cluster")
    monkeypatch.undo()
    pytest.importorskip("distributed")
    monkeypatch.setattr("_study_dask.CONNECT_S", 0.5)
    for address in ("tcp://127.0.0.1:9", "nowhere", "what://x:1"):
        assert call(study, "--out", tmp_path / "out", "--dask", address) == 2
        require_one_line(capsys.readouterr().err, "--dask", address)
    assert not (tmp_path / "out").exists()


def test_the_lock_of_the_cluster_pins_its_extra():
    root = SCRIPTS.parent
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    cluster, main = (
        (root / f"requirements{part}.lock").read_text(encoding="utf-8").split() for part in ("-cluster", "")
    )
    assert set(project["optional-dependencies"]["cluster"]) <= set(cluster)
    assert [line for line in cluster if not re.fullmatch(r"[a-z0-9_.-]+==[0-9][0-9a-z.]*", line)] == []
    assert {line.split("==")[0] for line in cluster} & {line.split("==")[0] for line in main} == set()
