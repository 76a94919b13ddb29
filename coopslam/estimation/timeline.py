"""From records to variables and factors: which robot has a pose variable when, and what to guess for it.

A robot gets a new pose variable when a record needs its pose and it has driven since the last one; a
robot that stands keeps its variable. Robots that no relative pose fix ties to the first robot yet live in
a frame of their own; what concerns them is held back until a fix joins the frames.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType

import gtsam
import numpy as np

from coopslam.errors import BadRecord
from coopslam.estimation import factors
from coopslam.estimation.keys import pose_key, vertex_key
from coopslam.estimation.tracks import Edge, Frame, Growth, Track
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerDecision,
    CornerEvidence,
    CornerSighting,
    MoveNote,
    Odometry,
    RangeFix,
    Record,
    RelativePoseFix,
    TriangleDecision,
    WallDecision,
)
from coopslam.se2 import Pose2, chain_covariance, observer_to_target_axes, xytheta

STAMP_TOLERANCE_S = 1e-6  # two stamps closer than this are the same instant


class Timeline:
    """Which variables and factors the records of a run call for; the same records always give the same."""

    def __init__(self, robots: Iterable[str]):
        """robots: all names; the first robot's first pose is the origin."""
        self.robots = tuple(robots)
        if not self.robots or len(set(self.robots)) != len(self.robots):
            raise BadRecord(f"a timeline needs different robot names, not {self.robots}")
        self.tracks = {robot: Track(robot, index) for index, robot in enumerate(self.robots)}
        self.stamps: dict[int, float] = {}  # pose key -> s
        self.vertices: list[int] = []  # ids of placed vertices, in the order of their placement
        self.used: Counter[str] = Counter()  # kind of record -> number
        self.dropped: Counter[str] = Counter()  # "kind: reason" -> number
        self.refused: list[gtsam.NonlinearFactor] = []  # of fixes that were not believed; they may be looked at again
        self._frames = {robot: Frame({robot: None}) for robot in self.robots}  # also by vertex id
        self._anchored = self._frames[self.robots[0]]
        self._waiting: dict = {}  # robot or vertex that is not placed -> [(factor, members)]
        self._doubt: dict[int, float] = {}  # pose key of this group -> how bad its guess is
        self._growth = Growth()
        self._estimate: Callable[[int], Pose2] | None = None

    def extend(
        self,
        records: Iterable[Record],
        estimate: Callable[[int], Pose2],
        refusals: Mapping[int, str] = MappingProxyType({}),
    ) -> Growth:
        """New factors, new variables and their guesses.

        estimate: the current value of a variable that an earlier call handed out.  refusals: position among the
        records of each relative pose fix that is not believed, and why; it has its variables, and no factor.
        """
        self._growth, self._estimate, self._doubt = Growth(), estimate, {}
        for position, record in enumerate(records):
            if position in refusals:
                self._refuse(record, refusals[position])
            elif self._take(record):
                self.used[type(record).__name__] += 1
        self._growth.values, self._growth.poses = self._anchored.values, self._anchored.poses
        self._anchored.values, self._anchored.poses = gtsam.Values(), []
        return self._growth

    def is_placed(self, member: str | int) -> bool:
        """Whether a robot (by name) or a vertex (by id) has a pose in the first robot's frame."""
        if self._frames.get(member) is not self._anchored:
            return False
        return member not in self.tracks or bool(self.tracks[member].keys)

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
        return True

    def _take_relative_pose(self, record: RelativePoseFix) -> bool:
        keys = self._pair(record)
        if keys is None:
            return False
        cov_target = observer_to_target_axes(record.T_observer_target, record.cov_observer)
        edge = Edge(*keys, record.T_observer_target, cov_target)
        if self._frames[record.observer] is not self._frames[record.target]:
            self._join(record.observer, record.target, edge)
        else:
            self._improve_guess(edge, self._frames[record.observer])
        self._add(factors.relative_pose(*keys, record), (record.observer, record.target))
        return True

    def _take_sighting(self, record: CornerSighting) -> bool:
        return self._key_at(record.observer, record) is not None

    def _take_corner(self, record: CornerDecision) -> bool:
        sighting = record.sighting
        key = self._key_at(sighting.observer, sighting)
        if key is None:
            return False
        frame, known = self._frames[sighting.observer], self._frames.get(record.vertex)
        if known is None or (known is not frame and frame is self._anchored):
            self._place_vertex(record.vertex, frame, self._guess(key, frame) * sighting.T_observer_corner)
        self._add(factors.corner(key, vertex_key(record.vertex), sighting), (sighting.observer, record.vertex))
        return True

    def _take_wall(self, record: WallDecision) -> bool:
        factor = factors.wall(vertex_key(record.start), vertex_key(record.end), record)
        self._add(factor, (record.start, record.end))
        return True

    def _take_fix(self, record: BearingRangeFix | RangeFix | BearingFix) -> bool:
        if getattr(record, "range_m", 1.0) == 0.0:
            return self._drop(record, "range zero")
        keys = self._pair(record)
        if keys is None:
            return False
        make = {BearingRangeFix: factors.bearing_range, RangeFix: factors.distance, BearingFix: factors.bearing}
        self._add(make[type(record)](*keys, record), (record.observer, record.target))
        return True

    def _take_nothing(self, record: CornerEvidence | TriangleDecision | MoveNote) -> bool:
        return True  # nothing to estimate

    # ---- pose variables ----

    def _pair(self, record) -> tuple[int, int] | None:
        """Pose keys of observer and target at the record's stamp, or None after counting the drop."""
        if record.observer not in self.tracks or record.target not in self.tracks:
            self._drop(record, "unknown robot")
            return None
        key_observer = self._key_at(record.observer, record)
        key_target = None if key_observer is None else self._key_at(record.target, record)
        return None if key_target is None else (key_observer, key_target)

    def _key_at(self, robot: str, record) -> int | None:
        """The robot's pose variable at the record's stamp, made if needed; None (and counted) when it is too late."""
        track = self.tracks.get(robot)
        if track is None:
            self._drop(record, "unknown robot")
            return None
        if not track.keys:
            self._begin(track, record.stamp_s)
        if track.moved and record.stamp_s >= track.odometry_end_s - STAMP_TOLERANCE_S:
            self._end_leg(track)
        number = max(bisect_right(track.since_s, record.stamp_s + STAMP_TOLERANCE_S) - 1, 0)
        stood = track.since_s[number] - STAMP_TOLERANCE_S <= record.stamp_s <= track.until_s[number] + STAMP_TOLERANCE_S
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
        guess = self._guess(last, self._frames[track.robot]) * track.T_last_now
        key = self._new_key(track, track.odometry_end_s, guess)
        self._add(factors.odometry_leg(last, key, track.T_last_now, track.cov_now), (track.robot,))
        self._growth.tree.append(Edge(last, key, track.T_last_now, track.cov_now))
        self._doubt[key] = self._doubt.get(last, 0.0) + float(np.trace(track.cov_now))
        track.moved, track.T_last_now, track.cov_now = False, Pose2(), np.zeros((3, 3))

    def _new_key(self, track: Track, stamp_s: float, guess: Pose2) -> int:
        key = pose_key(track.index, len(track.keys))
        track.keys.append(key)
        track.since_s.append(stamp_s)
        track.until_s.append(np.inf)
        self.stamps[key] = stamp_s
        frame = self._frames[track.robot]
        frame.values.insert(key, guess)
        frame.poses.append(key)
        return key

    # ---- guesses and frames ----

    def _guess(self, key: int, frame: Frame) -> Pose2:
        """The current value of a variable in its frame."""
        return frame.values.atPose2(key) if frame.values.exists(key) else self._estimate(key)

    def _improve_guess(self, edge: Edge, frame: Frame) -> None:
        """Let a fix correct the guess of a variable of this group where odometry guessed worse."""
        doubt_a, doubt_b = self._doubt.get(edge.key_a, 0.0), self._doubt.get(edge.key_b, 0.0)
        doubt_edge = float(np.trace(edge.cov_b))
        if doubt_a + doubt_edge < doubt_b and frame.values.exists(edge.key_b):
            frame.values.update(edge.key_b, self._guess(edge.key_a, frame) * edge.T_a_b)
            self._doubt[edge.key_b] = doubt_a + doubt_edge
        elif doubt_b + doubt_edge < doubt_a and frame.values.exists(edge.key_a):
            frame.values.update(edge.key_a, self._guess(edge.key_b, frame) * edge.T_a_b.inverse())
            self._doubt[edge.key_a] = doubt_b + doubt_edge

    def _join(self, a: str, b: str, edge: Edge) -> None:
        """Bring the frames of robots a and b together by a fix; the first robot's frame stays."""
        stays, goes = self._frames[a], self._frames[b]
        T_stays_goes = self._guess(edge.key_a, stays) * edge.T_a_b * self._guess(edge.key_b, goes).inverse()
        if goes is self._anchored:
            stays, goes, T_stays_goes = goes, stays, T_stays_goes.inverse()
        moving = goes.values.keys()
        for key in moving:
            stays.values.insert(key, T_stays_goes * goes.values.atPose2(key))
        stays.poses.extend(goes.poses)
        stays.members |= goes.members
        self._growth.tree.append(edge)
        for member in goes.members:
            self._frames[member] = stays
        if stays is self._anchored:
            for member in goes.members:
                self._placed(member)

    def _place_vertex(self, vertex: int, frame: Frame, guess: Pose2) -> None:
        """Give a vertex its first guess, or move it from a frame that is not placed to one that is."""
        former = self._frames.get(vertex)
        if former is not None:
            former.members.pop(vertex)
            former.values.erase(vertex_key(vertex))
        self._frames[vertex] = frame
        frame.members[vertex] = None
        frame.values.insert(vertex_key(vertex), guess)
        if frame is self._anchored:
            self._placed(vertex)

    # ---- factors ----

    def _add(self, factor, members: tuple) -> None:
        """Hand out a factor, or hold it back until all robots and vertices that it ties are placed."""
        missing = next((member for member in members if not self.is_placed(member)), None)
        if missing is None:
            self._growth.graph.push_back(factor)
        else:
            self._waiting.setdefault(missing, []).append((factor, members))

    def _placed(self, member: str | int) -> None:
        """Look again at what waited for this robot or vertex."""
        if member not in self.tracks:
            self.vertices.append(member)
        for factor, members in self._waiting.pop(member, []):
            self._add(factor, members)

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
    return bool(record.cov_now.any() or xytheta(record.T_start_now).any())


_TAKE = {
    Odometry: Timeline._take_odometry,
    RelativePoseFix: Timeline._take_relative_pose,
    CornerSighting: Timeline._take_sighting,
    CornerDecision: Timeline._take_corner,
    WallDecision: Timeline._take_wall,
    BearingRangeFix: Timeline._take_fix,
    RangeFix: Timeline._take_fix,
    BearingFix: Timeline._take_fix,
    CornerEvidence: Timeline._take_nothing,
    TriangleDecision: Timeline._take_nothing,
    MoveNote: Timeline._take_nothing,
}
