"""Robots that drive along curves among landmarks and measure bearings and ranges; knows records only, no estimators."""

from dataclasses import dataclass, field

import numpy as np

from coopslam.records import BearingFix, BearingRangeFix, Odometry, RangeFix, Record
from coopslam.se2 import Pose2

STEP_S = 0.5
STEP_SIGMAS = np.array([0.01, 0.003, 0.005])  # m, m, rad: of each step of odometry
RANGE_SIGMA_M, BEARING_SIGMA_RAD = 0.08, 0.03
SEES_M = {"bearing and range": 6.0, "bearing": 6.0, "range": 20.0}  # a camera, or a radio


@dataclass
class LandmarkWorld:
    """What robots recorded, and where everything really was."""

    robots: tuple[str, ...]
    landmarks: dict[str, np.ndarray]
    records: list[Record] = field(default_factory=list)  # by stamp
    truth: dict[str, list[Pose2]] = field(default_factory=dict)  # of each robot at 0, STEP_S, 2 STEP_S ...
    false: int = 0  # sightings with a wrong name

    def in_first_start(self, pose: Pose2) -> Pose2:
        """A true pose as an estimate tells it: in the frame of the first robot's start."""
        return self.truth[self.robots[0]][0].between(pose)

    def start_of(self, robot: str) -> Pose2:
        """Where a robot really started, in that frame."""
        return self.in_first_start(self.truth[robot][0])


def landmark_world(
    seed: int,
    robots: int = 2,
    landmarks: int = 12,
    steps: int = 60,
    kind: str = "bearing and range",
    targets: str = "all",
    false_share: float = 0.0,
    blind: tuple[str, ...] = (),
) -> LandmarkWorld:
    """A world of 8 m by 8 m.

    kind: of the sightings: "bearing and range", "range" or "bearing".  targets: "all", "landmarks" or "robots".
    false_share: of the sightings, with the name of another target.  blind: robots that see nothing and are not seen.
    """
    rng = np.random.default_rng(seed)
    names = tuple(f"r{k}" for k in range(robots))
    points = {f"L{k}": rng.uniform(-4, 4, 2) for k in range(landmarks)}
    world = LandmarkWorld(names, points if targets != "robots" else {})
    poses = {name: Pose2(*rng.uniform(-3, 3, 2), rng.uniform(-np.pi, np.pi)) for name in names}
    turns = {name: rng.uniform(0.06, 0.12) * rng.choice([-1, 1]) for name in names}
    world.truth = {name: [pose] for name, pose in poses.items()}
    for k in range(steps):
        stamp = (k + 1) * STEP_S
        for name in names:
            step = Pose2(0.25, 0.0, turns[name] * (1 + np.sin(k / 7 + len(name))))
            poses[name] = poses[name] * step
            world.truth[name].append(poses[name])
            measured = step * Pose2(*(STEP_SIGMAS * rng.standard_normal(3)))
            world.records.append(Odometry(stamp - STEP_S, stamp, name, measured, np.diag(STEP_SIGMAS**2)))
        for name in [name for name in names if name not in blind]:
            others = {other: poses[other].translation() for other in names if other not in (name, *blind)}
            seen = {**(world.landmarks if targets != "robots" else {}), **(others if targets != "landmarks" else {})}
            near = [target for target, xy in seen.items() if 0.3 < poses[name].range(np.asarray(xy)) < SEES_M[kind]]
            for target in rng.permutation(near)[:3].tolist():
                called = target
                if rng.random() < false_share and len(seen) > 1:
                    called = str(rng.choice([other for other in seen if other != target]))
                    world.false += 1
                world.records.append(_sighting(stamp, name, called, poses[name], np.asarray(seen[target]), kind, rng))
    return world


def _sighting(stamp: float, observer: str, target: str, pose: Pose2, xy: np.ndarray, kind: str, rng) -> Record:
    bearing = pose.bearing(xy).theta() + BEARING_SIGMA_RAD * rng.standard_normal()
    range_m = abs(pose.range(xy) + RANGE_SIGMA_M * rng.standard_normal())
    if kind == "range":
        return RangeFix(stamp, observer, target, range_m, RANGE_SIGMA_M)
    if kind == "bearing":
        return BearingFix(stamp, observer, target, bearing, BEARING_SIGMA_RAD)
    return BearingRangeFix(stamp, observer, target, bearing, range_m, np.diag([BEARING_SIGMA_RAD, RANGE_SIGMA_M]) ** 2)
