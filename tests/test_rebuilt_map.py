"""A map from its log: every fan, spoke and gate as the explorer had them."""

from dataclasses import replace

import pytest
from explorations import run

from coopslam.errors import BadRecord
from coopslam.exploration.mission import Budget
from coopslam.exploration.rebuilt_map import rebuilt_map
from coopslam.records import CornerDecision, TriangleDecision


@pytest.mark.parametrize("moves", [1, 4, 11, 30, 1000])
@pytest.mark.parametrize("world", ["paper_one_obstacle", "comb", "rooms_with_doors"])
def test_it_is_the_explorers_map(world, moves):
    """Whenever the exploration ends; among the vertices of rooms_with_doors some have two unexplored sectors."""
    explored = run(world, "typical", seed=20, budget=Budget(moves=moves))
    assert rebuilt_map(explored.records, explored.smoothed()) == explored.free_map


def test_decisions_that_contradict_each_other_are_refused():
    explored = run("paper_one_obstacle", "typical", seed=21)
    records, estimate = explored.records, explored.smoothed()
    triangles = [k for k, record in enumerate(records) if isinstance(record, TriangleDecision)]
    twice = [*records, records[triangles[3]]]
    with pytest.raises(BadRecord, match="make no map"):
        rebuilt_map(twice, estimate)
    skipped = [record for k, record in enumerate(records) if k != triangles[3]]
    with pytest.raises(BadRecord, match="make no map"):
        rebuilt_map(skipped, estimate)
    unknown = [replace(r, is_new=False) if isinstance(r, CornerDecision) and r.vertex == 4 else r for r in records]
    with pytest.raises(BadRecord, match="make no map"):
        rebuilt_map(unknown, estimate)
