"""The final smoothing when fixes of the robot tracker may be false: truncated least squares.

It minimizes the sum of min(d^2, c^2) over the fixes, d^2 the squared Mahalanobis distance of a fix, beside the plain
squares of everything else, by graduated non-convexity: Yang, Antonante, Tzoumas, Carlone, Graduated Non-Convexity for
Robust Spatial Perception, RA-L 2020. In its solution a fix has its full weight or none, so the covariance, linearized
over those that count, stays honest; losses such as Huber's or Cauchy's take weight from good fixes as well. GTSAM's
`GncLMOptimizer` finds the same, several times slower: it solves to the end, from the beginning, at every step.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from coopslam.errors import BadInput, UnderDetermined, require_between
from coopslam.estimation.batch import optimize, solve_batch
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.keys import robot_index
from coopslam.estimation.ordering import nested_dissection

_STEPS_MAX = 60  # of graduation; from a residual of 1 km where 1 mm was expected it takes some 45
_LEAST_WEIGHT = 1e-12  # while it graduates: a robot may have no fix that counts, and has to be somewhere
_ROUNDS_MAX = 10  # of choosing the inliers of a solution and solving again


@dataclass(frozen=True, slots=True)
class RobustSettings:
    """Which fixes count, and how gradually that is decided."""

    # c^2, 3 degrees of freedom: one good fix in a hundred thousand is beyond; inf: every fix in the graph counts.
    distance_sq_max: float = field(default=25.9, metadata={"infinite": True})
    mu_factor: float = 2.0  # between two steps; the paper's 1.4 finds the same in twice the time
    iterations: int = 1  # of Levenberg-Marquardt at each step

    def __post_init__(self):
        if not self.distance_sq_max > 0:
            raise BadInput(f"distance_sq_max: more than zero expected, got {self.distance_sq_max}")
        if not 1 < self.mu_factor <= 100:
            raise BadInput(f"mu_factor: more than 1 and at most 100 expected, got {self.mu_factor}")
        require_between(1, 1000, iterations=self.iterations)


@dataclass(frozen=True, slots=True, eq=False)
class RobustSolution:
    """What is left when the false fixes are out: values, and the graph that they solve."""

    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph  # everything that counts; linearize it for covariances
    outliers: list[gtsam.NonlinearFactor]  # fixes that do not count
    thrown_out: int  # outliers that were in the graph
    taken_back: int  # fixes that had been refused and count now
    steps: int  # of graduation; 0: the plain solution was the answer


def solve_robust(
    graph: gtsam.NonlinearFactorGraph,
    refused: Sequence[gtsam.NonlinearFactor],
    initial: gtsam.Values,
    robots: Sequence[str] = (),
    settings: RobustSettings | None = None,
) -> RobustSolution:
    """Solve the graph, deciding on all fixes of the tracker again; everything else is true.

    refused: factors of fixes that are not in the graph (`Timeline.refused`); of variables that have no value they stay
    out.  robots: names for the messages.  Where no fix was refused and none is beyond the limit, this is `solve_batch`.
    Raises UnderDetermined as that does.
    """
    settings = settings or RobustSettings()
    values = plain = solve_batch(graph, initial, robots)
    known = [all(map(values.exists, factor.keys())) for factor in refused]
    problem = _Problem(graph, list(compress(refused, known)))
    limit = settings.distance_sq_max
    if problem.accepted.all() and (problem.distances_sq(values) <= limit).all():
        return RobustSolution(values, graph, list(refused), 0, 0, 0)
    graduated, steps = _graduate(problem, values, settings)
    if problem.cost(graduated, limit) < problem.cost(values, limit):
        values = graduated
    try:
        values, inliers = _settle(problem, values, limit, robots)
        _require_tied_down(problem, values, inliers, robots)
    except UnderDetermined:  # those that fit leave somebody without any: then those of the graph count, as they are
        values, inliers = plain, problem.accepted
    return RobustSolution(
        values,
        problem.graph(inliers.astype(float)),
        [*compress(problem.fixes, ~inliers), *compress(refused, np.logical_not(known))],
        thrown_out=int(np.sum(problem.accepted & ~inliers)),
        taken_back=int(np.sum(~problem.accepted & inliers)),
        steps=steps,
    )


def is_tracker_fix(factor: gtsam.NonlinearFactor) -> bool:
    """Whether a factor ties the poses of two robots with all three degrees of freedom."""
    if not isinstance(factor, gtsam.BetweenFactorPose2):
        return False
    a, b = map(robot_index, factor.keys())
    return a is not None and b is not None and a != b


class _Problem:
    """All factors: the fixes in question, and what is known to be true."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, refused: Sequence[gtsam.NonlinearFactor]):
        self.fixes, self.known = [], gtsam.NonlinearFactorGraph()
        for i in range(graph.size()):
            factor = graph.at(i)
            if is_tracker_fix(factor):
                self.fixes.append(factor)
            elif factor is not None:
                self.known.push_back(factor)
        self.accepted = np.arange(len(self.fixes) + len(refused)) < len(self.fixes)
        self.fixes += refused
        self._roots = [fix.noiseModel().R() for fix in self.fixes]
        self.ordering = nested_dissection(self.graph(np.ones(len(self.fixes))))

    def distances_sq(self, values: gtsam.Values) -> np.ndarray:
        """(N,) squared Mahalanobis distances of the fixes."""
        return np.array([2 * fix.error(values) for fix in self.fixes])

    def cost(self, values: gtsam.Values, limit: float) -> float:
        """The truncated sum of squares."""
        return 2 * self.known.error(values) + float(np.minimum(self.distances_sq(values), limit).sum())

    def graph(self, weights: np.ndarray) -> gtsam.NonlinearFactorGraph:
        """Everything, each fix with its weight in [0, 1] of (N,)."""
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self.known)
        for fix, root, weight in zip(self.fixes, self._roots, weights.tolist(), strict=True):
            if weight == 1.0:
                graph.push_back(fix)
            elif weight > 0.0:
                noise = gtsam.noiseModel.Gaussian.SqrtInformation(np.sqrt(weight) * root)
                graph.push_back(gtsam.BetweenFactorPose2(*fix.keys(), fix.measured(), noise))
        return graph


