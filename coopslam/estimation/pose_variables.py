"""Which robot has a pose variable when: a new one where a record needs it, after the robot has driven."""

from bisect import bisect_right
from collections.abc import Iterable

import numpy as np

from coopslam.estimation import factors
from coopslam.estimation.assembly import Assembly
from coopslam.estimation.keys import pose_key
from coopslam.estimation.tracks import Edge, Track
from coopslam.records import Odometry
from coopslam.se2 import Pose2, chain_covariance

STAMP_TOLERANCE_S = 1e-6  # two stamps closer than this are the same instant
_ANYWHERE_M = 50.0  # random starts lie at most so far from the origin along either axis


def tracks_of(robots: Iterable[str]) -> dict[str, Track]:
    """An empty track for each robot."""
    return {robot: Track(robot, index) for index, robot in enumerate(robots)}


class PoseVariables:
    """Makes the pose variables, and the legs of odometry between them."""

    def __init__(self, tracks: dict[str, Track], assembly: Assembly, every_leg: bool, random_start: int | None = None):
        """every_leg: a variable at the end of each odometry record.  random_start: seed of where robots begin."""
        self.stamps: dict[int, float] = {}  # pose key -> s
        self._tracks, self._assembly, self._every_leg = tracks, assembly, every_leg
        self._random_start = random_start

    def drive(self, record: Odometry) -> bool:
        """Compose it with the odometry since the last variable; False when it goes back in time."""
        track = self._tracks[record.robot]
        if record.start_s < track.odometry_end_s - STAMP_TOLERANCE_S:
            return False
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
        if self._every_leg:
            self._end_leg(track)
        return True

    def at(self, robot: str, stamp_s: float) -> int | None:
        """The robot's variable at an instant, made if needed; None when it is too late for that."""
        track = self._tracks[robot]
        if not track.keys:
            self._begin(track, stamp_s)
        if track.moved and stamp_s >= track.odometry_end_s - STAMP_TOLERANCE_S:
            self._end_leg(track)
        number = max(bisect_right(track.since_s, stamp_s + STAMP_TOLERANCE_S) - 1, 0)
        stood = track.since_s[number] - STAMP_TOLERANCE_S <= stamp_s <= track.until_s[number] + STAMP_TOLERANCE_S
        return track.keys[number] if stood else None

    def first(self, robot: str, stamp_s: float) -> int:
        """The robot's first variable; one that has nothing yet has stood at its start until this instant."""
        if not self._tracks[robot].keys:
            self._begin(self._tracks[robot], stamp_s)
        return self._tracks[robot].keys[0]

    def _begin(self, track: Track, stamp_s: float) -> None:
        """The first variable of a robot: the origin of its own frame, or a random place in it."""
        guess = Pose2()
        if self._random_start is not None and track.index > 0:
            rng = np.random.default_rng((self._random_start, track.index))
            guess = Pose2(*rng.uniform(-_ANYWHERE_M, _ANYWHERE_M, 2), rng.uniform(-np.pi, np.pi))
        key = self._new_key(track, stamp_s, guess)
        if track.index == 0:
            self._assembly.add(factors.gauge_prior(key), (track.robot,))

    def _end_leg(self, track: Track) -> None:
        """A new variable at the end of the odometry since the last one."""
        last, frames, growth = track.keys[-1], self._assembly.frames, self._assembly.growth
        guess = frames.guess(last, frames.of(track.robot)) * track.T_last_now
        key = self._new_key(track, track.odometry_end_s, guess)
        self._assembly.add(factors.odometry_leg(last, key, track.T_last_now, track.cov_now), (track.robot,))
        growth.tree.append(Edge(last, key, track.T_last_now, track.cov_now))
        frames.doubt[key] = frames.doubt.get(last, 0.0) + float(np.trace(track.cov_now))
        track.moved, track.T_last_now, track.cov_now = False, Pose2(), np.zeros((3, 3))

    def _new_key(self, track: Track, stamp_s: float, guess: Pose2) -> int:
        key = pose_key(track.index, len(track.keys))
        track.keys.append(key)
        track.since_s.append(stamp_s)
        track.until_s.append(np.inf)
        self.stamps[key] = stamp_s
        self._assembly.frames.add_pose(track.robot, key, guess)
        return key


def is_motion(record: Odometry) -> bool:
    """Whether a robot may have moved; otherwise it stands, and knows it."""
    step = record.T_start_now
    return bool(step.x() or step.y() or step.theta() or np.any(record.cov_now))
