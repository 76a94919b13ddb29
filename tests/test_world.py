"""Worlds: what is read, what is refused and how it is said; shapely is the judge of geometry."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from coopslam.errors import BadInput
from sim.world import World, load_world, world_from_geojson, world_names

SHARED_WORLDS = Path(__file__).parents[2] / "shared" / "data" / "worlds"
N_AND_HOLES = {
    "cave": (81, 3),
    "comb": (28, 0),
    "corridor_side_rooms": (76, 0),
    "office_floor": (240, 3),
    "paper_one_obstacle": (13, 1),
    "paper_two_occluders": (12, 0),
    "pillars": (92, 15),
    "rooms_with_doors": (44, 1),
    "slippery_hall": (48, 3),
    "spiral": (26, 0),
    "symmetric_cross": (12, 0),
    "zigzag_corridor": (50, 0),
}
OUTER = [[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]]
HOLE = [[1, 1], [2, 1], [2, 2], [1, 2], [1, 1]]
LON_LAT = [[-73.57, 45.50], [-73.56, 45.50], [-73.56, 45.51], [-73.57, 45.50]]


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def feature(geometry, **properties):
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def scaled(factor, offset=0.0):
    return [[factor * x + offset, factor * y + offset] for x, y in OUTER]


def shifted(ring, dx, dy):
    return [[x + dx, y + dy] for x, y in ring]


def outer_with(index, position):
    ring = list(OUTER)
    ring[index] = position
    return ring


def require_sound(world: World) -> None:
    """Orientation, neighbours, angles and counts of a loaded world, judged by shapely and by identities."""
    assert world.polygon.is_valid
    assert [shapely.is_ccw(shapely.linearrings(ring)) for ring in world.rings] == [True] + [False] * world.holes
    assert world.points.shape == (world.n, 2)
    assert (world.prev_index[world.next_index] == np.arange(world.n)).all()
    assert [world.flat_index(*world.ring_index(i)) for i in range(world.n)] == list(range(world.n))
    assert (world.ring_of[world.next_index] == world.ring_of).all()
    assert world.triangles_expected == len(shapely.constrained_delaunay_triangles(world.polygon).geoms)
    assert ((world.interior_angles > 0) & (world.interior_angles < 2 * np.pi)).all()
    assert world.interior_angles.sum() == pytest.approx(world.triangles_expected * np.pi, rel=1e-9)
    walls = world.points[world.next_index] - world.points
    assert world.perimeter_m == pytest.approx(np.hypot(*walls.T).sum(), rel=1e-12)
    assert world.area_m2 == pytest.approx(world.polygon.area)


def test_every_world_of_the_repository_is_named_here():
    assert world_names() == sorted(N_AND_HOLES)


@pytest.mark.parametrize("name", N_AND_HOLES)
def test_worlds_of_the_repository(name):
    world = load_world(name)
    assert (world.name, world.n, world.holes) == (name, *N_AND_HOLES[name])
    require_sound(world)
    assert shapely.minimum_clearance(world.polygon) > 0.1  # no gap that a robot of 10 cm would not see


def test_shared_worlds():
    paths = sorted(SHARED_WORLDS.glob("*.geojson"))
    if not paths:
        pytest.skip(f"{SHARED_WORLDS} is absent: nothing tested")
    assert len(paths) == 26
    for path in paths:
        require_sound(load_world(path))


def test_free_space_lies_on_the_left_whatever_the_file_says():
    for outer in (OUTER, OUTER[::-1]):
        for hole in (HOLE, HOLE[::-1]):
            world = world_from_geojson(polygon(outer, hole))
            require_sound(world)
            middle = (world.points + world.points[world.next_index]) / 2
            along = world.points[world.next_index] - world.points
            left = middle + 1e-3 * np.column_stack([-along[:, 1], along[:, 0]])
            assert shapely.contains_xy(world.polygon, left).all()
            assert world.rings[0][0].tolist() == [0, 0] and world.rings[1][0].tolist() == [1, 1]


def test_interior_angles_of_a_notched_square():
    world = world_from_geojson(polygon([[0, 0], [2, 0], [4, 0], [4, 4], [2, 2], [0, 4], [0, 0]]))
    assert np.degrees(world.interior_angles) == pytest.approx([90, 180, 90, 45, 270, 45])
    assert world.interior_angle(4) == pytest.approx(1.5 * np.pi)
    assert world.n == 6  # the straight vertex stays


def test_corner_names():
    world = world_from_geojson(polygon(OUTER, HOLE))
    assert world.offset.tolist() == [0, 4]
    assert world.ring_index(5) == (1, 1) and world.flat_index(1, 1) == 5
    assert world.next_index.tolist() == [1, 2, 3, 0, 5, 6, 7, 4]
    for ring, index in [(2, 0), (1, 4), (-1, 0), (0, -1)]:
        with pytest.raises(IndexError):
            world.flat_index(ring, index)


def test_arrays_are_read_only():
    world = load_world("paper_one_obstacle")
    for array in (world.points, world.next_index, world.offset, world.interior_angles, *world.rings):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_a_world_made_by_hand_must_have_free_space_on_the_left():
    with pytest.raises(BadInput, match="ring 0 does not have free space on its left"):
        World("wrong", (np.array(OUTER[:0:-1], dtype=float),))


def geometries(world: World) -> list[dict]:
    data = world.to_geojson()
    return [entry["geometry"] for entry in data.get("features", [data])]


@pytest.mark.parametrize("name", N_AND_HOLES)
def test_round_trip(name, tmp_path):
    world = load_world(name)
    path = tmp_path / "other.geojson"
    path.write_text(json.dumps(world.to_geojson()))
    again = load_world(path)
    assert again.name == name
    assert [ring.tolist() for ring in again.rings] == [ring.tolist() for ring in world.rings]
    assert len(again.patches) == len(world.patches)
    assert shapely.from_geojson(json.dumps(geometries(world)[0])).equals(world.polygon)


@pytest.mark.parametrize(
    "data",
    [
        polygon(OUTER),
        feature(polygon(OUTER), colour="blue"),
        {"type": "Feature", "properties": None, "geometry": polygon(OUTER)},
        feature({"type": "MultiPolygon", "coordinates": [[OUTER]]}, units="m"),
        {"type": "FeatureCollection", "features": [feature(polygon(OUTER), units="m")], "crs": None},
        {
            "type": "FeatureCollection",
            "features": [feature({"type": "Point", "coordinates": [1, 1]}), feature(polygon(OUTER))],
        },
        feature(polygon(scaled(1.0, 5e6))),  # far from the origin, as map grids are
        feature(polygon(scaled(0.02)), units="m"),  # 12 cm: small, and said to be metres
    ],
)
def test_accepted_forms(data, tmp_path):
    path = tmp_path / "yard.geojson"
    path.write_text(json.dumps(data), encoding="utf-8-sig")
    world = load_world(path)
    assert (world.name, world.n) == ("yard", 4)
    require_sound(world)


def test_a_world_of_many_corners_loads():
    angle = np.linspace(0, 2 * np.pi, 1400, endpoint=False)
    radius = 30 + 5 * np.sin(37 * angle)
    data = World("sun", (np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]),)).to_geojson()
    world = world_from_geojson(data)
    assert world.n == 1400


@st.composite
def stars(draw):
    """A ring around the origin, of which the angle grows and the radius is any: always simple."""
    n = draw(st.integers(3, 30))
    steps = np.array(draw(st.lists(st.floats(1, 1.9), min_size=n, max_size=n)))  # < 180 degrees also when n = 3
    radii = np.array(draw(st.lists(st.floats(1, 20), min_size=n, max_size=n)))
    angles = 2 * np.pi * np.cumsum(steps) / steps.sum()
    ring = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    if draw(st.booleans()):
        ring = ring[::-1]
    return [*ring.tolist(), ring[0].tolist()]


@given(stars())
def test_random_stars_load(ring):
    world = world_from_geojson(polygon(ring))
    require_sound(world)
    assert world.area_m2 == pytest.approx(shapely.Polygon(ring).area)
