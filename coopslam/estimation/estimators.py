"""All estimators behind one call: the same synchronized records in, an Estimate and what it took out."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from coopslam.errors import BadInput, require_between
from coopslam.estimation.dead_reckoning import DeadReckoning
from coopslam.estimation.ekf import Ekf, EkfSettings
from coopslam.estimation.estimate import Estimator
from coopslam.estimation.fixed_lag import FixedLag, FixedLagSettings
from coopslam.estimation.gate import GateSettings
from coopslam.estimation.incremental import Incremental, IncrementalSettings
from coopslam.estimation.loss import Loss
from coopslam.estimation.offline import SmoothSettings, require_connected, smooth
from coopslam.estimation.replay import Replay, in_groups, replay
from coopslam.estimation.timeline import TimelineSettings
from coopslam.estimation.weighted import Weighted
from coopslam.records import LoopClosure, Record

BATCH = "batch"
CAUSAL = ("dead-reckoning", "weighted", "ekf", "incremental", "fixed-lag")
NAMES = (*CAUSAL, BATCH)


@dataclass(frozen=True, slots=True)
class EstimatorSettings:
    """Settings of all estimators; those of one do not touch the others."""

    period_s: float = 0.25  # shortest time between two updates of a causal estimator; zero: at each instant with a fix
    timeline: TimelineSettings = field(default_factory=lambda: TimelineSettings(loss=Loss("cauchy")))
    gate: GateSettings = field(default_factory=GateSettings)
    incremental: IncrementalSettings = field(default_factory=lambda: REPLAYED)
    fixed_lag: FixedLagSettings = field(default_factory=FixedLagSettings)
    ekf: EkfSettings = field(default_factory=EkfSettings)
    smooth: SmoothSettings = field(default_factory=SmoothSettings)

    def __post_init__(self):
        require_between(0.0, 1e6, period_s=self.period_s)


# A log that is replayed has no explorer that reads relative covariances of millimetres from each update.
REPLAYED = IncrementalSettings(0.03, wildfire_threshold=1e-3, relinearize_skip=10, rounds=0, factorization="CHOLESKY")


def make(name: str, robots: Sequence[str], landmarks: Sequence[str], settings: EstimatorSettings) -> Estimator:
    """A causal estimator by its name. Raises BadInput for another name.

    Filters judge a fix by a gate before they use it, so they take plain squares; smoothers take the robust loss.
    """
    plain = replace(settings.timeline, loss=Loss())
    if name == "dead-reckoning":
        return DeadReckoning(robots, landmarks, settings.gate, plain)
    if name == "weighted":
        return Weighted(robots, landmarks, settings.ekf, settings.gate, plain)
    if name == "ekf":
        return Ekf(robots, landmarks, settings.ekf, settings.gate, plain)
    if name == "incremental":
        return Incremental(robots, landmarks, settings.incremental, settings.gate, settings.timeline)
    if name == "fixed-lag":
        return FixedLag(robots, landmarks, settings.fixed_lag, settings.gate, settings.timeline)
    raise BadInput(f"no estimator is called {name}; there are {', '.join(NAMES)}")


def run(
    name: str,
    records: Sequence[Record],
    robots: Sequence[str],
    landmarks: Sequence[str],
    settings: EstimatorSettings,
    watch: Callable[[float], None] = lambda stamp_s: None,
) -> Replay:
    """One estimator over synchronized records. watch: is told the stamp after each update.

    Raises BadInput for an unknown name or when there are no records, UnderDetermined when nothing ties a robot down.
    """
    if not records:
        raise BadInput("the log holds no records")
    settings = replace(settings, timeline=_for_log(settings.timeline, records))
    if name != BATCH:
        done = replay(make(name, robots, landmarks, settings), in_groups(records, settings.period_s), watch)
        require_connected(done.estimate.timeline)
        return done
    began = time.perf_counter()
    smoothed = smooth(records, robots, landmarks, settings.timeline, settings.smooth, watch)
    seconds = np.array([time.perf_counter() - began])
    end_s, poses = np.array([records[-1].stamp_s]), np.array([len(smoothed.estimate.timeline.stamps)])
    return Replay(smoothed.estimate, smoothed.solution.graph, end_s, seconds, poses)


def _for_log(settings: TimelineSettings, records: Iterable[Record]) -> TimelineSettings:
    """Loop closures name poses of long ago: then each leg of odometry ends with a variable."""
    closures = any(isinstance(record, LoopClosure) for record in records)
    return replace(settings, every_leg=True) if closures else settings
