"""The simulated team: executes the explorer's moves in a true world and returns what the robots sensed.

Event-driven: where a move ends is computed, not stepped to; then the leg is sampled at the sensor rates.
Truth stays here; `Team.truth` is its own door, for evaluation and figures only.
"""

from dataclasses import replace

import numpy as np

from coopslam.errors import BadMove
from coopslam.exploration.moves import DriveAway, FollowWall, GoToCorner, Move, MoveEnd, ReturnAlongContact, Side, Step
from coopslam.se2 import Pose2
from sim.driving import Drive, Driver
from sim.homing import Waypoint, best_corner, cut_off, way_to_corner
from sim.scene import Body, Scene
from sim.sensors import Sensors
from sim.sight import TOLERANCE_M, cross
from sim.team_settings import TeamSettings
from sim.truth import Truth, TruthTrack
from sim.world import World

__all__ = ["Team", "TeamSettings", "Truth", "TruthTrack"]


class Team:
    """Robots in a world. `begin` once, then `execute` moves."""

    def __init__(self, world: World, sensors: Sensors, settings: TeamSettings | None = None):
        self.settings = settings or TeamSettings()
        self.world, self.sensors = world, sensors
        self._scene = Scene(world, sensors, self.settings)
        self._driver = Driver(self._scene)
        self._bodies, self.sight, self.truth = self._scene.bodies, self._scene.sight, self._scene.truth
        self._watched = True  # whether the move that is executed began in view of its watcher

    @property
    def time_s(self) -> float:
        """Seconds since the start."""
        return self._scene.time_s

    def begin(self) -> Step:
        """What the robots sense before the first move: each other, and the first robot its corner.

        Trackers without heading cannot tell which way the other robots look: then how the team was set up says so.
        """
        for robot in self.settings.robots:
            self._scene.note_truth(robot)
        first = self.settings.robots[0]
        corner = self._scene.sight_corner(first, self._bodies[first].corner)
        placings = self._scene.placings()
        fixes = self._scene.first_fixes()
        placings += self._scene.placings_of_unseen(fixes)
        return Step(self.time_s, (corner, *placings, *fixes), MoveEnd.CORNER)

    def execute(self, move: Move) -> Step:
        """Execute one move. Raises BadMove when it makes no sense where the robot stands.

        A robot that follows a wall or goes to a corner alone, or where its watcher cannot see it from the start, does
        so unwatched: neither contact nor a bearing ends that move.
        """
        self._check(move)
        body, watcher = self._bodies[move.robot], self._bodies[move.watcher]
        self._watched = not self.sight.is_hidden(watcher.position, body.position)
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

    def _require_contact(self, move: Move) -> None:
        if not self._watched:
            raise BadMove(f"{move.robot} cannot drive along the line of contact: {move.watcher} does not see it")

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
        self._require_contact(move)
        corner = self.sight.first_corner_between(body.position, watcher.position)
        target = watcher.position if corner is None else self.world.points[corner]
        ended = MoveEnd.PARTNER if corner is None else MoveEnd.CORNER
        return self._drive(move, target, ended, corner=watcher.corner if corner is None else corner)

    def _drive_away(self, move: DriveAway) -> Step:
        body, watcher = self._bodies[move.robot], self._bodies[move.watcher]
        self._require_contact(move)
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
            shortened = float(np.hypot(*(aim - body.position))) > reach
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
        obstacle = self.sight.first_obstacle(body.position, outward) if metres > 0 else None
        if obstacle is None or obstacle.distance_m > metres:
            return self._drive(move, body.position + metres * outward, MoveEnd.NOTHING)
        if obstacle.distance_m == 0.0:
            return Step(self.time_s, (), MoveEnd.NOTHING)
        there = body.position + obstacle.distance_m * outward
        return self._drive(move, there, MoveEnd.NOTHING, obstacle.corner, obstacle.wall)

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
            seen = self._scene.look_at_corner(robot, corner)
            return self._bodies[robot].pose * seen.T_observer_corner, seen.interior_angle_rad

        return look

    # driving

    def _drive_watched(self, move, target, corner: int | None, wall: int | None, ended: MoveEnd) -> Step:
        """Drive straight to a place, unless contact would break or the watched bearing comes first."""
        body, watcher = self._bodies[move.robot], self._bodies[move.watcher]
        there = Drive(move.robot, move.watcher, target, ended, corner, wall if corner is None else None, wall, True)
        if not self._watched or move.alone:
            return self._driver.execute(replace(there, watcher=None, needs_contact=False))
        lost = self.sight.contact_break(watcher.position, body.position, target, body.corner)
        seen = None
        if move.watch_for_rad is not None:
            bearing = watcher.heading + move.watch_for_rad
            seen = _bearing_crossing(watcher, body.position, target, bearing)
            error = self._bearing_error(move, target, seen)
            if error is None:
                lost = min(seen, lost if lost is not None else seen)
            else:
                seen = _bearing_crossing(watcher, body.position, target, bearing - error)
        if lost is not None and (seen is None or lost <= seen):
            return self._within_reach(_cut_short(there, body, lost, MoveEnd.CONTACT))
        if seen is not None:
            return self._within_reach(_cut_short(there, body, seen, MoveEnd.BEARING))
        return self._within_reach(there)

    def _bearing_error(self, move, target, fraction: float | None) -> float | None:
        """Of the bearing watched for, where the robot comes by it on its drive; None when it is not seen there."""
        start = self._bodies[move.robot].position
        way = target - start
        place = None if fraction is None else start + fraction * way
        velocity = self.settings.speed_m_per_s * way / max(float(np.hypot(*way)), TOLERANCE_M)
        return self._scene.bearing_error(move.robot, move.watcher, place, velocity)

    def _drive(self, move, target, ended: MoveEnd, corner: int | None = None, wall: int | None = None) -> Step:
        """Drive straight to a place along the line of contact."""
        return self._within_reach(Drive(move.robot, move.watcher, target, ended, corner, wall))

    def _within_reach(self, drive: Drive) -> Step:
        """Execute a drive in contact. Raises BadMove when it leads out of the tracker's reach, or begins there."""
        reach, watcher = self.sensors.tracker_limits.max_range_m, self._bodies[drive.watcher].position
        apart = max(float(np.hypot(*(place - watcher))) for place in (self._bodies[drive.robot].position, drive.target))
        if apart > reach:
            raise BadMove(
                f"contact lost because of distance: {drive.robot} would be {apart:.1f} m from {drive.watcher}, "
                f"and the tracker reaches {reach:g} m"
            )
        return self._driver.execute(drive)

    def _end_at(self, move, corner: int) -> MoveEnd:
        return MoveEnd.PARTNER if self._bodies[move.watcher].corner == corner else MoveEnd.CORNER


def _cut_short(drive: Drive, body: Body, fraction: float, ended: MoveEnd) -> Drive:
    """The first part of a drive, up to where it must end for another reason."""
    if fraction <= 0.0:
        return replace(drive, target=body.position, ended=ended, corner=body.corner, wall=body.wall)
    target = body.position + fraction * (drive.target - body.position)
    return replace(drive, target=target, ended=ended, corner=None, wall=drive.wall_on_the_way)


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
