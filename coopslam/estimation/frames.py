"""Guesses of all variables, in as many frames as nothing ties together yet.

Each robot begins in a frame of its own, at whose origin it starts; two frames become one when it is known where a
robot of the one is in the other. The first robot's frame is the one that an estimate is told in: what is in it is
"placed".
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import gtsam
import numpy as np

from coopslam.estimation.keys import is_landmark, landmark_key
from coopslam.estimation.tracks import Edge, Track
from coopslam.se2 import Pose2


@dataclass(slots=True, eq=False)
class Frame:
    """Robots, vertices and landmarks that are guessed in one common frame."""

    members: dict[str | int, None]  # robots and vertices: a set that keeps its order
    located: dict[str, None] = field(default_factory=dict)  # landmarks; one may be located in several frames
    values: gtsam.Values = field(default_factory=gtsam.Values)  # guesses not yet handed out
    poses: list[int] = field(default_factory=list)  # pose variables not yet handed out


class Frames:
    """Which frame everything is in, and what is guessed there."""

    def __init__(self, tracks: dict[str, Track], landmarks: dict[str, int]):
        """tracks: by robot; the first robot's frame is the one of the estimate.  landmarks: name -> number."""
        self.estimate: Callable[[int], Pose2 | np.ndarray] | None = None  # values of what was handed out
        self.doubt: dict[int, float] = {}  # pose key of this group -> how bad its guess is
        self.tracks, self.landmarks = tracks, landmarks
        self._of: dict[str | int, Frame] = {robot: Frame({robot: None}) for robot in tracks}
        self.all = list(self._of.values())  # the first robot's first
        self.anchored = self.all[0]

    def of(self, member: str | int) -> Frame | None:
        """Frame of a robot, or of a vertex that has one."""
        return self._of.get(member)

    def is_placed(self, member: str | int) -> bool:
        """Whether a robot or landmark (by name) or a vertex (by id) has a place in the first robot's frame."""
        if member in self.landmarks:
            return member in self.anchored.located
        if self._of.get(member) is not self.anchored:
            return False
        return member not in self.tracks or bool(self.tracks[member].keys)

    def hand_out(self) -> tuple[gtsam.Values, list[int]]:
        """Guesses of what came into the first robot's frame since the last call, and the pose variables among it."""
        values, poses = self.anchored.values, self.anchored.poses
        self.anchored.values, self.anchored.poses = gtsam.Values(), []
        return values, poses

    # ---- guesses ----

    def guess(self, key: int, frame: Frame) -> Pose2:
        """The current value of a pose or vertex in its frame."""
        return frame.values.atPose2(key) if frame.values.exists(key) else self.estimate(key)

    def point(self, landmark: str, frame: Frame) -> np.ndarray:
        """(2,) the current place of a located landmark in its frame."""
        key = landmark_key(self.landmarks[landmark])
        return frame.values.atPoint2(key) if frame.values.exists(key) else self.estimate(key)

    def add_pose(self, robot: str, key: int, guess: Pose2) -> None:
        """A new pose variable of a robot."""
        frame = self._of[robot]
        frame.values.insert(key, guess)
        frame.poses.append(key)

    def improve(self, edge: Edge, frame: Frame) -> None:
        """Let a fix correct the guess of a variable of this group where odometry guessed worse."""
        doubt_a, doubt_b = self.doubt.get(edge.key_a, 0.0), self.doubt.get(edge.key_b, 0.0)
        doubt_edge = float(np.trace(edge.cov_b))
        if doubt_a + doubt_edge < doubt_b and frame.values.exists(edge.key_b):
            frame.values.update(edge.key_b, self.guess(edge.key_a, frame) * edge.T_a_b)
            self.doubt[edge.key_b] = doubt_a + doubt_edge
        elif doubt_b + doubt_edge < doubt_a and frame.values.exists(edge.key_a):
            frame.values.update(edge.key_a, self.guess(edge.key_b, frame) * edge.T_a_b.inverse())
            self.doubt[edge.key_a] = doubt_b + doubt_edge

    def place_vertex(self, vertex: int, key: int, frame: Frame, guess: Pose2) -> list[str | int]:
        """Give a vertex its first guess, or move it from another frame to this one; what is placed by that."""
        former = self._of.get(vertex)
        if former is not None:
            former.members.pop(vertex)
            former.values.erase(key)
        self._of[vertex] = frame
        frame.members[vertex] = None
        frame.values.insert(key, guess)
        return [vertex] if frame is self.anchored else []

    def place_landmark(self, landmark: str, frame: Frame, xy: np.ndarray) -> list[str | int]:
        """Give a landmark its first guess in a frame; what is placed by that."""
        frame.located[landmark] = None
        frame.values.insert(landmark_key(self.landmarks[landmark]), xy)
        return [landmark] if frame is self.anchored else []

    # ---- two frames become one ----

    def join(self, a: str, b: str, edge: Edge) -> list[str | int]:
        """Bring the frames of robots a and b together by where b was in the frame of a; what is placed by that."""
        stays, goes = self._of[a], self._of[b]
        T_stays_goes = self.guess(edge.key_a, stays) * edge.T_a_b * self.guess(edge.key_b, goes).inverse()
        if goes is self.anchored:
            stays, goes, T_stays_goes = goes, stays, T_stays_goes.inverse()
        return self.merge(stays, goes, T_stays_goes)

    def merge(self, stays: Frame, goes: Frame, T_stays_goes: Pose2) -> list[str | int]:
        """Move everything of one frame, which is not the anchored one, into the other; what is placed by that."""
        new = [landmark for landmark in goes.located if landmark not in stays.located]
        known = {landmark_key(self.landmarks[landmark]) for landmark in goes.located if landmark in stays.located}
        for key in goes.values.keys():  # noqa: SIM118 - Values is no dict
            if not is_landmark(key):
                stays.values.insert(key, T_stays_goes * goes.values.atPose2(key))
            elif key not in known:
                stays.values.insert(key, T_stays_goes.transformFrom(goes.values.atPoint2(key)))
        stays.poses.extend(goes.poses)
        stays.members |= goes.members
        stays.located |= goes.located
        for member in goes.members:
            self._of[member] = stays
        self.all.remove(goes)
        return [*goes.members, *new] if stays is self.anchored else []
