"""Odometry alone: the first robot from the origin, the others from the fix that placed them."""

import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence

import gtsam
import numpy as np

from coopslam.errors import BadInput
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.factors import GAUGE_SIGMA
from coopslam.estimation.gate import Gate, GateSettings
from coopslam.estimation.keys import is_landmark, is_vertex, pose_key
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.estimation.tracks import Edge
from coopslam.records import Record
from coopslam.se2 import Pose2, adjoint, chain_covariance


class DeadReckoning:
    """Composes odometry. It has a pose at the same instants as the estimators that use every record."""

    def __init__(
        self,
        robots: Iterable[str],
        landmarks: Iterable[str] = (),
        gate: GateSettings | None = None,
        timeline: TimelineSettings | None = None,
    ):
        """gate: the fix that places a robot is none that others contradict."""
        self.timeline = Timeline(robots, landmarks, timeline)
        self.graph = gtsam.NonlinearFactorGraph()  # everything so far, for a batch solve
        self.timing = 0.0  # s spent in updates
        self._gate = Gate(self.timeline, gate or GateSettings())
        self._estimate = DeadReckoningEstimate(self.timeline)

    def update(self, records: Iterable[Record]) -> Estimate:
        """Compose a further group of records."""
        began = time.perf_counter()
        records = list(records)
        placed = all(map(self.timeline.is_placed, self.timeline.robots))
        refusals = {} if placed else self._gate.refusals(records, self._estimate)
        growth = self.timeline.extend(records, self._estimate.any_value, refusals)
        self.graph.push_back(growth.graph)
        self._estimate.grow(growth.tree, growth.values)
        self._estimate.grow(self._new_corners(growth.graph), gtsam.Values())
        self._estimate.keep_causal(growth.poses)
        self.timing += time.perf_counter() - began
        return self._estimate

    def values(self) -> gtsam.Values:
        """All variables as known now."""
        return self._estimate.values()

    def _new_corners(self, graph: gtsam.NonlinearFactorGraph) -> Iterator[Edge]:
        """Map vertices hang on the pose from which they were first seen."""
        found = set()
        for factor in map(graph.at, range(graph.size())):
            keys = factor.keys()
            if not isinstance(factor, gtsam.BetweenFactorPose2) or not is_vertex(keys[1]):
                continue
            if not (keys[1] in found or self._estimate.knows(keys[1])):
                found.add(keys[1])
                yield Edge(*keys, factor.measured(), factor.noiseModel().covariance())


class DeadReckoningEstimate(Estimate):
    """Poses along the tree of odometry legs and placing fixes, rooted at the first pose of the first robot."""

    def __init__(self, timeline: Timeline):
        super().__init__(timeline)
        root = pose_key(0, 0)
        self._poses = {root: Pose2()}
        self._covs = {root: np.eye(3) * GAUGE_SIGMA**2}
        self._guesses = gtsam.Values()  # of landmarks: what the robots saw first
        self._parent: dict[int, int] = {}
        self._open: dict[int, list[Edge]] = defaultdict(list)  # by both keys; edges that nothing reaches yet

    def knows(self, key: int) -> bool:
        """Whether a pose or a map vertex hangs on the tree."""
        return key in self._poses

    def values(self) -> gtsam.Values:
        """Everything that it knows."""
        values = gtsam.Values(self._guesses)
        for key, pose in self._poses.items():
            values.insert(key, pose)
        return values

    @property
    def landmarks(self) -> list[str]:
        """None: dead reckoning does not look at landmarks."""
        return []

    def landmark_key(self, landmark: str) -> int:
        raise BadInput(f"dead reckoning estimates no landmarks ({landmark} was asked for)")

    def value(self, key: int) -> Pose2:
        return self._poses[key]

    def point(self, key: int) -> np.ndarray:
        return self._guesses.atPoint2(key)

    def covariance(self, key: int) -> np.ndarray:
        return self._covs[key]

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        """Two poses share the error of the last pose that both descend from."""
        return np.block([[self._cross(a, b) for b in keys] for a in keys])

    def grow(self, tree: Iterable[Edge], guesses: gtsam.Values) -> None:
        """Compose new edges where they hang on known poses; keep the others."""
        for key in filter(is_landmark, guesses.keys()):
            self._guesses.insert(key, guesses.atPoint2(key))
        for edge in tree:
            self._open[edge.key_a].append(edge)
            self._open[edge.key_b].append(edge)
            ready = [key for key in (edge.key_a, edge.key_b) if key in self._poses]
            while ready:
                ready += self._reach_from(ready.pop())

    def _reach_from(self, key: int) -> list[int]:
        """Compose all open edges at a known pose; the keys reached by them."""
        reached = []
        for edge in self._open.pop(key, []):
            T, cov, other = edge.T_a_b, edge.cov_b, edge.key_b
            if key == edge.key_b:
                carry = adjoint(T)  # the error of the end, seen from the start
                T, cov, other = T.inverse(), carry @ cov @ carry.T, edge.key_a
            if other in self._poses:
                continue
            self._poses[other] = self._poses[key] * T
            self._covs[other] = chain_covariance(T, self._covs[key], cov)
            self._parent[other] = key
            reached.append(other)
        return reached

    def _cross(self, a: int, b: int) -> np.ndarray:
        """(3, 3) covariance between the errors of two poses, rows in the axes of a, columns in those of b."""
        ancestors = set(self._line(a))
        common = next(key for key in self._line(b) if key in ancestors)
        carry_a = adjoint(self._poses[a].between(self._poses[common]))
        carry_b = adjoint(self._poses[b].between(self._poses[common]))
        return carry_a @ self._covs[common] @ carry_b.T

    def _line(self, key: int):
        """The pose and its ancestors up to the root."""
        while key is not None:
            yield key
            key = self._parent.get(key)
