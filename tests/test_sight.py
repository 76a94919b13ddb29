"""Lines of sight; shapely says what is free: a polygon drawn out by a tolerance covers a segment or does not."""

import numpy as np
import pytest
import shapely
from random_worlds import KINDS, random_world

from sim.sight import Sight
from sim.world import World, load_world

DRAWN_OUT_M = 1e-7  # far more than the tolerance of `sim.sight`, far less than any wall
WORLDS = ["paper_one_obstacle", "rooms_with_doors", "cave", "pillars", "spiral", *(f"{kind} 11" for kind in KINDS)]


def get(name: str) -> World:
    kind, _, seed = name.partition(" ")
    return random_world(kind, int(seed)) if seed else load_world(name)


def drawn_out(world: World) -> shapely.Polygon:
    polygon = world.polygon.buffer(DRAWN_OUT_M, join_style="mitre")
    shapely.prepare(polygon)
    return polygon


def inside(world: World, rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 2) points of free space, none closer to a wall than a centimetre."""
    low, high = world.points.min(axis=0), world.points.max(axis=0)
    inner = world.polygon.buffer(-0.01)
    shapely.prepare(inner)
    points = rng.uniform(low, high, (40 * count, 2))
    return points[shapely.contains_xy(inner, *points.T)][:count]


def visible(polygon, watcher, places) -> np.ndarray:
    """(N,) whether the segments watcher - place are free."""
    lines = np.stack([np.broadcast_to(watcher, np.shape(places)), places], axis=1)
    return shapely.covers(polygon, shapely.linestrings(lines))


def world_of(outer, *holes) -> World:
    return World("hand-made", tuple(np.array(ring, float) for ring in (outer, *holes)))


# an L: the corner at (2, 1) is reflex
L = [(0, 0), (4, 0), (4, 1), (2, 1), (2, 4), (0, 4)]
HALL = [(0, 0), (10, 0), (10, 6), (0, 6)]
PILLAR = [(4, 2), (4, 4), (6, 4), (6, 2)]  # clockwise


@pytest.mark.parametrize("name", WORLDS)
def test_who_sees_whom(name):
    world = get(name)
    sight, free, rng = Sight(world), drawn_out(world), np.random.default_rng(1)
    points = inside(world, rng, 60)
    corners = world.points[rng.permutation(world.n)[:25]]
    pairs = [(a, b) for a, b in zip(points[:30], points[30:], strict=False)]
    pairs += [(a, b) for a in corners for b in points[:20]] + [(a, b) for a in corners for b in corners if a is not b]
    ours = [sight.sees(a, b) for a, b in pairs]
    theirs = [bool(visible(free, a, b[None])[0]) for a, b in pairs]
    assert ours == theirs
    assert 0 < sum(ours) < len(ours)
    assert ours == [sight.sees(b, a) for a, b in pairs]


@pytest.mark.parametrize("name", WORLDS)
def test_who_is_hidden_beyond_doubt(name):
    """Hidden is what lines shifted a little both ways do not see either; rounding of a grazing line hides nobody."""
    world = get(name)
    sight, free, rng = Sight(world), drawn_out(world), np.random.default_rng(1)
    places = np.vstack([inside(world, rng, 20), world.points[rng.permutation(world.n)[:25]]])
    pairs = [(a, b) for a in places for b in places]
    hidden = [sight.is_hidden(a, b) for a, b in pairs]
    assert hidden == [not visible(free, a, b[None])[0] for a, b in pairs]
    for k in range(world.n):  # along a wall, a little inside it
        a, b = world.points[k], world.points[world.next_index[k]]
        outward = np.array([b[1] - a[1], a[0] - b[0]]) / np.hypot(*(b - a))
        assert not sight.is_hidden(a + 1e-8 * outward, b + 1e-8 * outward)


def test_seeing_along_walls_and_past_corners():
    sight = Sight(world_of(HALL, PILLAR))
    a = np.array
    assert sight.sees(a([4.0, 0.0]), a([4.0, 6.0]))  # along the whole wall of the pillar
    assert sight.sees(a([2.0, 0.0]), a([6.0, 4.0])) is False  # through it
    assert sight.sees(a([2.0, 0.0]), a([4.0, 2.0])) and sight.sees(a([2.0, 4.0]), a([6.0, 0.0]))  # grazes (4, 2)
    assert not sight.sees(a([4.0, 2.0]), a([6.0, 4.0]))  # from corner to corner, inside
    assert sight.sees(a([4.0, 2.0]), a([4.0, 4.0]))
    assert sight.sees(a([4.0, 2.0]), a([4.0, 2.0]))
    assert not sight.sees(a([3.0, 3.0]), a([7.0, 3.0]))


@pytest.mark.parametrize("name", WORLDS)
def test_contact_breaks_where_sampled_lines_leave_free_space(name):
    """Just before the break all lines are free, just behind it one is not; without a break all of them are free."""
    world = get(name)
    sight, free, rng = Sight(world), drawn_out(world), np.random.default_rng(2)
    corners = range(world.n)
    loose = inside(world, rng, 300)
    drives = [
        (world.points[i], world.points[j], i) for i in corners for j in (world.next_index[i], world.prev_index[i])
    ]
    pairs = rng.integers(world.n, size=(300, 2))
    drives += [(world.points[i], world.points[j], i) for i, j in pairs if i != j and _diagonal(free, world, i, j)][:40]
    drives += [(a, b, None) for a, b in zip(loose[:60], loose[60:120], strict=False) if visible(free, a, b[None])[0]]
    broken = held = 0
    places = np.vstack([world.points, loose[:10]])
    for start, end, corner in drives:
        watchers = places[visible(free, start, places) & (places != start).any(axis=1)]
        for watcher in watchers[rng.permutation(len(watchers))[:3]]:
            found = sight.contact_break(watcher, start, end, None if corner is None else int(corner))
            until = 1.0 if found is None else found
            fractions = np.linspace(0.0, 1.0, 101) * max(until - 1e-7, 0.0)
            where = f"watcher {watcher}, drive {start} -> {end}: {found}"
            assert visible(free, watcher, start + fractions[:, None] * (end - start)).all(), where
            if found is None:
                held += 1
                continue
            broken += 1
            assert 0.0 <= found <= 1.0, where
            behind = found + np.array([1e-5, 1e-4, 1e-3]) / np.hypot(*(end - start))
            behind = behind[behind < 1.0]
            assert not len(behind) or not visible(free, watcher, start + behind[:, None] * (end - start)).all(), where
    assert broken > 3 and held > 20


def _diagonal(free, world, i, j) -> bool:
    """Whether corners see each other with no third corner on the way."""
    line = shapely.LineString(world.points[[i, j]])
    touched = shapely.dwithin(shapely.points(world.points), line, 1e-9).sum()
    return touched == 2 and bool(visible(free, world.points[i], world.points[j][None])[0])


def test_contact_in_an_l_breaks_where_the_corner_hides_the_robot():
    """The line from (4, 0) through (2, 1) meets the wall x = 0 at y = 2."""
    sight = Sight(world_of(L))
    watcher, start, end = np.array([4.0, 0.0]), np.array([0.0, 0.0]), np.array([0.0, 4.0])
    assert sight.contact_break(watcher, start, end, 0) == pytest.approx(0.5)
    assert sight.contact_break(watcher, start, np.array([0.0, 2.0]), 0) is None  # ends on the grazing line
    assert sight.contact_break(watcher, np.array([0.0, 2.0]), end) == 0.0  # begins on it
    assert sight.contact_break(watcher, np.array([0.0, 2.0]), start) is None  # and leaves it to the free side
    assert sight.contact_break(watcher, np.array([1.0, 0.0]), watcher) is None  # along the line of contact
    assert sight.contact_break(watcher, start, watcher, 0) is None


def test_grazing_does_not_break_and_an_obstacle_ahead_breaks_at_once():
    """The robot stands at (8, 0); the watcher at (0, 4) sees it past the corner (4, 2) of the pillar, exactly."""
    sight = Sight(world_of(HALL, PILLAR))
    watcher, start = np.array([0.0, 4.0]), np.array([8.0, 0.0])
    assert sight.sees(watcher, start)
    assert sight.contact_break(watcher, start, np.array([5.0, 0.0])) is None  # turns away from the pillar
    assert sight.contact_break(watcher, start, np.array([9.0, 0.0])) == 0.0  # turns into it
    assert sight.contact_break(watcher, start, np.array([8.0, 1.0])) == 0.0
    assert sight.contact_break(watcher, np.array([7.0, 0.0]), np.array([9.0, 0.0])) == pytest.approx(0.5)


def test_a_corner_that_the_drive_touches_may_hide_the_robot():
    """Along y = 2, under the pillar: from (3, 6) it hides the robot as soon as that is past (4, 2), half the way."""
    sight = Sight(world_of(HALL, PILLAR))
    watcher, start = np.array([3.0, 6.0]), np.array([0.0, 2.0])
    assert sight.contact_break(watcher, start, np.array([8.0, 1.999999])) == pytest.approx(0.5, abs=1e-5)
    assert sight.contact_break(watcher, start, np.array([8.0, 2.0])) == pytest.approx(0.5)


def test_several_collinear_corners_at_once():
    """Two pillars whose corners (2, 2) and (6, 2) lie on the line of contact, one on each side of it."""
    above = [(2, 2), (2, 3), (4, 3), (4, 2)]
    below = [(6, 1), (6, 2), (8, 2), (8, 1)]
    sight = Sight(world_of(HALL, above, below))
    watcher, robot = np.array([0.0, 2.0]), np.array([10.0, 2.0])
    assert sight.sees(watcher, robot)
    assert sight.contact_break(watcher, robot, np.array([10.0, 6.0])) == 0.0
    assert sight.contact_break(watcher, robot, np.array([10.0, 0.0])) == 0.0
    assert sight.contact_break(watcher, np.array([5.0, 2.0]), np.array([5.0, 0.0])) is None
    assert sight.contact_break(watcher, np.array([5.0, 2.0]), np.array([5.0, 6.0])) == 0.0


def test_straight_corners_neither_hide_nor_stop_the_line_of_contact():
    """Corners of exactly 180 degrees in the wall that is driven along, and in the one that is watched across."""
    straight = [(0, 0), (2, 0), (5, 0), (10, 0), (10, 3), (10, 6), (5, 6), (0, 6)]
    sight = Sight(world_of(straight))
    p = sight.points
    for watcher in range(8):
        for corner in range(8):
            if watcher != corner:
                drives = (sight.contact_break(p[watcher], p[corner], p[(corner + k) % 8], corner) for k in (1, 7))
                assert list(drives) == [None, None], (watcher, corner)


def test_the_corner_where_the_drive_starts_may_hide_what_comes():
    """Around a reflex corner: the wall that leads away from the watcher breaks contact at once."""
    sight = Sight(world_of(L))
    p = sight.points
    assert sight.contact_break(p[1], p[3], p[4], 3) == 0.0  # from (2, 1) up, watched from (4, 0)
    assert sight.contact_break(p[0], p[3], p[4], 3) is None  # watched from (0, 0)
    assert sight.contact_break(p[2], p[3], p[4], 3) == 0.0  # watched along the wall that arrives at it
    assert sight.contact_break(p[5], p[3], p[2], 3) == 0.0


@pytest.mark.parametrize("name", WORLDS)
def test_first_obstacle_against_the_crossing_of_ray_and_boundary(name):
    world = get(name)
    sight, rng = Sight(world), np.random.default_rng(3)
    boundary = world.polygon.boundary
    reach = 2 * np.ptp(world.points, axis=0).max()
    for origin, angle in zip(inside(world, rng, 150), rng.uniform(0, 2 * np.pi, 150), strict=True):
        direction = np.array([np.cos(angle), np.sin(angle)])
        found = sight.first_obstacle(origin, direction)
        ray = shapely.LineString([origin, origin + reach * direction])
        assert found.distance_m == pytest.approx(shapely.Point(origin).distance(boundary.intersection(ray)), abs=1e-9)
        assert found.corner is None
        wall = shapely.LineString([world.points[found.wall], world.points[world.next_index[found.wall]]])
        assert wall.distance(shapely.Point(origin + found.distance_m * direction)) < 1e-9


def test_first_obstacle_counts_corners_that_are_only_touched():
    sight = Sight(world_of(HALL, PILLAR))
    right, up = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    touched = sight.first_obstacle(np.array([1.0, 2.0]), right)
    assert (touched.corner, touched.wall, touched.distance_m) == (4, None, 3.0)
    along = sight.first_obstacle(np.array([4.0, 2.0]), right)  # along a wall, from its end
    assert (along.corner, along.distance_m) == (7, 2.0)
    beyond = sight.first_obstacle(np.array([6.0, 2.0]), right)
    assert (beyond.corner, beyond.wall, beyond.distance_m) == (None, 1, 4.0)
    assert sight.first_obstacle(np.array([5.0, 0.0]), up).wall == 7  # the pillar's lower wall
    diagonal = sight.first_obstacle(np.array([1.0, 5.0]), np.array([1.0, -1.0]) / np.sqrt(2))
    assert diagonal.corner == 4 and diagonal.distance_m == pytest.approx(3 * np.sqrt(2))
    assert sight.first_obstacle(np.array([5.0, 0.0]), -up).distance_m == 0.0  # into the wall at which it stands


def test_first_corner_between():
    sight = Sight(world_of(HALL, PILLAR))
    ends = np.array([0.0, 2.0]), np.array([10.0, 2.0])
    assert sight.first_corner_between(*ends) == 4
    assert sight.first_corner_between(*ends[::-1]) == 7
    assert sight.first_corner_between(sight.points[4], ends[1]) == 7  # not the corner where it starts
    assert sight.first_corner_between(sight.points[4], sight.points[7]) is None  # nor the one where it ends
    assert sight.first_corner_between(np.array([0.0, 1.9]), np.array([10.0, 1.9])) is None
    assert sight.first_corner_between(ends[0], ends[0]) is None


@pytest.mark.parametrize("name", ["maze 11", "straight 11", "grid 11"])
def test_first_corner_between_against_distances_to_the_segment(name):
    world = get(name)
    sight, points, on_way = Sight(world), shapely.points(get(name).points), 0
    for i in range(world.n):
        for j in range(world.n):
            line = shapely.LineString([world.points[i], world.points[j]])
            on = [k for k in range(world.n) if k not in (i, j) and points[k].distance(line) < 1e-9]
            nearest = min(on, key=lambda k: points[k].distance(points[i]), default=None)
            assert sight.first_corner_between(world.points[i], world.points[j]) == nearest or i == j
            on_way += nearest is not None
    assert on_way > 20


def test_corners_within_reach_nearest_first():
    sight = Sight(world_of(HALL, PILLAR))
    assert sight.corners_near(np.array([4.0, 1.0]), 1.0).tolist() == [4]
    assert sight.corners_near(np.array([4.1, 3.2]), 2.5).tolist() == [5, 4, 6, 7]
    assert sight.corners_near(np.array([2.0, 1.0]), 0.5).tolist() == []
