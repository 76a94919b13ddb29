"""The graph of records that have changed a little, started from the last solution: no search for where robots are."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from coopslam.estimation.driven_path import between, interpolated
from coopslam.estimation.keys import is_landmark, landmark_key, robot_index, value_of, vertex_key
from coopslam.estimation.loss import Loss
from coopslam.estimation.offline import require_connected
from coopslam.estimation.replay import in_groups
from coopslam.estimation.robust import is_tracker_fix
from coopslam.estimation.sensor_residuals import Course, Sightings, sightings_of
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.estimation.tracks import Edge, Growth
from coopslam.records import LandmarkPrior, Odometry, PosePrior, Record
from coopslam.se2 import Pose2

_GROUP_S = 10.0  # records that a timeline takes at once


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A solved trajectory that can be asked at any time, and the points around it."""

    courses: dict[str, Course]
    landmarks: dict[str, np.ndarray]  # name -> (2,)
    vertices: dict[int, Pose2]

    @classmethod
    def of(cls, timeline: Timeline, values: gtsam.Values, end_s: float) -> "Solution":
        """end_s: until then a robot stays that stands at last."""
        courses = {}
        for robot, track in timeline.tracks.items():
            if track.keys and timeline.is_placed(robot):
                poses = [values.atPose2(key) for key in track.keys]
                states = np.array([(pose.x(), pose.y(), pose.theta()) for pose in poses])
                courses[robot] = _course(np.array(track.since_s), np.array(track.until_s), states, end_s)
        places = {
            name: values.atPoint2(landmark_key(timeline.landmarks.index(name))) for name in timeline.placed_landmarks
        }
        return cls(courses, places, {vertex: values.atPose2(vertex_key(vertex)) for vertex in timeline.vertices})

    def sightings(self, records: Iterable[Record]) -> list[Sightings]:
        """What raw records say of what this solution has a place for."""
        return list(sightings_of(records, self.courses, self.landmarks).values())


def _course(since_s: np.ndarray, until_s: np.ndarray, states: np.ndarray, end_s: float) -> Course:
    """A robot stands from `since_s` to `until_s` of each pose, and drives between."""
    until_s = np.where(np.isfinite(until_s), until_s, np.maximum(since_s, end_s))
    stamps = np.maximum.accumulate(np.column_stack([since_s, until_s]).ravel())
    kept = np.concatenate([[True], np.diff(stamps) > 1e-9])
    states = np.repeat(states, 2, axis=0)
    states[:, 2] = np.unwrap(states[:, 2])
    return Course(stamps[kept], states[kept])


@dataclass(frozen=True, slots=True, eq=False)
class Rebuilt:
    """A graph and its start."""

    timeline: Timeline
    graph: gtsam.NonlinearFactorGraph
    legs: list[Edge]  # of odometry, and others that joined frames
    values: gtsam.Values


def rebuilt(
    records: Iterable[Record],
    robots: Sequence[str],
    landmarks: Sequence[str],
    settings: TimelineSettings,
    solution: Solution,
    robust_fixes: bool = False,
) -> Rebuilt:
    """The graph of synchronized records.

    robust_fixes: relative pose fixes get the loss of the other sightings; without, they are left to `solve_robust`.
    Raises UnderDetermined when nothing ties a robot down.
    """
    timeline, records = Timeline(robots, landmarks, settings), list(records)
    graph, legs, guesses = gtsam.NonlinearFactorGraph(), [], {}

    def known(key: int) -> Pose2 | np.ndarray:
        return _value(solution, timeline, key, guesses)

    def keep(growth: Growth) -> None:
        graph.push_back(growth.graph)
        legs.extend(growth.tree)
        for key in growth.values.keys():  # noqa: SIM118 - Values is no dict
            if robot_index(key) is None:
                guesses[key] = value_of(growth.values, key)

    keep(_with_places(timeline, records, solution, known))
    for group in in_groups(records, _GROUP_S):
        keep(timeline.extend(group, known))
    require_connected(timeline)
    if robust_fixes:
        _soften(graph, settings.loss)
    return Rebuilt(timeline, graph, legs, _start(solution, timeline, guesses))


