"""Lower bounds on metres: closed forms, and networkx on the whole metric of shortest paths."""

from itertools import combinations

import networkx as nx
import numpy as np
import pytest
import shapely
from random_worlds import random_world
from shapely import LineString, Polygon, box

from coopslam.evaluation.lower_bound import corners_bound_m, ring_tree_m, spanning_tree_m, walls_bound_m
from sim.world import World, load_world


def by_shortest_paths(world: World) -> float:
    """The minimum spanning tree of the complete graph whose edges are shortest paths over lines of sight."""
    corners, free = world.points, world.polygon.buffer(1e-7)
    sight = nx.Graph()
    for u, v in combinations(range(world.n), 2):
        line = LineString(corners[[u, v]])
        if free.covers(line):
            sight.add_edge(u, v, weight=line.length)
    metric = nx.Graph()
    for u, lengths in nx.all_pairs_dijkstra_path_length(sight):
        metric.add_weighted_edges_from((u, v, metres) for v, metres in lengths.items())
    assert metric.number_of_nodes() == world.n
    return nx.minimum_spanning_tree(metric).size(weight="weight")


@pytest.mark.parametrize("kind", ["halls", "maze", "stars", "grid", "straight"])
def test_it_is_the_spanning_tree_of_all_shortest_paths(kind):
    for seed in range(3):
        world = random_world(kind, seed)
        assert spanning_tree_m(world.polygon) == pytest.approx(by_shortest_paths(world), rel=1e-6)


def test_in_a_regular_polygon_all_walls_but_one():
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    polygon = Polygon(np.column_stack([np.cos(angles), np.sin(angles)]))
    side = 2 * np.sin(np.pi / 7)
    assert spanning_tree_m(polygon) == pytest.approx(6 * side)
    assert walls_bound_m(polygon) == pytest.approx(7 * side)
    assert corners_bound_m(polygon, starts_apart_m=0.3) == pytest.approx(6 * side - 0.3)


def test_walls_stand_in_the_way_of_the_tree():
    """Two corridors of 1 m side by side, joined at one end: their corners are 0.1 m apart through the wall."""
    u = Polygon([(0, 0), (2.1, 0), (2.1, 9), (1.1, 9), (1.1, 1), (1, 1), (1, 9), (0, 9)])
    assert spanning_tree_m(u) == pytest.approx(0.1 + 1 + 1 + np.sqrt(2) + np.sqrt(2) + 8 + 8)


def test_rings_are_joined_by_their_distance():
    """Holes in a row: each is nearer to the next one, or to the outer ring, than to the others."""
    polygon = box(0, 0, 12, 10).difference(shapely.union_all([box(4, 4, 5, 5), box(6, 4, 7, 5), box(8, 4, 9, 5)]))
    assert ring_tree_m(polygon) == pytest.approx(1 + 1 + 3)
    assert walls_bound_m(polygon, 0.5) == pytest.approx(44 + 3 * 4 + 5 - 0.5)


def test_without_holes_there_is_one_ring():
    assert ring_tree_m(box(0, 0, 2, 3)) == 0.0


def test_large_worlds_take_little_time():
    polygon = load_world("office_floor").polygon
    assert 0.3 * polygon.length < spanning_tree_m(polygon) < polygon.length
