"""What a timeline keeps of each robot and hands out for each group of records."""

from dataclasses import dataclass, field

import gtsam
import numpy as np

from coopslam.se2 import Pose2


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured relative pose between two pose variables."""

    key_a: int
    key_b: int
    T_a_b: Pose2
    cov_b: np.ndarray  # (3, 3); axes of b


@dataclass(slots=True, eq=False)
class Growth:
    """What a group of records adds."""

    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: gtsam.Values = field(default_factory=gtsam.Values)  # guesses of the new variables
    poses: list[int] = field(default_factory=list)  # new pose variables, in order
    tree: list[Edge] = field(default_factory=list)  # new odometry legs, and what joined two frames


@dataclass(slots=True, eq=False)
class Track:
    """One robot's pose variables, and its odometry since the last of them."""

    robot: str
    index: int
    keys: list[int] = field(default_factory=list)
    since_s: list[float] = field(default_factory=list)  # when the robot came to each variable's pose
    until_s: list[float] = field(default_factory=list)  # when it left; inf while it stands
    odometry_end_s: float = -np.inf
    moved: bool = False
    T_last_now: Pose2 = field(default_factory=Pose2)
    cov_now: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))

    @property
    def arrived_s(self) -> float:
        """When the robot came to the pose at which it is now; -inf while it has none."""
        if self.moved:
            return self.odometry_end_s
        return self.since_s[-1] if self.since_s else -np.inf
