"""The variables that a fixed-lag smoother still moves, and a prior for all that has left.

Gauss-Newton linearizes the window anew in every iteration; what leaves is eliminated and never linearized again.
"""

from collections.abc import Callable, Iterable, Sequence

import gtsam
import numpy as np

from coopslam.errors import UnderDetermined
from coopslam.estimation import deep_stack
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.keys import describe
from coopslam.estimation.marginal_prior import MarginalPrior, eliminated

_ELIMINATED_AT_ONCE = 40  # poses; elimination is dense, and many poses leave when a robot is placed late
_HALVINGS = 8  # of a step that raises the cost


class LagWindow:
    """Values, factors and the prior; after `descend` the covariances of its last linearization."""

    def __init__(self, robots: Sequence[str], landmarks: Sequence[str]):
        """Names, for the messages."""
        self.values = gtsam.Values()
        self.factors: list[tuple[gtsam.NonlinearFactor, list[int]]] = []  # with their keys
        self.prior: MarginalPrior | None = None
        self._robots, self._landmarks = robots, landmarks
        self._system: gtsam.GaussianFactorGraph | None = None  # what was solved last
        self._tree: gtsam.GaussianBayesTree | None = None  # the same, eliminated
        self._exact: Covariances | None = None  # the same by QR, where the tree fails
        self._is_stiff = False  # sigmas so far apart that Cholesky loses the large ones
        self._size = 0  # variables that were solved last

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        """A factor of variables in the window."""
        self.factors.append((factor, factor.keys()))

    def tied(self) -> set[int]:
        """Keys of all variables with a factor of their own."""
        return {key for _, keys in self.factors for key in keys}

    def require_tied_down(self) -> None:
        """Raises UnderDetermined when a direction is open. Elimination may take what rounding leaves for a factor."""
        Covariances.of_linear(self._linear(self._graph()), self._robots).require_all()

    # ---- the minimum ----

    def descend(self, rounds: int, step_threshold: float) -> None:
        """Gauss-Newton until a step is small; one that raises the cost is halved until it does not.

        rounds: at most so many steps.  step_threshold: m or rad.  Raises RuntimeError, GTSAM's, for an open direction.
        """
        self._size, self._exact = self.values.size(), None
        try:
            deep_stack.call(self._descend, rounds, step_threshold, variables=self._size)
        except RuntimeError:
            self._tree = None
            raise

    def _descend(self, rounds: int, step_threshold: float) -> None:
        graph = self._graph()
        cost, ordering = self._cost(graph, self.values), None
        for _ in range(rounds):
            linear = self._linear(graph)
            ordering = ordering or gtsam.Ordering.ColamdGaussianFactorGraph(linear)  # better than METIS when small
            tree, self._is_stiff = _elimination(linear, ordering)
            step = tree.optimize()
            self._system, self._tree = linear, tree
            for _ in range(_HALVINGS):
                moved = self.values.retract(step)
                cost_moved = self._cost(graph, moved)
                if cost_moved <= cost * (1 + 1e-9) + 1e-9:
                    break
                step = step.scale(0.5)
            else:
                return
            self.values, cost = moved, cost_moved
            if np.abs(step.vector()).max() < step_threshold:
                return

    def _graph(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for factor, _ in self.factors:
            graph.push_back(factor)
        return graph

    def _cost(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> float:
        return graph.error(values) + (0.0 if self.prior is None else self.prior.cost(values))

    def _linear(self, graph: gtsam.NonlinearFactorGraph) -> gtsam.GaussianFactorGraph:
        linear = graph.linearize(self.values)
        if self.prior is not None:
            linear.push_back(self.prior.linearized(self.values))
        return linear

    # ---- covariances ----

    def covariance(self, key: int) -> np.ndarray:
        """(d, d) in the variable's own axes. Raises UnderDetermined where nothing tells."""
        return self._told([key], lambda tree: tree.marginalCovariance(key), lambda exact: exact.marginal(key))

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        """Blocks in the order asked, each as `covariance` gives it. Raises UnderDetermined where nothing tells."""
        return self._told(
            keys, lambda tree: tree.jointMarginalCovariance(list(keys)).fullMatrix(), lambda exact: exact.joint(keys)
        )

    def _told(
        self, keys: Sequence[int], ask_tree: Callable[..., np.ndarray], ask_exact: Callable[..., np.ndarray]
    ) -> np.ndarray:
        """By the tree, which uses Cholesky; by QR, far slower, where that gave up, as what it tells is wrong then."""
        if self._tree is None:
            raise UnderDetermined(f"{self._names(keys)}: no covariance, the update failed")
        if not self._is_stiff:
            try:
                return deep_stack.call(ask_tree, self._tree, variables=self._size)
            except IndexError as error:
                raise UnderDetermined(f"{self._names(keys)}: no covariance, nothing ties it down") from error
            except RuntimeError:
                self._is_stiff = True
        if self._exact is None:
            self._exact = Covariances.of_linear(self._system, self._robots)
        return ask_exact(self._exact)

    def _names(self, keys: Iterable[int]) -> str:
        return ", ".join(describe(key, self._robots, self._landmarks) for key in keys)

    # ---- what leaves ----

    def eliminate(self, leaving: Sequence[int]) -> None:
        """Poses leave, the oldest first; a prior on what remains stays. Raises RuntimeError for an open direction."""
        for start in range(0, len(leaving), _ELIMINATED_AT_ONCE):
            self._eliminate(leaving[start : start + _ELIMINATED_AT_ONCE])

    def _eliminate(self, leaving: Sequence[int]) -> None:
        gone = set(leaving)
        touched = gtsam.NonlinearFactorGraph()
        kept = []
        for factor, keys in self.factors:
            if gone.isdisjoint(keys):
                kept.append((factor, keys))
            else:
                touched.push_back(factor)
        self.prior = eliminated(self._linear(touched), self.values, leaving)
        self.factors = kept
        for key in leaving:
            self.values.erase(key)


def _elimination(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> tuple[gtsam.GaussianBayesTree, bool]:
    """The Bayes tree by Cholesky, or by QR, half as fast, where that sees an open direction; and whether it was QR."""
    try:
        return linear.eliminateMultifrontal(ordering), False
    except RuntimeError:
        return linear.eliminateMultifrontal(ordering, gtsam.EliminateQR), True
