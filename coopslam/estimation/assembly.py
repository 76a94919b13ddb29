"""What a group of records adds, and what waits until the robots, landmarks and vertices that it ties have places."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import inf

import gtsam
import numpy as np

from coopslam.estimation.alignment import AlignmentSettings
from coopslam.estimation.frames import Frames
from coopslam.estimation.keys import vertex_key
from coopslam.estimation.meetings import Glimpse, Meetings
from coopslam.estimation.tracks import Edge, Growth, Track
from coopslam.se2 import Pose2


@dataclass(slots=True)
class Seen:
    """How often one saw another, and when last."""

    times: int = 0
    last_s: float = -inf

    def again(self, stamp_s: float) -> None:
        """Once more."""
        self.times, self.last_s = self.times + 1, max(self.last_s, stamp_s)


class Assembly:
    """Puts factors together with the frames in which their variables are guessed."""

    def __init__(self, tracks: dict[str, Track], landmarks: dict[str, int], settings: AlignmentSettings):
        """tracks: by robot; the first robot's frame is the one of the estimate.  landmarks: name -> number."""
        self.frames = Frames(tracks, landmarks)
        self.growth = Growth()  # of this group of records
        self.vertices: list[int] = []  # ids of placed ones, in the order of their placement
        self.landmarks: list[str] = []  # the same
        self.seen: dict[tuple[str, str], Seen] = {}  # observer, target of points -> how often
        self._meetings = Meetings(self.frames, settings)
        self._waiting: dict[str | int, list[tuple]] = {}  # what has no place -> [(factor, members)]

    def begin(self, estimate: Callable[[int], Pose2 | np.ndarray]) -> None:
        """A new group of records. estimate: the current value of a variable that was handed out."""
        self.growth, self.frames.estimate, self.frames.doubt = Growth(), estimate, {}

    def finish(self) -> Growth:
        """What the group has added."""
        self.growth.values, self.growth.poses = self.frames.hand_out()
        return self.growth

    @property
    def held_back(self) -> int:
        """Number of factors that wait."""
        return sum(map(len, self._waiting.values()))

    def add(self, factor: gtsam.NonlinearFactor, members: Iterable[str | int]) -> None:
        """Hand out a factor, or hold it back until all robots, landmarks and vertices that it ties are placed."""
        missing = next((member for member in members if not self.frames.is_placed(member)), None)
        if missing is None:
            self.growth.graph.push_back(factor)
        else:
            self._waiting.setdefault(missing, []).append((factor, members))

    def tie(self, a: str, b: str, edge: Edge) -> None:
        """A measured relative pose brings the frames of two robots together, or improves a guess in one."""
        frame_a, frame_b = self.frames.of(a), self.frames.of(b)
        if frame_a is frame_b:
            self.frames.improve(edge, frame_a)
            return
        self.growth.tree.append(edge)
        placed = self.frames.join(a, b, edge)
        joined = self.frames.of(a)
        self._meetings.merged(joined, frame_b if joined is frame_a else frame_a)
        self._release(placed)

    def see_point(self, observer: str, target: str, glimpse: Glimpse, key_target: int) -> None:
        """A glimpse of a landmark, which may locate it, or of a robot."""
        self.seen.setdefault((observer, target), Seen()).again(glimpse.fix.stamp_s)
        if target in self.frames.landmarks:
            self._release(self._meetings.see_landmark(observer, target, glimpse))
        elif self.frames.of(observer) is not self.frames.of(target):
            self._meetings.see_robot(observer, target, glimpse, key_target)

    def see_vertex(self, observer: str, vertex: int, key_observer: int, T_observer_vertex: Pose2) -> None:
        """A vertex that has no guess yet gets one; one that waits in another frame comes to the first robot's."""
        frame, known = self.frames.of(observer), self.frames.of(vertex)
        if known is None or (known is not frame and frame is self.frames.anchored):
            guess = self.frames.guess(key_observer, frame) * T_observer_vertex
            self._release(self.frames.place_vertex(vertex, vertex_key(vertex), frame, guess))

    def meet(self, robot: str) -> None:
        """Look whether the robot's frame and another one share enough points by now."""
        joined = self._meetings.join_around(robot)
        if joined is not None:
            edge, placed = joined
            self.growth.tree.append(edge)
            self._release(placed)

    def place_landmark(self, landmark: str, xy: np.ndarray) -> None:
        """A landmark that a survey has put into the first robot's frame."""
        self._release(self.frames.place_landmark(landmark, self.frames.anchored, xy))

    def _release(self, placed: Iterable[str | int]) -> None:
        """Look again at what waited for these robots, landmarks and vertices, which have a place now."""
        for member in placed:
            if member in self.frames.landmarks:
                self.landmarks.append(member)
            elif member not in self.frames.tracks:
                self.vertices.append(member)
            for factor, others in self._waiting.pop(member, []):
                self.add(factor, others)
