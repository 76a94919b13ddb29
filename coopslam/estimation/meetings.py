"""Points that frames share: from where landmarks are located, and two frames brought together (`alignment`).

A landmark gets a guess when two glimpses of it agree, so that one false glimpse places nothing. Frames meet when
landmarks are known in both, or when robots of the one were seen from the other.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from coopslam.estimation.alignment import Alignment, AlignmentSettings, align, align_by_ranges, intersect, locate
from coopslam.estimation.frames import Frame, Frames
from coopslam.estimation.tracks import Edge
from coopslam.records import BearingFix, BearingRangeFix, PointFix
from coopslam.se2 import Pose2, position

_KEPT = 60  # latest glimpses of one landmark in one frame that are looked at
_MUTUAL_KEPT = 300  # glimpses of one robot by another while their frames are apart
_RETRY = 1.25  # an alignment that failed is tried again after so many times as many fixes


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
class Pairs:
    """Points known in two frames, and distances between points of the two."""

    points_a: list[np.ndarray]
    points_b: list[np.ndarray]
    sigmas_m: list[float]
    ranges_m: list[float | None]  # None: the same point

    def add(self, point_a: np.ndarray, point_b: np.ndarray, sigma_m: float, range_m: float | None = None) -> None:
        """One more pair."""
        self.points_a.append(point_a)
        self.points_b.append(point_b)
        self.sigmas_m.append(sigma_m)
        self.ranges_m.append(range_m)

    def aligned(self, settings: AlignmentSettings) -> Alignment | None:
        """Frame b in frame a; by ranges only where hardly any points are shared."""
        if not self.points_a:
            return None
        a, b, sigmas = np.array(self.points_a), np.array(self.points_b), np.array(self.sigmas_m)
        same = np.array([range_m is None for range_m in self.ranges_m])
        if same.sum() >= settings.pairs_min or same.all():
            return align(a[same], b[same], sigmas[same], settings)
        ranges = np.array([range_m for range_m in self.ranges_m if range_m is not None])
        return align_by_ranges(a[~same], b[~same], ranges, sigmas[~same], settings)


class Meetings:
    """What was seen of points, by frame, and what follows from it."""

    def __init__(self, frames: Frames, settings: AlignmentSettings):
        self._frames, self._settings = frames, settings
        self._glimpses: dict[int, dict[str, list[Glimpse]]] = defaultdict(dict)  # id of frame -> landmark -> glimpses
        self._mutual: dict[tuple[str, str], list[tuple[Glimpse, int]]] = {}  # observer, target -> with target's key
        self._fixes: Counter[tuple[int, int]] = Counter()  # of points, by ids of two frames that are apart
        self._next_try: dict[tuple[int, int], float] = {}  # number of fixes at which to align two frames again

    def see_landmark(self, robot: str, landmark: str, glimpse: Glimpse) -> list[str | int]:
        """Remember it, and locate the landmark when that suffices; what is placed by that."""
        frame = self._frames.of(robot)
        kept = self._glimpses[id(frame)].setdefault(landmark, [])
        kept.append(glimpse)
        found = None if landmark in frame.located else self._located(kept, frame)
        return [] if found is None else self._frames.place_landmark(landmark, frame, found)

    def see_robot(self, observer: str, target: str, glimpse: Glimpse, key_target: int) -> None:
        """Remember how a robot saw one of another frame."""
        kept = self._mutual.setdefault((observer, target), [])
        kept.append((glimpse, key_target))
        del kept[:-_MUTUAL_KEPT]

    def join_around(self, robot: str) -> tuple[Edge, list[str | int]] | None:
        """Join the robot's frame with another when what is known in both says how.

        Returns the relative pose of latest variables that follows from it, and what is placed by it.
        """
        frame, frames = self._frames.of(robot), self._frames
        for other in frames.all():
            if other is frame or not any(frames.tracks[m].keys for m in other.members if m in frames.tracks):
                continue
            stays, goes = (frame, other) if frame is frames.anchored else (other, frame)
            both = id(stays), id(goes)
            self._fixes[both] += 1
            if self._fixes[both] < self._next_try.get(both, 0):
                continue
            alignment = self._pairs(stays, goes).aligned(self._settings)
            if alignment is None:
                self._next_try[both] = self._fixes[both] * _RETRY + 1
                continue
            edge = self._edge(stays, goes, alignment)
            placed = frames.merge(stays, goes, alignment.T_a_b)
            self.merged(stays, goes)
            return edge, placed
        return None

    def merged(self, stays: Frame, goes: Frame) -> None:
        """Two frames have become one."""
        for landmark, glimpses in self._glimpses.pop(id(goes), {}).items():
            kept = self._glimpses[id(stays)].setdefault(landmark, [])
            kept.extend(glimpses)
        for pair in [pair for pair in self._mutual if self._frames.of(pair[0]) is self._frames.of(pair[1])]:
            del self._mutual[pair]

    def _pairs(self, stays: Frame, goes: Frame) -> Pairs:
        pairs = Pairs([], [], [], [])
        for point_a, point_b, sigma in self._shared(stays, goes):
            pairs.add(point_a, point_b, sigma)
        for (observer, target), kept in self._mutual.items():
            sides = self._frames.of(observer), self._frames.of(target)
            if sides == (stays, goes) or sides == (goes, stays):
                self._add_mutual(pairs, kept, *sides, flipped=sides[0] is goes)
        return pairs

    def _shared(self, stays: Frame, goes: Frame) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
        """Landmarks that are located in one of the frames, and each glimpse of them from the other."""
        guess, point = self._frames.guess, self._frames.point
        seen_stays, seen_goes = self._glimpses[id(stays)], self._glimpses[id(goes)]
        for landmark in seen_goes:
            if landmark in stays.located:
                here = point(landmark, stays)
                for glimpse in _points(seen_goes[landmark]):
                    yield here, glimpse.seen_from(guess(glimpse.key, goes)), glimpse.sigma_m
            elif landmark in goes.located:
                there = point(landmark, goes)
                for glimpse in _points(seen_stays.get(landmark, ())):
                    yield glimpse.seen_from(guess(glimpse.key, stays)), there, glimpse.sigma_m

    def _add_mutual(self, pairs: Pairs, kept, eyes: Frame, others: Frame, flipped: bool) -> None:
        for glimpse, key_target in kept:
            if isinstance(glimpse.fix, BearingFix):
                continue
            eye = self._frames.guess(glimpse.key, eyes)
            seen = glimpse.seen_from(eye) if glimpse.is_point else position(eye)
            there = position(self._frames.guess(key_target, others))
            range_m = None if glimpse.is_point else glimpse.fix.range_m
            pairs.add(*((there, seen) if flipped else (seen, there)), glimpse.sigma_m, range_m)

    def _edge(self, stays: Frame, goes: Frame, alignment: Alignment) -> Edge:
        """The alignment as a relative pose between two latest variables."""
        key_a, key_b = self._latest(stays), self._latest(goes)
        T_goes_b = self._frames.guess(key_b, goes)
        T_a_b = self._frames.guess(key_a, stays).between(alignment.T_a_b * T_goes_b)
        return Edge(key_a, key_b, T_a_b, alignment.covariance_at(T_goes_b))

    def _latest(self, frame: Frame) -> int:
        tracks = [self._frames.tracks[m] for m in frame.members if m in self._frames.tracks]
        return next(track.keys[-1] for track in tracks if track.keys)

    def _located(self, kept: list[Glimpse], frame: Frame) -> np.ndarray | None:
        """A landmark's first guess: two glimpses that agree, or several ranges, or several bearings."""
        last, guess, drift = kept[-1], self._frames.guess, self._settings.drift_sigma_m
        if last.is_point:
            here = last.seen_from(guess(last.key, frame))
            for other in _points(kept[:-1]):
                there = other.seen_from(guess(other.key, frame))
                sigma = np.sqrt(last.sigma_m**2 + other.sigma_m**2 + drift**2)
                if np.hypot(*(here - there)) <= self._settings.gate_sigmas * sigma:
                    return (here + there) / 2
            return None
        if len(kept) < 6 or len(kept) % 4 != 2:
            return None
        kind = type(last.fix)
        same = [glimpse for glimpse in kept[-_KEPT:] if isinstance(glimpse.fix, kind)]
        eyes = [guess(glimpse.key, frame) for glimpse in same]
        points = np.array([position(eye) for eye in eyes])
        if kind is BearingFix:
            directions = [eye.theta() + glimpse.fix.bearing_rad for eye, glimpse in zip(eyes, same, strict=True)]
            return intersect(points, np.array(directions), np.array([glimpse.fix.sigma_rad for glimpse in same]))
        sigmas = np.hypot([glimpse.sigma_m for glimpse in same], drift)
        return locate(points, np.array([glimpse.fix.range_m for glimpse in same]), sigmas)


def _points(glimpses: list[Glimpse]) -> list[Glimpse]:
    return [glimpse for glimpse in glimpses[-_KEPT:] if glimpse.is_point]
