"""Routes of the team over mapped triangles, against networkx on the same states written out by shapely."""

from itertools import pairwise, permutations

import networkx as nx
import numpy as np
import pytest
import shapely
from random_worlds import random_world
from test_free_map import grown

from coopslam.exploration.free_map import FreeMap
from coopslam.exploration.travel import CLEARANCE_M, CLEARANCE_RAD, Crossing, reachable_gates


def route_to_gate(free_map: FreeMap, at, positions) -> tuple[list[Crossing], tuple[int, int]] | None:
    option = next(reachable_gates(free_map, at, positions), None)
    return None if option is None else (list(option.crossings), option.gate)


def state(u: int, v: int) -> tuple[int, int]:
    return (min(u, v), max(u, v))


def runs_of_triangles(free_map: FreeMap, stander: int) -> list[list[int]]:
    """Around a vertex: the spokes of each stretch of neighbouring triangles."""
    fan = free_map.fans[stander]
    runs = [[fan.spokes[0]]]
    for spoke, sector in zip(fan.spokes[1:], fan.sectors, strict=True):
        runs = [*runs, [spoke]] if sector is None else [*runs[:-1], [*runs[-1], spoke]]
    return [run for run in runs if len(run) > 1]


def is_clear(corner: int, start: int, end: int, points: np.ndarray) -> bool:
    """Whether the straight line through start and end keeps away from a corner."""
    ahead = 1e3 * (points[end] - points[start])
    gap = shapely.distance(
        shapely.LineString([points[start] - ahead, points[end] + ahead]), shapely.Point(points[corner])
    )
    return gap > max(CLEARANCE_M, np.sin(CLEARANCE_RAD) * np.hypot(*(points[corner] - points[start])))


def is_straight_way(run: list[int], stander: int, start: int, end: int, points: np.ndarray) -> bool:
    """Whether a robot comes straight from start to end inside of a run of triangles, clear of all corners beside it."""
    i, j = sorted((run.index(start), run.index(end)))
    way = shapely.LineString(points[[start, end]])
    if j == i + 1:
        foot = shapely.line_locate_point(way, shapely.Point(points[stander]))
        return not 0 < foot < way.length or is_clear(stander, start, end, points)
    if not all(is_clear(corner, start, end, points) for corner in [stander, *run[i + 1 : j]]):
        return False
    triangles = shapely.polygons([points[[stander, u, v]] for u, v in pairwise(run[i : j + 1])])
    return shapely.union_all(triangles).buffer(1e-9).covers(way)


def states(free_map: FreeMap, points: np.ndarray) -> nx.DiGraph:
    """Where the team can stand (an edge, or both at one vertex) and what each crossing costs in metres."""
    graph = nx.DiGraph()
    for stander, fan in free_map.fans.items():
        for other in {spoke for spoke in fan.spokes if spoke is not None}:
            graph.add_edge(
                (stander, stander), state(stander, other), weight=np.hypot(*(points[other] - points[stander]))
            )
            graph.add_edge(
                state(stander, other), (stander, stander), weight=np.hypot(*(points[other] - points[stander]))
            )
        for run in runs_of_triangles(free_map, stander):
            for start, end in permutations(run, 2):
                if is_straight_way(run, stander, start, end, points):
                    metres = np.hypot(*(points[end] - points[start]))
                    graph.add_edge(state(start, stander), state(end, stander), weight=metres)
    return graph


CASES = [("halls", 0), ("halls", 3), ("maze", 4), ("stars", 0), ("stars", 2), ("grid", 3), ("straight", 1)]


@pytest.mark.parametrize(("kind", "seed"), CASES)
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_the_route_is_the_shortest(kind, seed, share):
    world = random_world(kind, seed)
    rng = np.random.default_rng(seed)
    free_map = grown(world, rng, most=int(share * world.triangles_expected))
    graph = states(free_map, world.points)
    gates = {state(*gate) for gate in free_map.gates}
    assert gates
    toward = graph.reverse()
    metres = nx.multi_source_dijkstra_path_length(toward, gates & set(graph))
    assert len(metres) > 3
    for start in sorted(graph)[:: max(len(graph) // 40, 1)]:
        for at in (start, start[::-1]):
            crossings, gate = route_to_gate(free_map, at, lambda v: world.points[v])
            total = sum(np.hypot(*(world.points[c.end] - world.points[c.start])) for c in crossings)
            assert total == pytest.approx(metres[start])
            walk = [start, *(state(c.end, c.stander) for c in crossings)]
            assert [state(c.start, c.stander) for c in crossings] == walk[:-1]
            assert all(graph.has_edge(*step) for step in pairwise(walk))
            assert walk[-1] == state(*gate) and gate in free_map.gates


def test_on_a_gate_there_is_nothing_to_travel():
    free_map = grown(random_world("halls", 0), np.random.default_rng(0), most=5)
    for a, b in free_map.gates:
        assert route_to_gate(free_map, (a, b), None) == route_to_gate(free_map, (b, a), None) == ([], (a, b))


def test_without_a_gate_there_is_no_route():
    world = random_world("halls", 0)
    free_map = grown(world, np.random.default_rng(0))
    assert route_to_gate(free_map, free_map.triangles[0][:2], lambda v: world.points[v]) is None


def test_gates_come_nearest_first_and_each_with_its_own_way():
    world = random_world("halls", 3)
    free_map = grown(world, np.random.default_rng(3), most=world.triangles_expected // 2)
    start = next(iter(free_map.triangles.values()))[:2]
    options = list(reachable_gates(free_map, start, lambda v: world.points[v]))
    assert sorted(option.gate for option in options) == sorted(free_map.gates) and len(options) > 3
    assert [option.metres for option in options] == sorted(option.metres for option in options)
    for option in options:
        stands = set(start)
        for crossing in option.crossings:
            assert {crossing.start, crossing.stander} == stands
            stands = {crossing.end, crossing.stander}
        assert stands == set(option.gate)
        total = sum(np.hypot(*(world.points[c.end] - world.points[c.start])) for c in option.crossings)
        assert option.metres == pytest.approx(total)
        assert option.opened == (-1 if free_map.gates[option.gate] is None else free_map.gates[option.gate])
    assert (route := route_to_gate(free_map, start, lambda v: world.points[v])) and route[1] == options[0].gate


def test_a_fan_of_triangles_is_crossed_in_one_go():
    """Corners 1 to 4 stand in an arc about corner 0, but corner 3 is drawn in: the way from 1 to 4 bends there."""
    places = {0: (0, 0), 1: (4, 0), 2: (3.5, 2), 3: (1, 1.5), 4: (0, 4)}
    free_map = FreeMap()
    for vertex in places:
        free_map.add_vertex(vertex, np.pi / 2)
    free_map.add_first_wall(0, 1)
    for known, new in ((1, 2), (2, 3), (3, 4)):
        free_map.add_triangle((0, known), new, wall_at_end=True, wall_at_start=False)
    crossings, gate = route_to_gate(free_map, (0, 1), lambda v: np.array(places[v], float))
    assert gate == (0, 4) and [(c.start, c.end, c.stander) for c in crossings] == [(1, 3, 0), (3, 4, 0)]
