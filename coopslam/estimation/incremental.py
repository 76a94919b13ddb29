"""iSAM2: what the explorer drives with. The cost of an update depends on what changes, not on the run."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf

import gtsam
import numpy as np

from coopslam.errors import BadInput, UnderDetermined
from coopslam.estimation import deep_stack
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.gate import Gate, GateSettings
from coopslam.estimation.graph_check import in_words
from coopslam.estimation.keys import describe
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.records import Record
from coopslam.se2 import Pose2


@dataclass(frozen=True, slots=True)
class IncrementalSettings:
    """When iSAM2 relinearizes and how far it carries a change."""

    relinearize_threshold: float = 3e-3  # m or rad: what 3 mrad bend a 10 m lever is 45 micrometres
    wildfire_threshold: float = 1e-5  # m or rad: smaller changes are not carried on
    rounds: int = 3  # at most so many extra steps in an update that moved variables beyond the threshold

    def __post_init__(self):
        for name in ("relinearize_threshold", "wildfire_threshold"):
            if not 0 < getattr(self, name) < inf:
                raise BadInput(f"{name}: more than zero and finite expected, got {getattr(self, name)}")
        if self.rounds < 0:
            raise BadInput(f"rounds: zero or more expected, got {self.rounds}")


class Incremental:
    """Causal smoothing: each factor is given to iSAM2 once."""

    def __init__(
        self,
        robots: Iterable[str],
        landmarks: Iterable[str] = (),
        settings: IncrementalSettings = IncrementalSettings(),
        gate: GateSettings | None = None,
        timeline: TimelineSettings | None = None,
    ):
        self.timeline = Timeline(robots, landmarks, timeline)
        self.settings = settings
        self.graph = gtsam.NonlinearFactorGraph()  # everything so far, for a batch solve
        self.timing = 0.0  # s spent in updates
        self._isam = gtsam.ISAM2(_parameters(settings))
        self._gate = Gate(self.timeline, gate or GateSettings())
        self._estimate = IncrementalEstimate(self)

    def update(self, records: Iterable[Record]) -> Estimate:
        """Smooth with a further group of records. Raises UnderDetermined when a variable is not tied down."""
        began = time.perf_counter()
        records = list(records)
        refusals = self._gate.refusals(records, self._estimate)
        growth = self.timeline.extend(records, self._estimate.any_value, refusals)
        self.graph.push_back(growth.graph)
        self._smooth(growth.graph, growth.values)
        self._estimate.forget()
        self._estimate.keep_causal(growth.poses)
        self.timing += time.perf_counter() - began
        return self._estimate

    def values(self) -> gtsam.Values:
        """All variables as known now."""
        return self._ask(self._isam.calculateBestEstimate)

    def _smooth(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        if graph.size() == 0:
            return
        self._ask(self._isam.update, graph, values)
        for _ in range(self.settings.rounds):
            if self._ask(self._isam.update).getVariablesRelinearized() == 0:
                break

    def _ask(self, function, *arguments):
        """Call iSAM2 with room to recurse; its complaint about an open direction names the variable."""
        try:
            return deep_stack.call(function, *arguments, variables=len(self.timeline.stamps))
        except RuntimeError as error:
            raise in_words(error, self.graph, self._isam.getLinearizationPoint(), self.timeline.robots) from error


class IncrementalEstimate(Estimate):
    """A view of iSAM2; asks it only for what is asked."""

    def __init__(self, owner: Incremental):
        super().__init__(owner.timeline)
        self._owner = owner
        self._covariance_of: dict[int, np.ndarray] = {}

    def forget(self) -> None:
        """Drop what was computed before an update."""
        self._covariance_of = {}

    def value(self, key: int) -> Pose2:
        return self._told(self._owner._isam.calculateEstimatePose2, key)

    def point(self, key: int) -> np.ndarray:
        return self._told(self._owner._isam.calculateEstimatePoint2, key)

    def covariance(self, key: int) -> np.ndarray:
        if key not in self._covariance_of:
            self._covariance_of[key] = self._owner._ask(self._owner._isam.marginalCovariance, key)
        return self._covariance_of[key]

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        return self._owner._ask(self._owner._isam.jointMarginalCovariance, list(keys)).fullMatrix()

    def _told(self, function, key: int):
        try:
            return function(key)
        except IndexError as error:
            raise UnderDetermined(f"{describe(key, self.robots)} has no estimate: the update failed") from error

    def _covariances(self, keys: Sequence[int]) -> np.ndarray:
        """iSAM2's tree is as deep as the run is long; a balanced one answers for many poses faster."""
        covariances = Covariances(self._owner.graph, self._owner.values(), self.robots)
        return np.array(covariances.marginals(keys))


def _parameters(settings: IncrementalSettings) -> gtsam.ISAM2Params:
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")  # Cholesky takes a sigma 4 096 times another for an open direction
    parameters.relinearizeSkip = 1
    parameters.setRelinearizeThreshold(settings.relinearize_threshold)
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(settings.wildfire_threshold))
    return parameters
