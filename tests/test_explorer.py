"""Whole explorations: complete, without overlap, true; judged by shapely on the true corners."""

import gc
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, ModuleType

import numpy as np
import pytest
import shapely
from explorations import require_complete, run
from random_worlds import KINDS, random_world

from coopslam.exploration.moves import DriveAway, FollowWall, GoToCorner, ReturnAlongContact
from coopslam.records import CornerDecision, Decision, Measurement, MoveNote, Odometry, TriangleDecision, WallDecision
from sim.team import TeamSettings
from sim.world import World, load_world, world_names

SHARED_WORLDS = Path(__file__).parents[2] / "shared" / "data" / "worlds"
QUICK = 100  # corners; larger shared worlds are slow


def shared_worlds():
    if not SHARED_WORLDS.is_dir():
        return [pytest.param(None, marks=pytest.mark.skip(reason=f"{SHARED_WORLDS} is not here"))]
    marks = {
        path: [pytest.mark.slow] if load_world(path).n > QUICK else []
        for path in sorted(SHARED_WORLDS.glob("*.geojson"))
    }
    return [pytest.param(path, id=path.stem, marks=mark) for path, mark in marks.items()]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "office_floor" else []) for name in world_names()]
)
def test_the_repositorys_worlds(name):
    require_complete(run(name))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_random_worlds(kind, seed):
    require_complete(run(random_world(kind, seed)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(100, 130))
def test_larger_random_worlds(kind, seed):
    require_complete(run(random_world(kind, seed, (20, 120))))


@pytest.mark.parametrize("path", shared_worlds())
def test_shared_worlds(path):
    require_complete(run(load_world(path)))


@pytest.mark.parametrize("name", ["paper_one_obstacle", "rooms_with_doors"])
@pytest.mark.parametrize("seed", range(3))
def test_with_the_papers_noise(name, seed):
    finished = run(name, "typical", seed)
    require_complete(finished)
    smoothed, corner_of = finished.smoothed(), finished.corner_of()
    origin = finished.team.truth.origin
    for vertex, corner in corner_of.items():  # a vertex is where its corner is, within its own uncertainty
        belief, really = smoothed.vertex_belief(vertex), origin.transformTo(finished.world.points[corner])
        error = belief.T_world_body.translation() - really
        assert error @ np.linalg.solve(belief.position_covariance, error) < 35.0  # chi-square, 2 dof: 2.5e-8
        assert np.hypot(*error) < 0.5


@pytest.mark.parametrize("corner", range(3))
@pytest.mark.parametrize("ring", range(2))
def test_wherever_they_start(ring, corner):
    require_complete(run("paper_one_obstacle", team=TeamSettings(start_ring=ring, start_corner=corner)))


def test_the_smallest_world_is_one_triangle():
    triangle = World("triangle", (np.array([[0.0, 0.0], [3.0, 0.0], [1.0, 2.0]]),))
    finished = run(triangle)
    require_complete(finished)
    assert len(finished.free_map.triangles) == 1


def decisions(finished):
    """What was decided, without the numbers that noise reaches."""
    told = []
    for record in finished.records:
        match record:
            case CornerDecision():
                told.append(("corner", record.vertex, record.is_new))
            case WallDecision():
                told.append(("wall", record.start, record.end))
            case TriangleDecision():
                told.append(("triangle", record.vertices))
            case MoveNote():
                told.append((record.stamp_s, record.move, record.ended))
    return told


def test_the_seed_decides_everything():
    one, same, other = (run("paper_one_obstacle", "typical", seed) for seed in (5, 5, 6))
    assert decisions(one) == decisions(same)
    assert odometry(one) == odometry(same)
    assert not set(odometry(one)) & set(odometry(other))


def odometry(finished):
    return [
        record.T_start_now.x() + record.T_start_now.theta()
        for record in finished.records
        if isinstance(record, Odometry)
    ]


def test_noise_that_is_nearly_nothing_changes_no_decision():
    """Exact sensors twice, with different draws of nothing."""
    one, other = run("rooms_with_doors", seed=1), run("rooms_with_doors", seed=2)
    strip = [
        [told for told in decisions(finished) if told[0] in ("corner", "wall", "triangle")] for finished in (one, other)
    ]
    assert strip[0] == strip[1] and len(strip[0]) > 100


def test_moves_are_in_the_robots_own_terms():
    """Turning and shifting the world changes neither moves nor decisions: nothing of the world's frame is in them."""
    world = load_world("paper_one_obstacle")
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    moved = World("moved", tuple(ring @ turn.T + [1000.0, -500.0] for ring in world.rings))
    one, other = run(world, "typical", 3), run(moved, "typical", 3)
    plain = [
        [told if len(told) < 3 or told[0] in ("corner", "wall") else told[2] for told in decisions(f)]
        for f in (one, other)
    ]
    assert plain[0] == plain[1]
    assert one.records[-1].stamp_s == pytest.approx(other.records[-1].stamp_s, abs=1e-4)


def reachable(start, most=2_000_000):
    """Objects that can be reached from one, not through classes, functions and modules."""
    seen, queue = {id(start)}, [start]
    while queue and len(seen) < most:
        current = queue.pop()
        yield current
        for found in gc.get_referents(current):
            if id(found) not in seen and not isinstance(found, type | ModuleType | FunctionType | BuiltinFunctionType):
                seen.add(id(found))
                queue.append(found)


def from_sim(objects) -> set[str]:
    return {type(found).__qualname__ for found in objects if type(found).__module__.split(".")[0] == "sim"}


def test_the_explorer_holds_nothing_of_the_simulator():
    finished = run("paper_one_obstacle", "typical")
    explorer = finished.mission.explorer
    objects = list(reachable(explorer))
    assert {id(finished.mission.estimate), id(explorer.free_map)} <= {id(found) for found in objects}
    assert from_sim(objects) == set()
    assert {"World", "Team", "Truth", "Sight"} <= from_sim(reachable(finished.team))  # the walk would find them


def test_the_explorer_says_moves_and_decisions_and_nothing_else():
    finished = run("paper_one_obstacle")
    kinds = {record.move.split("(")[0] for record in finished.records if isinstance(record, MoveNote)}
    assert kinds <= {kind.__name__ for kind in (DriveAway, FollowWall, GoToCorner, ReturnAlongContact)}
    decided = [record for record in finished.records if isinstance(record, Decision)]
    moved = [record for record in finished.records if isinstance(record, MoveNote)]
    sensed = [record for record in finished.records if isinstance(record, Measurement)]
    assert len(decided) + len(moved) + len(sensed) == len(finished.records) and decided and sensed


def test_every_diagonal_of_the_map_is_free_in_truth():
    """Gates were open lines of contact: no diagonal crosses a wall."""
    finished = run("pillars")
    corner_of, world = finished.corner_of(), finished.world
    polygon = world.polygon.buffer(1e-7, join_style="mitre")
    for _, _, edge in finished.free_map.adjacent_triangles():
        assert polygon.covers(shapely.LineString(world.points[[corner_of[v] for v in edge]]))
