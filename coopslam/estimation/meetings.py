"""Points that frames share: from where landmarks are located, and two frames brought together (`alignment`).

A landmark gets a guess when two glimpses of it agree, so that one false glimpse places nothing; the same mistake twice
does, and is left to the robust loss. Frames meet when landmarks are known in both, or when robots of the one were seen
from the other; what is seen by its direction alone brings no frames together.
"""

from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from coopslam.estimation.alignment import Alignment, AlignmentSettings, align
from coopslam.estimation.frames import Frame, Frames
from coopslam.estimation.ranging import align_by_ranges, intersect, locate
from coopslam.estimation.tracks import Edge
from coopslam.records import BearingFix, BearingRangeFix, PointFix
from coopslam.se2 import Pose2, position

_KEPT = 60  # latest glimpses of one landmark in one frame that are looked at
_MUTUAL_KEPT = 300  # glimpses of one robot by another while their frames are apart
_FIRST_TRY = 6  # number of ranges, or of bearings, from which a landmark is located
_RETRY = 1.25  # what failed is tried again after so many times as many fixes


@dataclass(frozen=True, slots=True, eq=False)
class Glimpse:
    """What was seen of a point from a pose variable."""

    key: int
    fix: PointFix

    @property
    def is_point(self) -> bool:
        """Whether it tells the whole point, not only its direction or distance."""
        return isinstance(self.fix, BearingRangeFix)

    @property
    def sigma_m(self) -> float:
        """Of the point in its worse direction; of the range where there is no bearing."""
        if not self.is_point:
            return self.fix.sigma_m
        across, along = np.sqrt(np.diag(self.fix.cov))
        return float(max(across * self.fix.range_m, along))

    def seen_from(self, T_frame_observer: Pose2) -> np.ndarray:
        """(2,) the point in the frame of the observer's pose."""
        direction = np.array([np.cos(self.fix.bearing_rad), np.sin(self.fix.bearing_rad)])
        return T_frame_observer.transformFrom(self.fix.range_m * direction)


@dataclass(slots=True, eq=False)
class Tries:
    """When to try again what failed: ever more seldom, so that hopeless cases cost little."""

    fixes: int = 0
    next_at: float = 0.0

    def is_due(self) -> bool:
        """Count one more fix, and say whether it is time for a try."""
        self.fixes += 1
        if self.fixes < self.next_at:
            return False
        self.next_at = self.fixes * _RETRY + 1
        return True


@dataclass(slots=True, eq=False)
class Sights:
    """All that was seen of one landmark in one frame."""

    points: deque[Glimpse] = field(default_factory=lambda: deque(maxlen=_KEPT))
    others: dict[type, deque[Glimpse]] = field(default_factory=dict)  # ranges and bearings, by kind
    tries: Tries = field(default_factory=lambda: Tries(next_at=_FIRST_TRY))  # to locate it by ranges or bearings

    def add(self, glimpse: Glimpse) -> None:
        """One more; the oldest of many is forgotten."""
        if glimpse.is_point:
            self.points.append(glimpse)
        else:
            self.others.setdefault(type(glimpse.fix), deque(maxlen=_KEPT)).append(glimpse)

    def telling(self) -> Iterator[Glimpse]:
        """Those that tell more than a direction."""
        yield from self.points
        for kind, glimpses in self.others.items():
            if kind is not BearingFix:
                yield from glimpses


@dataclass(slots=True, eq=False)
class Pairs:
    """Points known in two frames, and distances between points of the two."""

    points: list[tuple[np.ndarray, np.ndarray, float]] = field(default_factory=list)  # in a, in b, sigma in m
    ranges: list[tuple[np.ndarray, np.ndarray, float, float]] = field(default_factory=list)  # range and sigma in m

    def add(self, glimpse: Glimpse, eye: Pose2, target: np.ndarray, flipped: bool) -> None:
        """What was seen from a pose in frame a of a point that is known in frame b; flipped: of b in a."""
        seen = glimpse.seen_from(eye) if glimpse.is_point else position(eye)
        ends = (target, seen) if flipped else (seen, target)
        if glimpse.is_point:
            self.points.append((*ends, glimpse.sigma_m))
        else:
            self.ranges.append((*ends, glimpse.fix.range_m, glimpse.sigma_m))

    def aligned(self, settings: AlignmentSettings) -> Alignment | None:
        """Frame b in frame a; by ranges only where points do not tell."""
        found = align(*map(np.array, zip(*self.points, strict=True)), settings) if self.points else None
        if found is None and self.ranges:
            return align_by_ranges(*map(np.array, zip(*self.ranges, strict=True)), settings)
        return found


