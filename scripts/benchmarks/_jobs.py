"""Work on a list of jobs in processes of one thread each, with a progress bar."""

import os
import sys
import time
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

import cv2
from _study_pool import single_threaded
from rich.console import Console
from rich.progress import track

PLAIN_LINE_EVERY_S = 30.0
Job, Result = TypeVar("Job"), TypeVar("Result")


def in_processes(work: Callable[[Job], Result], jobs: Sequence[Job], processes: int, title: str) -> list[Result]:
    """The result of each job, in their order. work: a function of a module; with one process it runs in this one."""
    with single_threaded():
        if processes == 1:
            one_thread()
            return list(_shown(map(work, jobs), len(jobs), title))
        with ProcessPoolExecutor(processes, get_context("spawn"), initializer=one_thread) as pool:
            return list(_shown(pool.map(work, jobs), len(jobs), title))


def one_thread() -> None:
    """cv2 keeps to one core in this process."""
    cv2.setNumThreads(1)


def count(text: str) -> int:
    """An argument of the command line."""
    if not text.isdecimal() or int(text) < 1:
        raise ArgumentTypeError(f"a whole number of one or more expected, got {text[:60]!r}")
    return int(text)


def whole(text: str) -> int:
    """An argument of the command line."""
    if not text.isdecimal():
        raise ArgumentTypeError(f"a whole number of zero or more expected, got {text[:60]!r}")
    return int(text)


def _shown(results: Iterable[Result], total: int, title: str) -> Iterable[Result]:
    """The same with a bar on a terminal, with a line now and then elsewhere."""
    console = Console(stderr=True)
    if console.is_terminal and not os.environ.get("CI"):
        return track(results, title, total=total, console=console, transient=True)
    return _said(results, total, title)


def _said(results: Iterable[Result], total: int, title: str) -> Iterator[Result]:
    next_line_s = time.monotonic()
    for done, result in enumerate(results, start=1):
        yield result
        if time.monotonic() >= next_line_s or done == total:
            print(f"{title}: {done} of {total}", file=sys.stderr, flush=True)
            next_line_s = time.monotonic() + PLAIN_LINE_EVERY_S
