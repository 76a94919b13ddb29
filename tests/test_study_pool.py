"""The pool of a study: a worker that dies loses no run, none is counted twice. Light jobs, real processes."""

import os
import signal
from collections import Counter
from pathlib import Path

import pytest
from _study_crash import CRASH
from _study_pool import ONE_THREAD, RETRIES, processors, run_in_pool


def jobs(count: int, **more) -> list[dict]:
    return [{"key": str(k), **more} for k in range(count)]


def work(job: dict) -> dict:
    """Dies on the keys of job["dies"], as often as job["times"] says."""
    if job["key"] in job.get("dies", ()):
        died = Path(job["scratch"]) / f"{job['key']}.{os.getpid()}"
        if len(list(died.parent.glob(f"{job['key']}.*"))) < job["times"]:
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return {"square": int(job["key"]) ** 2, "threads": [os.environ.get(name) for name in ONE_THREAD]}


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("processes", [1, 2])
def test_every_job_once_with_one_thread_per_worker(processes, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    done = list(run_in_pool(jobs(7), processes, work))
    assert sorted((int(job["key"]), results["square"]) for job, results in done) == [(k, k * k) for k in range(7)]
    assert all(results["threads"] == ["1"] * len(ONE_THREAD) for _, results in done)
    assert os.environ["OMP_NUM_THREADS"] == "7"


def test_a_killed_worker_loses_nothing(tmp_path):
    done = list(run_in_pool(jobs(8, dies=["0", "5"], times=1, scratch=str(tmp_path)), 2, work))
    assert sorted((int(job["key"]), results["square"]) for job, results in done) == [(k, k * k) for k in range(8)]
    assert len(list(tmp_path.iterdir())) == 2


def test_a_job_that_always_kills_is_a_crash_and_accuses_no_other(tmp_path):
    done = list(run_in_pool(jobs(5, dies=["2"], times=99, scratch=str(tmp_path)), 2, work))
    assert Counter(job["key"] for job, _ in done) == Counter("01234")
    crashed = {job["key"]: results for job, results in done if results.get("outcome") == CRASH}
    assert list(crashed) == ["2"] and f"died {RETRIES + 1} times" in crashed["2"]["error"]
    assert len(list(tmp_path.iterdir())) == RETRIES + 1


def pid_of(job: dict) -> dict:
    return {"pid": os.getpid()}


def test_workers_end_with_the_iterator():
    finished = run_in_pool(jobs(9), 2, pid_of)
    pids = {next(finished)[1]["pid"], next(finished)[1]["pid"]}
    finished.close()
    assert [pid for pid in pids if alive(pid)] == []


def test_processors():
    assert 1 <= processors() <= os.cpu_count()
