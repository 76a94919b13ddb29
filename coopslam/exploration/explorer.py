"""The explorer: a pure decision from (free map, estimate, last step) to the next move, or the end and why.

Its `actions` are a dialogue: it yields a move and is sent the step that the move returned, or yields what it
decided and is sent nothing. Which robot goes where follows section 4 of the design: the apex rule, walls,
roles, doorways. It never holds the world. Every wall of the map gets walked: a gate along a wall closes when the
robot that follows it arrives at its partner, so "wall or narrow triangle" is never a matter of measured angles.
"""

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np

from coopslam.errors import require_positive
from coopslam.estimation.estimate import Estimate
from coopslam.exploration.account import Stuck, account
from coopslam.exploration.chart import SAME_PLACE_M, Chart, ChartSettings
from coopslam.exploration.free_map import FreeMap, MapConflict
from coopslam.exploration.moves import (
    DriveAway,
    FollowWall,
    GoToCorner,
    Move,
    MoveEnd,
    ReturnAlongContact,
    Side,
    Step,
)
from coopslam.exploration.recognition import (
    RecognitionSettings,
    corner_distance_sq,
    interior_angle_agrees,
    known_corners,
)
from coopslam.exploration.sweep import Sweep, gate_ahead, next_known, stands_between, ways_to_sweep
from coopslam.exploration.travel import route_to_gate
from coopslam.records import CornerDecision, CornerSighting, Decision, TriangleDecision, WallDecision
from coopslam.se2 import Pose2, position

NOWHERE_ELSE = np.zeros(2)
STRAIGHTNESS_RAD = 1e-4  # sigma of the direction of a long wall
MAX_HALVINGS = 16  # of a way that is aimed anew half way


@dataclass(frozen=True, slots=True)
class Decided:
    """What the explorer decided after a step: records for the log and the estimator."""

    records: tuple[Decision, ...]


@dataclass(frozen=True, slots=True)
class ExplorerSettings:
    """How the explorer looks for known corners, and how sure it wants to be."""

    sure_reach_m: float = 0.4  # a corner this near to where it should be is found
    search_places: int = 25  # at most so many places are searched for a corner
    chart: ChartSettings = field(default_factory=ChartSettings)
    recognition: RecognitionSettings = field(default_factory=RecognitionSettings)

    def __post_init__(self):
        require_positive(sure_reach_m=self.sure_reach_m, search_places=self.search_places)


Actions = Generator[Move | Decided, Step | None, str]


