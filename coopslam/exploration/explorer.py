"""The explorer: a pure decision from (free map, estimate, last step) to the next move, or the end and why.

Its `actions` are a dialogue: it yields a move and is sent the step that the move returned, or yields what it
decided and is sent nothing. Which robot goes where follows section 4 of the design: the apex rule, walls,
roles, doorways. It never holds the world.
"""

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np

from coopslam.errors import CoopSlamError
from coopslam.estimation.estimate import Estimate
from coopslam.exploration.free_map import Boundary, FreeMap, Sector
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
    bearing,
    corner_distance_sq,
    fitting_sector,
    interior_angle_agrees,
)
from coopslam.exploration.travel import route_to_gate
from coopslam.records import CornerDecision, CornerSighting, Decision, TriangleDecision, WallDecision
from coopslam.se2 import adjoint, largest_sigma, position, wrap


STRAIGHT_RAD = 1e-6  # angles closer than this are one direction, however good the sensors
SAME_PLACE_M = 1e-6
PATH_SLACK_RAD = 0.1  # how far a path may bend away from the direction measured at its start


class Stuck(CoopSlamError):
    """Exploration cannot go on; the message says where and why."""

    exit_code = 3


@dataclass(frozen=True, slots=True)
class Decided:
    """What the explorer decided after a step: records for the log and the estimator."""

    records: tuple[Decision, ...]


@dataclass(frozen=True, slots=True)
class ExplorerSettings:
    """How sure the explorer wants to be."""

    angle_sigmas: float = 5.0  # an angle this close to a straight line counts as undecided
    same_place_sigmas: float = 3.0
    attempts: int = 3  # to find a known corner
    sure_reach_m: float = 0.4  # when a corner may be further than this from its estimate, half way is driven first
    recognition: RecognitionSettings = field(default_factory=RecognitionSettings)


@dataclass(frozen=True, slots=True)
class Sweep:
    """One way to find the apex behind a gate: the robot at `corner` moves, the one at `pivot` watches.

    boundary: what the mover follows from its corner; None: the doorway, straight on and away from the watcher.
    """

    gate: tuple[int, int]
    mover: str
    watcher: str
    corner: int
    pivot: int
    boundary: Boundary | None

    @property
    def wall_on(self) -> Side:
        """Behind gate (a, b) the robot at b has the wall on its right, the one at a on its left."""
        return Side.RIGHT if self.corner == self.gate[1] else Side.LEFT

    @property
    def turn(self) -> int:
        """+1: the line of contact turns counter-clockwise about the pivot."""
        return 1 if self.wall_on == Side.RIGHT else -1


Actions = Generator[Move | Decided, Step | None, str]


