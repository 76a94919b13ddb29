"""Do measurements miss by as much as their covariances say: residuals of a solved graph, innovations of a filter.

A squared normalized residual is r' R^-1 r, R the covariance of the measurement alone. In a solved graph it is smaller
than its dimension on average, as the solution has bent towards the measurement; by how much, the posterior tells. An
innovation is the miss before the measurement is used, normalized with its own covariance S = H P H' + R: its square
(NIS) has the dimension as its mean (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.stats import chi2

from coopslam.errors import BadInput
from coopslam.estimation.factor_kinds import kind_of
from coopslam.estimation.innovation_gate import Innovation
from coopslam.evaluation.consistency import chi_square_band

_QUANTILE = 0.95


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Of all measurements of one kind in a solved graph."""

    count: int
    dim: int  # of one measurement
    mean_per_dim: float  # of the squared normalized residuals, divided by their dimension
    expected_per_dim: float | None  # where all covariances are right; None: not asked for


@dataclass(frozen=True, slots=True)
class InnovationStatistics:
    """Of all measurements of one kind that a filter judged."""

    count: int
    dof: int  # of all together
    mean_per_dof: float  # 1 where all covariances are right
    band_per_dof: tuple[float, float]  # in which the mean lies with 95 % probability
    beyond_95: float  # share of innovations beyond the 95 % quantile of their chi-square distribution; 0.05 is right


def residual_statistics(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    joint_covariance: Callable[[Sequence[int]], np.ndarray] | None = None,
) -> dict[str, ResidualStatistics]:
    """Squared normalized residuals by kind of measurement (`kind_of`), at the solution of the graph.

    Robust losses are looked through: the residual has its full weight, and so false measurements show.
    joint_covariance: posterior of variables, e.g. `Covariances.joint` or `Estimate.joint_covariance`; it is asked once
    for each factor (0.3 ms), and what it raises is passed on.
    """
    squares, expected, dims = defaultdict(list), defaultdict(list), {}
    for factor in map(graph.at, range(graph.size())):
        kind = None if factor is None else kind_of(factor)
        if kind is None:
            continue
        dims[kind] = factor.dim()
        squares[kind].append(squared_residual(factor, values))
        if joint_covariance is not None:
            expected[kind].append(expected_square(factor, values, joint_covariance))
    return {
        kind: ResidualStatistics(
            len(squares[kind]),
            dim,
            float(np.mean(squares[kind])) / dim,
            float(np.mean(expected[kind])) / dim if expected else None,
        )
        for kind, dim in dims.items()
    }


def squared_residual(factor: gtsam.NoiseModelFactor, values: gtsam.Values) -> float:
    """r' R^-1 r; of a robust noise model that of the noise beneath the loss."""
    return _gaussian(factor.noiseModel()).squaredMahalanobisDistance(factor.unwhitenedError(values))


def expected_square(
    factor: gtsam.NoiseModelFactor, values: gtsam.Values, joint_covariance: Callable[[Sequence[int]], np.ndarray]
) -> float:
    """Expectation of `squared_residual` where the noise is as believed: dim - trace(R^-1 H P H').

    P is the posterior of the factor's variables. Summed over a graph it is rows less columns, exactly, as the traces
    are the diagonal of the projector onto what the variables can explain.  A measurement with the weight w of a robust
    loss bends the solution less: dim + (1 - 2 w) trace(R^-1 H P H'), exact where all weights are 0 or 1.
    """
    noise = factor.noiseModel()
    linear = factor.cloneWithNewNoiseModel(_gaussian(noise)).linearize(values)
    whitened = linear.jacobian()[0]
    explained = float(np.sum((whitened @ joint_covariance(list(linear.keys()))) * whitened))
    weight = noise.robust().weight(np.sqrt(squared_residual(factor, values))) if _is_robust(noise) else 1.0
    return factor.dim() + (1.0 - 2.0 * weight) * explained


def innovation_statistics(
    innovations: Iterable[Innovation],
) -> dict[str, InnovationStatistics]:
    """Squared normalized innovations by kind of measurement.

    The band is that of independent innovations: those of a consistent filter are white.
    Raises BadInput for a value that no innovation can have.
    """
    by_kind = defaultdict(list)
    for kind, nis, dof in innovations:
        if not (0.0 <= nis < np.inf and dof >= 1):
            raise BadInput(f"{kind}: an innovation of nis >= 0 and dof >= 1 expected, got {nis} and {dof}")
        by_kind[kind].append((nis, dof))
    return {kind: _innovation_statistics(*np.array(pairs).T) for kind, pairs in by_kind.items()}


def _innovation_statistics(nis: np.ndarray, dofs: np.ndarray) -> InnovationStatistics:
    """nis: (N,).  dofs: (N,)."""
    dof = int(dofs.sum())
    low, high = chi_square_band(dof, 1)
    beyond = float(np.mean(nis > chi2.ppf(_QUANTILE, dofs)))
    return InnovationStatistics(len(nis), dof, float(nis.sum()) / dof, (low / dof, high / dof), beyond)


def _is_robust(noise: gtsam.noiseModel.Base) -> bool:
    return isinstance(noise, gtsam.noiseModel.Robust)


def _gaussian(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    return noise.noise() if _is_robust(noise) else noise
