"""Marginal and joint covariances of a solved graph, from its square root by QR.

`gtsam.Marginals` offers no choice of ordering, and COLAMD recurses as deep as a chain is long; a METIS ordering gives
an elimination tree of logarithmic depth. GTSAM's own marginals eliminate again by Cholesky, which refuses a graph whose
sigmas are 10^4 apart, or is wrong by some per cent. So the square root is all that is taken from it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from coopslam.errors import UnderDetermined
from coopslam.estimation.graph_check import in_words
from coopslam.estimation.ordering import nested_dissection

_SINGULAR = 1e-14  # of the largest diagonal element of the square root: what rounding leaves of a zero


@dataclass(frozen=True, slots=True, eq=False)
class _Conditional:
    """What is left of a variable x when those before it are eliminated: R x + S p = noise of unit covariance."""

    R_inverse: np.ndarray  # (d, d)
    S: np.ndarray  # (d, sum of the parents' dimensions)
    parents: list[int]  # places of later variables in the ordering, ascending


class Covariances:
    """The linearized graph, eliminated once. Its methods raise UnderDetermined where nothing ties a variable down."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, robots: Sequence[str] = ()):
        self._graph, self._values, self._robots = graph, values, robots
        self._eliminate(graph.linearize(values))

    @classmethod
    def of_linear(cls, linear: gtsam.GaussianFactorGraph, robots: Sequence[str] = ()) -> "Covariances":
        """Those of a graph that is linear already."""
        covariances = cls.__new__(cls)
        covariances._graph, covariances._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        covariances._robots = robots
        covariances._eliminate(linear)
        return covariances

    def _eliminate(self, linear: gtsam.GaussianFactorGraph) -> None:
        try:
            self._net = linear.eliminateSequential(nested_dissection(linear), gtsam.EliminateQR)
        except RuntimeError as error:
            raise in_words(error, self._graph, self._values, self._robots) from error
        self._place, self._scale = {}, 0.0
        for i in range(self._net.size()):
            conditional = self._net.at(i)
            self._place[conditional.firstFrontalKey()] = i  # not always its place in the ordering
            self._scale = max(self._scale, float(np.abs(conditional.R().diagonal()).max()))
        self._conditionals: dict[int, _Conditional] = {}
        self._families: dict[int, tuple[np.ndarray, dict[int, slice]]] = {}

    def require_all(self) -> None:
        """Raises UnderDetermined when any variable is not tied down: elimination may pass over an open direction."""
        for place in range(self._net.size()):
            self._conditional(place)

    def marginal(self, key: int) -> np.ndarray:
        """(d, d) covariance of a variable in its own axes."""
        place = self._place_of(key)
        lacking, later = [], place
        while later not in self._families:
            lacking.append(later)
            parents = self._conditional(later).parents
            if not parents:
                break
            later = parents[0]
        for later in reversed(lacking):
            self._families[later] = self._family(later)
        cov, columns = self._families[place]
        return cov[columns[place], columns[place]].copy()

    def marginals(self, keys: Sequence[int]) -> list[np.ndarray]:
        """The covariances of many variables, each in its own axes; one costs as much as all between it and the root."""
        return [self.marginal(key) for key in keys]

    def joint(self, keys: Sequence[int]) -> np.ndarray:
        """Joint covariance of different variables, blocks in the order asked, each in its own axes.

        Y'Y with R'Y = U, for the columns U of the identity that belong to the keys: they reach only what lies between
        the keys and the root of the elimination tree.
        """
        places = [self._place_of(key) for key in keys]
        visited = sorted(set().union(*map(self._path, places)))
        dims = [len(self._conditional(place).R_inverse) for place in visited]
        ends = np.cumsum(dims)
        rows = {place: slice(end - dim, end) for place, dim, end in zip(visited, dims, ends, strict=True)}
        wanted = np.concatenate([np.arange(rows[place].start, rows[place].stop) for place in places])
        solution = np.zeros((ends[-1], len(wanted)))
        solution[wanted, np.arange(len(wanted))] = 1.0
        for place in visited:
            conditional = self._conditional(place)
            own = solution[rows[place]] = conditional.R_inverse.T @ solution[rows[place]]
            carried, column = conditional.S.T @ own, 0
            for parent in conditional.parents:
                block = rows[parent]
                solution[block] -= carried[column : column + block.stop - block.start]
                column += block.stop - block.start
        return solution.T @ solution

    def _place_of(self, key: int) -> int:
        if key not in self._place:
            raise UnderDetermined("a variable has no estimate: the update that made it failed")
        return self._place[key]

    def _path(self, place: int) -> list[int]:
        """A variable and those between it and the root; all its parents, and theirs, are among them."""
        path = [place]
        while parents := self._conditional(path[-1]).parents:
            path.append(parents[0])
        return path

    def _conditional(self, place: int) -> _Conditional:
        found = self._conditionals.get(place)
        if found is None:
            found = self._conditionals[place] = self._taken(self._net.at(place))
        return found

    def _taken(self, conditional: gtsam.GaussianConditional) -> _Conditional:
        """Out of GTSAM, the parents in the order of elimination."""
        R, S, keys = conditional.R(), conditional.S(), conditional.keys()
        if np.abs(np.diagonal(R)).min() <= _SINGULAR * self._scale:
            error = RuntimeError(f"Indeterminant linear system near variable {keys[0]}")
            raise in_words(error, self._graph, self._values, self._robots) from error
        parents = [self._place[key] for key in keys[1:]]
        if parents != sorted(parents):
            dims = [len(self._net.at(parent).R()) for parent in parents]
            blocks = np.split(S, np.cumsum(dims)[:-1], axis=1)
            order = np.argsort(parents)
            S, parents = np.hstack([blocks[i] for i in order]), [parents[i] for i in order]
        return _Conditional(np.linalg.inv(R), S, parents)

    def _family(self, place: int) -> tuple[np.ndarray, dict[int, slice]]:
        """Joint covariance of a variable and its parents, and where each stands in it.

        The parents are all among the family of the first of them (Takahashi, Fagan and Chin 1973).
        """
        conditional = self._conditional(place)
        dim = len(conditional.R_inverse)
        if not conditional.parents:
            return conditional.R_inverse @ conditional.R_inverse.T, {place: slice(0, dim)}
        cov, columns = self._families[conditional.parents[0]]
        within = np.concatenate([np.arange(columns[p].start, columns[p].stop) for p in conditional.parents])
        of_parents = cov[within[:, None], within]
        slope = -conditional.R_inverse @ conditional.S
        across = slope @ of_parents
        family = np.empty((dim + len(within),) * 2)
        family[:dim, :dim] = across @ slope.T + conditional.R_inverse @ conditional.R_inverse.T
        family[:dim, dim:], family[dim:, :dim], family[dim:, dim:] = across, across.T, of_parents
        places, end = {place: slice(0, dim)}, dim
        for parent in conditional.parents:
            size = columns[parent].stop - columns[parent].start
            places[parent] = slice(end, end + size)
            end += size
        return family, places
