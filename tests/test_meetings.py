import time

import gtsam
import numpy as np
import pytest
from landmark_world import STEP_S, landmark_world

from coopslam.estimation.keys import value_of
from coopslam.estimation.meetings import Tries
from coopslam.estimation.timeline import Timeline
from coopslam.records import BearingRangeFix, Odometry, RangeFix
from coopslam.se2 import Pose2, xytheta


class Guesses:
    """A timeline whose guesses are taken as they are: odometry, and what joined frames."""

    def __init__(self, world, group=20):
        self.world, self.timeline, self.values = world, Timeline(world.robots, world.landmarks), gtsam.Values()
        self.joined = []  # edges between robots
        for k in range(0, len(world.records), group):
            growth = self.timeline.extend(world.records[k : k + group], lambda key: value_of(self.values, key))
            self.values.insert(growth.values)
            self.joined += [edge for edge in growth.tree if edge.key_a >> 32 != edge.key_b >> 32]

    def error(self, robot):
        """(3,) of the guess of where the robot started."""
        start = self.values.atPose2(self.timeline.tracks[robot].keys[0])
        return xytheta(self.world.start_of(robot).between(start))

    def true_relative(self, edge):
        robots = [self.world.robots[(key >> 32) & 0xFFFFFF] for key in (edge.key_a, edge.key_b)]
        poses = [
            self.world.truth[robot][round(self.timeline.stamps[key] / STEP_S)]
            for robot, key in zip(robots, (edge.key_a, edge.key_b), strict=True)
        ]
        return poses[0].between(poses[1])


WAYS = {
    "common landmarks": {"targets": "landmarks"},
    "each other": {"targets": "robots"},
    "both": {},
    "distances of each other": {"targets": "robots", "kind": "range", "steps": 120},
    "false names of landmarks": {"targets": "landmarks", "false_share": 0.1},
    "false names of all": {"robots": 3, "false_share": 0.1},
}


@pytest.mark.parametrize("way", WAYS)
def test_robots_that_started_anywhere_find_each_other(way):
    found = 0
    for seed in range(8):
        run = Guesses(landmark_world(seed, **WAYS[way]))
        for robot in run.world.robots[1:]:
            if run.timeline.is_placed(robot):
                found += 1
                assert np.abs(run.error(robot)).max() < 1.0  # drift of 30 s, before any smoothing
        for edge in run.joined:
            error = xytheta(run.true_relative(edge).between(edge.T_a_b))
            # guesses drift, and the caution of 3 in the sigmas is for that
            assert error @ np.linalg.solve(edge.cov_b, error) < 25.0
    assert found >= 6 * (len(run.world.robots) - 1)  # in some worlds robots hardly meet


def test_who_has_nothing_in_common_stays_apart():
    world = landmark_world(3, robots=3, blind=("r2",), false_share=0.1)
    run = Guesses(world)
    assert [run.timeline.is_placed(robot) for robot in world.robots] == [True, True, False]
    # the blind robot is never asked for a pose, so nothing of it waits but what it drove
    assert not any(key >> 32 & 0xFFFFFF == 2 for key in run.values.keys())  # noqa: SIM118 - Values is no dict


def test_directions_alone_join_no_frames_but_locate_landmarks():
    run = Guesses(landmark_world(2, kind="bearing"))
    assert not run.timeline.is_placed("r1")
    assert len(run.timeline.placed_landmarks) > 3
    for landmark in run.timeline.placed_landmarks:
        place = value_of(run.values, gtsam.symbol("l", run.timeline.landmarks.index(landmark)))
        true = run.world.truth["r0"][0].transformTo(run.world.landmarks[landmark])
        assert np.hypot(*(place - true)) < 1.0


