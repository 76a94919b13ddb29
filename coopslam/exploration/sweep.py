"""One sweep of the line of contact behind a gate, and which known gates it will meet (by the estimate)."""

from dataclasses import dataclass

import numpy as np

from coopslam.exploration.chart import SAME_PLACE_M, STRAIGHT_RAD, Chart
from coopslam.exploration.free_map import Boundary
from coopslam.exploration.moves import Side
from coopslam.exploration.recognition import sector_for
from coopslam.se2 import position, rotation, wrap

PATH_SLACK_RAD = 0.1  # how far a path may bend away from the direction measured at its start


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


def ways_to_sweep(chart: Chart, gate: tuple[int, int], robot_at: dict[int, str], last_mover: str) -> list[Sweep]:
    """Ways to sweep behind a gate, the surest first: along a wall or known gate, else through the doorway.

    robot_at: which robot stands at which end. Of equally sure ways the one without a role exchange comes first,
    unless the gate may be a wall and another gate waits where the mover stands: then its partner walks.
    """
    free_map = chart.free_map
    a, b = gate
    sure, unsure, doorway = [], [], []
    for corner, pivot in ((b, a), (a, b)):
        boundary = free_map.boundary_at_end(gate) if corner == b else free_map.boundary_at_start(gate)
        opening, margin = chart.opening(corner, pivot, boundary, clockwise=corner == b)
        mover, watcher = robot_at[corner], robot_at[pivot]
        leaves_gate = opening < margin and any(corner in other for other in free_map.gates if other != gate)
        rank = (leaves_gate, mover != last_mover)
        if opening < np.pi - margin:
            sure.append((rank, Sweep(gate, mover, watcher, corner, pivot, boundary)))
        elif opening < np.pi + margin:
            unsure.append((rank, Sweep(gate, mover, watcher, corner, pivot, boundary)))
        doorway.append(((False, mover != last_mover), Sweep(gate, mover, watcher, corner, pivot, None)))
    return [sweep for group in (sure, unsure, doorway) for _, sweep in sorted(group, key=lambda option: option[0])]


def next_known(chart: Chart, sweep: Sweep, target: int | None, passed: set) -> tuple[int | None, float | None]:
    """The next end of an open gate that the line of contact will meet, and its bearing in the watcher's frame.

    target: the known vertex to which the mover drives; None: it follows a wall.  passed: vertices to leave out.
    Left out too: what lies beyond the mover's path, and vertices in whose unexplored space the triangle does not fit.
    """
    ends = sorted({v for gate in chart.free_map.gates for v in gate} - passed - set(sweep.gate))
    if not ends:
        return None, None
    places = np.array([chart.position(vertex) for vertex in ends])
    angles = ahead_angles(chart, sweep, places)
    ahead = (angles > -STRAIGHT_RAD) & ~_beyond_path(chart, sweep, target, places)
    for k in np.argsort(angles):
        if not ahead[k] or (angles[k] <= STRAIGHT_RAD and not _gate_goes_ahead(chart, sweep, ends[k])):
            continue
        if sector_for(chart, ends[k], sweep.gate) is not None:
            there = chart.robot(sweep.watcher).transformTo(places[k])
            return ends[k], float(np.arctan2(there[1], there[0]))
    return None, None


def stands_between(chart: Chart, sweep: Sweep, vertex: int) -> bool:
    """Whether a vertex on the line of contact is nearer to the pivot than the mover, and not the mover's place."""
    pivot = chart.position(sweep.pivot)
    mover, known = chart.estimate.belief(sweep.mover), chart.estimate.vertex_belief(vertex)
    gap = np.hypot(*(position(mover.T_world_body) - pivot)) - np.hypot(*(chart.position(vertex) - pivot))
    if gap <= 0:
        return False
    sigmas = chart.settings.place_sigmas
    if gap > sigmas * (mover.position_sigma_m + known.position_sigma_m) + SAME_PLACE_M:
        return True
    return bool(gap > sigmas * chart.relative_sigma(sweep.mover, vertex) + SAME_PLACE_M)


