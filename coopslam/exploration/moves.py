"""What a robot can be told to do, in its own terms, and what comes back. Never world coordinates, never truth."""

from dataclasses import dataclass
from enum import StrEnum

from coopslam.records import CornerSighting, Odometry, Record


class Side(StrEnum):
    """The hand on which a followed wall lies."""

    LEFT = "left"  # the wall is on the robot's left, free space on its right
    RIGHT = "right"  # the wall is on the robot's right, free space on its left


class MoveEnd(StrEnum):
    """Why a move ended."""

    CORNER = "corner"  # the robot stands in a corner
    PARTNER = "partner"  # the robot bumped into its partner, which stands in the corner that it reached
    CONTACT = "contact"  # one step more would break the line of visual contact
    BEARING = "bearing"  # the watcher sees the robot at the bearing it was asked to watch for
    WALL = "wall"  # a wall, between its corners, stopped the robot
    DISTANCE = "distance"  # the distance that was asked for is driven
    NOTHING = "nothing"  # the robot arrived and found no corner within the reach of its finder


@dataclass(frozen=True, slots=True)
class FollowWall:
    """Follow the wall until its corner; stop before contact breaks, or at a bearing seen by the watcher."""

    robot: str
    watcher: str
    wall_on: Side
    watch_for_rad: float | None = None  # bearing of the robot in the watcher's frame
    alone: bool = False  # go on where contact with the watcher breaks


@dataclass(frozen=True, slots=True)
class ReturnAlongContact:
    """Drive along the line of contact towards the watcher until the finder meets a corner, or the watcher."""

    robot: str
    watcher: str


@dataclass(frozen=True, slots=True)
class DriveAway:
    """Drive straight on, away from the watcher, until a wall or a corner stops the robot, or `limit_m` is driven."""

    robot: str
    watcher: str
    limit_m: float | None = None


@dataclass(frozen=True, slots=True)
class GoToCorner:
    """Drive to where a known corner should be, along walls that are in the way, and home on the corner found there."""

    robot: str
    watcher: str
    corner_body: tuple[float, float, float]  # x, y, heading of the oriented corner in the robot's frame
    interior_angle_rad: float
    watch_for_rad: float | None = None  # as for FollowWall
    limit_m: float | None = None  # drive at most so far; the next move can be aimed better
    keep_contact: bool = False  # where contact would break, go on along the line of contact as far as that leads nearer
    alone: bool = False  # as for FollowWall


Move = FollowWall | ReturnAlongContact | DriveAway | GoToCorner


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What executing a move returned: everything sensed on the way, in order, and why the move ended.

    travelled_m: by the robot's own odometry.
    """

    stamp_s: float
    records: tuple[Record, ...]
    ended: MoveEnd
    travelled_m: float = 0.0

    @property
    def moved(self) -> bool:
        """Whether the robot turned or drove at all."""
        return any(isinstance(record, Odometry) for record in self.records)

    @property
    def corner(self):
        """The sighting of the corner in which the move ended, or None."""
        if self.ended not in (MoveEnd.CORNER, MoveEnd.PARTNER):
            return None
        return next((r for r in reversed(self.records) if isinstance(r, CornerSighting)), None)
