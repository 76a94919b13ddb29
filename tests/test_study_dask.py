"""A study on a Dask cluster whose worker is killed: no run is lost, none is counted twice."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest
from script_calls import SCRIPTS, rows_of

STUDY = """
name = "small"
seeds = 12
worlds = ["symmetric_cross"]
[axes]
noise = ["typical", "legged"]
"""


def wait_for(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.1)


@pytest.mark.slow
def test_a_killed_dask_worker_loses_nothing(tmp_path):
    """A scheduler and two workers in processes of their own; one is killed with runs under way."""
    distributed = pytest.importorskip("distributed")
    study = tmp_path / "small.toml"
    study.write_text(STUDY, encoding="utf-8")
    python, contact, out = [sys.executable, "-m"], tmp_path / "scheduler.json", tmp_path / "out"
    quiet = {"cwd": tmp_path, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = [*python, "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    worker = [*python, "distributed.cli.dask_worker", "--scheduler-file", str(contact), "--nthreads", "1", "--no-nanny"]
    started = [subprocess.Popen([*scheduler, "--host", "127.0.0.1", "--scheduler-file", str(contact)], **quiet)]
    try:
        wait_for(contact.exists)
        address = json.loads(contact.read_text(encoding="utf-8"))["address"]
        started += [subprocess.Popen([*worker, "--no-dashboard"], **quiet) for _ in range(2)]
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        command = [sys.executable, str(SCRIPTS / "sweep.py"), str(study), "--out", str(out), "--dask", address]
        sweeping = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(sweeping)
        wait_for(lambda: (out / "results.csv").exists() and len(rows_of(out / "results.csv")) >= 4)
        started[1].kill()
        done_before = len(rows_of(out / "results.csv"))
        said, wrong = sweeping.communicate(timeout=180)
        assert sweeping.returncode == 0, wrong
    finally:
        for process in started:
            process.kill()
            process.wait()
    rows = rows_of(out / "results.csv")
    print(f"killed after {done_before} of {len(rows)} rows\n{said}")
    assert done_before < 24 == len(rows) == len({row["key"] for row in rows})
    assert all(row["outcome"] == "complete" for row in rows)
    assert np.isfinite([float(row["batch.ate_rmse_m"]) for row in rows]).all()
