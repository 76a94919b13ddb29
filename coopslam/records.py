"""What robots measure and what the team decides: the vocabulary between sensors, logs and estimators.

Every record is immutable, in SI units and radians, stamped in seconds, and refuses nonsense when it is
made. Covariances name their axes. A log is a header and a sequence of records.
"""

from dataclasses import dataclass, field
from math import isfinite, pi

import numpy as np

from coopslam.errors import BadRecord
from coopslam.se2 import Pose2, is_covariance, xytheta


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """A robot's own measurement of how it moved from `start_s` to `stamp_s`."""

    start_s: float
    stamp_s: float
    robot: str
    T_start_now: Pose2
    cov_now: np.ndarray  # (3, 3); axes of the robot at stamp_s

    def __post_init__(self):
        _check_stamp(self.stamp_s, self.robot)
        if not isfinite(self.start_s) or self.start_s > self.stamp_s:
            raise BadRecord(f"odometry of {self.robot} runs from t = {self.start_s:g} s back to {self.stamp_s:g} s")
        _check_pose(self.T_start_now, f"odometry of {self.robot}", self.stamp_s)
        _check_cov(self.cov_now, 3, f"odometry of {self.robot}", self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class RelativePoseFix:
    """The robot tracker: range, bearing and heading of the target, as a pose in the observer's frame."""

    stamp_s: float
    observer: str
    target: str
    T_observer_target: Pose2
    cov_observer: np.ndarray  # (3, 3); x and y in the observer's axes

    def __post_init__(self):
        _check_pair(self.stamp_s, self.observer, self.target)
        _check_pose(self.T_observer_target, f"fix of {self.target} by {self.observer}", self.stamp_s)
        _check_cov(self.cov_observer, 3, f"fix of {self.target} by {self.observer}", self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class BearingRangeFix:
    """Bearing and range of a robot or landmark, without its heading."""

    stamp_s: float
    observer: str
    target: str
    bearing_rad: float
    range_m: float
    cov: np.ndarray  # (2, 2); order (bearing, range); rad, m

    def __post_init__(self):
        _check_pair(self.stamp_s, self.observer, self.target)
        if not isfinite(self.bearing_rad):
            raise BadRecord(f"{self.observer} reports the bearing {self.bearing_rad} at t = {self.stamp_s:.3f} s")
        _check_range(self.range_m, self.observer, self.stamp_s)
        _check_cov(self.cov, 2, f"fix of {self.target} by {self.observer}", self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class RangeFix:
    """Distance to a robot or landmark."""

    stamp_s: float
    observer: str
    target: str
    range_m: float
    sigma_m: float

    def __post_init__(self):
        _check_pair(self.stamp_s, self.observer, self.target)
        _check_range(self.range_m, self.observer, self.stamp_s)
        _check_sigma(self.sigma_m, self.observer, self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class BearingFix:
    """Direction to a robot or landmark in the observer's frame."""

    stamp_s: float
    observer: str
    target: str
    bearing_rad: float
    sigma_rad: float

    def __post_init__(self):
        _check_pair(self.stamp_s, self.observer, self.target)
        if not isfinite(self.bearing_rad):
            raise BadRecord(f"{self.observer} reports the bearing {self.bearing_rad} at t = {self.stamp_s:.3f} s")
        _check_sigma(self.sigma_rad, self.observer, self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """A robot now in the frame of a robot, itself or another, at an earlier time: what matching two scans gives."""

    earlier_s: float
    stamp_s: float
    earlier_robot: str
    robot: str
    T_earlier_now: Pose2
    cov_now: np.ndarray  # (3, 3); axes of the robot at stamp_s

    def __post_init__(self):
        _check_stamp(self.stamp_s, self.robot)
        if not isfinite(self.earlier_s) or self.earlier_s > self.stamp_s:
            raise BadRecord(f"loop closure of {self.robot}: {self.earlier_s:g} s is not before {self.stamp_s:g} s")
        if self.earlier_s == self.stamp_s and self.earlier_robot == self.robot:
            raise BadRecord(f"loop closure of {self.robot} with itself at t = {self.stamp_s:.3f} s")
        _check_pose(self.T_earlier_now, f"loop closure of {self.robot}", self.stamp_s)
        _check_cov(self.cov_now, 3, f"loop closure of {self.robot}", self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """Where a robot is in the frame of the first robot's start, from a survey or a satellite receiver."""

    stamp_s: float
    robot: str
    T_start_robot: Pose2
    cov_robot: np.ndarray  # (3, 3); axes of the robot

    def __post_init__(self):
        _check_stamp(self.stamp_s, self.robot)
        _check_pose(self.T_start_robot, f"prior of {self.robot}", self.stamp_s)
        _check_cov(self.cov_robot, 3, f"prior of {self.robot}", self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkPrior:
    """Where a landmark is in the frame of the first robot's start, from a survey."""

    stamp_s: float
    landmark: str
    xy: np.ndarray  # (2,), m
    cov: np.ndarray  # (2, 2); axes of the frame, m^2

    def __post_init__(self):
        _check_stamp(self.stamp_s, self.landmark)
        if np.shape(self.xy) != (2,) or not np.isfinite(self.xy).all():
            raise BadRecord(f"the prior of {self.landmark} is {np.asarray(self.xy).tolist()}; x and y in m expected")
        _check_cov(self.cov, 2, f"prior of {self.landmark}", self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class CornerSighting:
    """The short-range finder: a corner as an oriented pose, and its interior (free) angle.

    The corner's heading is the direction of the wall that leaves it with free space on the left.
    """

    stamp_s: float
    observer: str
    T_observer_corner: Pose2
    cov_observer: np.ndarray  # (3, 3); x and y in the observer's axes
    interior_angle_rad: float  # in (0, 2 pi), counter-clockwise from the leaving wall to the arriving wall
    interior_angle_sigma_rad: float

    def __post_init__(self):
        _check_stamp(self.stamp_s, self.observer)
        _check_pose(self.T_observer_corner, f"corner seen by {self.observer}", self.stamp_s)
        _check_cov(self.cov_observer, 3, f"corner seen by {self.observer}", self.stamp_s)
        if not 0.0 < self.interior_angle_rad < 2 * pi:
            angle = f"an interior angle of {self.interior_angle_rad:g} rad"
            raise BadRecord(f"{self.observer} reports {angle} at t = {self.stamp_s:.3f} s; in (0, 2 pi) expected")
        _check_sigma(self.interior_angle_sigma_rad, self.observer, self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class CornerDecision:
    """The team decides that a corner sighting is a certain map vertex, new or known, and says why."""

    stamp_s: float
    sighting: CornerSighting
    vertex: int
    is_new: bool
    distance_sq: float | None = None  # squared Mahalanobis distance (3 dof) to the vertex; None when new
    runner_up_sq: float | None = None  # the same for the best other candidate
    evidence: str = ""

    def __post_init__(self):
        _check_stamp(self.stamp_s, f"a corner decision on vertex {self.vertex}")
        if self.vertex < 0:
            raise BadRecord(f"a corner decision names vertex {self.vertex}; zero or more expected")


@dataclass(frozen=True, slots=True, eq=False)
class CornerEvidence:
    """What the team did to find out whether the corner in which a robot stands is a certain map vertex."""

    stamp_s: float
    observer: str
    vertex: int
    done: str
    log_odds: float  # afterwards: natural logarithm of "is the vertex" over "is a corner never seen before"

    def __post_init__(self):
        _check_stamp(self.stamp_s, self.observer)
        if not isfinite(self.log_odds):
            raise BadRecord(f"{self.observer} has log odds of {self.log_odds} that it stands in vertex {self.vertex}")


@dataclass(frozen=True, slots=True, eq=False)
class WallDecision:
    """The team decides that a straight wall joins two map vertices; free space lies left of start -> end."""

    stamp_s: float
    start: int
    end: int
    straightness_sigma_rad: float = 1e-4

    def __post_init__(self):
        _check_stamp(self.stamp_s, f"the wall from vertex {self.start} to {self.end}")
        if self.start == self.end:
            raise BadRecord(f"a wall from vertex {self.start} to itself at t = {self.stamp_s:.3f} s")
        _check_sigma(self.straightness_sigma_rad, f"the wall from vertex {self.start} to {self.end}", self.stamp_s)


@dataclass(frozen=True, slots=True, eq=False)
class TriangleDecision:
    """The team decides that the triangle of three map vertices (counter-clockwise) is free."""

    stamp_s: float
    triangle: int
    vertices: tuple[int, int, int]

    def __post_init__(self):
        _check_stamp(self.stamp_s, f"triangle {self.triangle}")
        if len(set(self.vertices)) != 3:
            raise BadRecord(f"triangle {self.triangle} has the vertices {self.vertices}; three different ones expected")


@dataclass(frozen=True, slots=True, eq=False)
class MoveNote:
    """What a robot was told to do, who watched, and why the move ended; the log's thread for a reader."""

    stamp_s: float
    robot: str
    watcher: str
    move: str
    ended: str

    def __post_init__(self):
        _check_stamp(self.stamp_s, self.robot)


Prior = PosePrior | LandmarkPrior
PointFix = BearingRangeFix | RangeFix | BearingFix  # of a robot or a landmark, without its heading
Measurement = Odometry | RelativePoseFix | PointFix | LoopClosure | CornerSighting | Prior
Decision = CornerDecision | CornerEvidence | WallDecision | TriangleDecision
Record = Measurement | Decision | MoveNote


@dataclass(frozen=True, slots=True)
class LogHeader:
    """What a reader must know before the first record."""

    robots: tuple[str, ...]
    landmarks: tuple[str, ...] = ()  # points that robots see; where they are is unknown
    frame: str = "start pose of the first robot"
    seed: int | None = None
    world: str = ""
    sensor_models: dict = field(default_factory=dict)
    provenance: str = ""

    def __post_init__(self):
        if not self.robots or len(set(self.robots)) != len(self.robots):
            raise BadRecord(f"a log needs different robot names, not {self.robots}")
        names = self.robots + self.landmarks
        if len(set(names)) != len(names):
            raise BadRecord(f"a log needs different names for its landmarks {self.landmarks} and robots {self.robots}")


def _check_stamp(stamp_s: float, who: str) -> None:
    if not isfinite(stamp_s):
        raise BadRecord(f"a record of {who} has the time stamp {stamp_s}")


def _check_pair(stamp_s: float, observer: str, target: str) -> None:
    _check_stamp(stamp_s, observer)
    if observer == target:
        raise BadRecord(f"{observer} cannot observe itself (t = {stamp_s:.3f} s)")


def _check_pose(pose: Pose2, what: str, stamp_s: float) -> None:
    if not np.isfinite(xytheta(pose)).all():
        raise BadRecord(f"{what} is not finite at t = {stamp_s:.3f} s: {xytheta(pose)}")


def _check_cov(cov: np.ndarray, size: int, what: str, stamp_s: float) -> None:
    if not is_covariance(cov, size):
        raise BadRecord(f"{what} has no ({size}, {size}) covariance at t = {stamp_s:.3f} s: {np.asarray(cov).tolist()}")


def _check_range(range_m: float, observer: str, stamp_s: float) -> None:
    if not isfinite(range_m) or range_m < 0:
        raise BadRecord(f"{observer} reports the range {range_m} m at t = {stamp_s:.3f} s; zero or more expected")


def _check_sigma(sigma: float, observer: str, stamp_s: float) -> None:
    if not isfinite(sigma) or sigma <= 0:
        raise BadRecord(f"{observer} reports the sigma {sigma} at t = {stamp_s:.3f} s; more than zero expected")
