"""The map as decisions: hand-built maps, conflicts, and shapely's own triangulations fed triangle by triangle."""

from math import pi

import numpy as np
import pytest
import shapely
from random_worlds import KINDS, random_world

from coopslam.exploration.free_map import Boundary, FreeMap, MapConflict
from sim.world import World, load_world

RIGHT, REFLEX = pi / 2, 1.5 * pi


def map_with(angles: list[float], first_wall: tuple[int, int] = (0, 1)) -> FreeMap:
    free_map = FreeMap()
    for vertex, angle in enumerate(angles):
        free_map.add_vertex(vertex, angle)
    free_map.add_first_wall(*first_wall)
    return free_map


def square() -> FreeMap:
    """Corners 0 to 3, counter-clockwise; nothing but the wall 0 - 1 is known."""
    return map_with([RIGHT] * 4)


# a square with a square hole: corners (0, 0) (4, 0) (4, 4) (0, 4) are 0 to 3, (1, 1) (1, 3) (3, 3) (3, 1) are 4 to 7
AROUND_A_HOLE = [  # gate, apex, wall at its end, wall at its start
    ((0, 1), 7, False, False),
    ((0, 7), 4, True, False),
    ((7, 1), 2, True, False),
    ((7, 2), 6, False, True),
    ((6, 2), 3, True, False),
    ((6, 3), 5, False, True),
    ((5, 3), 0, True, False),
    ((5, 0), 4, False, True),  # closes gate (0, 4) from its other side
]


def complete(free_map: FreeMap) -> bool:
    return not free_map.gates and all(fan.complete for fan in free_map.fans.values())


def test_a_square_is_two_triangles():
    free_map = square()
    assert free_map.gates == {(0, 1): None} and free_map.walls() == [(0, 1)] and not complete(free_map)
    assert free_map.add_triangle((0, 1), 2, wall_at_end=True, wall_at_start=False) == 0
    assert free_map.gates == {(0, 2): 0}
    assert free_map.boundary_at_end((0, 2)) == Boundary(True, None)
    assert free_map.boundary_at_start((0, 2)) == Boundary(True, None)
    assert free_map.add_triangle((0, 2), 3, wall_at_end=True, wall_at_start=True) == 1
    assert complete(free_map) and free_map.holes == 0
    assert free_map.triangles == {0: (0, 1, 2), 1: (0, 2, 3)}
    assert sorted(free_map.walls()) == [(0, 1), (1, 2), (2, 3), (3, 0)]
    assert free_map.rings() == [[0, 1, 2, 3]] and free_map.turning([0, 1, 2, 3]) == pytest.approx(2 * pi)
    assert free_map.triangles_at(2, 0) == free_map.triangles_at(0, 2) == [0, 1] and free_map.triangles_at(1, 3) == []
    assert free_map.adjacent_triangles() == [(0, 1, (0, 2))]


def test_a_square_with_a_hole_is_eight_triangles():
    free_map = map_with([RIGHT] * 4 + [REFLEX] * 4)
    for number, (gate, apex, at_end, at_start) in enumerate(AROUND_A_HOLE):
        assert gate in free_map.gates and not complete(free_map) and free_map.holes == 0
        assert free_map.add_triangle(gate, apex, at_end, at_start) == number
    assert complete(free_map) and free_map.holes == 1
    assert sorted(map(sorted, free_map.rings())) == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert free_map.wall_leaving(7) == 4 and free_map.wall_arriving(4) == 7  # the hole runs clockwise
    assert len(free_map.adjacent_triangles()) == 8  # all around
    # the corner (0, 0) sees, counter-clockwise: its wall, 7, 4, 5 and the wall to 3
    assert free_map.fans[0].spokes == [1, 7, 4, 5, 3] and free_map.fans[0].sectors == [0, 1, 7, 6]


