"""A straight drive: turn, drive from stop to stop, sense at each of them.

Where it ends was computed before; here it is sampled at the rates of the sensors.
"""

from dataclasses import dataclass

import numpy as np

from coopslam.exploration.moves import MoveEnd, Step
from coopslam.records import Odometry
from coopslam.se2 import wrap
from sim.scene import Body, Scene
from sim.sight import TOLERANCE_M, cross

SMALLEST_TURN_RAD = 1e-9  # less is rounding: no sample, so that rounding draws no noise
APART_M = 0.01  # stops on a drive are at least so far from each other, for each has its own time
ROUNDED = 6  # decimals of metres: corners that are equally near stay so wherever the world lies


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A straight drive of one robot to `target`, and what it touches there."""

    robot: str
    watcher: str | None  # holds contact all the way; None: nobody is known to
    target: np.ndarray  # (2,) m, world frame
    ended: MoveEnd
    corner: int | None = None
    wall: int | None = None
    wall_on_the_way: int | None = None  # where it ends early, if it has come to that wall by then
    needs_contact: bool = False  # ends where contact seems to be lost


class Driver:
    """Executes drives in a scene, and lets its time pass."""

    def __init__(self, scene: Scene):
        self.scene, self.settings = scene, scene.settings

    def execute(self, drive: Drive) -> Step:
        """Turn towards the target, drive there, sense on the way and at the end."""
        body = self.scene.bodies[drive.robot]
        way = drive.target - body.position
        distance = float(np.hypot(*way))
        records, ended = [], drive.ended
        self.scene.note_truth(drive.robot)  # it stood still until now
        if distance > TOLERANCE_M:
            records += self._turn(drive.robot, float(np.arctan2(way[1], way[0])))
            more, ended = self._drive_straight(drive, way / distance, distance)
            records += more
        else:
            body.corner, body.wall = drive.corner, drive.wall
        if body.corner is not None and ended in (MoveEnd.CORNER, MoveEnd.PARTNER):
            records.append(self.scene.sight_corner(drive.robot, body.corner))
        travelled = sum(abs(record.T_start_now.x()) for record in records if isinstance(record, Odometry))
        return Step(self.scene.time_s, tuple(records), ended, travelled)

    def _turn(self, robot: str, heading: float) -> list:
        body = self.scene.bodies[robot]
        turn = float(wrap(heading - body.heading))
        records = []
        if abs(turn) >= SMALLEST_TURN_RAD:
            turns = turn * self._shares(abs(turn) / self.settings.turn_rate_rad_per_s)
            places = np.broadcast_to(body.position, (len(turns), 2))
            durations = np.abs(turns) / self.settings.turn_rate_rad_per_s
            records = self._odometry(robot, turns, np.zeros(len(turns)), durations, places, places)
        body.heading = heading
        if records:
            self.scene.note_truth(robot)
        return records

    def _drive_straight(self, drive: Drive, direction: np.ndarray, distance: float) -> tuple[list, MoveEnd]:
        """Drive, with a look around at each stop; returns the records and why it ended."""
        scene, body = self.scene, self.scene.bodies[drive.robot]
        start, records = body.position, []
        passed = self._passing_corners(drive, body, direction, distance)
        body.corner = body.wall = None
        driven = 0.0
        for stop in self._stops(distance, list(passed)):
            records += self._go_on(drive.robot, direction, stop - driven)
            driven = stop
            body.position = start + stop * direction if stop < distance else np.array(drive.target, dtype=float)
            body.velocity = self.settings.speed_m_per_s * direction if stop < distance else np.zeros(2)
            scene.note_truth(drive.robot)
            fixes = scene.fixes_of(drive.robot, drive.watcher)
            sighted = [scene.sight_corner(drive.robot, passed[stop])] if stop in passed else []
            lost = stop < distance and drive.needs_contact
            lost = lost and scene.contact_seems_lost(drive.robot, drive.watcher, fixes)
            records += sorted([*fixes, *sighted], key=lambda record: record.stamp_s)
            if lost:
                body.wall = self._wall_here(body, drive.wall_on_the_way)
                return records, MoveEnd.CONTACT
        body.corner, body.wall = drive.corner, self._wall_here(body, drive.wall)
        return records, drive.ended

    def _wall_here(self, body: Body, wall: int | None) -> int | None:
        """The wall that a drive leads to or along, unless it stopped short of it."""
        return wall if wall is not None and self.scene.sight.is_at_wall(body.position, wall) else None

    def _go_on(self, robot: str, direction: np.ndarray, distance: float) -> list:
        """Odometry of a stretch from where the robot is."""
        metres = distance * self._shares(distance / self.settings.speed_m_per_s)
        ends = self.scene.bodies[robot].position + np.outer(np.cumsum(metres), direction)
        starts = ends - np.outer(metres, direction)
        return self._odometry(robot, np.zeros(len(metres)), metres, metres / self.settings.speed_m_per_s, starts, ends)

    def _odometry(self, robot: str, turns_rad, distances_m, durations_s, starts, ends) -> list:
        scene = self.scene
        times = scene.time_s + np.append(0.0, np.cumsum(durations_s))
        scene.time_s = float(times[-1])
        factors = scene.world.noise_factors(starts, ends)
        return scene.sensors.odometry(robot, times, turns_rad, distances_m, factors)

    def _shares(self, duration_s: float) -> np.ndarray:
        """(N,) shares of a stretch between one odometry sample and the next; they add up to 1."""
        steps = max(int(np.ceil(duration_s / self.settings.odometry_period_s - 1e-9)), 1)
        shares = np.full(steps, self.settings.odometry_period_s / duration_s)
        shares[-1] = 1.0 - shares[:-1].sum()
        return shares

    def _stops(self, distance: float, extra: list[float]) -> list[float]:
        """Metres from the start at which the robot senses, in order; the end is the last."""
        rates = self.settings
        apart = max(rates.speed_m_per_s * rates.sighting_period_s, distance / rates.sightings_per_leg)
        regular = np.arange(1, int(distance / apart) + 1) * apart
        regular = regular[regular < distance - 1e-6]
        if extra:
            regular = regular[np.abs(regular[:, None] - extra).min(axis=1) >= APART_M]
        return [*sorted([*regular.tolist(), *extra]), distance]

    def _passing_corners(self, drive: Drive, body: Body, direction: np.ndarray, distance: float) -> dict[float, int]:
        """The nearest corners in view beside the drive: metres from the start to where each is closest -> corner."""
        most, sight = self.settings.passing_corners_per_leg, self.scene.sight
        if most < 1:
            return {}
        arm = sight.points - body.position
        along, beside = arm @ direction, np.abs(cross(direction, arm))
        near = beside <= self.settings.finder_reach_m + TOLERANCE_M
        near &= (along >= APART_M) & (along <= distance - APART_M)
        near[[corner for corner in (body.corner, drive.corner) if corner is not None]] = False
        corners = np.flatnonzero(near)
        nearest_first = np.lexsort((along[corners].round(ROUNDED), beside[corners].round(ROUNDED)))
        passed: dict[float, int] = {}
        for corner in corners[nearest_first].tolist():
            stop = float(along[corner])
            if all(abs(stop - other) >= APART_M for other in passed) and sight.sees(
                body.position + stop * direction, sight.points[corner]
            ):
                passed[stop] = corner
                if len(passed) == most:
                    break
        return passed