def test_distances_alone_locate_landmarks_and_join_frames_by_them():
    placed = 0
    for seed in range(4):
        run = Guesses(landmark_world(seed, kind="range", targets="landmarks", steps=150))
        for landmark in run.timeline.placed_landmarks:
            place = value_of(run.values, gtsam.symbol("l", run.timeline.landmarks.index(landmark)))
            true = run.world.truth["r0"][0].transformTo(run.world.landmarks[landmark])
            assert np.hypot(*(place - true)) < 1.0
        assert len(run.timeline.placed_landmarks) > 6
        if run.timeline.is_placed("r1"):
            placed += 1
            assert np.abs(run.error("r1")).max() < 1.0
    assert placed >= 2


def test_one_false_glimpse_places_nothing_and_two_that_agree_do():
    fix = [BearingRangeFix(1.0, "r0", "L0", bearing, 3.0, np.diag([0.01, 0.05]) ** 2) for bearing in (0.0, 1.5, 0.01)]
    timeline, never = Timeline(("r0",), ("L0",)), lambda key: pytest.fail("nothing was handed out")
    timeline.extend(fix[:2], never)
    assert not timeline.placed_landmarks and timeline.held_back == 2
    values = timeline.extend(fix[2:], lambda key: Pose2()).values
    np.testing.assert_allclose(values.atPoint2(gtsam.symbol("l", 0)), [3.0, 0.015], atol=1e-3)
    assert timeline.held_back == 0


def test_what_failed_is_tried_ever_more_seldom():
    tries = Tries(next_at=6)
    due = [number for number in range(1, 50_001) if tries.is_due()]
    assert due[:4] == [6, 9, 13, 18]
    # each try waits for a quarter more fixes than the last: log(50 000 / 6) / log(1.25)
    assert len(due) <= 41


def many_fixes(count, others):
    """Two robots that circle, each about landmarks or hints of its own; never joined unless they share them."""
    rng = np.random.default_rng(0)
    step, cov = Pose2(0.3, 0, 0.1), np.diag([0.01, 0.01, 0.01]) ** 2
    for k in range(count // 2):
        stamp = 0.1 * (k + 1)
        for robot, targets in others.items():
            yield Odometry(stamp - 0.1, stamp, robot, step, cov)
            target = targets[k % len(targets)]
            if target.startswith("r"):
                yield RangeFix(stamp, robot, target, rng.uniform(1, 9), 0.1)
            else:
                pose = Pose2.Expmap((k + 1) * Pose2.Logmap(step))
                xy = np.array([len(target), 3.0 + ord(target[-1]) % 7])
                bearing = pose.bearing(xy).theta()
                yield BearingRangeFix(stamp, robot, target, bearing, pose.range(xy), np.diag([0.02, 0.1]) ** 2)


def seconds(records, robots, landmarks, group=500):
    """Of the processor, that a timeline takes for the records."""
    timeline, values, began = Timeline(robots, landmarks), gtsam.Values(), time.process_time()
    for k in range(0, len(records), group):
        growth = timeline.extend(records[k : k + group], lambda key: value_of(values, key))
        values.insert(growth.values)
    return time.process_time() - began, timeline


def test_a_robot_that_never_joins_does_not_make_a_log_slow():
    """Against the same number of fixes of robots that join at once. With 50 000 fixes: 5.6 s against 3.1 s."""
    names = ("r0", "r1")
    apart = list(many_fixes(4_000, {"r0": ("La", "Lb", "Lc", "r1"), "r1": ("Ld", "Le", "Lf", "r0")}))
    joined = list(many_fixes(4_000, {"r0": ("La", "Lb", "Lc"), "r1": ("La", "Lb", "Lc")}))
    landmarks = ("La", "Lb", "Lc", "Ld", "Le", "Lf")
    slow, timeline = seconds(apart, names, landmarks)
    assert not timeline.is_placed("r1")  # distances that fit nowhere
    fast, timeline = seconds(joined, names, landmarks)
    assert timeline.is_placed("r1")
    assert slow < 2 * fast + 4.0  # some 27 tries of 0.05 s, and as many when others use the machine
