"""Smoothing a whole log at once: a start from the sightings alone, then everything together.

A solver that starts far off ends in a wrong basin. The start is what a causal smoother makes of the log in coarse steps
(it places robots and landmarks as soon as enough was seen of them, and refuses fixes that cannot be true); a graph of
nothing but relative poses has a better one in closed form (lago: Carlone, Aragues, Castellanos, Bona, A linear
approximation for graph-based simultaneous localization and mapping, RSS 2011).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np

from coopslam.errors import UnderDetermined, require_between
from coopslam.estimation import deep_stack
from coopslam.estimation.assembly import Seen
from coopslam.estimation.batch import BatchEstimate
from coopslam.estimation.gate import GateSettings
from coopslam.estimation.incremental import Incremental, IncrementalSettings
from coopslam.estimation.replay import in_groups, replay
from coopslam.estimation.robust import RobustSettings, RobustSolution, solve_robust
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.records import Record

_LAGO_MOST = 20_000  # variables; its time grows with their square: 1 s for 5 000, 26 s for 30 000
_NAMED = 3  # of those that a robot saw, or that saw it, in a message
_RELATIVE_POSES = gtsam.BetweenFactorPose2 | gtsam.PriorFactorPose2


@dataclass(frozen=True, slots=True)
class SmoothSettings:
    """How a whole log is smoothed."""

    start_period_s: float = 10.0  # steps of the causal smoother that finds the start
    start: IncrementalSettings = field(
        default_factory=lambda: IncrementalSettings(0.03, wildfire_threshold=1e-3, rounds=1, factorization="CHOLESKY")
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
    settings = settings or SmoothSettings()
    causal = Incremental(robots, landmarks, settings.start, settings.gate, timeline)
    replay(causal, in_groups(records, settings.start_period_s), watch)
    require_connected(causal.timeline)
    start = _best_start(causal.graph, causal.values())
    refused = causal.timeline.refused
    solution = solve_robust(causal.graph, refused, start, causal.timeline.robots, settings.robust)
    estimate = BatchEstimate(causal.timeline, solution.graph, solution.values)
    return Smoothed(estimate, solution, start)


def _best_start(graph: gtsam.NonlinearFactorGraph, causal: gtsam.Values) -> gtsam.Values:
    """The causal values, or those of lago where it applies and fits better."""
    size = causal.size()
    if not 0 < size <= _LAGO_MOST or not all(isinstance(graph.at(i), _RELATIVE_POSES) for i in range(graph.size())):
        return causal
    try:
        linear = deep_stack.call(gtsam.lago.initialize, _with_diagonal_noise(graph), False, variables=size)
    except RuntimeError:
        return causal
    complete = linear.size() == size and all(map(linear.exists, causal.keys()))
    return linear if complete and graph.error(linear) < graph.error(causal) else causal


def _with_diagonal_noise(graph: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    """The factors without their correlations, which lago refuses."""
    diagonal = gtsam.NonlinearFactorGraph()
    for factor in map(graph.at, range(graph.size())):
        variances = np.diag(factor.noiseModel().covariance())
        diagonal.push_back(factor.cloneWithNewNoiseModel(gtsam.noiseModel.Diagonal.Variances(variances)))
    return diagonal


def require_connected(timeline: Timeline) -> None:
    """Raises UnderDetermined when robots that have records have no place in the common frame; says what they saw."""
    lost = [robot for robot in timeline.robots if timeline.tracks[robot].keys and not timeline.is_placed(robot)]
    if lost:
        are = "is" if len(lost) == 1 else "are"
        raise UnderDetermined(
            f"{', '.join(lost)} {are} not connected to {timeline.robots[0]}, too little says where they started: "
            + "; ".join(_sightings(timeline, robot) for robot in lost)
        )


def _sightings(timeline: Timeline, robot: str) -> str:
    """What a robot saw and who saw it, in words."""
    sees = {target: seen for (observer, target), seen in timeline.seen.items() if observer == robot}
    seen_by = {observer: seen for (observer, target), seen in timeline.seen.items() if target == robot}
    saw = f"sees only {_times(sees)}" if sees else "sees nothing"
    return f"{robot} {saw} and is {f'seen only by {_times(seen_by)}' if seen_by else 'never seen'}"


def _times(seen: Mapping[str, Seen]) -> str:
    """Whom, how often, and until when; those that were seen most often."""
    most = sorted(seen, key=lambda name: -seen[name].times)
    listed = ", ".join(f"{name} ({seen[name].times} times)" for name in most[:_NAMED])
    more = f" and {len(most) - _NAMED} more" if len(most) > _NAMED else ""
    return f"{listed}{more}, last at t = {max(entry.last_s for entry in seen.values()):.1f} s"
