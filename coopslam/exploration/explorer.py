"""The explorer: a pure decision from (free map, estimate, last step) to the next move, or the end and why.

Its `actions` are a dialogue: it yields a move and is sent the step that the move returned, or yields what it
decided and is sent nothing. Which robot goes where follows section 4 of the design: the apex rule, walls,
roles, doorways. It never holds the world. Every wall of the map gets walked: a gate along a wall closes when the
robot that follows it arrives at its partner, so "wall or narrow triangle" is never a matter of measured angles.
"""

from collections.abc import Generator, Iterable
from dataclasses import dataclass, field

from coopslam.errors import require_positive
from coopslam.estimation.estimate import Estimate
from coopslam.exploration.account import Stuck, account
from coopslam.exploration.chart import Chart, ChartSettings
from coopslam.exploration.crew import Crew, Decided
from coopslam.exploration.free_map import FreeMap, MapConflict
from coopslam.exploration.identification import Identification
from coopslam.exploration.moves import (
    DriveAway,
    FollowWall,
    Move,
    MoveEnd,
    ReturnAlongContact,
    Side,
    Step,
)
from coopslam.exploration.navigation import MAX_HALVINGS, NOWHERE_ELSE, Navigation
from coopslam.exploration.recognition import RecognitionSettings, Walked, known_corners
from coopslam.exploration.strategies import STRATEGIES, StrategyName
from coopslam.exploration.sweep import Sweep, gate_ahead, next_known, stands_between, ways_to_sweep
from coopslam.exploration.travel import Crossing, reachable_gates
from coopslam.records import CornerSighting, TriangleDecision


@dataclass(frozen=True, slots=True)
class ExplorerSettings:
    """How the explorer looks for known corners, and how sure it wants to be."""

    sure_reach_m: float = 0.4  # a corner this near to where it should be is found
    search_places: int = 25  # at most so many places are searched for a corner
    reobserve: bool = True  # known corners that a robot passes on its way are factors too
    strategy: StrategyName = "nearest"  # which waiting gate next
    chart: ChartSettings = field(default_factory=ChartSettings)
    recognition: RecognitionSettings = field(default_factory=RecognitionSettings)

    def __post_init__(self):
        require_positive(sure_reach_m=self.sure_reach_m, search_places=self.search_places)


Actions = Generator[Move | Decided, Step | None, str]


