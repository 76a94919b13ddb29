"""Levenberg-Marquardt over everything: the reference."""

import time
from collections.abc import Iterable, Sequence
from math import inf, sqrt

import gtsam
import numpy as np

from coopslam.estimation import graph_check
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.gate import Gate, GateSettings
from coopslam.estimation.ordering import nested_dissection
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.records import Record
from coopslam.se2 import Pose2

RELATIVE_TOLERANCE = 1e-9  # of the cost, between two iterations
ABSOLUTE_TOLERANCE = 1e-9
SIGMA_TOLERANCE = 0.05  # where robust losses make convergence slow: how far from the minimum any variable may stay
MAX_ITERATIONS = 100

_FAST = ("MULTIFRONTAL_SOLVER", "MULTIFRONTAL_CHOLESKY")  # the first is faster, and gives up more easily
_LARGE = 5_000  # variables; below, the first is no faster either
_FEW = 10  # iterations; a change of solver pays only beyond
_LAST = 3  # iterations with QR that there always may be
_SLOW = 0.25  # each decrease of the cost at least so much of the one before: no Gauss-Newton in its last steps
_LIGHT_DAMPING = 1e-5  # lambda; GTSAM's first, which no variable feels that is known better than 300 m or rad


def solve_batch(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, robots: Sequence[str] = ()) -> gtsam.Values:
    """The values of least cost near the initial ones. Raises UnderDetermined before solving.

    robots: names for the messages.
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

    ordering: of the variables, for graphs of one structure that are solved again and again; `nested_dissection`
    without one.  iterations: at most so many with both linear solvers, but for the last few.
    Cholesky goes most of the way and QR, half as fast, the last step or all that is left: GTSAM's Cholesky takes a
    sigma 4 096 times another for an open direction. So it is always QR that finds nothing left to gain.
    """
    if ordering is None:
        ordering = nested_dissection(graph)
    descent = _Descent(graph, initial, ordering)
    if iterations > _FEW:
        for solver in _FAST if initial.size() > _LARGE else _FAST[1:]:
            try:
                descent.run(solver, iterations, is_last=False)
                break
            except RuntimeError:  # the start of an open direction, it thinks, or a noise model that it does not know
                continue
    descent.run("MULTIFRONTAL_QR", max(iterations - descent.iterations, min(iterations, _LAST)), is_last=True)
    return descent.values


class _Descent:
    """Levenberg-Marquardt that may change its linear solver on the way."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, ordering: gtsam.Ordering):
        self.values, self.iterations = initial, 0
        self._graph, self._ordering = graph, ordering
        self._cost, self._decrease = graph.error(initial), inf  # before the last iteration, and what that brought

    def run(self, solver: str, iterations: int, is_last: bool) -> None:
        """Iterate until it is time to stop; what was gained stays when the solver raises RuntimeError."""
        if self._cost <= ABSOLUTE_TOLERANCE:
            return  # it cannot become less than zero
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolver(getattr(gtsam.LevenbergMarquardtParams.LinearSolverType, solver))
        parameters.setOrdering(self._ordering)
        parameters.setRelativeErrorTol(RELATIVE_TOLERANCE)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self._graph, self.values, parameters)
        try:
            for _ in range(iterations):
                optimizer.iterate()
                self.iterations += 1
                former, self._decrease = self._decrease, self._cost - optimizer.error()
                self._cost = optimizer.error()
                if self._is_time_to_stop(former, optimizer.lambda_(), is_last):
                    break
        finally:
            self.values = optimizer.values()

    def _is_time_to_stop(self, former: float, damping: float, is_last: bool) -> bool:
        """Whether the iterations to come, which gain by the ratio of the last two, would gain nothing that matters.

        A cost that can decrease by g around its minimum, where its second derivative is A, is x with x' A x = 2 g away.
        Robust losses are linearized with an H > A; each step leaves at most q x, A >= (1 - q) H, and decreases shrink
        by q^2. So |x_i|^2 / sigma_i^2 <= x' H x (Cauchy-Schwarz) <= 2 g / (1 - q).
        """
        if self._decrease <= max(ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE * self._cost):
            return True
        if damping > _LIGHT_DAMPING or former <= 0 or (is_last and former == inf):
            return False
        ratio = 0.5 if former == inf else self._decrease / former
        if ratio >= 1 or (is_last and ratio < _SLOW):
            return False
        gain = self._decrease * ratio / (1 - ratio)
        return 2 * gain / (1 - sqrt(ratio)) <= SIGMA_TOLERANCE**2


def chi_square(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[float, int]:
    """Squared normalized residuals of a solved graph, and its degrees of freedom, which is what they should be."""
    factors = [graph.at(i) for i in range(graph.size())]
    rows = sum(factor.dim() for factor in factors if factor is not None)
    return 2 * graph.error(values), rows - values.dim()


class Batch:
    """Solves everything again at each update, from where the last solution was."""

    def __init__(
        self,
        robots: Iterable[str],
        landmarks: Iterable[str] = (),
        gate: GateSettings | None = None,
        timeline: TimelineSettings | None = None,
    ):
        self.timeline = Timeline(robots, landmarks, timeline)
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
        growth = self.timeline.extend(records, self._estimate.any_value, refusals)
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
        self.graph, self.values = graph, values
        self._covariances_of: Covariances | None = None

    def value(self, key: int) -> Pose2:
        return self.values.atPose2(key)

    def point(self, key: int) -> np.ndarray:
        return self.values.atPoint2(key)

    def covariance(self, key: int) -> np.ndarray:
        return self._solved().marginal(key)

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        return self._solved().joint(keys)

    def _covariances(self, keys: Sequence[int]) -> np.ndarray:
        return np.array(self._solved().marginals(keys))

    def _solved(self) -> Covariances:
        if self._covariances_of is None:
            self._covariances_of = Covariances(self.graph, self.values, self.robots)
        return self._covariances_of