def gate_ahead(chart: Chart, sweep: Sweep) -> tuple[int | None, float | None]:
    """The first open gate across the line of contact prolonged beyond the mover: its end on the unexplored side,
    and how far away the gate is, m.

    A gate one end of which may lie on the line, for all that is known of it, is across it too: who drives past that end
    on the wrong side is in explored space.
    """
    here = chart.position(sweep.corner)
    way = here - chart.position(sweep.pivot)
    way = way / np.hypot(*way)
    best, best_m = None, None
    for gate in chart.free_map.gates:
        if set(gate) & set(sweep.gate):
            continue
        ends = np.array([chart.position(vertex) for vertex in gate]) - here
        sides = sweep.turn * (way[0] * ends[:, 1] - way[1] * ends[:, 0])  # m; positive: unexplored
        doubtful = [k for k in (0, 1) if ends[k] @ way > 0 and abs(sides[k]) <= _doubt_of_side(chart, sweep, gate[k])]
        if sides[0] * sides[1] < 0:
            share = sides[0] / (sides[0] - sides[1])
            metres, last = float(way @ (ends[0] + share * (ends[1] - ends[0]))), gate[int(np.argmax(sides))]
        elif len(doubtful) == 1:
            touched, other = doubtful[0], 1 - doubtful[0]
            metres, last = float(way @ ends[touched]), gate[other if sides[other] > 0 else touched]
        else:
            continue
        if metres > 0 and (best_m is None or metres < best_m):
            best, best_m = last, metres
    return best, best_m


def _doubt_of_side(chart: Chart, sweep: Sweep, vertex: int) -> float:
    """How far a vertex beyond the mover may be off the line of contact prolonged and still lie on it, m."""
    here, pivot = chart.position(sweep.corner), chart.position(sweep.pivot)
    way, known = here - pivot, (sweep.pivot, sweep.corner, vertex)
    length = float(np.hypot(*way))
    lever = float(way @ (chart.position(vertex) - here)) / length**2  # of the vertex, over that of the gate
    sideways = np.array([-way[1], way[0]]) / length
    rows = [
        share * sideways @ rotation(chart.vertex(place).theta())
        for share, place in zip((lever, -1 - lever, 1.0), known, strict=True)
    ]
    jacobian = np.concatenate([np.append(row, 0.0) for row in rows])
    joint = chart.estimate.joint_covariance([chart.estimate.vertex_key(place) for place in known])
    return chart.settings.place_sigmas * float(np.sqrt(max(jacobian @ joint @ jacobian, 0.0))) + SAME_PLACE_M


def ahead_angles(chart: Chart, sweep: Sweep, places: np.ndarray) -> np.ndarray:
    """(N,) angles at the pivot from the mover to (N, 2) places, in the sense of the sweep, (-pi, pi]."""
    pivot = chart.position(sweep.pivot)
    to_mover = position(chart.robot(sweep.mover)) - pivot
    arms = places - pivot
    return sweep.turn * wrap(np.arctan2(arms[:, 1], arms[:, 0]) - np.arctan2(to_mover[1], to_mover[0]))


def _beyond_path(chart: Chart, sweep: Sweep, target: int | None, places: np.ndarray) -> np.ndarray:
    """(N,) whether places lie clearly on the far side of the straight path of the mover, seen from the pivot."""
    if target is None and sweep.boundary is None:
        return np.zeros(len(places), dtype=bool)  # a wall met beyond a doorway: its direction is not known
    if target is not None:
        start = position(chart.robot(sweep.mover))
        way = chart.position(target) - start
    else:
        start, corner = chart.position(sweep.corner), chart.vertex(sweep.corner)
        angle = 0.0 if sweep.turn > 0 else chart.free_map.interior_angles[sweep.corner]
        way = rotation(corner.theta() + angle)[:, 0]
    offset = places - start
    slack = PATH_SLACK_RAD * np.hypot(*offset.T) * np.hypot(*way)
    return sweep.turn * (way[0] * offset[:, 1] - way[1] * offset[:, 0]) < -slack


def _gate_goes_ahead(chart: Chart, sweep: Sweep, vertex: int) -> bool:
    """Whether an open gate at a vertex on the line of contact leads to where the line will turn."""
    others = [(set(gate) - {vertex}).pop() for gate in chart.free_map.gates if vertex in gate]
    return bool((ahead_angles(chart, sweep, np.array([chart.position(v) for v in others])) > STRAIGHT_RAD).any())
