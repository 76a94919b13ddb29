"""What a joint filter tells: its state, and the poses that have left it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coopslam.errors import UnderDetermined
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.filter_state import FilterState, in_own_axes
from coopslam.estimation.innovation_gate import Innovation
from coopslam.estimation.keys import describe
from coopslam.estimation.timeline import Timeline
from coopslam.se2 import Pose2


class Departed(NamedTuple):
    """A pose when it left the state."""

    mean: np.ndarray  # (3,)
    cov: np.ndarray  # (3, 3) axes of the frame


class EkfEstimate(Estimate):
    """A view of the filter's state, and of what is remembered of the poses that have left it.

    `trajectory` is what the filter knew: each pose as it was when it left the state, or as it is now.
    """

    def __init__(
        self, timeline: Timeline, state: FilterState, departed: dict[int, Departed], innovations: list[Innovation]
    ):
        """All of them the filter's own. innovations: of all measurements that were tested, those refused included."""
        super().__init__(timeline)
        self.innovations = innovations
        self._state, self._departed = state, departed

    def value(self, key: int) -> Pose2:
        return Pose2(*self._mean(key))

    def point(self, key: int) -> np.ndarray:
        return self._mean(key).copy()

    def covariance(self, key: int) -> np.ndarray:
        departed = self._departed.get(key)
        if departed is not None:
            return in_own_axes(*departed)
        self._require(key)
        return self._state.covariance(key)

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        """As for all estimates; raises UnderDetermined when a pose has left the state: nobody remembers what it had in
        common with others."""
        for key in keys:
            if key in self._departed:
                raise UnderDetermined(f"{self._name(key)} has left the filter's state: no joint covariance is kept")
            self._require(key)
        return self._state.joint(keys)

    def _mean(self, key: int) -> np.ndarray:
        departed = self._departed.get(key)
        if departed is not None:
            return departed.mean
        self._require(key)
        return self._state.mean(key)

    def _require(self, key: int) -> None:
        if key not in self._state:
            raise UnderDetermined(f"{self._name(key)} has no estimate: the update failed")

    def _name(self, key: int) -> str:
        return describe(key, self.robots, self.timeline.landmarks)
