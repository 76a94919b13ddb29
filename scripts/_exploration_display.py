"""What explore_and_optimize.py shows while it works, and prints when it is done."""

import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from _exploration import Exploration
from rich.console import Console
from rich.live import Live
from rich.progress import track
from rich.table import Table

from coopslam.exploration.mission import Progress

PLAIN_LINE_EVERY_S = 2.0


class ProgressDisplay:
    """A live table on a terminal, plain lines elsewhere."""

    def __init__(self, world: str):
        self._world = world
        self._console = Console()
        self._live = None
        if self._console.is_terminal and not os.environ.get("CI"):
            self._live = Live(console=self._console, refresh_per_second=8, transient=True)
        self._next_line_s = time.monotonic() + PLAIN_LINE_EVERY_S

    def __enter__(self) -> "ProgressDisplay":
        if self._live:
            self._live.__enter__()
        else:
            print(f"exploring {self._world}", flush=True)
        return self

    def __exit__(self, *error) -> None:
        if self._live:
            self._live.__exit__(*error)

    def show(self, progress: Progress) -> None:
        """Show where the mission stands."""
        if self._live:
            self._live.update(_table(self._world, progress))
        elif time.monotonic() >= self._next_line_s:
            print(_line(progress), flush=True)
            self._next_line_s = time.monotonic() + PLAIN_LINE_EVERY_S


def _line(progress: Progress) -> str:
    sigma = 100 * max(progress.position_sigma_m.values())
    return (
        f"{progress.triangles} triangles, {progress.open_gates} open gates, {progress.role_exchanges} role exchanges, "
        f"{progress.travel_m:.1f} m, position sigma {sigma:.1f} cm"
    )


def _table(world: str, progress: Progress) -> Table:
    table = Table(title=f"exploring {world}", show_header=False)
    table.add_row("triangles", str(progress.triangles))
    table.add_row("open gates", str(progress.open_gates))
    table.add_row("role exchanges", str(progress.role_exchanges))
    table.add_row("travelled", f"{progress.travel_m:.1f} m")
    for robot, sigma in progress.position_sigma_m.items():
        table.add_row(f"position sigma of {robot}", f"{100 * sigma:.1f} cm")
    return table


def print_result(finished: Exploration, out: Path, seconds: float) -> None:
    summary = finished.summary
    print(f"{summary['outcome']}: {summary['outcome_reason']}")
    found = f"{summary['vertices']} vertices, {summary['holes']} holes, {summary['triangles']} triangles"
    if "covered_fraction" in summary:
        found += (
            f" (expected {summary['triangles_expected']}), covered {summary['covered_fraction']:.6f}, "
            f"overlap {summary['overlap_fraction']:.1e}"
        )
    print(found)
    driven = f"{sum(summary['travel_m'].values()):.1f} m travelled, {summary['role_exchanges']} role exchanges"
    if summary.get("vertex_rmse_m") is not None and summary.get("vertex_nees_mean") is not None:
        driven += (
            f", vertex rmse {100 * summary['vertex_rmse_m']:.2f} cm, "
            f"vertex NEES {summary['vertex_nees_mean']:.2f} (ideal 2)"
        )
    print(driven)
    if "pictures" in summary.get("tracker", {}):
        print(_pictures_line(summary["tracker"]))
    for name, scores in summary["estimators"].items():
        if None not in (scores["ate_rmse_m"], scores["nees_mean"]):
            ate, nees = 100 * scores["ate_rmse_m"], scores["nees_mean"]
            print(f"{name:>14}: ATE {ate:7.2f} cm, pose NEES {nees:.2f} (ideal 3)")
    if "left_out" in summary:
        print(f"left out (reasons are in summary.json): {', '.join(summary['left_out'])}")
    print(f"{out / 'report.html'} and the run directory {out} written in {seconds:.1f} s")


def _pictures_line(tracker: dict) -> str:
    said = f"{tracker['pictures']} pictures, {tracker['kind']} found in {tracker['detections']}"
    said += f", {tracker['headings_withheld']} headings withheld"
    nees = tracker["pose_nees_median"]
    return said if nees is None else f"{said}, median NEES of fixes {nees:.2f} (ideal 2.37)"


def show_frames(console: Console) -> Callable[[Iterable], Iterable]:
    """A bar on a terminal, one line elsewhere."""
    if console.is_terminal and not os.environ.get("CI"):
        return lambda times: track(times, "drawing the animation", console=console, transient=True)
    print("drawing the animation", flush=True)
    return lambda times: times
