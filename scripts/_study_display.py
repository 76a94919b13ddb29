"""What a person sees of a study: a progress bar while it runs, and a table of its combinations at the end."""

import os
import time
from collections.abc import Mapping
from math import nan

import numpy as np
from _study_crash import CRASH
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from coopslam.report.study_panels import StudyResults

PLAIN_LINE_EVERY_S = 5.0
QUANTITIES = (  # heading, column, factor
    ("ATE, cm", "batch.ate_rmse_m", 100),
    ("vertex rmse, cm", "vertex_rmse_m", 100),
    ("odometry ATE, cm", "dead-reckoning.ate_rmse_m", 100),
    ("pose NEES", "batch.nees_mean", 1),
    ("seconds", "seconds", 1),
)


class StudyProgress:
    """A bar on a terminal, plain lines elsewhere."""

    def __init__(self, name: str, total: int, done: int, succeeded: int):
        """done, succeeded: of runs that an earlier sweep did."""
        self.total, self.done, self.before, self.succeeded, self.crashed = total, done, done, succeeded, 0
        self._name, self._began, self._next_line_s = name, time.monotonic(), 0.0
        console = Console()
        self._bar = None
        if console.is_terminal and not os.environ.get("CI"):
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
            columns += (TextColumn("{task.fields[said]}"), TextColumn("ETA"), TimeRemainingColumn())
            self._bar = Progress(*columns, console=console)

    def __enter__(self) -> "StudyProgress":
        if self._bar:
            self._bar.__enter__()
            self._task = self._bar.add_task(self._name, total=self.total, completed=self.done, said="")
        else:
            kept = f", {self.done} of them done before" if self.done else ""
            print(f"{self._name}: {self.total} runs{kept}", flush=True)
        return self

    def __exit__(self, *error) -> None:
        if self._bar:
            self._bar.__exit__(*error)

    @property
    def runs_per_s(self) -> float:
        """Of this sweep alone."""
        return (self.done - self.before) / max(time.monotonic() - self._began, 1e-9)

    def count(self, results: Mapping) -> None:
        """One more run is done."""
        self.done += 1
        self.succeeded += bool(results["success"])
        self.crashed += results["outcome"] == CRASH
        crashes = f", {self.crashed} crashed" if self.crashed else ""
        said = f"{self.succeeded} succeeded{crashes}, {self.runs_per_s:.2f} runs/s"
        if self._bar:
            self._bar.update(self._task, completed=self.done, said=said)
        elif time.monotonic() >= self._next_line_s or self.done == self.total:
            left_s = (self.total - self.done) / max(self.runs_per_s, 1e-9)
            print(f"{self.done} of {self.total} runs, {said}, {left_s:.0f} s left", flush=True)
            self._next_line_s = time.monotonic() + PLAIN_LINE_EVERY_S


def combination_table(results: StudyResults) -> str:
    """A line per combination: how many succeeded, and medians over those that did."""
    names = [dimension.name for dimension in results.dimensions]
    lines = [[*names, "success", *(heading for heading, _, _ in QUANTITIES)]]
    for combination in sorted({tuple(row) for row in results.index.tolist()}):
        chosen = (results.index == combination).all(axis=1)
        good = chosen & results.success
        labels = [d.labels[k] for d, k in zip(results.dimensions, combination, strict=True)]
        medians = [_median(results.column(column)[good]) * factor for _, column, factor in QUANTITIES]
        lines.append([*labels, f"{good.sum()}/{chosen.sum()}", *("-" if m != m else f"{m:.2f}" for m in medians)])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    left = len(names)
    return "\n".join(
        "  ".join(
            cell.ljust(width) if k < left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _median(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else nan
