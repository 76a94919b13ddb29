"""Paths by what a robot knows at their end: against every way there is, plain geometry, and a simulated patch."""

from itertools import pairwise

import numpy as np
import pytest
import shapely
from made_maps import LAWS, TWO_LANES, made_map

from coopslam.errors import BadInput
from coopslam.planning.belief_paths import pareto, route, safest, shortest, widest
from coopslam.planning.label_search import EPSILON, search
from coopslam.planning.lattice import gates_of, lattice, on_gate
from coopslam.planning.shortest import Unreachable
from coopslam.planning.travel_belief import TravelBelief
from coopslam.planning.traversal import SURE_SIGMAS, Escorted, OnOdometry, WithCorners, start_covariance, travel
from coopslam.planning.walk import walk_along
from coopslam.se2 import largest_sigma

START, GOAL, RADIUS = np.array([2.0, 1.2]), np.array([14.0, 1.2]), 0.2


def slippery(centroid) -> float:
    """The south lane is eight times as slippery."""
    return 8.0 if 3.5 < centroid[0] < 12.5 and centroid[1] < 2.2 else 1.0


@pytest.fixture(scope="module")
def even():
    return made_map(TWO_LANES)


@pytest.fixture(scope="module")
def patchy():
    return made_map(TWO_LANES, slip=slippery)


def coarse(map_graph):
    """Three points on each gate."""
    points_on = {gate: on_gate(map_graph, gate, np.array([0.2, 0.5, 0.8])) for gate in gates_of(map_graph)}
    return lattice(map_graph, START, GOAL, points_on, 0.0)


def every_way(ways, here=0, crossed=(), arcs=()):
    """All ways over the lattice that cross no gate twice, as lists of arcs."""
    if here == 1:
        yield list(arcs)
        return
    for arc in np.flatnonzero(ways.tails == here).tolist():
        there = int(ways.heads[arc])
        if ways.gates[there] not in crossed:
            yield from every_way(ways, there, (*crossed, ways.gates[there]), (*arcs, arc))


def judged(map_graph, ways, arcs, model) -> float:
    """Trace of the position's covariance at the goal, one operation after the other, the map held fixed."""
    home = map_graph.triangle_at(*ways.points[0])
    belief = TravelBelief(map_graph, list(map_graph.vertices), ways.points[0], home, start_covariance(map_graph))
    belief.cov[3:] = belief.cov[:, 3:] = 0.0
    belief.cov[:3, :3] = start_covariance(map_graph)
    for k, arc in enumerate(arcs):
        law = map_graph.odometry_law(int(ways.triangles[arc]))
        if k:
            (ax, ay), (bx, by) = ways.ways[arcs[k - 1]], ways.ways[arc]
            belief.turn(float(np.arctan2(ax * by - ay * bx, ax * bx + ay * by)), law)
        start, end = ways.points[ways.tails[arc]], ways.points[ways.heads[arc]]
        for fix in model.fixes(map_graph, int(ways.triangles[arc]), start, end, int(ways.pivots[arc])):
            belief.drive(start + fix.along * (end - start), law)
            if SURE_SIGMAS * largest_sigma(belief.cov[:2, :2]) > fix.room_m:
                continue
            x, y = fix.at - belief.at
            belief._measure(np.array([[1, 0, -y], [0, 1, x], [0, 0, 1.0]]) @ belief.robot_rows(), fix.cov)
        belief.drive(end, law)
    return float(np.trace(belief.cov[:2, :2]))


@pytest.fixture(scope="module")
def small():
    """A triangle around a triangular obstacle: few enough ways to try them all."""
    outer, hole = [(0, 0), (16, 0), (8, 9)], [(6, 2), (8, 5), (10, 2)]
    map_graph = made_map(shapely.Polygon(outer, [hole]), slip=lambda c: 6.0 if c[1] < 2 else 1.0)
    ways = coarse(map_graph)
    return map_graph, ways, list(every_way(ways))


