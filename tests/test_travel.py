"""Routes of the team over mapped triangles, against networkx on the same states written out."""

from itertools import pairwise

import networkx as nx
import numpy as np
import pytest
from random_worlds import random_world
from test_free_map import grown

from coopslam.exploration.free_map import FreeMap
from coopslam.exploration.travel import route_to_gate


def state(u: int, v: int) -> tuple[int, int]:
    return (min(u, v), max(u, v))


def states(free_map: FreeMap, points: np.ndarray) -> nx.DiGraph:
    """Where the team can stand (an edge, or both at one vertex) and what each crossing costs in metres."""
    graph = nx.DiGraph()

    def cross(start, end, stander):
        graph.add_edge(state(start, stander), state(end, stander), weight=np.hypot(*(points[end] - points[start])))

    for a, b, c in free_map.triangles.values():
        for u, v, w in ((a, b, c), (b, c, a), (c, a, b)):
            cross(u, w, v)
            cross(v, w, u)
            for one, other in ((u, v), (v, u)):
                cross(one, other, one)  # from both at one vertex to an edge at it
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
