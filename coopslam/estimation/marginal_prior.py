"""What eliminated variables say about those that remain: a Gaussian in the coordinates of the frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import qr

from coopslam.estimation.keys import is_landmark, value_of
from coopslam.se2 import planar_rotation, wrap, xytheta


@dataclass(frozen=True, slots=True, eq=False)
class MarginalPrior:
    """The cost |root (X - at) - rest|^2 / 2 of X, the stacked x, y, theta of poses and x, y of landmarks.

    The axes are those of the frame and not of a pose that turns later, so the function stays what it was wherever it is
    asked for, and another elimination carries it over without loss. Its derivative by a right perturbation of a pose
    is exact: perturbations are turned by the pose's heading now.
    """

    keys: tuple[int, ...]
    root: np.ndarray  # (m, n): square root of the information; m <= n
    rest: np.ndarray  # (m,)
    at: np.ndarray  # (n,) where it was linearized

    def linearized(self, values: gtsam.Values) -> gtsam.GaussianConditional:
        """As a linear factor: the only kind with any number of keys that Python can make is a conditional."""
        terms = [
            (key, self.root[:, columns] if is_landmark(key) else self.root[:, columns] @ _turn(values, key))
            for key, columns in zip(self.keys, _columns(self.keys), strict=True)
        ]
        return gtsam.GaussianConditional(
            terms, 1, -self._residual(values), gtsam.noiseModel.Unit.Create(len(self.root))
        )

    def cost(self, values: gtsam.Values) -> float:
        """Half the squared residual."""
        residual = self._residual(values)
        return float(residual @ residual) / 2

    def _residual(self, values: gtsam.Values) -> np.ndarray:
        """(m,)"""
        apart = _coordinates(values, self.keys) - self.at
        headings = _headings(self.keys)
        apart[headings] = wrap(apart[headings])
        return self.root @ apart - self.rest


def eliminated(linear: gtsam.GaussianFactorGraph, values: gtsam.Values, leaving: Sequence[int]) -> MarginalPrior | None:
    """What a linear graph says of its other variables once the leaving poses are eliminated; None without others.

    values: where it was linearized. By a dense QR decomposition [A b] = Q R, the leaving columns first: the rows of R
    below theirs are the marginal (Golub and Plemmons 1980), and nothing is squared.
    """
    gone = set(leaving)
    remaining = tuple(key for key in linear.keyVector() if key not in gone)
    if not remaining:
        return None
    ordering = gtsam.Ordering()
    for key in (*leaving, *remaining):
        ordering.push_back(key)
    stacked = linear.augmentedJacobian(ordering)
    (triangle,) = qr(stacked, mode="r", overwrite_a=True, check_finite=False)
    first = 3 * len(leaving)
    rows = triangle[first : stacked.shape[1] - 1, first:]
    if not len(rows):
        return None
    root, rest = rows[:, :-1].copy(), rows[:, -1].copy()
    for key, columns in zip(remaining, _columns(remaining), strict=True):
        if not is_landmark(key):
            root[:, columns] = root[:, columns] @ _turn(values, key).T
    return MarginalPrior(remaining, root, rest, _coordinates(values, remaining))


def _turn(values: gtsam.Values, key: int) -> np.ndarray:
    """(3, 3) from a right perturbation of a pose to its x, y, theta."""
    return planar_rotation(values.atPose2(key).theta())


def _coordinates(values: gtsam.Values, keys: Sequence[int]) -> np.ndarray:
    parts = [value_of(values, key) for key in keys]
    return np.concatenate([part if isinstance(part, np.ndarray) else xytheta(part) for part in parts])


def _sizes(keys: Sequence[int]) -> list[int]:
    return [2 if is_landmark(key) else 3 for key in keys]


def _columns(keys: Sequence[int]) -> list[slice]:
    ends = np.cumsum(_sizes(keys)).tolist()
    return [slice(end - size, end) for end, size in zip(ends, _sizes(keys), strict=True)]


def _headings(keys: Sequence[int]) -> np.ndarray:
    """Places of the headings among the coordinates."""
    return np.array([columns.stop - 1 for columns in _columns(keys) if columns.stop - columns.start == 3], int)
