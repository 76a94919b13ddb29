"""Whole explorations for tests: run in memory, and judged by shapely."""

from dataclasses import dataclass

import numpy as np
import shapely

from coopslam.estimation.batch import BatchEstimate
from coopslam.estimation.incremental import Incremental
from coopslam.estimation.robust import solve_robust
from coopslam.exploration.explorer import Explorer, ExplorerSettings
from coopslam.exploration.mission import Budget, Mission, run_mission
from coopslam.records import CornerDecision, Record
from sim.noise import PRESETS, Noise
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import World, load_world

ROBOTS = TeamSettings().robots


@dataclass
class Run:
    """What a finished exploration leaves behind."""

    world: World
    team: Team
    mission: Mission
    driver: Incremental
    records: list[Record]

    @property
    def free_map(self):
        return self.mission.explorer.free_map

    def smoothed(self) -> BatchEstimate:
        driver = self.driver
        solution = solve_robust(driver.graph, driver.timeline.refused, driver.values(), ROBOTS)
        return BatchEstimate(driver.timeline, solution.graph, solution.values)

    def corner_of(self) -> dict[int, int]:
        """Map vertex -> true corner. Fails when a vertex was taken for two corners or a corner for two vertices."""
        found: dict[int, int] = {}
        for record in self.records:
            if isinstance(record, CornerDecision):
                corner = self.team.truth.sighted[record.sighting.stamp_s, record.sighting.observer]
                assert found.setdefault(record.vertex, corner) == corner, f"vertex {record.vertex} is two corners"
        assert len(set(found.values())) == len(found), "one corner is two vertices"
        return found


def run(
    world: World | str,
    noise: str = "none",
    seed: int = 0,
    true: Noise | None = None,
    believed: Noise | None = None,
    budget: Budget | None = None,
    team: TeamSettings | None = None,
    settings: ExplorerSettings | None = None,
) -> Run:
    world = load_world(world) if isinstance(world, str) else world
    sensors = Sensors(true or PRESETS[noise][0], believed or PRESETS[noise][1], np.random.default_rng(seed))
    robots = Team(world, sensors, team)
    driver, records = Incremental(ROBOTS), []
    mission = run_mission(robots, driver, Explorer(ROBOTS, settings), records.append, budget)
    return Run(world, robots, mission, driver, records)


def require_complete(finished: Run) -> None:
    """Complete, and its triangles on the true corners are a triangulation of the true polygon; shapely is the judge."""
    mission, world = finished.mission, finished.world
    assert mission.outcome == "complete", f"{world.name}: {mission.outcome}: {mission.reason}"
    corner_of = finished.corner_of()
    assert len(corner_of) == world.n and finished.free_map.holes == world.holes
    assert len(finished.free_map.triangles) == world.n + 2 * world.holes - 2
    corners = world.points[[[corner_of[v] for v in triangle] for triangle in finished.free_map.triangles.values()]]
    signed = _areas(corners)
    assert (signed > -1e-9 * world.polygon.area).all()
    solid = shapely.polygons(corners[signed > 1e-12 * world.polygon.area])
    union = shapely.union_all(solid, grid_size=1e-9)
    assert union.intersection(world.polygon).area >= (1 - 1e-6) * world.polygon.area
    assert shapely.area(solid).sum() - union.area <= 1e-6 * world.polygon.area
    assert shapely.area(shapely.difference(solid, world.polygon)).sum() <= 1e-6 * world.polygon.area


def _areas(corners: np.ndarray) -> np.ndarray:
    """(m,) signed areas of (m, 3, 2) triangles."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