def test_on_odometry_the_search_finds_the_best_of_all_ways(small):
    map_graph, ways, everyone = small
    assert len(everyone) > 100
    best = min(judged(map_graph, ways, arcs, OnOdometry()) for arcs in everyone)
    found = search(map_graph, ways, OnOdometry(), start_covariance(map_graph))
    assert found[0].value == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("model", [WithCorners(reach_m=1.5), Escorted()], ids=["corners", "escorted"])
def test_with_measurements_it_is_as_good_but_for_what_it_gives_up(small, model):
    """At each of the points passed a label may be dropped for one that is worse by a share EPSILON."""
    map_graph, ways, everyone = small
    longest = 2.0 * np.hypot(*(GOAL - START))
    short = [arcs for arcs in everyone if np.hypot(*ways.ways[arcs].T).sum() <= longest]
    values = [judged(map_graph, ways, arcs, model) for arcs in short]
    found = search(map_graph, ways, model, start_covariance(map_graph), longest)
    passed = max(map(len, short))
    assert min(values) * (1 - 1e-9) <= found[0].value <= min(values) * (1 + EPSILON) ** passed
    assert max(values) > 1.05 * min(values)  # there is something to choose


def test_the_front_of_the_search_holds_the_best_of_all_ways_for_each_length(small):
    map_graph, ways, everyone = small
    labels = search(map_graph, ways, OnOdometry(), start_covariance(map_graph), with_length=True)
    lengths = [float(np.hypot(*ways.ways[arcs].T).sum()) for arcs in everyone]
    values = [judged(map_graph, ways, arcs, OnOdometry()) for arcs in everyone]
    passed = max(map(len, everyone))
    for length, value in zip(lengths, values, strict=True):
        room = (1 + EPSILON) ** passed
        assert any(label.length_m <= room * length and label.value <= room * value for label in labels)
    assert len(labels) >= 2


def test_the_safest_path_goes_around_a_slippery_short_cut(even, patchy):
    direct, around = safest(even, START, GOAL, OnOdometry(), RADIUS), safest(patchy, START, GOAL, OnOdometry(), RADIUS)
    south, north = shapely.box(3.5, 0, 12.5, 2), shapely.box(3.5, 2.4, 12.5, 4)
    assert shapely.LineString(direct.bends).intersects(south) and not shapely.LineString(direct.bends).intersects(north)
    assert shapely.LineString(around.bends).intersects(north) and not shapely.LineString(around.bends).intersects(south)
    through = route(patchy, direct.bends, OnOdometry(), RADIUS)
    assert around.length_m > direct.length_m and around.final_sigma_m < 0.5 * through.final_sigma_m


@pytest.mark.parametrize("model", [OnOdometry(), WithCorners(), Escorted()], ids=["odometry", "corners", "escorted"])
def test_no_other_path_is_safer(patchy, model):
    """Than the safest: the shortest, the widest, all of the front, and twenty that somebody drew."""
    best = safest(patchy, START, GOAL, model, RADIUS)
    front = pareto(patchy, START, GOAL, model, RADIUS)
    others = [shortest(patchy, START, GOAL, model, RADIUS), widest(patchy, START, GOAL, model, RADIUS), *front]
    sigmas, rng = [other.final_sigma_m for other in others], np.random.default_rng(0)
    for _ in range(20):
        lane = rng.uniform(0.3, 1.7) if rng.random() < 0.5 else rng.uniform(2.7, 3.7)
        bends = np.array([START, [3.0, lane], [13.0, lane], GOAL])
        walk = walk_along(patchy, bends, model.stops(patchy, bends))
        cov = travel(patchy, walk, model, start_covariance(patchy)).covariances[-1]
        sigmas.append(float(np.sqrt(np.trace(cov[:2, :2]))))
    # a share EPSILON / 2 is given up for a shorter way; with measurements the map is held fixed where the way is chosen
    room = EPSILON if model == OnOdometry() else 0.05
    assert best.final_sigma_m <= (1 + room) * min(sigmas)
    assert best.clearance_m >= -2e-3  # of chords in rounded corners
    for one, other in pairwise(front):
        assert one.length_m < other.length_m and one.final_sigma_m > other.final_sigma_m
    assert front[0].length_m == pytest.approx(others[0].length_m)
    assert front[-1].final_sigma_m <= (1 + EPSILON) * best.final_sigma_m  # the same candidates and more


