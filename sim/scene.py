"""Where the robots truly are now, and what their trackers and finders report from there."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from coopslam.errors import BadInput
from coopslam.records import BearingRangeFix, CornerSighting, PosePrior, RelativePoseFix
from coopslam.se2 import Pose2, rotation
from sim.sensors import Circumstances, Sensors
from sim.sight import Sight
from sim.team_settings import TeamSettings
from sim.truth import Truth
from sim.world import World

ROUNDS_TO_VOTE = 5  # of looks at the start, when some may be false: only they place the other robots
MOST_ROUNDS = 100

Fix = RelativePoseFix | BearingRangeFix


@dataclass(slots=True)
class Body:
    """Where a robot truly is: its pose, and the corner (vertex) or wall (first vertex) that it touches."""

    position: np.ndarray  # (2,) m, world frame
    heading: float  # rad, world frame
    corner: int | None = None
    wall: int | None = None
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(2))  # m/s, world frame

    @property
    def pose(self) -> Pose2:
        return Pose2(*self.position, self.heading)


class Scene:
    """The world, the robots in it and the time. What the robots report bears that time."""

    def __init__(self, world: World, sensors: Sensors, settings: TeamSettings):
        self.world, self.sensors, self.settings, self.sight = world, sensors, settings, Sight(world)
        self.time_s = settings.clock_s
        self.truth = Truth(world, settings.robots)
        self.bodies = _line_up(world, settings)

    def note_truth(self, robot: str) -> None:
        """Let the truth know where a robot is now."""
        self.truth.note(robot, self.time_s, self.bodies[robot].pose)

    def placings(self) -> list[PosePrior]:
        """How the team was set up, where that is all that tells which way each robot looks."""
        return [] if self.sensors.tracker_limits.has_heading else self._placings(self.settings.robots[1:])

    def placings_of_unseen(self, fixes: Iterable[Fix]) -> list[PosePrior]:
        """The same of robots that the first looks do not place with their heading, directly or by way of others."""
        first, *others = self.settings.robots
        if not self.sensors.may_withhold_headings:
            return []
        placed, pairs = {first}, [{f.observer, f.target} for f in fixes if isinstance(f, RelativePoseFix)]
        while reached := [pair for pair in pairs if len(pair & placed) == 1]:
            placed = placed.union(*reached)
        return self._placings([robot for robot in others if robot not in placed])

    def _placings(self, robots: Iterable[str]) -> list[PosePrior]:
        start = self.bodies[self.settings.robots[0]].pose
        return [self.sensors.placing(self.time_s, robot, start.between(self.bodies[robot].pose)) for robot in robots]

    def first_fixes(self) -> list[Fix]:
        """Everybody looks at everybody else, until each has seen each other: standing at one wall, all are in view.

        Looks that may be false are repeated, a sighting period apart each.
        """
        pairs = [pair for pair in combinations(self.settings.robots, 2) if not self._too_close(*pair)]
        missing = {pair for one, other in pairs for pair in ((one, other), (other, one))}
        rounds = ROUNDS_TO_VOTE if self.sensors.false_sightings.share > 0 else 1
        fixes = []
        for number in range(MOST_ROUNDS):
            if number >= rounds and not missing:
                break
            self.time_s += self.settings.sighting_period_s if number else 0.0
            for pair in pairs:
                fixes += self.mutual_fixes(*pair)
            missing -= {(fix.observer, fix.target) for fix in fixes}
        return fixes

    def fixes_of(self, robot: str, watcher: str | None) -> list[Fix]:
        """A robot and those who see it look at each other.

        watcher: is known to see it, also where rounding might say otherwise; None: nobody is.
        """
        fixes = [] if watcher is None else self.mutual_fixes(watcher, robot)
        here = self.bodies[robot].position
        for other in self.settings.robots:
            if other not in (robot, watcher) and self.sight.sees(self.bodies[other].position, here):
                fixes += self.mutual_fixes(other, robot)
        return fixes

    def mutual_fixes(self, one: str, other: str) -> list[Fix]:
        """Each robot's tracker looks at the other, which is in view."""
        if self._too_close(one, other):
            return []
        looks = [self._look(one, other), self._look(other, one)]
        return [fix for fix in looks if fix is not None]

    def contact_seems_lost(self, robot: str, watcher: str, fixes: list[Fix]) -> bool:
        """Whether a robot and its watcher, in view of each other, come to believe that they are not.

        fixes: of the last look around; those of further looks, for which the robot stops, are added to them.
        """

        def seen_again() -> bool:
            self.time_s += self.settings.sighting_period_s
            self.note_truth(robot)
            more = self.mutual_fixes(watcher, robot)
            fixes.extend(more)
            return bool(more)

        body, pair = self.bodies[robot], {robot, watcher}
        seen = self._too_close(robot, watcher) or any({fix.observer, fix.target} == pair for fix in fixes)
        body.velocity = np.zeros(2)
        return self.sensors.contact_seems_lost(
            self.settings.confirmations, seen_again=(lambda: True) if seen else seen_again
        )

    def bearing_error(self, robot: str, watcher: str, place: np.ndarray | None, velocity: np.ndarray) -> float | None:
        """Of the bearing at which the watcher sees a robot come by, rad; None when it does not see it there.

        place: (2,) in the world; None: it does not come by.  velocity: (2,) m/s, world frame; not zero.
        """
        if place is None:
            return self.sensors.bearing_error()
        observer = self.bodies[watcher].pose
        passing = Pose2(*place, np.arctan2(velocity[1], velocity[0]))
        turn = rotation(-observer.theta())
        return self.sensors.bearing_error(observer.between(passing), Circumstances(observer.theta(), turn @ velocity))

    def _look(self, one: str, other: str) -> Fix | None:
        observer, target = self.bodies[one], self.bodies[other]
        velocity = rotation(-observer.heading) @ (target.velocity - observer.velocity)
        seen = Circumstances(observer.heading, velocity)
        return self.sensors.relative_pose(self.time_s, one, other, observer.pose.between(target.pose), seen)

    def sight_corner(self, robot: str, corner: int) -> CornerSighting:
        """What the robot's finder reports of a corner in view; the truth keeps which one it was."""
        self.truth.sighted[self.time_s, robot] = corner
        return self.look_at_corner(robot, corner)

    def look_at_corner(self, robot: str, corner: int) -> CornerSighting:
        """The same, for the robot's own use only."""
        T_robot_corner = self.bodies[robot].pose.between(_corner_pose(self.world, corner))
        return self.sensors.corner(self.time_s, robot, T_robot_corner, self.world.interior_angle(corner))

    def _too_close(self, one: str, other: str) -> bool:
        apart = self.bodies[one].position - self.bodies[other].position
        blind_m = max(self.settings.tracker_blind_m, self.sensors.tracker_limits.min_range_m)
        return bool(np.hypot(*apart) < blind_m)


def _corner_pose(world: World, corner: int) -> Pose2:
    """The corner with the direction of the wall that leaves it."""
    start, end = world.points[corner], world.points[world.next_index[corner]]
    return Pose2(*start, np.arctan2(*(end - start)[::-1]))


def _line_up(world: World, settings: TeamSettings) -> dict[str, Body]:
    """The first robot in its corner, looking along the wall that leaves it; the others at that wall, a step apart.

    The second is the farthest: it walks away first, and nobody stands in its way.
    """
    try:
        corner = world.flat_index(settings.start_ring, settings.start_corner)
    except IndexError as error:
        raise BadInput(f"start_ring, start_corner: {error}") from None
    start, end = world.points[corner], world.points[world.next_index[corner]]
    heading = _corner_pose(world, corner).theta()
    length = np.hypot(*(end - start))
    first, second, *between = settings.robots
    step = min(settings.start_step_m, 0.5 * length / (len(settings.robots) - 1))
    bodies = {first: Body(start, heading, corner=corner)}
    for k, robot in enumerate([*between, second], start=1):
        bodies[robot] = Body(start + k * step * (end - start) / length, heading, wall=corner)
    return bodies
