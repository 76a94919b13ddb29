"""Where the robots truly are now, and what their trackers and finders report from there."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from coopslam.errors import BadInput
from coopslam.records import BearingRangeFix, CornerSighting, PosePrior, RelativePoseFix
from coopslam.se2 import Pose2
from sim.sensors import Sensors
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

    @property
    def pose(self) -> Pose2:
        return Pose2(*self.position, self.heading)


class Scene:
    """The world, the robots in it and the time. What the robots report bears that time."""

    def __init__(self, world: World, sensors: Sensors, settings: TeamSettings):
        self.world, self.sensors, self.settings, self.sight = world, sensors, settings, Sight(world)
        self.time_s = 0.0
        self.truth = Truth(world, settings.robots)
        self.bodies = _line_up(world, settings)

    def note_truth(self, robot: str) -> None:
        """Let the truth know where a robot is now."""
        self.truth.note(robot, self.time_s, self.bodies[robot].pose)

    def placings(self) -> list[PosePrior]:
        """How the team was set up, where that is all that tells which way each robot looks."""
        if self.sensors.tracker_limits.has_heading:
            return []
        first, *others = self.settings.robots
        start = self.bodies[first].pose
        return [self.sensors.placing(self.time_s, robot, start.between(self.bodies[robot].pose)) for robot in others]

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
        a, b = self.bodies[one].pose, self.bodies[other].pose
        looks = [
            self.sensors.relative_pose(self.time_s, one, other, a.between(b)),
            self.sensors.relative_pose(self.time_s, other, one, b.between(a)),
        ]
        return [fix for fix in looks if fix is not None]

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
        return bool(np.hypot(*apart) < self.settings.tracker_blind_m)


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
