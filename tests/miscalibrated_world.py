"""Robots with wrong scales, offsets and clocks that drive among landmarks; knows records only, no estimators."""

from dataclasses import dataclass, field

import numpy as np

from coopslam.records import BearingRangeFix, Odometry, Record, RelativePoseFix
from coopslam.se2 import Pose2, wrap

STEP_S = 0.1
STEP_SIGMAS = np.array([1.5e-3, 0.5e-3, 2e-3])  # m, m, rad of true motion, at the end of each step
RANGE_SIGMA_M, BEARING_SIGMA_RAD = 0.02, 0.01
CLAIMED_SIGMAS = (0.03, 0.15)  # bearing, range: what the records say, of cameras that are not calibrated
TRACKER_SIGMAS = np.array([0.01, 0.01, 0.01])  # x, y, heading
HALF_VIEW_RAD = 0.6

# range offset, range scale, bearing offset, odometry scale, turn scale, creep, drift, delay; the mean scales are equal;
# a ninth is the heading offset with which a tracker sees the robot
PLANTED = {
    "a": (0.06, 1.03, 0.010, 1.05, 0.93, -0.06, -0.05, 0.25),
    "b": (-0.04, 0.98, -0.015, 1.00, 1.04, 0.03, 0.04, 0.15),
    "c": (0.02, 1.05, 0.005, 1.01, 0.97, 0.00, -0.02, -0.10),
}
NOTHING_WRONG = (0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Track:
    """Where a robot really was."""

    stamps_s: np.ndarray
    poses: list[Pose2]


@dataclass
class MiscalibratedWorld:
    """What robots recorded, and where everything really was."""

    robots: tuple[str, ...]
    landmarks: dict[str, np.ndarray]
    records: list[Record] = field(default_factory=list)  # by stamp
    truth: dict[str, Track] = field(default_factory=dict)


def miscalibrated_world(
    seed: int,
    planted: dict[str, tuple] = PLANTED,
    duration_s: float = 90.0,
    is_depth: bool = True,
    landmarks: int = 15,
    tracker: bool = False,
    looks_s: float = 0.5,
) -> MiscalibratedWorld:
    """A world of 8 m by 8 m.

    is_depth: cameras give the depth along their axis.  tracker: relative poses of robots seen by robots.
    looks_s: time between two looks of a robot around.
    """
    rng = np.random.default_rng(seed)
    points = {f"L{k}": rng.uniform(-4, 4, 2) for k in range(landmarks)}
    world = MiscalibratedWorld(tuple(planted), points)
    steps = int(duration_s / STEP_S)
    for number, (robot, wrong) in enumerate(planted.items()):
        _drive(world, robot, wrong, steps, number, rng)
    for k in range(2, steps - 2):
        if (k * STEP_S) % looks_s < STEP_S / 2:
            for robot in planted:
                _look(world, robot, planted, k, is_depth, tracker, rng)
    world.records.sort(key=lambda record: (record.stamp_s, not isinstance(record, Odometry)))
    return world


def _drive(world, robot, wrong, steps, number, rng) -> None:
    """Odometry is what a robot was told; what it then does differs by what is wrong, and by chance."""
    scale, turn_scale, creep, drift, delay = wrong[3:8]
    poses = [Pose2(*rng.uniform(-2, 2, 2), rng.uniform(-np.pi, np.pi))]
    for k in range(steps):
        phase = (k // 37 + number) % 4  # 3.7 s each: straight, left or right on the spot, a curve, a stop
        outward = poses[-1].bearing(np.zeros(2)).theta()
        side = np.sign(outward) if outward else 1.0
        told = ((0.3, 0.0), (0.0, 0.5 * side), (0.25, 0.4 * side), (0.0, 0.0))[phase]
        forward, turn = told[0] * STEP_S, told[1] * STEP_S
        truly = Pose2.Expmap(np.array([scale * forward + creep * abs(turn), 0.0, turn_scale * turn + drift * forward]))
        moving = forward != 0 or turn != 0
        noise = STEP_SIGMAS * moving * rng.standard_normal(3)
        start, end = k * STEP_S - delay, (k + 1) * STEP_S - delay
        cov = np.diag((moving * STEP_SIGMAS / np.array([scale, scale, turn_scale])) ** 2)
        step = Pose2.Expmap(np.array([forward, 0.0, turn]))
        world.records.append(Odometry(start, end, robot, step, cov))
        poses.append(poses[-1] * truly * Pose2(*noise))
    world.truth[robot] = Track(np.arange(steps + 1) * STEP_S, poses)


def _look(world, robot, planted, k, is_depth, tracker, rng) -> None:
    """All that is in view, at the time of the k-th true pose."""
    offset, scale, bearing_offset = planted[robot][:3]
    pose, stamp = world.truth[robot].poses[k], k * STEP_S
    others = {other: track.poses[k] for other, track in world.truth.items() if other != robot}
    places = world.landmarks | {other: other_pose.translation() for other, other_pose in others.items()}
    for target, place in places.items():
        range_m, bearing = pose.range(place), pose.bearing(place).theta()
        if abs(bearing) > HALF_VIEW_RAD or not 0.5 < range_m < 6.0:
            continue
        if tracker and target in others:
            true = pose.between(others[target]) * Pose2(*(TRACKER_SIGMAS * rng.standard_normal(3)))
            x, y = np.array([true.x(), true.y()]) * (scale + offset / np.hypot(true.x(), true.y()))
            askew = sum(planted[target][8:])
            seen = Pose2(0, 0, bearing_offset) * Pose2(x, y, true.theta() + askew)
            cov = np.diag(TRACKER_SIGMAS**2)
            world.records.append(RelativePoseFix(stamp, robot, target, seen, cov))
            continue
        read = float(wrap(bearing + bearing_offset + BEARING_SIGMA_RAD * rng.standard_normal()))
        measured = scale * (range_m + RANGE_SIGMA_M * rng.standard_normal()) + offset
        measured *= np.cos(read) if is_depth else 1.0
        cov = np.diag(np.square(CLAIMED_SIGMAS))
        world.records.append(BearingRangeFix(stamp, robot, target, read, float(measured), cov))
