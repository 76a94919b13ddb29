"""Levenberg-Marquardt over everything: the reference."""

import time
from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from coopslam.estimation import graph_check
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.gate import Gate, GateSettings
from coopslam.estimation.timeline import Timeline
from coopslam.records import Record
from coopslam.se2 import Pose2

RELATIVE_TOLERANCE = 1e-9  # of the cost, between two iterations
ABSOLUTE_TOLERANCE = 1e-9
MAX_ITERATIONS = 100


def solve_batch(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, robots: Sequence[str] = ()) -> gtsam.Values:
    """The values of least cost near the initial ones. Raises UnderDetermined before solving.

    robots: names for the messages. METIS ordering: COLAMD overflows the stack on long chains.
    """
    graph_check.check(graph, initial, robots)
    return optimize(graph, initial)


def optimize(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    ordering: gtsam.Ordering | None = None,
    iterations: int = MAX_ITERATIONS,
) -> gtsam.Values:
    """Levenberg-Marquardt without a check of the graph.

    ordering: of the variables, for graphs of one structure that are solved again and again.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    if ordering is None:
        parameters.setOrderingType("METIS")
    else:
        parameters.setOrdering(ordering)
    parameters.setLinearSolverType(
        "MULTIFRONTAL_QR"
    )  # Cholesky takes a sigma 4 096 times another for an open direction
    parameters.setRelativeErrorTol(RELATIVE_TOLERANCE)
    parameters.setAbsoluteErrorTol(ABSOLUTE_TOLERANCE)
    parameters.setMaxIterations(iterations)
    return gtsam.LevenbergMarquardtOptimizer(graph, initial, parameters).optimize()


def chi_square(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[float, int]:
    """Squared normalized residuals of a solved graph, and its degrees of freedom, which is what they should be."""
    factors = [graph.at(i) for i in range(graph.size())]
    rows = sum(factor.dim() for factor in factors if factor is not None)
    return 2 * graph.error(values), rows - values.dim()


class Batch:
    """Solves everything again at each update, from where the last solution was."""

    def __init__(self, robots: Iterable[str], gate: GateSettings | None = None):
        self.timeline = Timeline(robots)
        self.graph = gtsam.NonlinearFactorGraph()
        self.timing = 0.0  # s spent in updates
        self._causal: dict[int, Pose2] = {}
        self._values = gtsam.Values()
        self._estimate = BatchEstimate(self.timeline, self.graph, self._values, self._causal)
        self._gate = Gate(self.timeline, gate or GateSettings())

    def update(self, records: Iterable[Record]) -> Estimate:
        """Solve with a further group of records. Raises UnderDetermined when a variable is not tied down."""
        began = time.perf_counter()
        records = list(records)
        refusals = self._gate.refusals(records, self._estimate)
        growth = self.timeline.extend(records, self._values.atPose2, refusals)
        self.graph.push_back(growth.graph)
        self._values.insert(growth.values)
        if growth.graph.size():
            self._values = solve_batch(self.graph, self._values, self.timeline.robots)
        self._estimate = BatchEstimate(self.timeline, self.graph, self._values, self._causal)
        self._estimate.keep_causal(growth.poses)
        self.timing += time.perf_counter() - began
        return self._estimate

    def values(self) -> gtsam.Values:
        """All variables as known now."""
        return gtsam.Values(self._values)


class BatchEstimate(Estimate):
    """A solved graph; it is eliminated for covariances once, when the first is asked."""

    def __init__(
        self,
        timeline: Timeline,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        causal: dict[int, Pose2] | None = None,
    ):
        """values: a solution of the graph; both as the timeline handed them out."""
        super().__init__(timeline, causal)
        self._graph, self._values = graph, values
        self._covariances_of: Covariances | None = None

    def value(self, key: int) -> Pose2:
        return self._values.atPose2(key)

    def covariance(self, key: int) -> np.ndarray:
        return self._solved().marginal(key)

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        return self._solved().joint(keys)

    def _solved(self) -> Covariances:
        if self._covariances_of is None:
            self._covariances_of = Covariances(self._graph, self._values, self.robots)
        return self._covariances_of
