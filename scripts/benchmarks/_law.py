"""The law of a tracker's errors, fitted to a sample of them: sigma^2 = floor^2 + (slope * range)^2.

Maximum likelihood of zero-mean Gaussians, of all errors that there are. Errors are not clipped by their sigmas: where
the form does not hold (ranges err by the square of the range), that drops good measurements and hides the misfit; and
the large errors of a rig that is calibrated badly are what is to be measured.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from coopslam.errors import UnderDetermined

FEWEST = 8  # errors
LEAST_SHARE = 1e-12  # of the mean square: a variance that is none
MAD_TO_SIGMA = 1.4826  # of a Gaussian


@dataclass(frozen=True, slots=True)
class Line:
    """sigma^2 = floor^2 + (slope * range)^2."""

    floor: float  # unit of the errors
    slope: float  # the same per metre

    def variance(self, ranges_m: np.ndarray) -> np.ndarray:
        """(N,) at (N,) ranges."""
        return self.floor**2 + (self.slope * np.asarray(ranges_m)) ** 2


def fitted_line(errors: np.ndarray, ranges_m: np.ndarray, constant: bool = False) -> Line:
    """From (N,) errors at (N,) ranges. constant: the slope is zero.

    Raises UnderDetermined for too few errors, or when none of them is other than zero.
    """
    errors, ranges_m = np.asarray(errors, dtype=float), np.asarray(ranges_m, dtype=float)
    if len(errors) < FEWEST or not errors.any():
        raise UnderDetermined(f"{np.count_nonzero(errors)} errors; at least {FEWEST} expected to fit a law to")
    return Line(rms(errors), 0.0) if constant else _most_likely(errors, ranges_m)


def normalized_square(errors: np.ndarray, ranges_m: np.ndarray, line: Line) -> float:
    """Mean of e^2 / sigma^2: one where the law holds. NaN of none."""
    return float(np.mean(errors**2 / line.variance(ranges_m))) if len(errors) else np.nan


def resampled(fit: Callable[[np.ndarray], Sequence[float]], groups: np.ndarray, rng, draws: int) -> np.ndarray:
    """(draws, F) what `fit` makes of rows drawn with all of their group: the bootstrap over groups (Efron 1979).

    fit: takes (N,) indices of rows.  groups: (N,) labels of rows; errors within one are not independent.
    """
    own = [np.flatnonzero(groups == label) for label in np.unique(groups)]
    return np.array(
        [fit(np.concatenate([own[k] for k in rng.integers(len(own), size=len(own))])) for _ in range(draws)]
    )


def rms(errors: np.ndarray) -> float:
    """Root mean square; NaN of none."""
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else np.nan


def robust_sigma(errors: np.ndarray) -> float:
    """By the median absolute deviation from zero; NaN of none."""
    return MAD_TO_SIGMA * float(np.median(np.abs(errors))) if len(errors) else np.nan


def share_between(errors: np.ndarray, groups: np.ndarray) -> float:
    """Share of the mean square that is the same for all of a group: what averaging within it leaves. NaN if unknown.

    By the analysis of variance about zero: products of two different errors of one group estimate it without bias.
    """
    total, pairs = 0.0, 0
    for label in np.unique(groups):
        own = errors[groups == label]
        total += float(own.sum() ** 2 - np.sum(own**2))
        pairs += len(own) * (len(own) - 1)
    return float(total / pairs / np.mean(errors**2)) if pairs else np.nan


def _most_likely(errors: np.ndarray, ranges_m: np.ndarray) -> Line:
    """Searched for as variances, of floor and of slope at the rms range, in units of the mean square."""
    size, reach = rms(errors), rms(ranges_m)
    squares, by_slope = (errors / size) ** 2, (ranges_m / reach) ** 2

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        variance = x[0] + x[1] * by_slope
        by_variance = 0.5 * (1 / variance - squares / variance**2)
        value = 0.5 * np.mean(np.log(variance) + squares / variance)
        return float(value), np.array([np.mean(by_variance), np.mean(by_variance * by_slope)])

    bounds = [(LEAST_SHARE, None)] * 2
    tries = [minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in ((0.5, 0.5), (0.01, 1.0))]
    floor, slope = np.sqrt(min(tries, key=lambda one: one.fun).x)
    return Line(float(floor * size), float(slope * size / reach))
