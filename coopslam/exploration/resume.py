"""Going on with the map of an earlier exploration: find out where the team is in it, then extend it.

First the team explores as if it knew nothing, and asks after each triangle whether the place is recognized. Then
everything recorded in both sessions is smoothed together: the robots of the earlier one keep their poses under other
names, corners of the new one that are known are the old vertices, and the decisions on all others are forgotten (the
measurements stay). So the map goes on to be one triangulation; what was found beyond it, while nobody knew where, is
found again. The team walks to an edge of the old map over its known edges, and explores on from there.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np

from coopslam.estimation.estimate import Estimate, Estimator
from coopslam.estimation.replay import in_groups
from coopslam.exploration.account import Stuck, account
from coopslam.exploration.explorer import Actions, Explorer, ExplorerSettings
from coopslam.exploration.free_map import FreeMap
from coopslam.exploration.mission import Acting, Budget, Mission, Progress, run_mission
from coopslam.exploration.moves import Move, MoveEnd, Step
from coopslam.exploration.travel import way_to_edge
from coopslam.records import (
    CornerDecision,
    CornerEvidence,
    LoopClosure,
    PosePrior,
    Record,
    TriangleDecision,
    WallDecision,
)
from coopslam.se2 import Pose2

NAMES = ("robot", "observer", "target", "watcher", "earlier_robot")  # fields of records that may name a robot
# Of where the team began, as recognized: it places the new session for the solver and tells next to nothing, for what
# the recognized corners tell are factors themselves.
PLACING_SIGMAS = np.array([10.0, 10.0, 3.0])  # m, m, rad


class Place(Protocol):
    """An answer to where the team is."""

    reason: str
    vertices: Mapping[int, int] | None  # vertex of the new map -> the same one in the old map; None: not recognized
    T_old_new: Pose2 | None  # frame of the new estimate in that of the old map; None: not recognized


Recognize = Callable[[FreeMap, Estimate], Place]


@dataclass(frozen=True, slots=True, eq=False)
class OldSession:
    """What an earlier exploration left behind; its robots have names that the new ones do not have."""

    robots: tuple[str, ...]  # in the order of its estimate: the first one's start is the origin
    records: list[Record]
    free_map: FreeMap


class Relocalizer(Explorer):
    """Explores until the place is recognized and the team stands on an edge of vertices that the old map has too."""

    def __init__(self, robots: tuple[str, ...], settings: ExplorerSettings, recognize: Recognize):
        super().__init__(robots, settings)
        self._recognize = recognize
        self.place: Place | None = None  # the last answer

    def actions(self, first: Step) -> Actions:
        """Raises Stuck when everything is explored and the place is still not recognized."""
        yield from self._walk_first_wall(first)
        while True:
            self.place = self._recognize(self.free_map, self.chart.estimate)
            if self.place.vertices is not None and (yield from self._stand_on(set(self.place.vertices))):
                return self.place.reason
            if not self.free_map.gates:
                raise Stuck(f"everything is explored, and where in the old map it is remains open: {self.place.reason}")
            gate = yield from self._travel_to_gate()
            yield from self._explore_gate(gate)

    def _stand_on(self, known: set[int]):
        """Bring everybody to known vertices; False: no edge has two of them."""
        one, other = self.crew.pair
        here = (self.at[one], self.at[other])
        way = way_to_edge(self.free_map, here, self.chart.position, lambda u, v: u != v and {u, v} <= known)
        if way is None:
            return False
        yield from self._cross(way)
        for follower in self.crew.followers:
            if self.at[follower] not in known:
                yield from self.navigation.errand(follower, self.at[one], one)
        return True


class ResumedExplorer(Explorer):
    """Explores on from a map that is known; the robots stand in vertices of it, wherever these are."""

    def __init__(self, robots: tuple[str, ...], settings: ExplorerSettings, free_map: FreeMap, at: Mapping[str, int]):
        super().__init__(robots, settings, free_map)
        self.at.update(at)

    def know_angles(self, angle_sigma_rad: float) -> None:
        """How well the interior angles of the map were measured."""
        self.chart.corner_angle_sigma = max(self.chart.corner_angle_sigma, angle_sigma_rad)

    def actions(self, first: Step) -> Actions:
        """As of an explorer, without a first wall."""
        self.crew.now_s = first.stamp_s
        if self.free_map.gates:
            yield from self._gather()
        while self.free_map.gates:
            gate = yield from self._travel_to_gate()
            yield from self._explore_gate(gate)
        return account(self.free_map, self.chart.corner_angle_sigma, self.settings.recognition.angle_sigmas)

    def _gather(self):
        """Bring everybody to the first robot, or to an edge's other end; contact is lost on the way and found again."""
        first, *others = self.robots
        for robot in others:
            if self.free_map.joined(self.at[robot], self.at[first]):
                continue
            way = self.identification.route(self.at[robot], self.at[first])
            if way is None:
                raise Stuck(f"no way over known edges from vertex {self.at[robot]} to {self.at[first]}")
            for vertex in way[1:-1]:
                yield from self.navigation.errand(robot, vertex, first)