def test_what_bounds_the_unexplored_next_to_a_gate():
    free_map = map_with([RIGHT] * 4 + [REFLEX] * 4)
    for gate, apex, at_end, at_start in AROUND_A_HOLE[:2]:
        free_map.add_triangle(gate, apex, at_end, at_start)
    assert free_map.gates == {(7, 1): 0, (0, 4): 1}
    assert free_map.boundary_at_end((7, 1)) == Boundary(True, None)  # the wall that leaves 1, not yet walked
    assert free_map.boundary_at_start((7, 1)) == Boundary(True, None)  # the wall that arrives at 7
    assert free_map.boundary_at_end((0, 4)) == Boundary(True, None)
    assert free_map.boundary_at_start((0, 4)) == Boundary(True, None)
    (sector,) = free_map.unexplored_sectors(0)
    assert (sector.index, sector.clockwise, sector.counter_clockwise) == (2, Boundary(False, 4), Boundary(True, None))
    for gate, apex, at_end, at_start in AROUND_A_HOLE[2:7]:
        free_map.add_triangle(gate, apex, at_end, at_start)
    assert free_map.boundary_at_end((5, 0)) == Boundary(False, 4)  # the other open gate
    assert free_map.boundary_at_end((0, 4)) == Boundary(True, None)
    assert free_map.boundary_at_start((0, 4)) == Boundary(False, 5)


def test_two_sectors_at_one_corner():
    """A triangle that only touches corner 2: what is left and right of it is unexplored; the caller says which."""
    free_map = map_with([RIGHT, RIGHT, pi, RIGHT, RIGHT])
    free_map.add_triangle((0, 1), 2, False, False)
    left, right = free_map.unexplored_sectors(2)
    assert (left.clockwise, left.counter_clockwise) == (Boundary(True, None), Boundary(False, 0))
    assert (right.clockwise, right.counter_clockwise) == (Boundary(False, 1), Boundary(True, None))
    free_map.add_triangle((2, 1), 3, True, True)  # walls 1 - 3 and 3 - 2
    free_map.add_triangle((0, 2), 4, True, True)
    assert complete(free_map) and free_map.rings() == [[0, 1, 3, 2, 4]]


def test_a_gate_that_is_a_wall():
    free_map = map_with([pi / 3] * 3)
    free_map.add_triangle((0, 1), 2, wall_at_end=True, wall_at_start=False)
    assert free_map.gates == {(0, 2): 0} and not complete(free_map)
    assert free_map.close_as_wall((0, 2)) == (2, 0)
    assert complete(free_map) and sorted(free_map.walls()) == [(0, 1), (1, 2), (2, 0)]
    assert free_map.rings() == [[0, 1, 2]] and len(free_map.triangles) == 1


def test_a_gate_with_other_edges_beside_it_is_no_wall():
    free_map = map_with([RIGHT] * 4 + [REFLEX] * 4)
    for gate, apex, at_end, at_start in AROUND_A_HOLE[:7]:
        free_map.add_triangle(gate, apex, at_end, at_start)
    for gate in ((5, 0), (0, 4)):
        with pytest.raises(MapConflict, match="cannot be a wall"):
            free_map.close_as_wall(gate)


@pytest.mark.parametrize(
    ("gate", "apex", "at_end", "at_start", "words"),
    [
        ((0, 2), 1, False, False, "vertex 1|triangle 0"),  # back into what is mapped
        ((2, 3), 0, False, False, "vertex 3"),  # there is no such gate
        ((0, 2), 1, False, True, "a wall from vertex 1 to 0"),  # the wall runs the other way
    ],
)
def test_contradictions_are_refused(gate, apex, at_end, at_start, words):
    free_map = square()
    free_map.add_triangle((0, 1), 2, wall_at_end=True, wall_at_start=False)
    with pytest.raises(MapConflict, match=words):
        free_map.add_triangle(gate, apex, at_end, at_start)
    assert list(free_map.triangles) == [0] and list(free_map.gates) == [(0, 2)]


def test_a_finished_corner_takes_no_more_triangles():
    free_map = square()
    free_map.add_triangle((0, 1), 2, True, False)
    free_map.add_vertex(4, RIGHT)
    free_map.add_triangle((0, 2), 3, True, False)  # leaves gate (0, 3)
    assert free_map.fans[1].complete
    with pytest.raises(MapConflict, match="vertex 1 has no unexplored space|would lie on"):
        free_map.add_triangle((0, 3), 1, False, False)


# shapely's triangulations


def true_triangles(world: World) -> list[tuple[int, int, int]]:
    index = {tuple(point): i for i, point in enumerate(world.points)}
    triangles = shapely.constrained_delaunay_triangles(world.polygon).geoms
    return [tuple(index[corner] for corner in shapely.orient_polygons(t).exterior.coords[:3]) for t in triangles]