class Explorer:
    """Decides for a team of two. `free_map` and `at` (robot -> vertex) are its memory."""

    def __init__(self, robots: tuple[str, str], settings: ExplorerSettings | None = None):
        self.robots = robots
        self.settings = settings or ExplorerSettings()
        self.free_map = FreeMap()
        self.at: dict[str, int] = {}
        self.chart = Chart(self.free_map, self.settings.chart)
        self._last_mover = robots[1]

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
        watcher, mover = self.robots
        corner = self._new_vertex(first.corner)
        self.at[watcher] = corner.vertex
        yield Decided((corner,))
        step = yield FollowWall(mover, watcher, Side.RIGHT)
        if step.ended != MoveEnd.CORNER:
            raise Stuck(f"the first wall ended with {step.ended}, not in a corner")
        corner = self._new_vertex(step.corner)
        self.at[mover] = corner.vertex
        start, end = self.at[watcher], self.at[mover]
        self.free_map.add_first_wall(start, end)
        yield Decided((corner, self._wall(step.corner, start, end, seen_from=start)))

    # travel

    def _travel_to_gate(self):
        one, other = self.robots
        route = route_to_gate(self.free_map, (self.at[one], self.at[other]), self.chart.position)
        if route is None:
            raise Stuck(f"no way over the mapped triangles from vertices {self.at} to an open gate")
        crossings, gate = route
        for crossing in crossings:
            stander = self._last_mover if self.at[one] == self.at[other] else None
            mover = next(r for r in self.robots if self.at[r] == crossing.start and r != stander)
            yield from self._cross(mover, crossing.end)
        return gate

    def _cross(self, mover: str, target: int):
        """Bring a robot along a known edge to the vertex at its other end."""
        self._last_mover = mover
        start, watcher = self.at[mover], self._partner(mover)
        if self.free_map.wall_leaving(start) == target:
            step = yield FollowWall(mover, watcher, Side.RIGHT)
        elif self.free_map.wall_arriving(start) == target:
            step = yield FollowWall(mover, watcher, Side.LEFT)
        else:
            yield from self._go_to(mover, target)
            return
        if step.ended not in (MoveEnd.CORNER, MoveEnd.PARTNER):
            raise Stuck(f"{mover} followed the wall from vertex {start} to {target} and ended with {step.ended}")
        yield from self._know_again(step.corner, target, "end of a known wall")

    def _go_to(self, mover: str, target: int):
        """Drive to a known vertex in the open, search for it if need be, and make sure that it is the one."""
        places, search = 0, iter([NOWHERE_ELSE])
        while (offset := next(search, None)) is not None:
            step = yield self._go_to_corner(mover, target, None, offset, keep_contact=True)
            for _ in range(MAX_HALVINGS):
                if step.ended != MoveEnd.DISTANCE:
                    break  # else: watched on the way, it aims again
                step = yield self._go_to_corner(mover, target, None, offset, keep_contact=True)
            if step.ended in (MoveEnd.CORNER, MoveEnd.PARTNER) and self._may_be(step.corner, target):
                yield from self._know_again(step.corner, target, "found where it should be")
                return
            if places == 0:
                search = iter(self._places_to_search(mover, target))
            places += 1
        raise Stuck(f"{mover} looked for vertex {target} in {places} places and did not find it ({step.ended})")

    def _go_to_corner(
        self,
        mover: str,
        target: int,
        watch_for_rad: float | None = None,
        offset: np.ndarray = NOWHERE_ELSE,
        keep_contact: bool = False,
    ) -> GoToCorner:
        """offset: (2,) from where the vertex should be, axes of the map, m."""
        vertex = self.chart.vertex(target)
        there = self.chart.robot(mover).between(Pose2(vertex.x() + offset[0], vertex.y() + offset[1], vertex.theta()))
        metres = float(np.hypot(there.x(), there.y()))
        reach = self.settings.sure_reach_m
        far_off = metres > 2 * reach and 3 * self.chart.relative_sigma(mover, target) > reach
        return GoToCorner(
            mover,
            self._partner(mover),
            (there.x(), there.y(), there.theta()),
            self.free_map.interior_angles[target],
            watch_for_rad,
            metres / 2 if far_off and not offset.any() else None,
            keep_contact,
        )

    def _places_to_search(self, mover: str, target: int) -> list[np.ndarray]:
        """Offsets (2,) from where a vertex should be, on a grid that the finder covers, the likeliest first, m.

        The place itself comes first again: seen from near, the robot aims better.
        """
        variances, axes = np.linalg.eigh(self.chart.relative_covariance(mover, target))
        sigmas = np.sqrt(np.maximum(variances, 1e-12))
        spacing = 1.4 * self.settings.sure_reach_m  # squares whose corners the finder just reaches
        counts = np.minimum(np.ceil(np.maximum(3 * sigmas - self.settings.sure_reach_m, 0) / spacing), 10).astype(int)
        steps = [spacing * np.arange(-count, count + 1) for count in counts]
        grid = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
        likely = np.argsort(np.sum((grid / sigmas) ** 2, axis=1), kind="stable")[: self.settings.search_places]
        return [axes @ grid[k] for k in likely]

    # one gate

    def _explore_gate(self, gate: tuple[int, int]):
        """Find the apex behind a gate, or that it is a wall; the team stands on it."""
        robot_at = {vertex: robot for robot, vertex in self.at.items()}
        for sweep in ways_to_sweep(self.chart, gate, robot_at, self._last_mover):
            self._last_mover = sweep.mover
            found = yield from self._sweep(sweep)
            if found:
                return
        raise Stuck(f"no way to sweep behind the gate between vertices {gate[0]} and {gate[1]}")

    def _sweep(self, sweep: Sweep):
        """Turn the line of contact about the pivot until it meets the apex. False: it cannot be turned this way."""
        target = None  # the known vertex to which the mover drives; None: it follows a wall
        if sweep.boundary is None:
            target, limit = gate_ahead(self.chart, sweep)
            step = yield DriveAway(sweep.mover, sweep.watcher, limit)
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
                step = yield FollowWall(sweep.mover, sweep.watcher, sweep.wall_on, watch_for)
            else:
                step = yield self._go_to_corner(sweep.mover, target, watch_for, offset)
            match step.ended:
                case MoveEnd.CORNER:
                    walked = sweep.boundary is not None and target is None
                    return (yield from self._meet_corner(sweep, step.corner, walked))
                case MoveEnd.PARTNER if sweep.boundary is not None and target is None:
                    yield from self._close_as_wall(sweep, step)
                    return True
                case MoveEnd.CONTACT:
                    return (yield from self._return_to_occluder(sweep))
                case MoveEnd.BEARING:
                    passed.add(watched)
                    if stands_between(self.chart, sweep, watched):
                        target, search, offset, halvings = watched, None, NOWHERE_ELSE, MAX_HALVINGS
                case MoveEnd.DISTANCE if target is not None and halvings > 0:
                    halvings -= 1  # on the way to a known vertex: aim again
                case MoveEnd.NOTHING if target is not None:
                    search = iter(self._places_to_search(sweep.mover, target)) if search is None else search
                    offset = next(search, None)
                    if offset is None:
                        raise Stuck(f"{sweep.mover} did not find vertex {target} behind gate {sweep.gate}")
                case _:
                    raise Stuck(f"{sweep.mover} swept behind gate {sweep.gate} and ended with {step.ended}")

    def _return_to_occluder(self, sweep: Sweep):
        """Contact is about to break: the corner that breaks it lies on the line of contact, and is the apex.

        Known corners that only touch the line, where nothing unexplored faces the gate, are driven past.
        """
        while True:
            step = yield ReturnAlongContact(sweep.mover, sweep.watcher)
            if step.ended == MoveEnd.PARTNER:  # nothing in between: the wall led away after all
                yield from self._know_again(step.corner, sweep.pivot, "the partner stands there")
                yield from self._cross(sweep.mover, sweep.corner)
                return False
            matches = self._matches(sweep, step.corner, {sweep.pivot})
            if not matches or matches[0].sector is not None:
                return (yield from self._meet_corner(sweep, step.corner))
            yield from self._know_again(step.corner, matches[0].vertex, "touches the line of contact")

    def _meet_corner(self, sweep: Sweep, sighting: CornerSighting, walked_wall: bool = False):
        """The mover stands in the apex: decide which vertex that is and add the triangle."""
        wall_at_end = walked_wall and sweep.turn > 0
        wall_at_start = walked_wall and sweep.turn < 0
        corner, sector = self._recognise(sweep, sighting, wall_at_end, wall_at_start)
        apex = corner.vertex
        self.at[sweep.mover] = apex
        a, b = sweep.gate
        try:
            triangle = self.free_map.add_triangle(sweep.gate, apex, wall_at_end, wall_at_start, sector)
        except MapConflict:
            yield Decided((corner,))  # the log tells what led to the conflict
            raise
        start, end = (b, apex) if wall_at_end else (apex, a)
        walls = [self._wall(sighting, start, end, seen_from=sweep.corner)] if walked_wall else []
        yield Decided((corner, *walls, TriangleDecision(sighting.stamp_s, triangle, (a, b, apex))))
        return True

    def _close_as_wall(self, sweep: Sweep, step: Step):
        """The mover walked the wall to its partner: the gate is that wall."""
        start, end = self.free_map.close_as_wall(sweep.gate)
        again = self._seen_again(step.corner, sweep.pivot, "the partner stands there")
        yield Decided((again, self._wall(step.corner, start, end, seen_from=sweep.corner)))

    # which corner is this

    def _recognise(self, sweep: Sweep, sighting: CornerSighting, wall_at_end: bool, wall_at_start: bool):
        """(decision, sector): a known vertex and the sector that the triangle fills there, or a new one and None.

        Raises Stuck when the sighting looks like a known vertex at which the triangle does not fit: taking it for a
        new one would map a part of the world twice.
        """
        matches = self._matches(sweep, sighting, sweep.gate, wall_at_end, wall_at_start)
        if not matches:
            return self._new_vertex(sighting), None
        fitting = [match for match in matches if match.sector is not None]
        if not fitting:
            raise Stuck(
                f"{sighting.observer} found vertex {matches[0].vertex} behind gate {sweep.gate}, where it cannot be"
            )
        best, runner_up = fitting[0], fitting[1].distance_sq if len(fitting) > 1 else None
        known = CornerDecision(
            sighting.stamp_s, sighting, best.vertex, False, best.distance_sq, runner_up, "end of an open gate"
        )
        return known, best.sector.index

    def _matches(self, sweep: Sweep, sighting: CornerSighting, leave_out, wall_at_end=False, wall_at_start=False):
        limits = self.settings.recognition
        return known_corners(self.chart, limits, sighting, sweep.gate, leave_out, wall_at_end, wall_at_start)

    def _new_vertex(self, sighting: CornerSighting) -> CornerDecision:
        """A vertex that the map gets, and the decision that says so."""
        vertex = len(self.free_map.fans)
        self.free_map.add_vertex(vertex, sighting.interior_angle_rad)
        self.chart.corner_angle_sigma = max(self.chart.corner_angle_sigma, sighting.interior_angle_sigma_rad)
        return CornerDecision(sighting.stamp_s, sighting, vertex, True)

    def _wall(self, sighting: CornerSighting, start: int, end: int, seen_from: int) -> WallDecision:
        """The wall between a known corner and the sighted one at its other end.

        That a corner's direction points at the next corner is a bearing over the wall's length L. Its linearization is
        off by the square of sigma / L, with sigma what the finder leaves open of the two corners' places: the short
        walls of a rounded corner say little, and are believed little.
        """
        here = position(self.chart.robot(sighting.observer) * sighting.T_observer_corner)
        length = max(float(np.hypot(*(here - self.chart.position(seen_from)))), SAME_PLACE_M)
        bent = 2 * np.trace(sighting.cov_observer[:2, :2]) / length**2
        return WallDecision(sighting.stamp_s, start, end, float(max(STRAIGHTNESS_RAD, bent)))

    def _know_again(self, sighting: CornerSighting, vertex: int, evidence: str):
        yield Decided((self._seen_again(sighting, vertex, evidence),))

    def _seen_again(self, sighting: CornerSighting, vertex: int, evidence: str) -> CornerDecision:
        """The robot came back to a vertex, by a way that leaves no doubt or after a test: one more factor."""
        distance_sq = corner_distance_sq(self.chart.estimate, sighting, vertex)
        self.at[sighting.observer] = vertex
        return CornerDecision(sighting.stamp_s, sighting, vertex, False, distance_sq, None, evidence)

    def _may_be(self, sighting: CornerSighting, vertex: int) -> bool:
        """Whether a sighting fits a vertex in place, direction and interior angle."""
        limits = self.settings.recognition
        if not interior_angle_agrees(sighting, self.free_map.interior_angles[vertex], limits.angle_sigmas):
            return False
        return corner_distance_sq(self.chart.estimate, sighting, vertex) <= limits.distance_sq_max

    def _partner(self, robot: str) -> str:
        return self.robots[1] if robot == self.robots[0] else self.robots[0]
