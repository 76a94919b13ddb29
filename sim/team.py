"""The simulated team: executes the explorer's moves in a true world and returns what the robots sensed.

Event-driven: where a move ends is computed, not stepped to; then the leg is sampled at the sensor rates.
Truth stays here; `Team.truth` is its own door, for evaluation and figures only.
"""

import re
from bisect import bisect_right
from dataclasses import dataclass, field, replace

import numpy as np

from coopslam.errors import BadInput, BadMove
from coopslam.exploration.moves import DriveAway, FollowWall, GoToCorner, Move, MoveEnd, ReturnAlongContact, Side, Step
from coopslam.records import Odometry
from coopslam.se2 import Pose2, wrap
from sim.homing import Waypoint, best_corner, cut_off, way_to_corner
from sim.sensors import Sensors
from sim.sight import TOLERANCE_M, Sight, cross
from sim.world import World


@dataclass(frozen=True, slots=True)
class TeamSettings:
    """How the robots start, move and sample."""

    robots: tuple[str, ...] = ("robot0", "robot1")
    start_ring: int = 0
    start_corner: int = 0
    start_step_m: float = 0.3  # of each further robot along the wall; at most half the wall for all of them
    speed_m_per_s: float = 0.5
    turn_rate_rad_per_s: float = 1.0
    odometry_period_s: float = 1.0
    sighting_period_s: float = 2.0
    sightings_per_leg: int = 8  # at most; long legs are watched less often
    finder_reach_m: float = 0.5
    tracker_blind_m: float = 0.02  # closer than this the tracker sees nothing

    def __post_init__(self):
        for name in ("start_step_m", "speed_m_per_s", "turn_rate_rad_per_s", "odometry_period_s", "sighting_period_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise BadInput(f"{name}: more than zero expected, got {getattr(self, name)}")
        for name in ("finder_reach_m", "tracker_blind_m"):
            if not 0 <= getattr(self, name) < np.inf:
                raise BadInput(f"{name}: zero or more expected, got {getattr(self, name)}")
        if not 1 <= self.sightings_per_leg < np.inf:
            raise BadInput(f"sightings_per_leg: 1 or more expected, got {self.sightings_per_leg}")
        if len(self.robots) != 2 or len(set(self.robots)) != 2:
            raise BadInput(f"robots: two different names expected, got {', '.join(self.robots) or 'none'}")
        for name in self.robots:
            if not re.fullmatch(r"[A-Za-z0-9_-]{1,40}", name):
                raise BadInput(f"robots: names of up to 40 letters, digits, - and _ expected, got {name!r}")


@dataclass(slots=True)
class Body:
    """Where a robot truly is: its pose, and the corner (vertex) or wall (first vertex) that it touches."""

    position: np.ndarray  # (2,) m, world frame
    heading: float  # rad, world frame
    corner: int | None = None
    wall: int | None = None

    @property
    def pose(self) -> Pose2:
        return Pose2(*self.position, self.heading)


@dataclass(slots=True)
class TruthTrack:
    """A robot's true poses at its sampled instants, in the world's frame."""

    stamps_s: list[float] = field(default_factory=list)
    poses: list[Pose2] = field(default_factory=list)


class Truth:
    """The simulator's own door: the world, the robots' true paths, and which corner each sighting showed."""

    def __init__(self, world: World, robots: tuple[str, ...]):
        self.world = world
        self.tracks = {robot: TruthTrack() for robot in robots}
        self.sighted: dict[tuple[float, str], int] = {}  # (stamp, observer) -> flat index of the corner

    @property
    def origin(self) -> Pose2:
        """True start pose of the first robot in the world: the estimated frame."""
        return next(iter(self.tracks.values())).poses[0]

    def pose_at(self, robot: str, stamp_s: float) -> Pose2:
        """True pose at a sampled instant, or at the last one before it (the robot stood still since)."""
        track = self.tracks[robot]
        return track.poses[max(bisect_right(track.stamps_s, stamp_s + 1e-9) - 1, 0)]


class Team:
    """Robots in a world. `begin` once, then `execute` moves."""

    def __init__(self, world: World, sensors: Sensors, settings: TeamSettings | None = None):
        self.settings = settings or TeamSettings()
        self.world, self.sensors, self.sight = world, sensors, Sight(world)
        self.time_s = 0.0
        self.truth = Truth(world, self.settings.robots)
        self._bodies = self._place()

    def begin(self) -> Step:
        """What the robots sense before the first move: each other, and the first robot its corner."""
        first, *others = self.settings.robots
        for robot in self.settings.robots:
            self._note_truth(robot)
        records = [self._corner_sighting(first)]
        for other in others:
            records += self._mutual_fixes(first, other)
        return Step(self.time_s, tuple(records), MoveEnd.CORNER)

    def execute(self, move: Move) -> Step:
        """Execute one move. Raises BadMove when it makes no sense where the robot stands."""
        self._check(move)
        match move:
            case FollowWall():
                return self._follow_wall(move)
            case ReturnAlongContact():
                return self._return_along_contact(move)
            case DriveAway():
                return self._drive_away(move)
            case GoToCorner():
                return self._go_to_corner(move)

    def _check(self, move: Move) -> None:
        if not isinstance(move, Move):
            raise BadMove(f"unknown move {move!r}")
        for robot in (move.robot, move.watcher):
            if robot not in self._bodies:
                raise BadMove(f"no robot is called {robot!r}; there are {', '.join(self._bodies)}")
        if move.robot == move.watcher:
            raise BadMove(f"{move.robot} cannot watch itself")
        limit = getattr(move, "limit_m", None)
        if limit is not None and not limit >= 0:
            raise BadMove(f"{move.robot} cannot drive {limit} m; zero or more expected")
        if isinstance(move, FollowWall) and move.wall_on not in tuple(Side):
            raise BadMove(f"a wall is on the left or on the right, not on {move.wall_on!r}")
        if isinstance(move, GoToCorner) and not np.isfinite(move.corner_body).all():
            raise BadMove(f"{move.robot} cannot go to {move.corner_body}; finite numbers expected")

    # moves

    def _follow_wall(self, move: FollowWall) -> Step:
        body = self._bodies[move.robot]
        along = self.world.next_index if move.wall_on == Side.RIGHT else self.world.prev_index
        if body.corner is not None:
            end = int(along[body.corner])
        elif body.wall is not None:
            end = int(self.world.next_index[body.wall]) if move.wall_on == Side.RIGHT else body.wall
        else:
            raise BadMove(f"{move.robot} cannot follow a wall: it stands in the open")
        if body.corner is not None:
            wall = body.corner if move.wall_on == Side.RIGHT else end
        else:
            wall = body.wall
        return self._drive_watched(move, self.world.points[end], end, wall, self._end_at(move, end))

    def _return_along_contact(self, move: ReturnAlongContact) -> Step:
        body, watcher = self._bodies[move.robot], self._bodies[move.watcher]
        corner = self.sight.first_corner_between(body.position, watcher.position)
        target = watcher.position if corner is None else self.world.points[corner]
        ended = MoveEnd.PARTNER if corner is None else MoveEnd.CORNER
        return self._drive(move, target, ended, corner=watcher.corner if corner is None else corner)

    def _drive_away(self, move: DriveAway) -> Step:
        body, watcher = self._bodies[move.robot], self._bodies[move.watcher]
        line = body.position - watcher.position
        length = np.hypot(*line)
        if length <= TOLERANCE_M:
            raise BadMove(f"{move.robot} cannot drive away from {move.watcher}: both stand in one place")
        direction = line / length
        obstacle = self.sight.first_obstacle(body.position, direction)
        if obstacle is None:
            raise BadMove(f"{move.robot} stands outside the world")
        if move.limit_m is not None and move.limit_m < obstacle.distance_m:
            return self._drive(move, body.position + move.limit_m * direction, MoveEnd.DISTANCE)
        if obstacle.corner is not None:
            return self._drive(move, self.world.points[obstacle.corner], MoveEnd.CORNER, corner=obstacle.corner)
        if obstacle.distance_m == 0.0:
            return self._drive(move, body.position, MoveEnd.WALL, body.corner, body.wall)
        return self._drive(move, body.position + obstacle.distance_m * direction, MoveEnd.WALL, wall=obstacle.wall)

    def _go_to_corner(self, move: GoToCorner) -> Step:
        body, reach = self._bodies[move.robot], self.settings.finder_reach_m
        expected = body.pose * Pose2(*move.corner_body)
        aim = np.array([expected.x(), expected.y()])
        way = way_to_corner(self.sight, Waypoint(body.position, body.corner, body.wall), aim, reach)
        shortened = False
        if move.limit_m is not None:
            way, shortened = cut_off(body.position, way, move.limit_m)
        step = self._drive_along(move, way)
        if step.ended == MoveEnd.CONTACT and move.keep_contact:
            step = _joined(step, self._sidestep(move, aim))
        if step.ended != MoveEnd.NOTHING:
            return step
        if shortened:
            return replace(step, ended=MoveEnd.DISTANCE)
        found = best_corner(self.sight, body.position, expected, move.interior_angle_rad, reach, self._look(move.robot))
        if found is None:
            return step
        there = self.world.points[found]
        return _joined(step, self._drive_watched(move, there, found, None, self._end_at(move, found)))

    def _sidestep(self, move, aim: np.ndarray) -> Step:
        """Drive along the line of contact, which cannot break it, to where the aim is nearest."""
        body, watcher = self._bodies[move.robot], self._bodies[move.watcher]
        line = body.position - watcher.position
        length = float(np.hypot(*line))
        if length <= TOLERANCE_M:
            return Step(self.time_s, (), MoveEnd.CONTACT)
        outward = line / length
        metres = max(float((aim - body.position) @ outward), -length)
        if metres > 0:
            obstacle = self.sight.first_obstacle(body.position, outward)
            metres = min(metres, obstacle.distance_m) if obstacle else metres
        return self._drive(move, body.position + metres * outward, MoveEnd.NOTHING)

    def _drive_along(self, move, way: list[Waypoint]) -> Step:
        """Drive a way, stretch by stretch; ended NOTHING when all of it was driven."""
        step = Step(self.time_s, (), MoveEnd.NOTHING)
        for stop in way:
            more = self._drive_watched(move, stop.position, stop.corner, stop.wall, MoveEnd.NOTHING)
            step = _joined(step, more)
            if step.ended != MoveEnd.NOTHING:
                break
        return step

    def _look(self, robot: str):
        """How the finder of a robot sees a corner: corner -> (oriented corner in the world, interior angle)."""

        def look(corner: int) -> tuple[Pose2, float]:
            pose = self._bodies[robot].pose
            interior = self.world.interior_angle(corner)
            seen = self.sensors.corner(self.time_s, robot, pose.between(self._corner_pose(corner)), interior)
            return pose * seen.T_observer_corner, seen.interior_angle_rad

        return look

    # driving

    def _drive_watched(self, move, target, corner: int | None, wall: int | None, ended: MoveEnd) -> Step:
        """Drive straight to a place, unless contact would break or the watched bearing comes first."""
        body, watcher = self._bodies[move.robot], self._bodies[move.watcher]
        lost = self.sight.contact_break(watcher.position, body.position, target, body.corner)
        seen = None
        if move.watch_for_rad is not None:
            bearing = watcher.heading + move.watch_for_rad - self.sensors.bearing_error()
            seen = _bearing_crossing(watcher, body.position, target, bearing)
        if lost is not None and (seen is None or lost <= seen):
            return self._stop_on_the_way(move, target, lost, wall, MoveEnd.CONTACT)
        if seen is not None:
            return self._stop_on_the_way(move, target, seen, wall, MoveEnd.BEARING)
        return self._drive(move, target, ended, corner, wall if corner is None else None)

    def _end_at(self, move, corner: int) -> MoveEnd:
        return MoveEnd.PARTNER if self._bodies[move.watcher].corner == corner else MoveEnd.CORNER

    def _stop_on_the_way(self, move, target, fraction: float, wall: int | None, ended: MoveEnd) -> Step:
        body = self._bodies[move.robot]
        if fraction <= 0.0:
            return self._drive(move, body.position, ended, body.corner, body.wall)
        return self._drive(move, body.position + fraction * (target - body.position), ended, wall=wall)

    def _drive(self, move, target, ended: MoveEnd, corner: int | None = None, wall: int | None = None) -> Step:
        """Turn towards the target, drive there, sense on the way and at the end."""
        body, rates = self._bodies[move.robot], self.settings
        way = target - body.position
        distance = float(np.hypot(*way))
        records = []
        self._note_truth(move.robot)  # it stood still until now
        if distance > TOLERANCE_M:
            heading = float(np.arctan2(way[1], way[0]))
            turn = float(wrap(heading - body.heading))
            records += self._sample_turn(move.robot, turn)
            body.heading = heading
            apart = max(rates.speed_m_per_s * rates.sighting_period_s, distance / rates.sightings_per_leg)
            stops = np.arange(1, int(distance / apart) + 1) * apart
            stops = np.append(stops[stops < distance - 1e-6], distance)
            start = body.position
            for before, after in zip(np.concatenate([[0.0], stops[:-1]]), stops, strict=True):
                records += self._sample_drive(move.robot, after - before)
                body.position = start + after / distance * way
                body.corner = body.wall = None
                self._note_truth(move.robot)
                records += self._mutual_fixes(move.watcher, move.robot)
            body.position = np.array(target, dtype=float)
        body.corner, body.wall = corner, wall
        if corner is not None and ended in (MoveEnd.CORNER, MoveEnd.PARTNER):
            records.append(self._corner_sighting(move.robot))
        travelled = sum(record.T_start_now.x() for record in records if isinstance(record, Odometry))
        return Step(self.time_s, tuple(records), ended, travelled)

    def _sample_turn(self, robot: str, turn: float) -> list:
        if abs(turn) < 1e-9:  # rounding, not a turn: no sample, so that rounding draws no noise
            return []
        share = self._shares(abs(turn) / self.settings.turn_rate_rad_per_s)
        records = self._odometry(
            robot, turn * share, np.zeros(len(share)), abs(turn) / self.settings.turn_rate_rad_per_s * share
        )
        body = self._bodies[robot]
        body.heading += turn
        self._note_truth(robot)
        return records

    def _sample_drive(self, robot: str, distance: float) -> list:
        share = self._shares(distance / self.settings.speed_m_per_s)
        return self._odometry(
            robot, np.zeros(len(share)), distance * share, distance / self.settings.speed_m_per_s * share
        )

    def _shares(self, duration_s: float) -> np.ndarray:
        """(N,) shares of a stretch between one odometry sample and the next; they add up to 1."""
        steps = max(int(np.ceil(duration_s / self.settings.odometry_period_s - 1e-9)), 1)
        shares = np.full(steps, self.settings.odometry_period_s / duration_s)
        shares[-1] = 1.0 - shares[:-1].sum()
        return shares

    def _odometry(self, robot: str, turns_rad, distances_m, durations_s) -> list:
        times = self.time_s + np.append(0.0, np.cumsum(durations_s))
        self.time_s = float(times[-1])
        return self.sensors.odometry(robot, times, turns_rad, distances_m)

    # sensing

    def _mutual_fixes(self, one: str, other: str) -> list:
        """Each robot's tracker looks at the other."""
        a, b = self._bodies[one].pose, self._bodies[other].pose
        if a.range(b.translation()) < self.settings.tracker_blind_m:
            return []
        return [
            self.sensors.relative_pose(self.time_s, one, other, a.between(b)),
            self.sensors.relative_pose(self.time_s, other, one, b.between(a)),
        ]

    def _corner_sighting(self, robot: str):
        body = self._bodies[robot]
        self.truth.sighted[self.time_s, robot] = body.corner
        T_robot_corner = body.pose.between(self._corner_pose(body.corner))
        return self.sensors.corner(self.time_s, robot, T_robot_corner, self.world.interior_angle(body.corner))

    def _corner_pose(self, corner: int) -> Pose2:
        """The corner with the direction of the wall that leaves it."""
        start, end = self.world.points[corner], self.world.points[self.world.next_index[corner]]
        return Pose2(*start, np.arctan2(*(end - start)[::-1]))

    def _note_truth(self, robot: str) -> None:
        track = self.truth.tracks[robot]
        if track.stamps_s and track.stamps_s[-1] == self.time_s:
            track.stamps_s.pop()
            track.poses.pop()
        track.stamps_s.append(self.time_s)
        track.poses.append(self._bodies[robot].pose)

    def _place(self) -> dict[str, Body]:
        """The first robot in its corner, looking along the wall that leaves it; the others a step further each."""
        settings = self.settings
        try:
            corner = self.world.flat_index(settings.start_ring, settings.start_corner)
        except IndexError as error:
            raise BadInput(f"start_ring, start_corner: {error}") from None
        start, end = self.world.points[corner], self.world.points[self.world.next_index[corner]]
        heading = self._corner_pose(corner).theta()
        length = np.hypot(*(end - start))
        step = min(settings.start_step_m, 0.5 * length / max(len(settings.robots) - 1, 1))
        bodies = {}
        for k, robot in enumerate(settings.robots):
            position = start + k * step * (end - start) / length
            bodies[robot] = Body(position, heading, corner if k == 0 else None, None if k == 0 else corner)
        return bodies


def _joined(first: Step, then: Step) -> Step:
    """Two stretches as one step."""
    return Step(then.stamp_s, first.records + then.records, then.ended, first.travelled_m + then.travelled_m)


def _bearing_crossing(watcher: Body, start, end, bearing_rad: float) -> float | None:
    """Fraction of the drive start -> end at which the watcher sees the robot in a world direction, or None."""
    ray = np.array([np.cos(bearing_rad), np.sin(bearing_rad)])
    drive, line = end - start, start - watcher.position
    turning = cross(drive, ray)
    if abs(turning) < 1e-15:
        return None
    fraction = -cross(line, ray) / turning
    if not 0.0 <= fraction <= 1.0 - 1e-9 or (line + fraction * drive) @ ray <= 0:
        return None  # a bearing met just at the end of the drive: the corner there comes first
    return float(fraction)