class Explorer:
    """Decides for a team: the first two robots explore, the others come along and watch."""

    def __init__(
        self, robots: tuple[str, ...], settings: ExplorerSettings | None = None, free_map: FreeMap | None = None
    ):
        """free_map: known before; nothing without one."""
        self.robots = robots
        self.settings = settings or ExplorerSettings()
        self.free_map = FreeMap() if free_map is None else free_map
        self.chart = Chart(self.free_map, self.settings.chart)
        self.crew = Crew(
            robots, self.free_map, self.chart, self.settings.recognition, self.settings.reobserve, last_mover=robots[1]
        )
        self.navigation = Navigation(self.crew, self.settings.sure_reach_m, self.settings.search_places)
        self.identification = Identification(self.crew, self.navigation)

    @property
    def at(self) -> dict[str, int]:
        """robot -> vertex in which it stands, or from which it set out."""
        return self.crew.at

    def look_at(self, estimate: Estimate) -> None:
        """Steer by this estimate from now on."""
        self.chart.look_at(estimate)

    def actions(self, first: Step) -> Actions:
        """Explore until no gate is open; returns why that is the end. Raises Stuck when it cannot go on."""
        yield from self._walk_first_wall(first)
        while self.free_map.gates:
            gate = yield from self._travel_to_gate()
            yield from self._explore_gate(gate)
        return account(self.free_map, self.chart.corner_angle_sigma, self.settings.recognition.angle_sigmas)

    def _walk_first_wall(self, first: Step):
        crew, (watcher, mover) = self.crew, self.crew.pair
        crew.now_s = first.stamp_s
        corner = crew.new_vertex(first.corner)
        self.at[watcher] = corner.vertex
        yield Decided((corner,))
        step = yield from crew.follow_to_end(FollowWall(mover, watcher, Side.RIGHT))
        if step.ended != MoveEnd.CORNER:
            raise Stuck(f"the first wall ended with {step.ended}, not in a corner")
        corner = crew.new_vertex(step.corner)
        self.at[mover] = corner.vertex
        start, end = self.at[watcher], self.at[mover]
        self.free_map.add_first_wall(start, end)
        yield Decided((corner, crew.wall(step.corner, start, end, seen_from=start)))
        for follower in crew.followers:  # they stand on the first wall
            step = yield from crew.follow_to_end(FollowWall(follower, watcher, Side.LEFT))
            if step.ended != MoveEnd.PARTNER:
                raise Stuck(f"{follower} went back along the first wall and ended with {step.ended}")
            yield Decided((crew.seen_again(step.corner, start, "the first robot stands there"),))

    # travel

    def _travel_to_gate(self):
        one, other = self.crew.pair
        options = reachable_gates(self.free_map, (self.at[one], self.at[other]), self.chart.position)
        option = STRATEGIES[self.settings.strategy]().choose(options, self.chart)
        if option is None:
            raise Stuck(f"no way over the mapped triangles from vertices {self.at} to an open gate")
        yield from self._cross(option.crossings)
        return option.gate

    def _cross(self, crossings: Iterable[Crossing]):
        """One of the pair after the other goes a stretch of the way while its partner stands."""
        one, other = self.crew.pair
        for crossing in crossings:
            stander = self.crew.last_mover if self.at[one] == self.at[other] else None
            mover = next(r for r in self.crew.pair if self.at[r] == crossing.start and r != stander)
            yield from self._leave(mover)
            yield from self.navigation.cross(mover, crossing.end)

    def _leave(self, mover: str):
        """Before one of the pair leaves its vertex, followers that only it ties to the other one come there.

        So every follower stands in a vertex that a known edge joins with one of the pair, and sees it.
        """
        self.crew.last_mover = mover
        stays = self.at[self.crew.partner(mover)]
        for follower in self.crew.followers:
            if self.at[follower] != stays and not self.free_map.joined(self.at[follower], stays):
                yield from self.navigation.errand(follower, self.at[mover], mover)

    # one gate

    def _explore_gate(self, gate: tuple[int, int]):
        """Find the apex behind a gate, or that it is a wall; the team stands on it."""
        robot_at = {self.at[robot]: robot for robot in self.crew.pair}
        for sweep in ways_to_sweep(self.chart, gate, robot_at, self.crew.last_mover):
            yield from self._leave(sweep.mover)
            found = yield from self._sweep(sweep)
            if found:
                return
        raise Stuck(f"no way to sweep behind the gate between vertices {gate[0]} and {gate[1]}")

    def _sweep(self, sweep: Sweep):
        """Turn the line of contact about the pivot until it meets the apex. False: it cannot be turned this way."""
        target = None  # the known vertex to which the mover drives; None: it follows a wall
        if sweep.boundary is None:
            target, limit = gate_ahead(self.chart, sweep)
            step = yield from self.crew.go(DriveAway(sweep.mover, sweep.watcher, limit))
            if step.ended == MoveEnd.CORNER:
                return (yield from self._meet_corner(sweep, step.corner))
            if step.ended == MoveEnd.WALL:
                target = None
        elif not sweep.boundary.is_wall:
            target = sweep.boundary.other
        passed, search, offset, halvings = {target}, None, NOWHERE_ELSE, MAX_HALVINGS
        while True:
            watched, watch_for = next_known(self.chart, sweep, target, passed)
            if target is None:
                move = FollowWall(sweep.mover, sweep.watcher, sweep.wall_on, watch_for)
            else:
                move = self.navigation.aim(sweep.mover, target, sweep.watcher, watch_for, offset)
            step = yield from self.crew.go(move)
            match step.ended:
                case MoveEnd.CORNER:
                    walked = sweep.boundary is not None and target is None
                    return (yield from self._meet_corner(sweep, step.corner, walked))
                case MoveEnd.PARTNER if sweep.boundary is not None and target is None:
                    yield from self._close_as_wall(sweep, step)
                    return True
                case MoveEnd.CONTACT if step.moved:
                    pass  # contact may only seem lost: going on ends at once where it is
                case MoveEnd.CONTACT:
                    return (yield from self._return_to_occluder(sweep))
                case MoveEnd.BEARING:
                    passed.add(watched)
                    if stands_between(self.chart, sweep, watched):
                        target, search, offset, halvings = watched, None, NOWHERE_ELSE, MAX_HALVINGS
                case MoveEnd.DISTANCE if target is not None and halvings > 0:
                    halvings -= 1  # on the way to a known vertex: aim again
                case MoveEnd.NOTHING if target is not None:
                    search = search or iter(self.navigation.places_to_search(sweep.mover, target))
                    offset = next(search, None)
                    if offset is None:
                        raise Stuck(f"{sweep.mover} did not find vertex {target} behind gate {sweep.gate}")
                case _:
                    raise Stuck(f"{sweep.mover} swept behind gate {sweep.gate} and ended with {step.ended}")

    def _return_to_occluder(self, sweep: Sweep):
        """Contact is about to break: the corner that breaks it lies on the line of contact, and is the apex.

        Known corners that only touch the line, where nothing unexplored faces the gate, are driven past.
        """
        crew = self.crew
        while True:
            step = yield from crew.go(ReturnAlongContact(sweep.mover, sweep.watcher))
            if step.ended == MoveEnd.PARTNER:  # nothing in between: the wall led away after all
                yield Decided((crew.seen_again(step.corner, sweep.pivot, "the partner stands there"),))
                yield from self.navigation.cross(sweep.mover, sweep.corner)
                return False
            if step.ended != MoveEnd.CORNER:
                raise Stuck(f"{sweep.mover} returned along the line of contact and ended with {step.ended}")
            matches = known_corners(self.chart, crew.recognition, step.corner, sweep.gate, leave_out={sweep.pivot})
            touched = crew.surely_known(matches)
            if touched is None or matches[0].sector is not None:
                return (yield from self._meet_corner(sweep, step.corner))
            yield Decided((crew.seen_again(step.corner, touched, "touches the line of contact"),))

    def _meet_corner(self, sweep: Sweep, sighting: CornerSighting, walked_wall: bool = False):
        """The mover stands in the apex: decide which vertex that is and add the triangle."""
        walked = Walked(at_end=walked_wall and sweep.turn > 0, at_start=walked_wall and sweep.turn < 0)
        corner, sector = yield from self.identification.apex(sweep, sighting, walked)
        apex = corner.vertex
        self.at[sweep.mover] = apex
        a, b = sweep.gate
        try:
            triangle = self.free_map.add_triangle(sweep.gate, apex, walked.at_end, walked.at_start, sector)
        except MapConflict:
            yield Decided((corner,))  # the log tells what led to the conflict
            raise
        start, end = (b, apex) if walked.at_end else (apex, a)
        walls = [self.crew.wall(sighting, start, end, seen_from=sweep.corner)] if walked_wall else []
        yield Decided((corner, *walls, TriangleDecision(self.crew.now_s, triangle, (a, b, apex))))
        return True

    def _close_as_wall(self, sweep: Sweep, step: Step):
        """The mover walked the wall to its partner: the gate is that wall."""
        start, end = self.free_map.close_as_wall(sweep.gate)
        again = self.crew.seen_again(step.corner, sweep.pivot, "the partner stands there")
        yield Decided((again, self.crew.wall(step.corner, start, end, seen_from=sweep.corner)))