def true_sector(free_map: FreeMap, world: World, apex: int, a: int, b: int) -> int:
    """The unexplored sector of a known corner that holds the directions of a and b, by the true angles."""
    p, leaving = world.points, world.points[world.next_index[apex]] - world.points[apex]

    def angle(other):
        way = p[other] - p[apex]
        turned = np.arctan2(leaving[0] * way[1] - leaving[1] * way[0], leaving @ way) % (2 * pi)
        return 0.0 if turned > 2 * pi - 1e-9 else turned

    for sector in free_map.unexplored_sectors(apex):
        low = 0.0 if sector.clockwise.is_wall else angle(sector.clockwise.other)
        high = world.interior_angle(apex) if sector.counter_clockwise.is_wall else angle(sector.counter_clockwise.other)
        if low - 1e-9 <= angle(a) and angle(b) <= high + 1e-9:
            return sector.index
    raise AssertionError(f"triangle ({a}, {b}, {apex}) fits nowhere at {apex}")


def grown(world: World, rng: np.random.Generator, most: int | None = None) -> FreeMap:
    """A map fed with shapely's triangles, each behind a gate that is open then, in random order."""
    behind = {}
    for triangle in true_triangles(world):
        for k in range(3):
            a, b, c = triangle[k:] + triangle[:k]
            behind[a, b] = c
    free_map = FreeMap()
    for vertex in (0, int(world.next_index[0])):
        free_map.add_vertex(vertex, world.interior_angle(vertex))
    free_map.add_first_wall(0, int(world.next_index[0]))
    while free_map.gates and (most is None or len(free_map.triangles) < most):
        gates = sorted(free_map.gates)
        a, b = gates[rng.integers(len(gates))]
        c = behind[a, b]
        known = c in free_map.fans
        if not known:
            free_map.add_vertex(c, world.interior_angle(c))
        sector = true_sector(free_map, world, c, a, b) if known else None
        free_map.add_triangle((a, b), c, world.next_index[b] == c, world.next_index[c] == a, sector)
    return free_map


WORLDS = ["cave", "pillars", "rooms_with_doors", "spiral", *(f"{kind} {seed}" for kind in KINDS for seed in range(6))]


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("order", range(3))
def test_any_order_of_triangles_closes_the_map(name, order):
    kind, _, seed = name.partition(" ")
    world = random_world(kind, int(seed)) if seed else load_world(name)
    free_map = grown(world, np.random.default_rng(order))
    assert complete(free_map)
    expected = {frozenset(triangle) for triangle in true_triangles(world)}
    assert {frozenset(triangle) for triangle in free_map.triangles.values()} == expected
    assert len(free_map.triangles) == len(expected) == world.n + 2 * world.holes - 2
    assert free_map.holes == world.holes and len(free_map.rings()) == len(world.rings)
    assert sorted(free_map.walls()) == sorted(enumerate(world.next_index))
    diagonals = {frozenset(edge) for _, _, edge in free_map.adjacent_triangles()}
    walls = {frozenset(wall) for wall in free_map.walls()}
    assert len(diagonals) == len(free_map.adjacent_triangles()) == (3 * len(expected) - world.n) // 2
    assert not diagonals & walls
    for vertex, fan in free_map.fans.items():  # counter-clockwise, from wall to wall
        ways = world.points[fan.spokes] - world.points[vertex]
        turns = np.diff(np.unwrap(np.arctan2(ways[:, 1], ways[:, 0]) % (2 * pi)))
        assert (turns % (2 * pi)).sum() == pytest.approx(world.interior_angle(vertex))


@pytest.mark.parametrize("name", ["pillars", "halls 0", "maze 4"])
def test_a_map_that_is_not_finished_owns_up_to_its_gates(name):
    """Half fed: gates are exactly the edges with a triangle on one side that are not walls."""
    kind, _, seed = name.partition(" ")
    world = random_world(kind, int(seed)) if seed else load_world(name)
    free_map = grown(world, np.random.default_rng(0), most=world.triangles_expected // 2)
    edges = [(t[k], t[(k + 1) % 3]) for t in free_map.triangles.values() for k in range(3)]
    lonely = {(b, a) for a, b in edges if (b, a) not in edges} - {(b, a) for a, b in enumerate(world.next_index)}
    assert set(free_map.gates) == lonely
    assert not complete(free_map)
    for a, b in free_map.gates:
        assert free_map.unexplored_sectors(a) and free_map.unexplored_sectors(b)
