"""The story of a run, read off its records: who moved when, what was found when, which gates were open at a moment."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerDecision,
    MoveNote,
    Odometry,
    RangeFix,
    Record,
    RelativePoseFix,
    TriangleDecision,
    WallDecision,
)


@dataclass(frozen=True, slots=True)
class StoryMove:
    """One move, from the end of the one before to its own end."""

    start_s: float
    end_s: float
    robot: str
    watcher: str
    kind: str  # name of the move's class, as it was logged
    ended: str
    watched: bool  # a fix between the two was made on the way
    role_exchanges: int  # up to this move, with the one that made its robot the mover


@dataclass(frozen=True, slots=True)
class Found:
    """A corner, wall or triangle that was decided, and the robot whose move led to it."""

    stamp_s: float
    robot: str
    vertices: tuple[int, ...]  # one, two (free space on the left) or three (counter-clockwise)


@dataclass(frozen=True, slots=True)
class Story:
    """What happened, in order of time. "At a moment" always includes what was decided at that very instant."""

    moves: tuple[StoryMove, ...]
    corners: tuple[Found, ...]  # every visit of a corner, also of a known one
    walls: tuple[Found, ...]
    triangles: dict[int, Found]

    @property
    def end_s(self) -> float:
        """When the last move ended."""
        return self.moves[-1].end_s if self.moves else 0.0

    def move_at(self, time_s: float) -> StoryMove | None:
        """The move that is under way, or that ends at this moment; None when there was no move at all."""
        return next((move for move in self.moves if move.end_s >= time_s), self.moves[-1] if self.moves else None)

    def triangles_at(self, time_s: float) -> list[int]:
        """Ids of the triangles known at a moment."""
        return [triangle for triangle, found in self.triangles.items() if found.stamp_s <= time_s]

    def walls_at(self, time_s: float) -> list[tuple[int, int]]:
        """Walls known at a moment, free space on the left."""
        return [found.vertices for found in self.walls if found.stamp_s <= time_s]

    def gates_at(self, time_s: float) -> list[tuple[int, int]]:
        """Open gates at a moment, the unexplored on the left.

        They are the sides of known triangles that are neither a known wall nor a side of two triangles; the wall that
        was walked first is a gate until its triangle is known.
        """
        walls = self.walls_at(time_s)
        sides = {side for t in self.triangles_at(time_s) for side in sides_of(self.triangles[t].vertices)}
        walked = set(walls)
        gates = {(b, a) for a, b in sides if (a, b) not in walked and (b, a) not in sides}
        return sorted(gates | {wall for wall in walls[:1] if wall not in sides})


def sides_of(triangle: tuple[int, ...]) -> list[tuple[int, int]]:
    """Its three sides with the triangle on their left."""
    a, b, c = triangle
    return [(a, b), (b, c), (c, a)]


def story_of(records: Iterable[Record], pair: Sequence[str] = ()) -> Story:
    """Read the story off the records of a run, in the order of its log.

    pair: the robots that explore, when others only come along: role exchanges are between these.
    """
    moves: list[StoryMove] = []
    corners, walls, triangles = [], [], {}
    until_s = last_of_pair = None
    exchanges, fixed = 0, set()
    for record in records:
        match record:
            case Odometry() if until_s is None:
                until_s = record.start_s
            case RelativePoseFix() | BearingRangeFix() | RangeFix() | BearingFix():
                fixed.add(frozenset((record.observer, record.target)))
            case MoveNote():
                if not pair or record.robot in pair:
                    exchanges += last_of_pair not in (None, record.robot)
                    last_of_pair = record.robot
                start_s, until_s = record.stamp_s if until_s is None else until_s, record.stamp_s
                kind, watched = record.move.partition("(")[0], frozenset((record.robot, record.watcher)) in fixed
                who = (record.robot, record.watcher, kind, record.ended)
                moves.append(StoryMove(start_s, record.stamp_s, *who, watched, exchanges))
                fixed = set()
            case CornerDecision():
                corners.append(Found(record.stamp_s, record.sighting.observer, (record.vertex,)))
            case WallDecision():
                walls.append(Found(record.stamp_s, moves[-1].robot if moves else "", (record.start, record.end)))
            case TriangleDecision():
                mover = moves[-1].robot if moves else ""
                triangles[record.triangle] = Found(record.stamp_s, mover, record.vertices)
    return Story(tuple(moves), tuple(corners), tuple(walls), triangles)
