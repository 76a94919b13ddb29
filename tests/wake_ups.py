"""A simulated team that wakes up in a world of which a map is stored, for tests."""

from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from explorations import ROBOTS, Run

from coopslam.estimation.incremental import Incremental
from coopslam.exploration.explorer import Explorer
from coopslam.exploration.mission import run_mission
from coopslam.planning.corner_map import CornerMap, corner_map
from coopslam.planning.place_recognition import PlaceRecognition, Recognition, Verdict
from coopslam.records import CornerDecision
from sim.noise import TYPICAL
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import World

ANGLE_SIGMA_RAD = TYPICAL.finder.interior_angle_sigma_rad


class Enough(Exception):
    """Ends an exploration."""


@dataclass
class WakeUp:
    """The answers after each triangle, and what was true."""

    team: Team
    answers: list[Recognition] = field(default_factory=list)
    maps: list[CornerMap] = field(default_factory=list)
    corner_of: dict[int, int] = field(default_factory=dict)

    def is_right(self, old: Run) -> bool:
        """Whether the last answer pairs the same true corners."""
        known = old.corner_of()
        return all(known[j] == self.corner_of[i] for i, j in self.answers[-1].pairs)


def stored_map(old: Run) -> CornerMap:
    """What a run leaves behind."""
    return corner_map(old.free_map, old.smoothed(), ANGLE_SIGMA_RAD)


def wake_up(world: World, corner: int, seed: int, stored: CornerMap) -> WakeUp:
    """Explore from a corner until the place is recognized, or to the end."""
    ring, index = world.ring_index(corner)
    team = Team(
        world,
        Sensors(TYPICAL, TYPICAL, np.random.default_rng(seed)),
        TeamSettings(start_ring=ring, start_corner=index),
    )
    explorer, driver, records = Explorer(ROBOTS), Incremental(ROBOTS), []
    found, recognition = WakeUp(team), PlaceRecognition(stored)

    def ask():
        found.maps.append(corner_map(explorer.free_map, driver.update(()), ANGLE_SIGMA_RAD, ROBOTS[0]))
        found.answers.append(recognition.recognize(found.maps[-1]))
        if found.answers[-1].verdict is Verdict.RECOGNIZED:
            raise Enough

    def watch(progress):
        if progress.triangles > len(found.answers):
            ask()

    with suppress(Enough):
        run_mission(team, driver, explorer, records.append, None, watch)
        ask()  # the last walls are decided after the last step
    for record in records:
        if isinstance(record, CornerDecision):
            sighted = team.truth.sighted[record.sighting.stamp_s, record.sighting.observer]
            assert found.corner_of.setdefault(record.vertex, sighted) == sighted
    return found
