"""Smoothing a whole log at once: a start from the sightings alone, then everything together.

A solver that starts far off ends in a wrong basin. The start is what a causal smoother makes of the log in coarse steps
(it places robots and landmarks as soon as enough was seen of them, and refuses fixes that cannot be true); a graph of
nothing but relative poses has a better one in closed form (lago: Carlone, Aragues, Castellanos, Bona, A linear
approximation for graph-based simultaneous localization and mapping, RSS 2011).
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import gtsam

from coopslam.errors import UnderDetermined, require_between
from coopslam.estimation.batch import BatchEstimate
from coopslam.estimation.gate import GateSettings
from coopslam.estimation.incremental import Incremental, IncrementalSettings
from coopslam.estimation.replay import in_groups, replay
from coopslam.estimation.robust import RobustSettings, RobustSolution, solve_robust
from coopslam.estimation.timeline import TimelineSettings
from coopslam.records import Record

_RELATIVE_POSES = gtsam.BetweenFactorPose2 | gtsam.PriorFactorPose2


@dataclass(frozen=True, slots=True)
class SmoothSettings:
    """How a whole log is smoothed."""

    start_period_s: float = 10.0  # steps of the causal smoother that finds the start
    start: IncrementalSettings = field(
        default_factory=lambda: IncrementalSettings(relinearize_threshold=0.03, wildfire_threshold=1e-3, rounds=1)
    )
    gate: GateSettings = field(default_factory=GateSettings)
    robust: RobustSettings = field(default_factory=RobustSettings)

    def __post_init__(self):
        require_between(0.0, 1e6, start_period_s=self.start_period_s)


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A whole log, smoothed."""

    estimate: BatchEstimate
    solution: RobustSolution
    start: gtsam.Values
    start_seconds: float
    solve_seconds: float


def smooth(
    records: Iterable[Record],
    robots: Iterable[str],
    landmarks: Iterable[str] = (),
    timeline: TimelineSettings | None = None,
    settings: SmoothSettings | None = None,
    watch: Callable[[float], None] = lambda stamp_s: None,
) -> Smoothed:
    """Everything that synchronized records tell, at once. watch: is told the stamps that the start has come to.

    Raises UnderDetermined when nothing ties a robot down.
    """
    settings, began = settings or SmoothSettings(), time.perf_counter()
    causal = Incremental(robots, landmarks, settings.start, settings.gate, timeline)
    replay(causal, in_groups(records, settings.start_period_s), watch)
    require_connected(causal.timeline)
    start = _best_start(causal.graph, causal.values())
    started = time.perf_counter()
    refused = causal.timeline.refused
    solution = solve_robust(causal.graph, refused, start, causal.timeline.robots, settings.robust)
    estimate = BatchEstimate(causal.timeline, solution.graph, solution.values)
    return Smoothed(estimate, solution, start, started - began, time.perf_counter() - started)


def _best_start(graph: gtsam.NonlinearFactorGraph, causal: gtsam.Values) -> gtsam.Values:
    """The causal values, or those of lago where it applies and fits better."""
    if not all(isinstance(graph.at(i), _RELATIVE_POSES) for i in range(graph.size())):
        return causal
    try:
        linear = gtsam.lago.initialize(graph, False)
    except RuntimeError:
        return causal
    complete = linear.size() == causal.size() and all(map(linear.exists, causal.keys()))
    return linear if complete and graph.error(linear) < graph.error(causal) else causal


def require_connected(timeline) -> None:
    """Raises UnderDetermined that names the robots which have records and no place in the common frame, and why."""
    lost = [robot for robot in timeline.robots if timeline.tracks[robot].keys and not timeline.is_placed(robot)]
    if lost:
        are = "is" if len(lost) == 1 else "are"
        raise UnderDetermined(
            f"{', '.join(lost)} {are} not connected to {timeline.robots[0]}: too few sightings of each other and of "
            "common landmarks say where they started"
        )
