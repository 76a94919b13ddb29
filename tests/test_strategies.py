"""Strategies: choices on maps made by hand, and whole explorations by each of them."""

from dataclasses import dataclass, field
from itertools import combinations

import networkx as nx
import numpy as np
import pytest
from explorations import require_complete, run
from random_worlds import random_world
from test_free_map import AROUND_A_HOLE, grown
from test_travel import state, states

from coopslam.evaluation.lower_bound import corners_bound_m, walls_bound_m
from coopslam.exploration.explorer import ExplorerSettings
from coopslam.exploration.free_map import FreeMap
from coopslam.exploration.strategies import STRATEGIES, DepthFirst, LeastUncertain, LoopClosing, Nearest, Regret
from coopslam.exploration.travel import GateOption, reachable_gates
from sim.team import TeamSettings
from sim.world import World, load_world


@dataclass
class Belief:
    position_sigma_m: float


@dataclass
class Map:
    """What strategies ask of a chart and its estimate, written down by hand."""

    places: dict[int, tuple[float, float]]
    free_map: FreeMap = field(default_factory=FreeMap)
    sigmas_m: dict[int, float] = field(default_factory=dict)

    @property
    def estimate(self):
        return self

    def position(self, vertex: int) -> np.ndarray:
        return np.array(self.places[vertex], float)

    def vertex_belief(self, vertex: int) -> Belief:
        return Belief(self.sigmas_m[vertex])

    def options(self, at: tuple[int, int]) -> list[GateOption]:
        return list(reachable_gates(self.free_map, at, self.position))


def option(gate: tuple[int, int], metres: float, opened: int = 0) -> GateOption:
    return GateOption(gate, (), metres, opened)


NOWHERE = Map({})


@pytest.mark.parametrize("strategy", STRATEGIES.values())
def test_without_gates_there_is_no_choice(strategy):
    assert strategy().choose(iter([]), NOWHERE) is None


@pytest.mark.parametrize("strategy", [Nearest, Regret])
def test_no_gate_is_asked_for_in_vain(strategy):
    """The team stands on the first gate: nothing beyond it is searched."""

    def options():
        yield option((0, 1), 0.0)
        raise AssertionError("searched on")

    assert strategy().choose(options(), NOWHERE).gate == (0, 1)


def test_depth_first_takes_the_gate_opened_last_and_of_two_the_nearer():
    waiting = [option((0, 1), 0.0, -1), option((2, 3), 1.0, 4), option((3, 4), 2.0, 7), option((4, 5), 3.0, 7)]
    assert DepthFirst().choose(iter(waiting), NOWHERE).gate == (3, 4)


def test_least_uncertain_goes_by_the_worse_end():
    known = Map({}, sigmas_m={0: 0.1, 1: 0.5, 2: 0.3, 3: 0.2, 4: 0.3})
    waiting = [option((0, 1), 0.0), option((2, 3), 4.0), option((4, 3), 5.0)]
    assert LeastUncertain().choose(iter(waiting), known).gate == (2, 3)


def around_a_hole() -> Map:
    """A square of 4 m with a hole, mapped three quarters around it: gates (6, 3) and (0, 4) face each other."""
    corners = [(0, 0), (4, 0), (4, 4), (0, 4), (1, 1), (1, 3), (3, 3), (3, 1)]
    chart = Map(dict(enumerate(corners)))
    for vertex in chart.places:
        chart.free_map.add_vertex(vertex, np.pi / 2 if vertex < 4 else 1.5 * np.pi)
    chart.free_map.add_first_wall(0, 1)
    for step in AROUND_A_HOLE[:5]:
        chart.free_map.add_triangle(*step)
    return chart


def test_the_loop_is_closed_before_a_nearer_gate_is_explored():
    """Gate (2, 1) is nearer but faces away from the others; around the hole it is more than three times the gap."""
    chart = around_a_hole()
    assert sorted(chart.free_map.gates) == [(0, 4), (6, 3)]
    waiting = [option((2, 1), 0.5), option((6, 3), 1.0), option((0, 4), 5.0)]
    assert LoopClosing().choose(iter(waiting), chart).gate == (6, 3)
    assert LoopClosing(detour=20.0).choose(iter(waiting), chart).gate == (2, 1)
    assert LoopClosing().choose(iter(waiting[:2]), chart).gate == (2, 1)


@pytest.mark.parametrize(("kind", "seed"), [("halls", 3), ("stars", 2), ("grid", 3)])
def test_regret_weighs_metres_against_loneliness(kind, seed):
    """By the definition, with all distances from networkx; the strategy stops searching early."""
    world = random_world(kind, seed)
    free_map = grown(world, np.random.default_rng(seed), most=world.triangles_expected // 2)
    chart = Map(dict(enumerate(world.points)), free_map)
    graph, gates = states(free_map, world.points), [state(*gate) for gate in free_map.gates]
    lonely_m = {}
    for gate in gates:
        metres = nx.single_source_dijkstra_path_length(graph, gate)
        lonely_m[gate] = min(metres[other] for other in gates if other != gate)
    other_than_nearest = 0
    for at in sorted({state(*edge) for triangle in free_map.triangles.values() for edge in combinations(triangle, 2)}):
        metres = nx.single_source_dijkstra_path_length(graph, at)
        chosen = Regret(0.8).choose(reachable_gates(free_map, at, chart.position), chart)
        cost = {gate: metres[gate] - 0.8 * lonely_m[gate] for gate in gates}
        nearest = min(gates, key=metres.get)
        if metres[nearest] > 0:
            assert cost[state(*chosen.gate)] == pytest.approx(min(cost.values()))
            other_than_nearest += metres[state(*chosen.gate)] > metres[nearest] + 1e-6
    assert other_than_nearest > 0


SHOWN = [("halls", 2), ("comb", None), ("paper_one_obstacle", None)]


def world_of(kind: str, seed: int | None) -> World:
    return load_world(kind) if seed is None else random_world(kind, seed)


@pytest.mark.parametrize("name", STRATEGIES)
@pytest.mark.parametrize(("kind", "seed"), SHOWN)
def test_every_strategy_explores_completely_and_no_bound_is_beaten(name, kind, seed):
    world = world_of(kind, seed)
    finished = run(world, settings=ExplorerSettings(strategy=name))
    require_complete(finished)
    metres = sum(finished.mission.travel_m.values())
    step_m = TeamSettings().start_step_m
    assert metres >= corners_bound_m(world.polygon, step_m)
    assert metres >= walls_bound_m(world.polygon, step_m) - 1e-3  # the sensors of "none" have millimetres of noise


@pytest.mark.parametrize("name", STRATEGIES)
def test_the_same_twice(name):
    world = load_world("paper_one_obstacle")
    one, other = (run(world, "typical", 3, settings=ExplorerSettings(strategy=name)) for _ in range(2))
    assert list(one.free_map.triangles.values()) == list(other.free_map.triangles.values())
    assert one.mission.travel_m == other.mission.travel_m