class _AlreadyThere:
    """A team that has begun."""

    def __init__(self, team: Acting, stamp_s: float):
        self._team, self._stamp_s = team, stamp_s

    def begin(self) -> Step:
        """Nothing new is sensed."""
        return Step(self._stamp_s, (), MoveEnd.CORNER)

    def execute(self, move: Move) -> Step:
        """As the team does."""
        return self._team.execute(move)


def joint_records(old: OldSession, found: Mission, new: Sequence[Record]) -> list[Record]:
    """Both sessions as one log, the new one in the old map's vertices.

    found: a mission of a `Relocalizer` that ended with outcome "complete".  new: its records.
    """
    place, estimate, first = found.explorer.place, found.estimate, found.explorer.robots[0]
    start = estimate.timeline.tracks[first].keys[0]
    T_old_start = place.T_old_new * estimate.value(start)
    prior = PosePrior(new[0].stamp_s, first, T_old_start, np.diag(PLACING_SIGMAS**2))
    return [*old.records, prior, *_in_old_terms(new, place.vertices, first)]


def extend(
    team: Acting,
    driver: Estimator,
    old: OldSession,
    found: Mission,
    records: Sequence[Record],
    log: Callable[[Record], None],
    budget: Budget | None = None,
    watch: Callable[[Progress], None] | None = None,
) -> Mission:
    """Smooth both sessions, go to the old map and explore on. The mission goes on with the account of `found`.

    driver: new, of the robots of both sessions.  records: `joint_records`, which the log holds already.
    """
    relocalizer = found.explorer
    at = {robot: relocalizer.place.vertices[vertex] for robot, vertex in relocalizer.at.items()}
    explorer = ResumedExplorer(relocalizer.robots, relocalizer.settings, old.free_map, at)
    explorer.know_angles(max(one.sighting.interior_angle_sigma_rad for one in records if _is_corner(one)))
    for group in in_groups(records):
        driver.update(group)
    team = _AlreadyThere(team, records[-1].stamp_s)
    return run_mission(team, driver, explorer, log, budget, watch, begun=found)


def renamed(record: Record, names: Mapping[str, str]) -> Record:
    """The same record of robots with other names; those that are not among the names keep theirs."""
    changes = {}
    for entry in fields(record):
        value = getattr(record, entry.name)
        if entry.name in NAMES and value in names:
            changes[entry.name] = names[value]
        elif entry.name == "sighting":
            changes[entry.name] = renamed(value, names)
    return replace(record, **changes) if changes else record


def _in_old_terms(records: Iterable[Record], vertices: Mapping[int, int], first: str) -> Iterator[Record]:
    """Measurements as they are; of the decisions those on corners that are old vertices, as such.

    How the new team was set up is said relative to the start of its first robot, which is no longer the origin.
    """
    for record in records:
        if isinstance(record, PosePrior):
            at = (record.stamp_s, record.stamp_s, first, record.robot)
            yield LoopClosure(*at, record.T_start_robot, record.cov_robot)
            continue
        if _is_corner(record):
            if record.vertex in vertices:
                yield CornerDecision(
                    record.stamp_s, record.sighting, vertices[record.vertex], False, evidence="recognized place"
                )
        elif not isinstance(record, CornerEvidence | WallDecision | TriangleDecision):
            yield record


def _is_corner(record: Record) -> bool:
    return isinstance(record, CornerDecision)
