"""The paper's own localization, equation (1): two estimates of a robot, weighted as if they were independent.

The robot that has moved has an estimate by odometry, X_odom with covariance P_odom. The other robot, which stands, and
the tracker between them give a second one, X_stat + X_track. In the paper's scalar form

    X = (w_t (X_track + X_stat) + w_o X_odom) / (w_t + w_o),

its sigma_s and sigma_o being the weights w_t and w_o. Read as standard deviations, as the text introduces them, they
would give the worse of the two the greater say; what minimizes the error are the inverse variances, and in the plane
the inverse covariances,

    X = (P_t^-1 + P_odom^-1)^-1 (P_t^-1 (X_track + X_stat) + P_odom^-1 X_odom),    P = (P_t^-1 + P_odom^-1)^-1,

with P_t the covariance of the standing robot, carried to where the tracker sees the other, plus the tracker's. It is
computed as X_odom + K (X_track + X_stat - X_odom) with K = P_odom (P_odom + P_t)^-1, which serves bearings and ranges
as well.

What it ignores: that the two estimates are not independent. The standing robot was itself located by the moving one,
and each robot and landmark keeps its own covariance and nothing of what it has in common with others. The same error
is counted as a new opinion at every fix, so this filter believes to know far more than it does (Roumeliotis and Bekey
2002; Julier and Uhlmann 1997). It is the baseline that a joint filter is compared with.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from coopslam.estimation.ekf import Ekf
from coopslam.estimation.filter_models import Linearized, Sighting, noise_covariance
from coopslam.estimation.keys import robot_index
from coopslam.estimation.tracks import Edge


class _Encounter(NamedTuple):
    """The last measurement between two: their variables then, and which were corrected."""

    keys: frozenset[int]
    corrected: frozenset[int]


class Weighted(Ekf):
    """Equation (1) for any number of robots, for landmarks and map vertices. The state has no cross-covariances."""

    def __init__(self, *arguments, **settings):
        """As `Ekf`."""
        super().__init__(*arguments, **settings)
        self._encounters: dict[frozenset[int], _Encounter] = {}

    def _placed(self, keys: Sequence[int]) -> None:
        for key in keys:
            self._state.forget_correlations(key)

    def _fuse(self, factor: gtsam.NoiseModelFactor, keys: Sequence[int], model: Linearized) -> bool:
        """Each one that is corrected takes the other, as it was before, for a landmark with a covariance."""
        state, noise = self._state, noise_covariance(factor)
        priors = [state.block(key).copy() for key in keys]
        spreads = [H @ P @ H.T for H, P in zip(model.jacobians, priors, strict=True)]
        S = sum(spreads) + noise
        S_inverse = np.linalg.inv(S)
        if not self._innovations.is_credible(factor, float(model.miss @ S_inverse @ model.miss), len(model.miss)):
            return False
        for i in self._corrected(keys):
            H, P = model.jacobians[i], priors[i]
            gain = P @ H.T @ S_inverse
            rest = np.eye(len(P)) - gain @ H
            cov = rest @ P @ rest.T + gain @ (S - spreads[i]) @ gain.T  # Joseph
            state.fuse(state.place(keys[i]), gain, model.miss, cov)
        return True

    def _corrected(self, keys: Sequence[int]) -> tuple[int, ...]:
        """Positions among the keys: robots that have driven since the two last met, and whatever is no robot.

        Robots that both stand since are in the roles that they had.
        """
        last = self._encounters.get(frozenset(map(_who, keys)))
        moved = [key for key in keys if last is None or key not in last.keys]
        if last is not None and not moved:
            corrected = last.corrected
        else:
            corrected = frozenset(key for key in keys if key in moved or robot_index(key) is None)
        self._meet(keys, corrected)
        return tuple(i for i, key in enumerate(keys) if key in corrected)

    def _meet(self, keys: Sequence[int], corrected: Iterable[int]) -> None:
        self._encounters[frozenset(map(_who, keys))] = _Encounter(frozenset(keys), frozenset(corrected))

    def _place(self, key: int, observer: int, seen: Sighting) -> None:
        super()._place(key, observer, seen)
        self._meet((observer, key), [key])

    def _join(self, known: int, edge: Edge) -> None:
        super()._join(known, edge)
        ends = {edge.key_a, edge.key_b}
        self._meet(tuple(ends), ends - {known})


def _who(key: int) -> int:
    """The same number for all poses of a robot, its own for each landmark and vertex."""
    index = robot_index(key)
    return key if index is None else index
