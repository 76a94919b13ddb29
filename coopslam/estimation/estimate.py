"""What every estimator returns."""

from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np

from coopslam.errors import BadInput, UnderDetermined
from coopslam.estimation.keys import is_landmark, landmark_key, vertex_key
from coopslam.estimation.timeline import STAMP_TOLERANCE_S, Timeline
from coopslam.records import Record
from coopslam.se2 import Pose2, PoseBelief, chain_covariance


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """The poses of one robot in the frame of the estimate, by time."""

    stamps_s: np.ndarray  # (N,)
    poses: list[Pose2]  # N
    covariances: np.ndarray | None = None  # (N, 3, 3); axes of each pose; m, m, rad


@dataclass(frozen=True, slots=True, eq=False)
class PointBelief:
    """A landmark and how well it is known."""

    xy: np.ndarray  # (2,) m
    cov: np.ndarray  # (2, 2) axes of the frame, m^2


class Estimate(ABC):
    """Robots, map vertices and landmarks in the frame of the first robot's start, and how well they are known.

    A view of its estimator: after the next update it tells the newer values. Everything is computed when asked.
    """

    def __init__(self, timeline: Timeline, causal: dict[int, Pose2] | None = None):
        """causal: pose key -> its value right after the update that made it."""
        self.timeline = timeline
        self._causal = {} if causal is None else causal

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of all robots."""
        return self.timeline.robots

    @property
    def vertices(self) -> list[int]:
        """Ids of the map vertices, in the order in which they were placed."""
        return list(self.timeline.vertices)

    @property
    def landmarks(self) -> list[str]:
        """Names of the landmarks, in the order in which they were placed."""
        return list(self.timeline.placed_landmarks)

    def pose_key(self, robot: str) -> int:
        """Key of the robot's latest pose variable. Raises UnderDetermined while it is not placed, or has no records."""
        keys = self._keys(robot)
        if not keys:
            raise UnderDetermined(f"{robot} has no pose yet: no record has named it")
        return keys[-1]

    def pose_key_at(self, robot: str, stamp_s: float) -> int:
        """Key of the robot's pose variable at an instant. Raises UnderDetermined when there is none."""
        keys, track = self._keys(robot), self.timeline.tracks[robot]
        number = bisect_right(track.since_s, stamp_s + STAMP_TOLERANCE_S) - 1
        if number < 0 or stamp_s > track.until_s[number] + STAMP_TOLERANCE_S:
            raise UnderDetermined(f"{robot} has no pose variable at t = {stamp_s:.3f} s")
        return keys[number]

    def vertex_key(self, vertex: int) -> int:
        """Key of a map vertex. Raises UnderDetermined when it is not placed."""
        if not self.timeline.is_placed(vertex):
            raise UnderDetermined(f"vertex {vertex} is not in the estimate: no placed robot has seen it")
        return vertex_key(vertex)

    def landmark_key(self, landmark: str) -> int:
        """Key of a landmark. Raises UnderDetermined when it is not placed."""
        if landmark not in self.timeline.landmarks:
            raise BadInput(f"no landmark is called {landmark}; there are {', '.join(self.timeline.landmarks)}")
        if not self.timeline.is_placed(landmark):
            raise UnderDetermined(f"{landmark} is not in the estimate: too little was seen of it")
        return landmark_key(self.timeline.landmarks.index(landmark))

    def pose(self, robot: str) -> Pose2:
        """T_world_robot now: its latest variable and what it has driven since."""
        return self.value(self.pose_key(robot)) * self.timeline.tracks[robot].T_last_now

    def belief(self, robot: str) -> PoseBelief:
        """The robot now, with its covariance."""
        key, track = self.pose_key(robot), self.timeline.tracks[robot]
        cov = chain_covariance(track.T_last_now, self.covariance(key), track.cov_now)
        return PoseBelief(self.value(key) * track.T_last_now, cov)

    def vertex(self, vertex: int) -> Pose2:
        """T_world_vertex: position of a corner, heading of the wall that leaves it."""
        return self.value(self.vertex_key(vertex))

    def vertex_belief(self, vertex: int) -> PoseBelief:
        """A map vertex with its covariance."""
        key = self.vertex_key(vertex)
        return PoseBelief(self.value(key), self.covariance(key))

    def landmark(self, landmark: str) -> np.ndarray:
        """(2,) a landmark's position."""
        return self.point(self.landmark_key(landmark))

    def landmark_belief(self, landmark: str) -> PointBelief:
        """A landmark with its covariance."""
        key = self.landmark_key(landmark)
        return PointBelief(self.point(key), self.covariance(key))

    def trajectory(self, robot: str) -> Trajectory:
        """All poses of a robot as known now, with covariances."""
        keys = self._keys(robot)
        poses = [self.value(key) for key in keys]
        return Trajectory(self._stamps(keys), poses, self._covariances(keys))

    def causal_trajectory(self, robot: str) -> Trajectory:
        """Each pose as known right after the update that made it; without covariances.

        Poses of an update that failed were never known, and are not among them.
        """
        keys = [key for key in self._keys(robot) if key in self._causal]
        return Trajectory(self._stamps(keys), [self._causal[key] for key in keys])

    def keep_causal(self, keys: Iterable[int]) -> None:
        """For estimators: remember how new variables are known now."""
        self._causal.update((key, self.value(key)) for key in keys)

    def any_value(self, key: int) -> Pose2 | np.ndarray:
        """The pose, or the point when it is a landmark, of any placed variable."""
        return self.point(key) if is_landmark(key) else self.value(key)

    @abstractmethod
    def value(self, key: int) -> Pose2:
        """The pose of a placed robot or vertex."""

    @abstractmethod
    def point(self, key: int) -> np.ndarray:
        """(2,) the position of a placed landmark."""

    @abstractmethod
    def covariance(self, key: int) -> np.ndarray:
        """Marginal covariance: (3, 3) in the variable's own axes, m, m, rad; of a landmark (2, 2), frame's axes."""

    @abstractmethod
    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        """Joint covariance of different variables: blocks in the order asked, each as `covariance` gives it."""

    def _covariances(self, keys: Sequence[int]) -> np.ndarray:
        return np.array([self.covariance(key) for key in keys])

    def _keys(self, robot: str) -> list[int]:
        """All pose keys of a placed robot."""
        track = self.timeline.tracks.get(robot)
        if track is None:
            raise BadInput(f"no robot is called {robot}; there are {', '.join(self.robots)}")
        if not self.timeline.is_placed(robot):
            raise UnderDetermined(
                f"{robot} has no place yet: no relative pose fix ties it to {self.robots[0]} "
                f"({self.timeline.held_back} factors wait)"
            )
        return track.keys

    def _stamps(self, keys: Sequence[int]) -> np.ndarray:
        return np.array([self.timeline.stamps[key] for key in keys])


class Estimator(Protocol):
    """Takes records in groups, as they come, and tells what it makes of all of them so far."""

    timeline: Timeline
    graph: gtsam.NonlinearFactorGraph  # everything so far
    timing: float  # s spent in updates

    def update(self, records: Iterable[Record]) -> Estimate:
        """Use a further group of records; raises UnderDetermined when a variable is not tied down."""

    def values(self) -> gtsam.Values:
        """All variables as last known: where a solver may start."""