def test_the_widest_path_takes_the_wider_door():
    """Two doors in a wall, 1.0 and 1.6 m wide; the wider one is a detour. Clearance: half its width."""
    wall = (
        [(5, 0), (5, 1), (5.2, 1), (5.2, 0)],
        [(5, 2), (5, 5), (5.2, 5), (5.2, 2)],
        [(5, 6.6), (5, 8), (5.2, 8), (5.2, 6.6)],
    )
    room = shapely.box(0, 0, 10, 8).difference(shapely.union_all([shapely.Polygon(part) for part in wall]))
    map_graph = made_map(room)
    ends = np.array([2.0, 1.5]), np.array([8.0, 1.5])
    wide = widest(map_graph, *ends, OnOdometry(), 0.1)
    short = shortest(map_graph, *ends, OnOdometry(), 0.1)
    assert short.length_m == pytest.approx(6.0) and wide.length_m > 9.0
    assert wide.clearance_m == pytest.approx(0.8 - 0.1, abs=2e-3)  # half the door's width, less the robot; 1 mm steps
    in_corner = widest(map_graph, np.array([0.12, 0.12]), ends[1], OnOdometry(), 0.1)
    assert shapely.LineString(in_corner.bends).intersects(shapely.LineString([(5.1, 5), (5.1, 6.6)]))
    touches = [route(map_graph, way.bends, OnOdometry(), 0.35).touching_probability for way in (wide, short)]
    assert touches[0] < 0.5 * touches[1]


def test_a_route_tells_what_lies_along_it(even):
    found = route(even, np.array([START, [8.0, 1.2], GOAL]), OnOdometry(), RADIUS)
    assert found.bends.tolist() == [START.tolist(), GOAL.tolist()]  # the middle one was none
    assert found.length_m == pytest.approx(12.0) and len(found.points) == len(found.covariances)
    assert found.clearance_m == pytest.approx(0.8 - RADIUS)  # to the island
    shapes = [shapely.Polygon(even.corners[t]) for t in found.triangles]
    line = shapely.LineString(found.bends)
    assert sum(line.intersection(shape).length for shape in shapes) == pytest.approx(12.0)
    assert all(edge in even.graph.edges for edge in pairwise(found.triangles))
    q = LAWS.odometry.heading_sigma_per_m**2
    least = 0.03**2 * 12 + q * 12**3 / 3  # of odometry alone; the map and the start add to it
    assert least < found.final_sigma_m**2 < 1.2 * least


def test_start_and_goal_may_be_the_same(even):
    for kind in (shortest, safest, widest):
        found = kind(even, START, START, OnOdometry(), RADIUS)
        assert found.length_m == 0.0 and len(found.points) == 1
        np.testing.assert_allclose(found.covariances[0], start_covariance(even), atol=1e-12)
        beside = kind(even, START, START + [0.0, 1e-9], OnOdometry(), RADIUS)
        assert beside.length_m < 1e-8 and beside.final_sigma_m == pytest.approx(found.final_sigma_m)
    assert len(pareto(even, START, START, OnOdometry(), RADIUS)) == 1


@pytest.mark.parametrize("kind", [shortest, safest, widest, pareto])
def test_places_where_no_robot_can_be(even, kind):
    with pytest.raises(BadInput, match="start"):
        kind(even, np.array([-1.0, 1.0]), GOAL, OnOdometry(), RADIUS)
    with pytest.raises(BadInput, match="goal"):
        kind(even, START, np.array([8.0, 2.2]), OnOdometry(), RADIUS)  # in the island
    with pytest.raises(BadInput, match="finite"):
        kind(even, np.array([np.nan, 1.0]), GOAL, OnOdometry(), RADIUS)
    with pytest.raises(BadInput, match="robot_radius_m"):
        kind(even, START, GOAL, OnOdometry(), -1.0)
    with pytest.raises(Unreachable):
        kind(even, np.array([1.7, 1.7]), np.array([14.3, 1.7]), OnOdometry(), 1.2)  # lanes are 2 m and 1.6 m wide