class Explorer:
    """Decides for a team of two. `free_map` and `at` (robot -> vertex) are its memory; `estimate` is kept current."""

    def __init__(self, robots: tuple[str, str], settings: ExplorerSettings | None = None):
        self.robots = robots
        self.settings = settings or ExplorerSettings()
        self.free_map = FreeMap()
        self.at: dict[str, int] = {}
        self.estimate: Estimate | None = None
        self._last_mover = robots[1]
        self._angle_sigma = 0.0  # of a corner's interior angle, rad
        self._vertex_cache: dict = {}

    def look_at(self, estimate: Estimate) -> None:
        """Steer by this estimate from now on."""
        self.estimate = estimate
        self._vertex_cache.clear()

    def actions(self, first: Step) -> Actions:
        """Explore until no gate is open; returns why that is the end. Raises Stuck when it cannot go on."""
        yield from self._walk_first_wall(first)
        while self.free_map.gates:
            gate = yield from self._travel_to_gate()
            yield from self._explore_gate(gate)
        return self._account()

    # the first wall

    def _walk_first_wall(self, first: Step):
        watcher, mover = self.robots
        self.at[watcher] = yield from self._new_vertex(first.corner)
        step = yield FollowWall(mover, watcher, Side.RIGHT)
        if step.ended != MoveEnd.CORNER:
            raise Stuck(f"the first wall ended with {step.ended}, not in a corner")
        self.at[mover] = yield from self._new_vertex(step.corner)
        start, end = self.at[watcher], self.at[mover]
        self.free_map.add_first_wall(start, end)
        yield Decided((WallDecision(step.stamp_s, start, end),))

    # travel

    def _travel_to_gate(self):
        one, other = self.robots
        route = route_to_gate(self.free_map, (self.at[one], self.at[other]), self._position)
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
        start, watcher = self.at[mover], self._partner(mover)
        if self.free_map.wall_leaving(start) == target:
            move = FollowWall(mover, watcher, Side.RIGHT)
        elif self.free_map.wall_arriving(start) == target:
            move = FollowWall(mover, watcher, Side.LEFT)
        else:
            yield from self._go_to(mover, target)
            return
        self._last_mover = mover
        step = yield move
        if step.ended not in (MoveEnd.CORNER, MoveEnd.PARTNER):
            raise Stuck(f"{mover} followed the wall from vertex {start} to {target} and ended with {step.ended}")
        yield from self._know_again(step.corner, target)

    def _go_to(self, mover: str, target: int):
        """Drive to a known vertex in the open and make sure that it is the one."""
        for _ in range(self.settings.attempts):
            step = yield self._go_to_corner(mover, target)
            while step.ended == MoveEnd.DISTANCE:  # watched on the way, it aims again
                step = yield self._go_to_corner(mover, target)
            if step.ended in (MoveEnd.CORNER, MoveEnd.PARTNER) and self._may_be(step.corner, target):
                yield from self._know_again(step.corner, target)
                return
        raise Stuck(f"{mover} did not find vertex {target} where the map says: {step.ended}")

    def _go_to_corner(self, mover: str, target: int, watch_for_rad: float | None = None) -> GoToCorner:
        self._last_mover = mover
        there = self.estimate.pose(mover).between(self._vertex(target))
        where = (there.x(), there.y(), there.theta())
        metres = float(np.hypot(*where[:2]))
        aims_badly = 3.0 * self._relative_sigma(mover, target) > self.settings.sure_reach_m
        limit_m = metres / 2 if aims_badly and metres > 2.0 * self.settings.sure_reach_m else None
        angle = self.free_map.interior_angles[target]
        return GoToCorner(mover, self._partner(mover), where, angle, watch_for_rad, limit_m)

    # one gate

    def _explore_gate(self, gate: tuple[int, int]):
        """Find the apex behind a gate, or that it is a wall; the team stands on it."""
        for sweep in self._sweeps(gate):
            self._last_mover = sweep.mover
            found = yield from self._sweep(sweep)
            if found:
                return
        raise Stuck(f"no way to sweep behind the gate between vertices {gate[0]} and {gate[1]}")

    def _sweeps(self, gate: tuple[int, int]) -> list[Sweep]:
        """Ways to sweep behind a gate, the surest first: along a wall or known gate, else through the doorway."""
        sure, unsure, doorway = [], [], []
        a, b = gate
        for corner, pivot in ((b, a), (a, b)):
            boundary = self.free_map.boundary_at_end(gate) if corner == b else self.free_map.boundary_at_start(gate)
            opening, margin = self._opening(corner, pivot, boundary, clockwise=corner == b)
            mover = next(robot for robot in self.robots if self.at[robot] == corner)
            sweep = Sweep(gate, mover, self._partner(mover), corner, pivot, boundary)
            if opening < np.pi - margin:
                sure.append((opening < margin and self._other_gate_at(corner, gate), sweep))
            elif opening < np.pi + margin:
                unsure.append((False, sweep))
            doorway.append((False, Sweep(gate, mover, self._partner(mover), corner, pivot, None)))

        def preference(option):
            ends_apart, sweep = option
            return ends_apart, sweep.mover != self._last_mover

        return [sweep for group in (sure, unsure, doorway) for _, sweep in sorted(group, key=preference)]

    def _other_gate_at(self, vertex: int, gate: tuple[int, int]) -> bool:
        return any(vertex in other for other in self.free_map.gates if other != gate)

    def _opening(self, corner: int, pivot: int, boundary: Boundary, clockwise: bool) -> tuple[float, float]:
        """Unexplored angle at a gate's end between the gate and its next boundary, and how sure that is, rad.

        An angle within the margin of a full turn is one of zero: the gate runs along the wall.
        """
        toward_pivot = bearing(self._vertex(corner), self._vertex(pivot))
        if not boundary.is_wall:
            edge = bearing(self._vertex(corner), self._vertex(boundary.other))
        else:
            edge = 0.0 if clockwise else self.free_map.interior_angles[corner]
        opening = ((toward_pivot - edge) if clockwise else (edge - toward_pivot)) % (2 * np.pi)
        margin = self._bearing_margin(corner, pivot, clearance=min(opening, abs(opening - np.pi), 2 * np.pi - opening))
        if opening > 2 * np.pi - margin:
            opening = 0.0
        return opening, margin

    def _sweep(self, sweep: Sweep):
        """Turn the line of contact about the pivot until it meets the apex. False: it cannot be turned this way."""
        target = None if sweep.boundary is None or sweep.boundary.is_wall else sweep.boundary.other
        if sweep.boundary is None:
            gate_ahead, limit = self._gate_ahead(sweep)
            step = yield DriveAway(sweep.mover, sweep.watcher, limit)
            if step.ended == MoveEnd.CORNER:
                return (yield from self._meet_corner(sweep, step.corner))
            if step.ended == MoveEnd.DISTANCE:
                target = gate_ahead[0] if self._ahead_angles(sweep, self._position(gate_ahead[0])[None])[0] > 0 else gate_ahead[1]
        passed = {target}
        attempts = self.settings.attempts
        while True:
            watched, watch_for = self._next_known(sweep, target, passed)
            if target is None:
                step = yield FollowWall(sweep.mover, sweep.watcher, sweep.wall_on, watch_for)
            else:
                step = yield self._go_to_corner(sweep.mover, target, watch_for)
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
                    if self._stands_between(sweep, watched):
                        target, attempts = watched, self.settings.attempts
                case MoveEnd.NOTHING if attempts > 1:
                    attempts -= 1
                case MoveEnd.DISTANCE:
                    pass  # on the way to a known vertex: aim again
                case _:
                    raise Stuck(f"{sweep.mover} swept behind gate {sweep.gate} and ended with {step.ended}")

    def _return_to_occluder(self, sweep: Sweep):
        """Contact is about to break: the corner that breaks it lies on the line of contact, and is the apex."""
        while True:
            step = yield ReturnAlongContact(sweep.mover, sweep.watcher)
            if step.ended == MoveEnd.PARTNER:  # nothing in between: the wall led away after all
                yield from self._know_again(step.corner, sweep.pivot)
                yield from self._cross(sweep.mover, sweep.corner)
                return False
            passed = self._explored_corner(sweep, step.corner)
            if passed is None:
                return (yield from self._meet_corner(sweep, step.corner))
            yield from self._know_again(step.corner, passed)

    def _meet_corner(self, sweep: Sweep, sighting: CornerSighting, walked_wall: bool = False):
        """The mover stands in the apex: decide which vertex that is and add the triangle."""
        wall_at_end = walked_wall and sweep.turn > 0
        wall_at_start = walked_wall and sweep.turn < 0
        apex, sector = yield from self._recognise(sweep, sighting, wall_at_end, wall_at_start)
        self.at[sweep.mover] = apex
        a, b = sweep.gate
        triangle = self.free_map.add_triangle(sweep.gate, apex, wall_at_end, wall_at_start, sector)
        decided = []
        if walked_wall:
            start, end = (b, apex) if wall_at_end else (apex, a)
            decided.append(WallDecision(sighting.stamp_s, start, end))
        yield Decided((*decided, TriangleDecision(sighting.stamp_s, triangle, (a, b, apex))))
        return True

    def _close_as_wall(self, sweep: Sweep, step: Step):
        """The mover walked the wall to its partner: the gate is that wall."""
        yield from self._know_again(step.corner, sweep.pivot)
        start, end = self.free_map.close_as_wall(sweep.gate)
        self.at[sweep.mover] = sweep.pivot
        yield Decided((WallDecision(step.stamp_s, start, end),))

    # which corner is this

    def _recognise(self, sweep: Sweep, sighting: CornerSighting, wall_at_end: bool, wall_at_start: bool):
        """(vertex, sector): a known vertex and the sector that the triangle fills there, or a new one and None."""
        limits = self.settings.recognition
        ranked = []
        ends = {vertex for gate in self.free_map.gates for vertex in gate}
        for vertex in self._near(sighting, ends):
            if interior_angle_agrees(sighting, self.free_map.interior_angles[vertex], limits.angle_sigmas):
                sector = self._fit(sweep, vertex, wall_at_end, wall_at_start)
                if sector is not None:
                    ranked.append((corner_distance_sq(self.estimate, sighting, vertex), vertex, sector))
        ranked.sort(key=lambda entry: entry[0])
        if not ranked or ranked[0][0] > limits.distance_sq_max:
            twin = next((v for v in self._near(sighting, set(self.free_map.fans) - set(sweep.gate)) if self._may_be(sighting, v)), None)
            if twin is not None:
                raise Stuck(f"{sighting.observer} found vertex {twin} behind gate {sweep.gate}, where it cannot be")
            nearest = ranked[0][0] if ranked else None
            return (yield from self._new_vertex(sighting, nearest)), None
        runner_up = ranked[1][0] if len(ranked) > 1 else None
        distance_sq, vertex, sector = ranked[0]
        known = CornerDecision(sighting.stamp_s, sighting, vertex, False, distance_sq, runner_up, "end of an open gate")
        yield Decided((known,))
        return vertex, sector.index

    def _explored_corner(self, sweep: Sweep, sighting: CornerSighting) -> int | None:
        """The known vertex at a sighting that cannot be the apex: nothing unexplored there faces the gate."""
        for vertex in self._near(sighting, self.free_map.fans):
            if vertex != sweep.pivot and self._may_be(sighting, vertex) and self._fit(sweep, vertex, False, False) is None:
                return vertex
        return None

    def _fit(self, sweep: Sweep, vertex: int, wall_at_end: bool, wall_at_start: bool) -> Sector | None:
        """The unexplored sector of a known vertex into which the triangle behind the gate fits, if any."""
        if vertex in sweep.gate:
            return None
        sector, miss = fitting_sector(self.free_map, self.estimate, vertex, sweep.gate, wall_at_end, wall_at_start)
        return sector if miss <= self._sector_slack(vertex, sweep.gate) else None

    def _sector_slack(self, vertex: int, others) -> float:
        """How far a direction at a vertex may lie outside a sector and still be taken for inside, rad."""
        corner = self.estimate.vertex_belief(vertex)
        across = max(
            (corner.position_sigma_m + self.estimate.vertex_belief(other).position_sigma_m)
            / max(np.hypot(*(self._position(other) - self._position(vertex))), SAME_PLACE_M)
            for other in others
        )
        doubt = self.settings.angle_sigmas * (across + np.sqrt(corner.cov_body[2, 2]) + self._angle_sigma)
        return min(doubt + STRAIGHT_RAD, self.settings.recognition.sector_slack_rad)

    def _near(self, sighting: CornerSighting, vertices) -> list[int]:
        """Those of some vertices that may be where the sighting is."""
        limits = self.settings.recognition
        belief = self.estimate.belief(sighting.observer)
        here = position(belief.T_world_body * sighting.T_observer_corner)
        reach = max(limits.search_radius_m, limits.search_sigmas * belief.position_sigma_m)
        return [vertex for vertex in sorted(vertices) if np.hypot(*(self._position(vertex) - here)) <= reach]

    def _new_vertex(self, sighting: CornerSighting, nearest_sq: float | None = None):
        vertex = len(self.free_map.fans)
        self.free_map.add_vertex(vertex, sighting.interior_angle_rad)
        self._angle_sigma = max(self._angle_sigma, sighting.interior_angle_sigma_rad)
        yield Decided((CornerDecision(sighting.stamp_s, sighting, vertex, True, None, nearest_sq),))
        return vertex

    def _know_again(self, sighting: CornerSighting, vertex: int):
        """The robot came back to a vertex: one more factor."""
        distance_sq = corner_distance_sq(self.estimate, sighting, vertex)
        if distance_sq > self.settings.recognition.distance_sq_max:
            raise Stuck(f"{sighting.observer} expected vertex {vertex} and found another corner (d^2 = {distance_sq:.0f})")
        self.at[sighting.observer] = vertex
        yield Decided((CornerDecision(sighting.stamp_s, sighting, vertex, False, distance_sq, None, "expected"),))

    def _may_be(self, sighting: CornerSighting, vertex: int) -> bool:
        """Whether a sighting fits a vertex in place, direction and interior angle."""
        limits = self.settings.recognition
        if not interior_angle_agrees(sighting, self.free_map.interior_angles[vertex], limits.angle_sigmas):
            return False
        return corner_distance_sq(self.estimate, sighting, vertex) <= limits.distance_sq_max

    # known gates, by the estimate

    def _next_known(self, sweep: Sweep, target: int | None, passed: set) -> tuple[int | None, float | None]:
        """The next end of an open gate that the line of contact will meet, and its bearing in the watcher's frame.

        Left out: what lies beyond the path that the mover follows, and vertices into whose unexplored space the
        triangle would not fit.
        """
        ends = sorted({v for gate in self.free_map.gates for v in gate} - passed - set(sweep.gate))
        if not ends:
            return None, None
        places = np.array([self._position(vertex) for vertex in ends])
        angles = self._ahead_angles(sweep, places)
        ahead = (angles > -STRAIGHT_RAD) & ~self._beyond_path(sweep, target, places)
        for k in np.argsort(angles):
            if not ahead[k] or (angles[k] <= STRAIGHT_RAD and not self._gate_goes_ahead(sweep, ends[k])):
                continue
            if self._fit(sweep, ends[k], False, False) is not None:
                there = self.estimate.pose(sweep.watcher).transformTo(places[k])
                return ends[k], float(np.arctan2(there[1], there[0]))
        return None, None

    def _beyond_path(self, sweep: Sweep, target: int | None, places: np.ndarray) -> np.ndarray:
        """(N,) whether places lie clearly on the far side of the straight path of the mover, seen from the pivot."""
        if target is None and sweep.boundary is None:
            return np.zeros(len(places), dtype=bool)  # a wall met beyond a doorway: its direction is not known
        corner = self._vertex(sweep.corner)
        if target is not None:
            way = self._position(target) - position(self.estimate.pose(sweep.mover))
        else:
            angle = 0.0 if sweep.turn > 0 else self.free_map.interior_angles[sweep.corner]
            way = corner.rotation().matrix() @ np.array([np.cos(angle), np.sin(angle)])
        offset = places - position(corner if target is None else self.estimate.pose(sweep.mover))
        slack = PATH_SLACK_RAD * np.hypot(*offset.T) * np.hypot(*way)
        return sweep.turn * (way[0] * offset[:, 1] - way[1] * offset[:, 0]) < -slack

    def _gate_goes_ahead(self, sweep: Sweep, vertex: int) -> bool:
        """Whether an open gate at a vertex on the line of contact leads to where the line will turn."""
        others = [(set(gate) - {vertex}).pop() for gate in self.free_map.gates if vertex in gate]
        return bool((self._ahead_angles(sweep, np.array([self._position(v) for v in others])) > STRAIGHT_RAD).any())

    def _ahead_angles(self, sweep: Sweep, places: np.ndarray) -> np.ndarray:
        """(N,) angles at the pivot from the mover to (N, 2) places, in the sense of the sweep, (-pi, pi]."""
        pivot = self._position(sweep.pivot)
        to_mover = position(self.estimate.pose(sweep.mover)) - pivot
        arms = places - pivot
        return sweep.turn * wrap(np.arctan2(arms[:, 1], arms[:, 0]) - np.arctan2(to_mover[1], to_mover[0]))

    def _stands_between(self, sweep: Sweep, vertex: int) -> bool:
        """Whether a vertex on the line of contact is nearer to the pivot than the mover, and not the mover's place."""
        pivot = self._position(sweep.pivot)
        mover, known = self.estimate.belief(sweep.mover), self.estimate.vertex_belief(vertex)
        gap = np.hypot(*(position(mover.T_world_body) - pivot)) - np.hypot(*(self._position(vertex) - pivot))
        if gap <= 0:
            return False
        sigmas = self.settings.same_place_sigmas
        if gap > sigmas * (mover.position_sigma_m + known.position_sigma_m) + SAME_PLACE_M:
            return True
        return gap > sigmas * self._relative_sigma(sweep.mover, vertex) + SAME_PLACE_M

    def _gate_ahead(self, sweep: Sweep) -> tuple[tuple[int, int] | None, float | None]:
        """The first open gate across the line of contact prolonged beyond the mover, and how far away, m."""
        here = self._position(sweep.corner)
        way = here - self._position(sweep.pivot)
        way = way / np.hypot(*way)
        best, best_m = None, None
        for gate in self.free_map.gates:
            if set(gate) & set(sweep.gate):
                continue
            u, v = (self._position(vertex) - here for vertex in gate)
            side_u, side_v = way[0] * u[1] - way[1] * u[0], way[0] * v[1] - way[1] * v[0]
            if side_u * side_v >= 0:
                continue
            metres = float(way @ (u + (v - u) * side_u / (side_u - side_v)))
            if metres > 0 and (best_m is None or metres < best_m):
                best, best_m = gate, metres
        return best, best_m

    # the end

    def _account(self) -> str:
        """Check that the finished map is a triangulation of one polygon with holes; says its numbers.

        Raises Stuck when a vertex is not surrounded by triangles and walls, when the corners of a ring of walls do
        not add up to one full turn, when there is not one outer ring, or when the counts do not agree.
        """
        free_map = self.free_map
        unfinished = [vertex for vertex, fan in free_map.fans.items() if not fan.complete]
        if unfinished:
            raise Stuck(f"no gate is open, but vertices {unfinished[:5]} have unexplored space or unknown walls")
        rings = free_map.rings()
        for ring in rings:
            doubt = self.settings.recognition.angle_sigmas * self._angle_sigma * np.sqrt(len(ring)) + STRAIGHT_RAD
            if abs(abs(free_map.turning(ring)) - 2 * np.pi) > doubt:
                degrees = np.degrees(free_map.turning(ring))
                raise Stuck(f"the corners of the walls {ring[:5]}... turn by {degrees:.1f} degrees, not by 360")
        n, holes, triangles = len(free_map.fans), free_map.holes, len(free_map.triangles)
        if len(rings) != holes + 1 or triangles != n + 2 * holes - 2:
            raise Stuck(f"{triangles} triangles do not fit {n} vertices, {len(rings)} rings of walls and {holes} holes")
        return f"no gate is open; {triangles} triangles = {n} vertices + 2 x {holes} holes - 2"

    # small things

    def _partner(self, robot: str) -> str:
        return self.robots[1] if robot == self.robots[0] else self.robots[0]

    def _vertex(self, vertex: int):
        if vertex not in self._vertex_cache:
            self._vertex_cache[vertex] = self.estimate.vertex(vertex)
        return self._vertex_cache[vertex]

    def _position(self, vertex: int) -> np.ndarray:
        return position(self._vertex(vertex))

    def _bearing_margin(self, corner: int, other: int, clearance: float) -> float:
        """How far off the direction of one vertex in another's frame may be, rad.

        A quick bound from the two marginals is enough when it is below the clearance that the decision has.
        """
        sigmas = self.settings.angle_sigmas
        there = self._vertex(corner).transformTo(self._position(other))
        range_m = float(np.hypot(*there))
        near, far = self.estimate.vertex_belief(corner), self.estimate.vertex_belief(other)
        bound = (near.position_sigma_m + far.position_sigma_m) / range_m + np.sqrt(near.cov_body[2, 2])
        if sigmas * bound < clearance:
            return max(sigmas * bound, STRAIGHT_RAD)
        across = np.array([-there[1], there[0]]) / range_m**2
        turn = self._vertex(corner).between(self._vertex(other)).rotation().matrix()
        jacobian = np.concatenate([-across, [-1.0], across @ turn, [0.0]])
        joint = self.estimate.joint_covariance([self.estimate.vertex_key(corner), self.estimate.vertex_key(other)])
        return max(sigmas * float(np.sqrt(max(jacobian @ joint @ jacobian, 0.0))), STRAIGHT_RAD)

    def _relative_sigma(self, robot: str, vertex: int) -> float:
        """Largest sigma of a vertex's position in a robot's frame, m."""
        there = self.estimate.pose(robot).between(self._vertex(vertex))
        jacobian = np.hstack([-adjoint(there.inverse()), np.eye(3)])
        joint = self.estimate.joint_covariance([self.estimate.pose_key(robot), self.estimate.vertex_key(vertex)])
        return largest_sigma((jacobian @ joint @ jacobian.T)[:2, :2])
