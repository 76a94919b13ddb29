"""A tiny world for tests of the estimators: two robots leap-frog around a ring and look at corners; no walls."""

from dataclasses import dataclass

import gtsam
import numpy as np

from coopslam.estimation.estimate import Trajectory
from coopslam.estimation.keys import is_vertex
from coopslam.records import CornerDecision, CornerSighting, Odometry, Record, RelativePoseFix
from coopslam.se2 import Pose2, position, wrap, xytheta

ROBOTS = ("robot0", "robot1")
FIX_COV = np.diag([0.02, 0.03, 0.01]) ** 2
CORNER_COV = np.diag([0.01, 0.02, 0.02]) ** 2


@dataclass
class LeapFrog:
    """Groups of records, one per leg, and the truth in the frame of robot0's start."""

    groups: list[list[Record]]
    truth: dict[str, Trajectory]
    corners: dict[int, Pose2]

    @property
    def records(self) -> list[Record]:
        return [record for group in self.groups for record in group]

    def values(self, timeline, keys) -> gtsam.Values:
        """True values of variables."""
        of_pose = {key: robot for robot, track in timeline.tracks.items() for key in track.keys}
        values = gtsam.Values()
        for key in keys:
            if is_vertex(key):
                values.insert(key, self.corners[gtsam.symbolIndex(key)])
            else:
                truth = self.truth[of_pose[key]]
                values.insert(key, truth.poses[int(np.argmin(np.abs(truth.stamps_s - timeline.stamps[key])))])
        return values


def leapfrog(rng: np.random.Generator, legs: int, steps: int = 3, scale: float = 1.0, corners: int = 6) -> LeapFrog:
    """scale: of all sigmas, true and believed alike; a corner is seen again after `corners` legs."""
    where = {"robot0": Pose2(), "robot1": Pose2(1.0, -0.5, 0.4)}
    history = {robot: ([0.0], [pose]) for robot, pose in where.items()}
    known: dict[int, Pose2] = {}
    stamp = 0.0

    def noisy(pose, cov):
        return pose * Pose2(*(rng.standard_normal(3) * np.sqrt(np.diag(cov))))

    def observed(pose, cov):
        """With noise in the observer's axes."""
        dx, dy, dtheta = rng.standard_normal(3) * np.sqrt(np.diag(cov))
        return Pose2(pose.x() + dx, pose.y() + dy, pose.theta() + dtheta)

    def fix(observer, target):
        relative = where[observer].between(where[target])
        return RelativePoseFix(stamp, observer, target, observed(relative, FIX_COV * scale**2), FIX_COV * scale**2)

    groups: list[list[Record]] = [[fix("robot0", "robot1")]]
    for leg in range(legs):
        mover, watcher = ("robot1", "robot0") if leg % 2 == 0 else ("robot0", "robot1")
        angle = 2 * np.pi * (leg % corners) / corners
        goal = 4.0 * np.array([np.cos(angle) - 1.0, np.sin(angle)]) + rng.normal(size=2) * 0.2
        along = goal - position(where[mover])
        turn = float(wrap(np.arctan2(along[1], along[0]) - where[mover].theta()))
        length = float(np.hypot(*along)) / steps
        group: list[Record] = []
        for step in range(steps):
            turned = turn if step == 0 else 0.0
            delta = Pose2(0, 0, turned) * Pose2(length, 0, 0)
            per_metre, per_radian = (0.03 * scale) ** 2 * length, (0.02 * scale) ** 2 * abs(turned)
            cov = np.diag([per_metre, per_metre / 4, per_metre + per_radian])
            group.append(Odometry(stamp, stamp + 1.0, mover, noisy(delta, cov), cov))
            stamp += 1.0
            where[mover] = where[mover] * delta
            history[mover][0].append(stamp)
            history[mover][1].append(where[mover])
            group.append(fix(watcher, mover))
        vertex = leg % corners
        is_new = vertex not in known
        corner = known.setdefault(vertex, where[mover] * Pose2(0.1, 0.1, 1.0))
        seen = observed(where[mover].between(corner), CORNER_COV * scale**2)
        sighting = CornerSighting(stamp, mover, seen, CORNER_COV * scale**2, 1.5, 0.01)
        group += [sighting, CornerDecision(stamp, sighting, vertex, is_new)]
        groups.append(group)
    truth = {robot: Trajectory(np.array(stamps), poses) for robot, (stamps, poses) in history.items()}
    return LeapFrog(groups, truth, known)


def difference(a: Pose2, b: Pose2) -> float:
    """Largest of the differences in x, y (m) and heading (rad)."""
    return float(np.abs(xytheta(a.between(b))).max())