class Meetings:
    """What was seen of points, by frame, and what follows from it."""

    def __init__(self, frames: Frames, settings: AlignmentSettings):
        self._frames, self._settings = frames, settings
        self._sights: dict[Frame, defaultdict[str, Sights]] = {frame: defaultdict(Sights) for frame in frames.all}
        self._mutual: dict[tuple[str, str], deque[tuple[Glimpse, int]]] = {}  # observer, target -> with target's key
        self._tries: defaultdict[tuple[Frame, Frame], Tries] = defaultdict(Tries)  # to align two frames

    def see_landmark(self, robot: str, landmark: str, glimpse: Glimpse) -> list[str | int]:
        """Remember it, and locate the landmark when that suffices; what is placed by that."""
        frame = self._frames.of(robot)
        is_located = landmark in frame.located
        if is_located and len(self._frames.all) == 1:
            return []  # nothing is left to find out
        sights = self._sights[frame][landmark]
        found = None if is_located else self._located(glimpse, sights, frame)
        sights.add(glimpse)
        return [] if found is None else self._frames.place_landmark(landmark, frame, found)

    def see_robot(self, observer: str, target: str, glimpse: Glimpse, key_target: int) -> None:
        """Remember how a robot saw one of another frame."""
        self._mutual.setdefault((observer, target), deque(maxlen=_MUTUAL_KEPT)).append((glimpse, key_target))

    def join_around(self, robot: str) -> tuple[Edge, list[str | int]] | None:
        """Join the robot's frame with another when what is known in both says how.

        Returns the relative pose of latest variables that follows from it, and what is placed by it.
        """
        if len(self._frames.all) == 1:
            return None
        frame, frames = self._frames.of(robot), self._frames
        for other in frames.all:
            if other is frame or not any(frames.tracks[m].keys for m in other.members if m in frames.tracks):
                continue
            stays, goes = (frame, other) if frame is frames.anchored else (other, frame)
            if not self._tries[stays, goes].is_due():
                continue
            alignment = self._pairs(stays, goes).aligned(self._settings)
            if alignment is None:
                continue
            edge = self._edge(stays, goes, alignment)
            placed = frames.merge(stays, goes, alignment.T_a_b)
            self.merged(stays, goes)
            return edge, placed
        return None

    def merged(self, stays: Frame, goes: Frame) -> None:
        """Two frames have become one."""
        for landmark, sights in self._sights.pop(goes).items():
            kept = self._sights[stays][landmark]
            for glimpse in (*sights.points, *(glimpse for others in sights.others.values() for glimpse in others)):
                kept.add(glimpse)
        for pair in [pair for pair in self._mutual if self._frames.of(pair[0]) is self._frames.of(pair[1])]:
            del self._mutual[pair]
        for pair in [pair for pair in self._tries if goes in pair]:
            del self._tries[pair]

    def _pairs(self, stays: Frame, goes: Frame) -> Pairs:
        """Landmarks and robots that are known in one of the frames, and what was seen of them from the other."""
        pairs, guess, point = Pairs(), self._frames.guess, self._frames.point
        for landmark in goes.located | stays.located:
            # seen from the frame that comes; in both frames, points seen from the one that stays would add the same
            known, eyes = (stays, goes) if landmark in stays.located else (goes, stays)
            if landmark in self._sights[eyes]:
                target = point(landmark, known)
                for glimpse in self._sights[eyes][landmark].telling():
                    pairs.add(glimpse, guess(glimpse.key, eyes), target, flipped=eyes is goes)
        for (observer, target), kept in self._mutual.items():
            eyes, others = self._frames.of(observer), self._frames.of(target)
            if {eyes, others} == {stays, goes}:
                for glimpse, key in kept:
                    if not isinstance(glimpse.fix, BearingFix):
                        there = position(guess(key, others))
                        pairs.add(glimpse, guess(glimpse.key, eyes), there, flipped=eyes is goes)
        return pairs

    def _edge(self, stays: Frame, goes: Frame, alignment: Alignment) -> Edge:
        """The alignment as a relative pose between two latest variables."""
        key_a, key_b = self._latest(stays), self._latest(goes)
        T_goes_b = self._frames.guess(key_b, goes)
        T_a_b = self._frames.guess(key_a, stays).between(alignment.T_a_b * T_goes_b)
        return Edge(key_a, key_b, T_a_b, alignment.covariance_at(T_goes_b))

    def _latest(self, frame: Frame) -> int:
        tracks = [self._frames.tracks[m] for m in frame.members if m in self._frames.tracks]
        return next(track.keys[-1] for track in tracks if track.keys)

    def _located(self, glimpse: Glimpse, sights: Sights, frame: Frame) -> np.ndarray | None:
        """A landmark's first guess: two glimpses that agree, or several ranges, or several bearings."""
        guess, drift = self._frames.guess, self._settings.drift_sigma_m
        if glimpse.is_point:
            here = glimpse.seen_from(guess(glimpse.key, frame))
            for other in sights.points:
                there = other.seen_from(guess(other.key, frame))
                sigma = np.sqrt(glimpse.sigma_m**2 + other.sigma_m**2 + drift**2)
                if np.hypot(*(here - there)) <= self._settings.gate_sigmas * sigma:
                    return (here + there) / 2
            return None
        if not sights.tries.is_due():
            return None
        kind = type(glimpse.fix)
        same = [*sights.others.get(kind, ()), glimpse]
        fixes, eyes = [one.fix for one in same], [guess(one.key, frame) for one in same]
        points = np.array([position(eye) for eye in eyes])
        if kind is BearingFix:
            directions = np.array([eye.theta() + fix.bearing_rad for eye, fix in zip(eyes, fixes, strict=True)])
            return intersect(points, directions, np.array([fix.sigma_rad for fix in fixes]), drift)
        sigmas = np.hypot([fix.sigma_m for fix in fixes], drift)
        return locate(points, np.array([fix.range_m for fix in fixes]), sigmas)
