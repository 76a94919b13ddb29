"""Marginal and joint covariances of a solved graph.

`gtsam.Marginals` offers no choice of ordering, and COLAMD recurses as deep as a chain is long; a METIS
ordering gives a tree of logarithmic depth.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from coopslam.errors import UnderDetermined
from coopslam.estimation.graph_check import in_words


class Covariances:
    """The linearized graph, eliminated once. Its methods raise UnderDetermined where nothing ties a variable down."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, robots: Sequence[str] = ()):
        linear = graph.linearize(values)
        ordering = gtsam.Ordering.MetisGaussianFactorGraph(linear)
        self._graph, self._values, self._robots = graph, values, robots
        self._tree = self._told(linear.eliminateMultifrontal, ordering, gtsam.EliminateQR)

    def marginal(self, key: int) -> np.ndarray:
        """(d, d) covariance of a variable in its own axes."""
        return self._told(self._tree.marginalCovariance, key)

    def joint(self, keys: Sequence[int]) -> np.ndarray:
        """Joint covariance of different variables, blocks in the order asked, each in its own axes."""
        return self._told(self._tree.jointMarginalCovariance, list(keys)).fullMatrix()

    def _told(self, function, *arguments):
        try:
            return function(*arguments)
        except IndexError as error:
            raise UnderDetermined("a variable has no estimate: the update that made it failed") from error
        except RuntimeError as error:
            raise in_words(error, self._graph, self._values, self._robots) from error
