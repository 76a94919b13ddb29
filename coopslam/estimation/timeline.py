"""From records to variables and factors: which robot has a pose variable when, and what to guess for it.

A robot gets a new pose variable when a record needs its pose and it has driven since the last one; a
robot that stands keeps its variable. Robots that nothing ties to the first robot yet live in frames of
their own (`frames`); what concerns them is held back until fixes or shared points join the frames (`meetings`).
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import gtsam
import numpy as np

from coopslam.errors import BadRecord
from coopslam.estimation import factors
from coopslam.estimation.alignment import AlignmentSettings
from coopslam.estimation.frames import Frames
from coopslam.estimation.keys import landmark_key, pose_key, vertex_key
from coopslam.estimation.loss import SQUARES, Loss
from coopslam.estimation.meetings import Glimpse, Meetings
from coopslam.estimation.tracks import Edge, Growth, Track
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerDecision,
    CornerEvidence,
    CornerSighting,
    LandmarkPrior,
    LoopClosure,
    MoveNote,
    Odometry,
    PointFix,
    PosePrior,
    RangeFix,
    Record,
    RelativePoseFix,
    TriangleDecision,
    WallDecision,
)
from coopslam.se2 import Pose2, chain_covariance, observer_to_target_axes

STAMP_TOLERANCE_S = 1e-6  # two stamps closer than this are the same instant


@dataclass(frozen=True, slots=True)
class TimelineSettings:
    """How records become factors."""

    loss: Loss = SQUARES  # of sightings of points: bearings and ranges, whose targets may be mistaken for each other
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)  # of robots whose start is unknown
    every_leg: bool = False  # a variable at the end of each odometry record; loop closures ask for poses of long ago


class Timeline:
    """Which variables and factors the records of a run call for; the same records always give the same."""

    def __init__(self, robots: Iterable[str], landmarks: Iterable[str] = (), settings: TimelineSettings | None = None):
        """robots: all names; the first robot's first pose is the origin.  landmarks: points that may be seen."""
        self.robots, self.landmarks = tuple(robots), tuple(landmarks)
        names = self.robots + self.landmarks
        if not self.robots or len(set(names)) != len(names):
            raise BadRecord(
                f"a timeline needs different names, not the robots {self.robots}, landmarks {self.landmarks}"
            )
        self.settings = settings or TimelineSettings()
        self.tracks = {robot: Track(robot, index) for index, robot in enumerate(self.robots)}
        self.stamps: dict[int, float] = {}  # pose key -> s
        self.vertices: list[int] = []  # ids of placed vertices, in the order of their placement
        self.placed_landmarks: list[str] = []  # in the order of their placement
        self.used: Counter[str] = Counter()  # kind of record -> number
        self.dropped: Counter[str] = Counter()  # "kind: reason" -> number
        self.refused: list[gtsam.NonlinearFactor] = []  # of fixes that were not believed; they may be looked at again
        self._number = {landmark: number for number, landmark in enumerate(self.landmarks)}
        self._frames = Frames(self.tracks, self._number)
        self._meetings = Meetings(self._frames, self.settings.alignment)
        self._waiting: dict = {}  # robot, landmark or vertex that is not placed -> [(factor, members)]
        self._growth = Growth()

    def extend(
        self,
        records: Iterable[Record],
        estimate: Callable[[int], Pose2 | np.ndarray],
        refusals: Mapping[int, str] = MappingProxyType({}),
    ) -> Growth:
        """New factors, new variables and their guesses.

        estimate: the current value of a variable that an earlier call handed out, (2,) for a landmark.
        refusals: position among the records of each relative pose fix that is not believed, and why; it has its
        variables, and no factor.
        """
        self._growth, self._frames.estimate, self._frames.doubt = Growth(), estimate, {}
        for position, record in enumerate(records):
            if position in refusals:
                self._refuse(record, refusals[position])
            elif self._take(record):
                self.used[type(record).__name__] += 1
        self._growth.values, self._growth.poses = self._frames.hand_out()
        return self._growth

    def is_placed(self, member: str | int) -> bool:
        """Whether a robot or landmark (by name) or a vertex (by id) has a place in the first robot's frame."""
        return self._frames.is_placed(member)

    @property
    def held_back(self) -> int:
        """Number of factors that wait for a robot or vertex to be placed."""
        return sum(map(len, self._waiting.values()))

    # ---- one record ----

    def _take(self, record: Record) -> bool:
        """Turn one record into variables and factors; False when it was dropped."""
        take = _TAKE.get(type(record))
        if take is None:
            raise BadRecord(f"a timeline cannot use a {type(record).__name__}")
        return take(self, record)

    def _take_odometry(self, record: Odometry) -> bool:
        track = self.tracks.get(record.robot)
        if track is None:
            return self._drop(record, "unknown robot")
        if record.start_s < track.odometry_end_s - STAMP_TOLERANCE_S:
            return self._drop(record, "overlaps what was already driven")
        if not track.keys:
            self._begin(track, record.start_s)
        track.odometry_end_s = record.stamp_s
        if not is_motion(record):
            return True
        if not track.moved:
            track.until_s[-1] = record.start_s
        track.moved = True
        track.cov_now = chain_covariance(record.T_start_now, track.cov_now, record.cov_now)
        track.T_last_now = track.T_last_now * record.T_start_now
        if self.settings.every_leg:
            self._end_leg(track)
        return True

    def _take_relative_pose(self, record: RelativePoseFix) -> bool:
        keys = self._pair(record)
        if keys is None:
            return False
        cov_target = observer_to_target_axes(record.T_observer_target, record.cov_observer)
        self._tie(record.observer, record.target, Edge(*keys, record.T_observer_target, cov_target))
        self._add(factors.relative_pose(*keys, record), (record.observer, record.target))
        return True

    def _take_loop_closure(self, record: LoopClosure) -> bool:
        if record.earlier_robot not in self.tracks or record.robot not in self.tracks:
            return self._drop(record, "unknown robot")
        key_now = self._key_at(record.robot, record.stamp_s, record)
        key_earlier = key_now and self._key_at(record.earlier_robot, record.earlier_s, record)
        if key_earlier is None:
            return False
        edge = Edge(key_earlier, key_now, record.T_earlier_now, record.cov_now)
        self._tie(record.earlier_robot, record.robot, edge)
        self._add(factors.loop_closure(key_earlier, key_now, record), (record.earlier_robot, record.robot))
        return True

    def _take_pose_prior(self, record: PosePrior) -> bool:
        key = self._key_at(record.robot, record.stamp_s, record)
        if key is None:
            return False
        first = self.tracks[self.robots[0]].keys
        if not first:
            return self._drop(record, f"before anything of {self.robots[0]}, whose start is the origin")
        if not self.is_placed(record.robot):
            self._tie(self.robots[0], record.robot, Edge(first[0], key, record.T_start_robot, record.cov_robot))
        self._add(factors.pose_prior(key, record), (record.robot,))
        return True

    def _take_landmark_prior(self, record: LandmarkPrior) -> bool:
        if record.landmark not in self._number:
            return self._drop(record, "unknown landmark")
        if not self.is_placed(record.landmark):
            xy = np.asarray(record.xy, float)
            self._placed(self._frames.place_landmark(record.landmark, self._frames.anchored, xy))
        self._add(factors.landmark_prior(landmark_key(self._number[record.landmark]), record), (record.landmark,))
        return True

    def _take_sighting(self, record: CornerSighting) -> bool:
        return self._key_at(record.observer, record.stamp_s, record) is not None

    def _take_corner(self, record: CornerDecision) -> bool:
        sighting = record.sighting
        key = self._key_at(sighting.observer, sighting.stamp_s, sighting)
        if key is None:
            return False
        frame, known = self._frames.of(sighting.observer), self._frames.of(record.vertex)
        if known is None or (known is not frame and frame is self._frames.anchored):
            guess = self._frames.guess(key, frame) * sighting.T_observer_corner
            self._placed(self._frames.place_vertex(record.vertex, vertex_key(record.vertex), frame, guess))
        self._add(factors.corner(key, vertex_key(record.vertex), sighting), (sighting.observer, record.vertex))
        return True

    def _take_wall(self, record: WallDecision) -> bool:
        factor = factors.wall(vertex_key(record.start), vertex_key(record.end), record)
        self._add(factor, (record.start, record.end))
        return True

    def _take_point(self, record: PointFix) -> bool:
        """A bearing or range, or both, of a robot or a landmark."""
        if getattr(record, "range_m", 1.0) == 0.0:
            return self._drop(record, "range zero")
        is_landmark = record.target in self._number
        keys = self._pair_with_landmark(record) if is_landmark else self._pair(record)
        if keys is None:
            return False
        glimpse = Glimpse(keys[0], record)
        if is_landmark:
            self._placed(self._meetings.see_landmark(record.observer, record.target, glimpse))
        elif self._frames.of(record.observer) is not self._frames.of(record.target):
            self._meetings.see_robot(record.observer, record.target, glimpse, keys[1])
        self._add(_MAKE[type(record)](*keys, record, is_landmark, self.settings.loss), (record.observer, record.target))
        self._meet(record.observer)
        return True

    def _take_nothing(self, record: CornerEvidence | TriangleDecision | MoveNote) -> bool:
        return True  # nothing to estimate

    # ---- pose variables ----

    def _pair(self, record) -> tuple[int, int] | None:
        """Pose keys of observer and target at the record's stamp, or None after counting the drop."""
        if record.observer not in self.tracks or record.target not in self.tracks:
            known = record.observer in self.tracks
            self._drop(record, "unknown target" if known and self.landmarks else "unknown robot")
            return None
        key_observer = self._key_at(record.observer, record.stamp_s, record)
        key_target = None if key_observer is None else self._key_at(record.target, record.stamp_s, record)
        return None if key_target is None else (key_observer, key_target)

    def _pair_with_landmark(self, record: PointFix) -> tuple[int, int] | None:
        key = self._key_at(record.observer, record.stamp_s, record)
        return None if key is None else (key, landmark_key(self._number[record.target]))

    def _key_at(self, robot: str, stamp_s: float, record) -> int | None:
        """The robot's pose variable at an instant, made if needed; None (and counted) when it is too late for that."""
        track = self.tracks.get(robot)
        if track is None:
            self._drop(record, "unknown robot")
            return None
        if not track.keys:
            self._begin(track, stamp_s)
        if track.moved and stamp_s >= track.odometry_end_s - STAMP_TOLERANCE_S:
            self._end_leg(track)
        number = max(bisect_right(track.since_s, stamp_s + STAMP_TOLERANCE_S) - 1, 0)
        stood = track.since_s[number] - STAMP_TOLERANCE_S <= stamp_s <= track.until_s[number] + STAMP_TOLERANCE_S
        if not stood:
            self._drop(record, "older than the odometry after it")
            return None
        return track.keys[number]

    def _begin(self, track: Track, stamp_s: float) -> None:
        """The first variable of a robot: the origin of its own frame."""
        key = self._new_key(track, stamp_s, Pose2())
        if track.index == 0:
            self._add(factors.gauge_prior(key), (track.robot,))

    def _end_leg(self, track: Track) -> None:
        """A new variable at the end of the odometry since the last one."""
        last = track.keys[-1]
        guess = self._frames.guess(last, self._frames.of(track.robot)) * track.T_last_now
        key = self._new_key(track, track.odometry_end_s, guess)
        self._add(factors.odometry_leg(last, key, track.T_last_now, track.cov_now), (track.robot,))
        self._growth.tree.append(Edge(last, key, track.T_last_now, track.cov_now))
        doubt = self._frames.doubt
        doubt[key] = doubt.get(last, 0.0) + float(np.trace(track.cov_now))
        track.moved, track.T_last_now, track.cov_now = False, Pose2(), np.zeros((3, 3))

    def _new_key(self, track: Track, stamp_s: float, guess: Pose2) -> int:
        key = pose_key(track.index, len(track.keys))
        track.keys.append(key)
        track.since_s.append(stamp_s)
        track.until_s.append(np.inf)
        self.stamps[key] = stamp_s
        self._frames.add_pose(track.robot, key, guess)
        return key

    # ---- frames ----

    def _tie(self, a: str, b: str, edge: Edge) -> None:
        """A measured relative pose brings two frames together, or improves a guess in one."""
        frame_a, frame_b = self._frames.of(a), self._frames.of(b)
        if frame_a is frame_b:
            self._frames.improve(edge, frame_a)
            return
        self._growth.tree.append(edge)
        placed = self._frames.join(a, b, edge)
        joined = self._frames.of(a)
        self._meetings.merged(joined, frame_b if joined is frame_a else frame_a)
        self._placed(placed)

    def _meet(self, robot: str) -> None:
        """Look whether the robot's frame and another one share enough points by now."""
        joined = self._meetings.join_around(robot)
        if joined is not None:
            edge, placed = joined
            self._growth.tree.append(edge)
            self._placed(placed)

    # ---- factors ----

    def _add(self, factor, members: tuple) -> None:
        """Hand out a factor, or hold it back until all robots and vertices that it ties are placed."""
        missing = next((member for member in members if not self.is_placed(member)), None)
        if missing is None:
            self._growth.graph.push_back(factor)
        else:
            self._waiting.setdefault(missing, []).append((factor, members))

    def _placed(self, members: Iterable[str | int]) -> None:
        """Look again at what waited for these robots, landmarks and vertices."""
        for member in members:
            if member in self._number:
                self.placed_landmarks.append(member)
            elif member not in self.tracks:
                self.vertices.append(member)
            for factor, others in self._waiting.pop(member, []):
                self._add(factor, others)

    def _refuse(self, record: RelativePoseFix, reason: str) -> None:
        """Keep the factor of a fix that is not believed, and count it; its poses are variables nevertheless."""
        keys = self._pair(record)
        if keys is not None:
            self.refused.append(factors.relative_pose(*keys, record))
            self._drop(record, reason)

    def _drop(self, record, reason: str) -> bool:
        self.dropped[f"{type(record).__name__}: {reason}"] += 1
        return False


def is_motion(record: Odometry) -> bool:
    """Whether a robot may have moved; otherwise it stands, and knows it."""
    step = record.T_start_now
    return bool(step.x() or step.y() or step.theta() or np.any(record.cov_now))


_MAKE = {BearingRangeFix: factors.bearing_range, RangeFix: factors.distance, BearingFix: factors.bearing}
_TAKE = {
    Odometry: Timeline._take_odometry,
    RelativePoseFix: Timeline._take_relative_pose,
    CornerSighting: Timeline._take_sighting,
    CornerDecision: Timeline._take_corner,
    WallDecision: Timeline._take_wall,
    BearingRangeFix: Timeline._take_point,
    RangeFix: Timeline._take_point,
    BearingFix: Timeline._take_point,
    LoopClosure: Timeline._take_loop_closure,
    PosePrior: Timeline._take_pose_prior,
    LandmarkPrior: Timeline._take_landmark_prior,
    CornerEvidence: Timeline._take_nothing,
    TriangleDecision: Timeline._take_nothing,
    MoveNote: Timeline._take_nothing,
}
