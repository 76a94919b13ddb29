"""The runs of a study on this machine: one worker process per processor, and no run is lost with its worker.

A pool breaks as a whole when one of its processes dies. The runs that were under way are then done again one at a
time, so that the next death accuses the right one; a run that was lost too often becomes a row with outcome crash.
"""

import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait as wait_for_end

from _study_crash import crashed

RETRIES = 3  # of a run whose process died under it
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def processors() -> int:
    """How many this process may use."""
    if hasattr(os, "process_cpu_count"):  # Python 3.13
        return os.process_cpu_count() or 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_in_pool(jobs: list[dict], processes: int, run: Callable[[dict], dict]) -> Iterator[tuple[dict, dict]]:
    """(job, results) of each job once, as they finish. Workers end with the iterator.

    run: a function of a module that workers can import.
    """
    fresh, suspects, losses = deque(jobs), deque(), Counter()
    with single_threaded():
        while fresh or suspects:
            lost = yield from _until_broken(suspects or fresh, 1 if suspects else processes, run)
            for job in lost:
                losses[job["key"]] += 1
                if losses[job["key"]] > RETRIES:
                    yield job, crashed(f"its process died {losses[job['key']]} times")
                else:
                    suspects.append(job)


def _until_broken(queue: deque, width: int, run: Callable) -> Iterator[tuple[dict, dict]]:
    """Work on the queue until it is empty or the pool breaks; returns the jobs that were lost."""
    strangers = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(width, multiprocessing.get_context("spawn"), initializer=_begin_worker)
    pending: dict[Future, dict] = {}
    ahead = 1 if width == 1 else width + 1  # one waits for the worker that is free next
    lost = []
    try:
        while (queue or pending) and not lost:
            while queue and len(pending) < ahead:
                job = queue.popleft()
                try:
                    pending[pool.submit(run, job)] = job
                except BrokenProcessPool:
                    queue.appendleft(job)
                    break
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                job = pending.pop(future)
                try:
                    results = future.result()
                except BrokenProcessPool:
                    lost.append(job)
                    continue
                yield job, results
        for future, job in pending.items():  # broken: the others are lost too, unless they had just finished
            try:
                yield job, future.result()
            except BrokenProcessPool:
                lost.append(job)
        return lost
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - strangers:
            process.terminate()
            process.join()


@contextmanager
def single_threaded() -> Iterator[None]:
    """Workers that start within use one thread each for linear algebra, so that N of them do N times as much."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _begin_worker() -> None:
    """An interrupt is the parent's to handle; a worker whose parent was killed ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    wait_for_end([multiprocessing.parent_process().sentinel])
    os._exit(1)