def _with_places(
    timeline: Timeline, records: Sequence[Record], solution: Solution, known: Callable[[int], Pose2 | np.ndarray]
) -> Growth:
    """Tell a timeline where robots and landmarks are, as if they had been surveyed, and take the surveys out again.

    Records that are not quite calibrated yet might not convince it.
    """
    begins = _begins(records)
    surveys, origin = [], None
    for robot in timeline.robots:
        if robot not in begins or robot not in solution.courses:
            continue
        course = solution.courses[robot]
        pose = Pose2(*interpolated(course.stamps_s, course.states, np.array([begins[robot]]))[0])
        origin = pose if origin is None else origin
        surveys.append(PosePrior(begins[robot], robot, origin.between(pose), np.eye(3)))
    if not surveys or surveys[0].robot != timeline.robots[0]:
        return Growth()
    for name, place in solution.landmarks.items():
        if name in begins:
            surveys.append(LandmarkPrior(surveys[0].stamp_s, name, origin.transformTo(place), np.eye(2)))
    growth = timeline.extend(surveys, known)
    timeline.used.clear()
    gauge = gtsam.NonlinearFactorGraph()
    gauge.push_back(growth.graph.at(0))  # the first robot's first pose is the origin; the rest are the surveys
    return Growth(gauge, growth.values, growth.poses)


def _begins(records: Iterable[Record]) -> dict[str, float]:
    """Robot or landmark -> when the first record that names it begins."""
    begins: dict[str, float] = {}
    for record in records:
        stamp_s = record.start_s if isinstance(record, Odometry) else record.stamp_s
        for role in ("robot", "observer", "target"):
            name = getattr(record, role, None)
            if name is not None:
                begins[name] = min(begins.get(name, np.inf), stamp_s)
    return begins


def _value(solution: Solution, timeline: Timeline, key: int, guesses: Mapping[int, Pose2 | np.ndarray]):
    """A variable as the solution has it; what it has no place for as it was guessed."""
    robot = robot_index(key)
    if robot is not None:
        stamp = np.array([timeline.stamps[key]])
        course = solution.courses[timeline.robots[robot]]
        return Pose2(*interpolated(course.stamps_s, course.states, stamp)[0])
    index = gtsam.symbolIndex(key)
    if is_landmark(key):
        return solution.landmarks.get(timeline.landmarks[index], guesses[key])
    return solution.vertices.get(index, guesses[key])


def _start(solution: Solution, timeline: Timeline, guesses: Mapping[int, Pose2 | np.ndarray]) -> gtsam.Values:
    """All variables, in the frame in which the first robot's first pose is the origin."""
    values, origin = gtsam.Values(), None
    for robot, track in timeline.tracks.items():
        if not track.keys:
            continue
        course = solution.courses[robot]
        states = interpolated(course.stamps_s, course.states, np.array([timeline.stamps[key] for key in track.keys]))
        origin = states[:1] if origin is None else origin
        for key, state in zip(track.keys, between(np.repeat(origin, len(states), axis=0), states), strict=True):
            values.insert(key, Pose2(*state))
    T_solution_start = Pose2(*origin[0]) if origin is not None else Pose2()
    for key in guesses:
        value = _value(solution, timeline, key, guesses)
        if is_landmark(key):
            values.insert(key, T_solution_start.transformTo(value))
        else:
            values.insert(key, T_solution_start.inverse() * value)
    return values


def _soften(graph: gtsam.NonlinearFactorGraph, loss: Loss) -> None:
    """Give relative pose fixes a robust loss."""
    for i in range(graph.size()):
        factor = graph.at(i)
        if is_tracker_fix(factor):
            softer = gtsam.BetweenFactorPose2(*factor.keys(), factor.measured(), loss.applied(factor.noiseModel()))
            graph.replace(i, softer)
