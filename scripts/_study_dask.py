"""The runs of a study on the workers of a running Dask scheduler.

Workers are started from an environment in which the repository is installed (`make cluster`), wherever they stand:
    .venv/bin/dask worker tcp://HOST:8786 --nthreads 1 --nworkers auto
Jobs and results are plain dictionaries. Dask does a run again whose worker died; one that killed several workers in a
row is submitted anew a few times, then becomes a row with outcome crash.
"""

import logging
import re
from collections import Counter
from collections.abc import Callable, Iterator

from _study_crash import crashed
from _study_pool import RETRIES

from coopslam.errors import BadInput, CoopSlamError

CONNECT_S = 5.0
AHEAD = 4  # runs submitted per thread of the cluster; the scheduler keeps the rest of a large study off its back
HOW_TO_INSTALL = "--dask needs Dask: make cluster, or pip install -e .[cluster]"


class ClusterLost(CoopSlamError):
    """The scheduler went away with runs under way."""

    exit_code = 3


def connect(address: str):
    """A client of the scheduler at `address`. Raises BadInput without Dask, or when nothing answers."""
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise BadInput(HOW_TO_INSTALL) from error
    if not re.fullmatch(r"(tcp|tls)://\S+:\d+", address):
        raise BadInput(f"--dask {address}: the address of a Dask scheduler expected, tcp://HOST:PORT")
    for name in [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what is wrong is said here, in one line
    dask.config.set({"distributed.comm.timeouts.connect": f"{CONNECT_S} s"})
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False, name="coopslam-sweep")
    except (OSError, ValueError, ImportError) as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise BadInput(f"--dask {address}: no Dask scheduler answers there: {said}") from error
    if not client.nthreads():
        print(f"the scheduler has no workers yet: .venv/bin/dask worker {address} --nthreads 1", flush=True)
    return client


def run_on_dask(jobs: list[dict], client, run: Callable[[dict], dict] | None = None) -> Iterator[tuple[dict, dict]]:
    """(job, results) of each job once, as they finish. Raises ClusterLost when the scheduler goes away.

    run: instead of the exploration; a function that workers can unpickle.
    """
    from distributed import CancelledError, KilledWorker, as_completed

    waiting, losses, job_of = iter(jobs), Counter(), {}
    finished = as_completed(loop=client.loop)

    def submit(job: dict) -> None:
        future = client.submit(run or _remote(), job, key=f"{job['key']}-{losses[job['key']]}", pure=False)
        job_of[future.key] = job
        finished.add(future)

    def top_up() -> None:
        room = AHEAD * max(sum(client.nthreads().values()), 1) - len(job_of)
        for _, job in zip(range(room), waiting, strict=False):
            submit(job)

    try:
        top_up()
        for future in finished:
            job = job_of.pop(future.key)
            try:
                results = future.result()
            except KilledWorker:
                losses[job["key"]] += 1
                if losses[job["key"]] <= RETRIES:
                    submit(job)
                    continue
                results = crashed("it killed its Dask workers again and again")
            except CancelledError as error:
                raise ClusterLost("the Dask scheduler is gone") from error
            except Exception as error:  # whatever the run raised there; the worker may not even import the program
                results = crashed(f"{type(error).__name__}: {error}")
            yield job, results
            top_up()
    except OSError as error:
        raise ClusterLost(f"the Dask scheduler is gone: {error}") from error
    finally:
        _forget(client, finished)


def _forget(client, finished) -> None:
    """Nobody waits for what is still under way."""
    from distributed.client import ClosedClientError

    try:
        client.cancel(list(finished.futures), force=True)
    except (ClosedClientError, OSError, RuntimeError):  # the scheduler is gone, and the runs with it
        logging.getLogger(__name__).debug("nothing to cancel", exc_info=True)


def _remote() -> Callable[[dict], dict]:
    """A function that finds the scripts beside the worker's own package; being local, it is pickled by value."""

    def run_job_there(job: dict) -> dict:
        import sys
        from pathlib import Path

        import coopslam

        scripts = str(Path(coopslam.__file__).resolve().parents[1] / "scripts")
        if scripts not in sys.path:
            sys.path.insert(0, scripts)
        from _study_run import run_job

        return run_job(job)

    return run_job_there
