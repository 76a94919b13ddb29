"""One estimator over a recorded log: records in groups, as they would have come, and how long each update took."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from coopslam.estimation.estimate import Estimate, Estimator
from coopslam.estimation.timeline import STAMP_TOLERANCE_S
from coopslam.records import Odometry, Record


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What an estimator made of a log."""

    estimate: Estimate  # after the last update
    graph: gtsam.NonlinearFactorGraph  # what it used of the records
    stamps_s: np.ndarray  # (N,) of the last record of each update
    latencies_s: np.ndarray  # (N,) wall time of each update
    poses: np.ndarray  # (N,) pose variables after each update

    @property
    def seconds(self) -> float:
        """Wall time of all updates."""
        return float(self.latencies_s.sum())


def in_groups(records: Iterable[Record], period_s: float = 0.0) -> Iterator[list[Record]]:
    """Synchronized records in groups, each of which ends with something else than odometry, at one instant.

    period_s: shortest time that a group spans, but for the last one; zero: a group for each instant with a fix.
    """
    group, first_s, last_s = [], None, None
    for record in records:
        full = last_s is not None and record.stamp_s > last_s + STAMP_TOLERANCE_S and last_s - first_s >= period_s
        if full:
            yield group
            group, first_s, last_s = [], None, None
        group.append(record)
        first_s = record.stamp_s if first_s is None else first_s
        if not isinstance(record, Odometry):
            last_s = record.stamp_s
    if group:
        yield group


def replay(
    estimator: Estimator, groups: Iterable[list[Record]], watch: Callable[[float], None] = lambda stamp_s: None
) -> Replay:
    """Update the estimator with each group. watch: is told the stamp after each update.

    Raises what the estimator raises; ValueError when there are no groups.
    """
    estimate, stamps, latencies, poses = None, [], [], []
    for group in groups:
        began = time.perf_counter()
        estimate = estimator.update(group)
        latencies.append(time.perf_counter() - began)
        stamps.append(group[-1].stamp_s)
        poses.append(len(estimator.timeline.stamps))
        watch(group[-1].stamp_s)
    if estimate is None:
        raise ValueError("nothing to replay")
    return Replay(estimate, estimator.graph, np.array(stamps), np.array(latencies), np.array(poses))
