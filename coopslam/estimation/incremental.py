"""iSAM2: what the explorer drives with. The cost of an update depends on what changes, not on the run."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Literal

import gtsam
import numpy as np

from coopslam.errors import BadInput, UnderDetermined, require_between
from coopslam.estimation import deep_stack
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.gate import Gate, GateSettings
from coopslam.estimation.graph_check import in_words
from coopslam.estimation.keys import describe, value_of
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.records import Record
from coopslam.se2 import Pose2


@dataclass(frozen=True, slots=True)
class IncrementalSettings:
    """When iSAM2 relinearizes and how far it carries a change."""

    relinearize_threshold: float = 3e-3  # m or rad: what 3 mrad bend a 10 m lever is 45 micrometres
    wildfire_threshold: float = 1e-5  # m or rad: smaller changes are not carried on
    relinearize_skip: int = 1  # updates between two looks at what has moved
    rounds: int = 3  # at most so many extra steps in an update that moved variables beyond the threshold
    # Cholesky is twice as fast, but takes a sigma 4 096 times another for an open direction; then QR goes on.
    factorization: Literal["QR", "CHOLESKY"] = "QR"

    def __post_init__(self):
        for name in ("relinearize_threshold", "wildfire_threshold"):
            if not 0 < getattr(self, name) < inf:
                raise BadInput(f"{name}: more than zero and finite expected, got {getattr(self, name)}")
        require_between(1, 1e6, relinearize_skip=self.relinearize_skip)
        require_between(0, 1000, rounds=self.rounds)


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
        self._isam = gtsam.ISAM2(_parameters(settings, settings.factorization))
        self._is_cholesky = settings.factorization == "CHOLESKY"
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
        return self._ask("calculateBestEstimate")

    def _smooth(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        if graph.size() == 0:
            return
        self._ask("update", graph, values)
        for _ in range(self.settings.rounds):
            if self._ask("update").getVariablesRelinearized() == 0:
                break

    def _ask(self, question: str, *arguments):
        """Call iSAM2 with room to recurse; its complaint about an open direction names the variable.

        When it was Cholesky that complained, everything so far goes into a smoother with QR, which is asked again.
        """
        try:
            return deep_stack.call(getattr(self._isam, question), *arguments, variables=len(self.timeline.stamps))
        except RuntimeError as error:
            if not self._is_cholesky:
                raise in_words(error, self.graph, self._isam.getLinearizationPoint(), self.timeline.robots) from error
        is_update = question == "update"
        self._go_on_with_qr(arguments[1] if is_update and arguments else gtsam.Values())
        return self._ask(question, *(() if is_update else arguments))

    def _go_on_with_qr(self, new: gtsam.Values) -> None:
        """All factors so far, from where they were linearized last."""
        values = self._isam.getLinearizationPoint()
        for key in filter(lambda key: not values.exists(key), new.keys()):
            values.insert(key, value_of(new, key))
        self._is_cholesky, self._isam = False, gtsam.ISAM2(_parameters(self.settings, "QR"))
        self._ask("update", self.graph, values)


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
            self._covariance_of[key] = self._owner._ask("marginalCovariance", key)
        return self._covariance_of[key]

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        return self._owner._ask("jointMarginalCovariance", list(keys)).fullMatrix()

    def _told(self, function, key: int):
        try:
            return function(key)
        except IndexError as error:
            raise UnderDetermined(f"{describe(key, self.robots)} has no estimate: the update failed") from error
        except RuntimeError as error:  # iSAM2 solves when it is first asked
            raise in_words(error, self._owner.graph, self._owner._isam.getLinearizationPoint(), self.robots) from error

    def _covariances(self, keys: Sequence[int]) -> np.ndarray:
        """iSAM2's tree is as deep as the run is long; a balanced one answers for many poses faster."""
        covariances = Covariances(self._owner.graph, self._owner.values(), self.robots)
        return np.array(covariances.marginals(keys))


def _parameters(settings: IncrementalSettings, factorization: str) -> gtsam.ISAM2Params:
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization(factorization)
    parameters.relinearizeSkip = settings.relinearize_skip
    parameters.setRelinearizeThreshold(settings.relinearize_threshold)
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(settings.wildfire_threshold))
    return parameters
