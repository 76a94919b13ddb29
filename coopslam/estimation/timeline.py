"""From records to variables and factors: which factor a record calls for, of which variables.

A robot gets a new pose variable when a record needs its pose and it has driven since the last one; a robot that stands
keeps its variable (`pose_variables`). Robots that nothing ties to the first robot yet live in frames of their own
(`frames`); what concerns them is held back (`assembly`) until fixes or shared points join the frames (`meetings`).
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import gtsam
import numpy as np

from coopslam.errors import BadRecord
from coopslam.estimation import factors
from coopslam.estimation.alignment import AlignmentSettings
from coopslam.estimation.assembly import Assembly
from coopslam.estimation.keys import landmark_key, vertex_key
from coopslam.estimation.loss import SQUARES, Loss
from coopslam.estimation.meetings import Glimpse
from coopslam.estimation.pose_variables import STAMP_TOLERANCE_S, PoseVariables, is_motion, tracks_of
from coopslam.estimation.tracks import Edge, Growth
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
from coopslam.se2 import Pose2, observer_to_target_axes

__all__ = ["STAMP_TOLERANCE_S", "Timeline", "TimelineSettings", "is_motion"]


@dataclass(frozen=True, slots=True)
class TimelineSettings:
    """How records become factors."""

    loss: Loss = SQUARES  # of sightings of points: bearings and ranges, whose targets may be mistaken for each other
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)  # of robots whose start is unknown
    every_leg: bool = False  # a variable at the end of each odometry record; loop closures ask for poses of long ago
    random_start: int | None = None  # seed: robots are first guessed anywhere, to show that it does not matter


class Timeline:
    """Which variables and factors the records of a run call for; the same records always give the same."""

    def __init__(self, robots: Iterable[str], landmarks: Iterable[str] = (), settings: TimelineSettings | None = None):
        """robots: all names; the first robot's first pose is the origin.  landmarks: points that may be seen."""
        self.robots, self.landmarks = tuple(robots), tuple(landmarks)
        names = self.robots + self.landmarks
        if not self.robots or len(set(names)) != len(names):
            raise BadRecord(f"different names of robots {self.robots} and landmarks {self.landmarks} expected")
        self.settings = settings or TimelineSettings()
        self.tracks = tracks_of(self.robots)
        self.used: Counter[str] = Counter()  # kind of record -> number
        self.dropped: Counter[str] = Counter()  # "kind: reason" -> number
        self.refused: list[gtsam.NonlinearFactor] = []  # of fixes that were not believed; they may be looked at again
        self._number = {landmark: number for number, landmark in enumerate(self.landmarks)}
        self._assembly = Assembly(self.tracks, self._number, self.settings.alignment)
        self._poses = PoseVariables(self.tracks, self._assembly, self.settings.every_leg, self.settings.random_start)
        self.stamps = self._poses.stamps  # pose key -> s
        self.vertices = self._assembly.vertices  # ids of placed vertices, in the order of their placement
        self.placed_landmarks = self._assembly.landmarks  # in the order of their placement
        self.seen = self._assembly.seen  # observer, target of bearings and ranges -> how often, and when last

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
        self._assembly.begin(estimate)
        for position, record in enumerate(records):
            if position in refusals:
                self._refuse(record, refusals[position])
            elif self._take(record):
                self.used[type(record).__name__] += 1
        return self._assembly.finish()

    def is_placed(self, member: str | int) -> bool:
        """Whether a robot or landmark (by name) or a vertex (by id) has a place in the first robot's frame."""
        return self._assembly.frames.is_placed(member)

    @property
    def held_back(self) -> int:
        """Number of factors that wait for a robot or vertex to be placed."""
        return self._assembly.held_back

    # ---- one record ----

    def _take(self, record: Record) -> bool:
        """Turn one record into variables and factors; False when it was dropped."""
        take = _TAKE.get(type(record))
        if take is None:
            raise BadRecord(f"a timeline cannot use a {type(record).__name__}")
        return take(self, record)

    def _take_odometry(self, record: Odometry) -> bool:
        if record.robot not in self.tracks:
            return self._drop(record, "unknown robot")
        return self._poses.drive(record) or self._drop(record, "overlaps what was already driven")

    def _take_relative_pose(self, record: RelativePoseFix) -> bool:
        keys = self._pair(record)
        if keys is None:
            return False
        cov_target = observer_to_target_axes(record.T_observer_target, record.cov_observer)
        self._assembly.tie(record.observer, record.target, Edge(*keys, record.T_observer_target, cov_target))
        self._assembly.add(factors.relative_pose(*keys, record), (record.observer, record.target))
        return True

    def _take_loop_closure(self, record: LoopClosure) -> bool:
        if record.earlier_robot not in self.tracks or record.robot not in self.tracks:
            return self._drop(record, "unknown robot")
        key_now = self._key_at(record.robot, record.stamp_s, record)
        key_earlier = key_now and self._key_at(record.earlier_robot, record.earlier_s, record)
        if key_earlier is None:
            return False
        edge = Edge(key_earlier, key_now, record.T_earlier_now, record.cov_now)
        self._assembly.tie(record.earlier_robot, record.robot, edge)
        self._assembly.add(factors.loop_closure(key_earlier, key_now, record), (record.earlier_robot, record.robot))
        return True

    def _take_pose_prior(self, record: PosePrior) -> bool:
        key = self._key_at(record.robot, record.stamp_s, record)
        if key is None:
            return False
        if not self.is_placed(record.robot):
            origin = self._poses.first(self.robots[0], record.stamp_s)
            edge = Edge(origin, key, record.T_start_robot, record.cov_robot)
            self._assembly.tie(self.robots[0], record.robot, edge)
        self._assembly.add(factors.pose_prior(key, record), (record.robot,))
        return True

    def _take_landmark_prior(self, record: LandmarkPrior) -> bool:
        if record.landmark not in self._number:
            return self._drop(record, "unknown landmark")
        if not self.is_placed(record.landmark):
            self._assembly.place_landmark(record.landmark, np.asarray(record.xy, float))
        self._assembly.add(
            factors.landmark_prior(landmark_key(self._number[record.landmark]), record), (record.landmark,)
        )
        return True

    def _take_sighting(self, record: CornerSighting) -> bool:
        return self._key_at(record.observer, record.stamp_s, record) is not None

    def _take_corner(self, record: CornerDecision) -> bool:
        sighting = record.sighting
        key = self._key_at(sighting.observer, sighting.stamp_s, sighting)
        if key is None:
            return False
        self._assembly.see_vertex(sighting.observer, record.vertex, key, sighting.T_observer_corner)
        self._assembly.add(factors.corner(key, vertex_key(record.vertex), sighting), (sighting.observer, record.vertex))
        return True

    def _take_wall(self, record: WallDecision) -> bool:
        factor = factors.wall(vertex_key(record.start), vertex_key(record.end), record)
        self._assembly.add(factor, (record.start, record.end))
        return True

    def _take_point(self, record: PointFix) -> bool:
        """A bearing or range, or both, of a robot or a landmark."""
        if getattr(record, "range_m", 1.0) == 0.0:
            return self._drop(record, "range zero")
        is_landmark = record.target in self._number
        keys = self._pair_with_landmark(record) if is_landmark else self._pair(record)
        if keys is None:
            return False
        self._assembly.see_point(record.observer, record.target, Glimpse(keys[0], record), keys[1])
        self._assembly.add(
            _MAKE[type(record)](*keys, record, is_landmark, self.settings.loss), (record.observer, record.target)
        )
        self._assembly.meet(record.observer)
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
        if robot not in self.tracks:
            self._drop(record, "unknown robot")
            return None
        key = self._poses.at(robot, stamp_s)
        if key is None:
            self._drop(record, "older than the odometry after it")
        return key

    # ---- what is not used ----

    def _refuse(self, record: RelativePoseFix, reason: str) -> None:
        """Keep the factor of a fix that is not believed, and count it; its poses are variables nevertheless."""
        keys = self._pair(record)
        if keys is not None:
            self.refused.append(factors.relative_pose(*keys, record))
            self._drop(record, reason)

    def _drop(self, record, reason: str) -> bool:
        self.dropped[f"{type(record).__name__}: {reason}"] += 1
        return False


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