def _graduate(problem: _Problem, values: gtsam.Values, settings: RobustSettings) -> tuple[gtsam.Values, int]:
    """From a nearly convex cost to the truncated one (the paper's algorithm 1), and the number of steps."""
    limit = settings.distance_sq_max
    squares = problem.distances_sq(values)
    mu = limit / max(2 * squares.max() - limit, limit)  # remark 5
    steps, weights = 0, None
    while steps < _STEPS_MAX and not np.array_equal(weights, squares <= limit):
        weights = truncated_weights(squares, limit, mu)
        held = problem.graph(np.maximum(weights, _LEAST_WEIGHT))
        values = optimize(held, values, problem.ordering, settings.iterations)
        squares = problem.distances_sq(values)
        steps, mu = steps + 1, mu * settings.mu_factor
    return values, steps


def truncated_weights(squares: np.ndarray, limit: float, mu: float) -> np.ndarray:
    """Weights of residuals in the surrogate of control parameter mu (the paper's equation 14).

    squares: (N,) squared residuals.  limit: c^2.  mu: near 0 for a convex surrogate, large for the truncated square.
    """
    weights = np.sqrt(limit * mu * (mu + 1) / np.maximum(squares, 1e-12)) - mu
    weights[squares <= limit * mu / (mu + 1)] = 1.0
    weights[squares >= limit * (mu + 1) / mu] = 0.0
    return np.clip(weights, 0.0, 1.0)


def _settle(
    problem: _Problem, values: gtsam.Values, limit: float, robots: Sequence[str]
) -> tuple[gtsam.Values, np.ndarray]:
    """Solve with the fixes within the limit until they stay the same; values and (N,) which of them count."""
    inliers = problem.distances_sq(values) <= limit
    for _ in range(_ROUNDS_MAX):
        values = solve_batch(problem.graph(inliers.astype(float)), values, robots)
        chosen = problem.distances_sq(values) <= limit
        if np.array_equal(chosen, inliers):
            break
        inliers, former = chosen, inliers
    else:
        inliers = former  # it swings between two choices: what was solved last
    return values, inliers


def _require_tied_down(problem: _Problem, values: gtsam.Values, inliers: np.ndarray, robots: Sequence[str]) -> None:
    """Raises UnderDetermined when the fixes that count leave a direction open; `solve_batch` only counts equations.

    Odometry holds each robot's poses together: nothing is open while the same robots hang together by fixes.
    """
    pairs = np.array([list(map(robot_index, fix.keys())) for fix in problem.fixes])
    if _groups(pairs[inliers], pairs.max() + 1) > _groups(pairs, pairs.max() + 1):
        Covariances(problem.graph(inliers.astype(float)), values, robots).require_all()


def _groups(pairs: np.ndarray, size: int) -> int:
    """Number of connected groups among so many robots.  pairs: (N, 2) their indices."""
    ties = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    return connected_components(ties, directed=False)[0]
