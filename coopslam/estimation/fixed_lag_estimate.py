"""What a fixed-lag smoother tells: its window, and the poses that have left it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coopslam.errors import UnderDetermined
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.keys import describe, value_of
from coopslam.estimation.lag_window import LagWindow
from coopslam.estimation.timeline import Timeline
from coopslam.se2 import Pose2


@dataclass(frozen=True, slots=True, eq=False)
class Departed:
    """A pose as it was known when it left the window."""

    pose: Pose2
    cov: np.ndarray | None  # (3, 3) axes of the pose; None where nothing told


class FixedLagEstimate(Estimate):
    """A view of the window, and of what is remembered of the poses that have left it.

    `trajectory` is the fixed-lag estimate: each pose as it was when it left, or as it is now.
    """

    def __init__(self, timeline: Timeline, window: LagWindow, departed: dict[int, Departed], lag_s: float):
        """All of them the smoother's own."""
        super().__init__(timeline)
        self._window, self._departed, self._lag_s = window, departed, lag_s

    def value(self, key: int) -> Pose2:
        departed = self._departed.get(key)
        return self._current(key) if departed is None else departed.pose

    def point(self, key: int) -> np.ndarray:
        return self._current(key)

    def covariance(self, key: int) -> np.ndarray:
        departed = self._departed.get(key)
        if departed is None:
            return self._window.covariance(key)
        if departed.cov is None:
            raise UnderDetermined(f"{self._name(key)} left the window before it was tied down")
        return departed.cov

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        """As for all estimates; raises UnderDetermined when a pose has left the window: nobody remembers what it
        had in common with others."""
        for key in keys:
            if key in self._departed:
                raise UnderDetermined(
                    f"{self._name(key)} left the window of {self._lag_s:g} s: no joint covariance is kept"
                )
        return self._window.joint_covariance(keys)

    def _current(self, key: int) -> Pose2 | np.ndarray:
        if not self._window.values.exists(key):
            raise UnderDetermined(f"{self._name(key)} has no estimate: the update failed")
        return value_of(self._window.values, key)

    def _name(self, key: int) -> str:
        return describe(key, self.robots, self.timeline.landmarks)
