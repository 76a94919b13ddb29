"""Slippery patches: their factor along a stretch against lengths done on paper and sampled places; what is refused."""

import json

import numpy as np
import pytest
import shapely

from coopslam.errors import BadInput
from sim.ground import Patch, noise_factors
from sim.world import World, load_world, world_from_geojson

SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
HALL = [[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]]
RING = [[1, 1], [3, 1], [3, 9], [1, 9], [1, 1]]  # reaches outside the hall


def one(patches, start, end) -> float:
    return float(noise_factors(patches, np.array([start], float), np.array([end], float))[0])


def collection(*patches, world=HALL) -> dict:
    polygon = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [world]}}
    return {"type": "FeatureCollection", "features": [polygon, *patches]}


def slippery(coordinates=None, kind="Polygon", **properties) -> dict:
    geometry = {"type": kind, "coordinates": [RING] if coordinates is None else coordinates}
    return {"type": "Feature", "properties": {"kind": "slippery"} | properties, "geometry": geometry}


def test_variances_are_averaged_over_the_length():
    patch = [Patch(SQUARE, 3.0)]
    assert one(patch, (0.5, 1), (1.5, 1)) == pytest.approx(3.0)
    assert one(patch, (3, 1), (9, 1)) == 1.0
    assert one(patch, (1, 1), (5, 1)) == pytest.approx(np.sqrt((1 * 9 + 3 * 1) / 4))
    assert one(patch, (5, 1), (1, 1)) == pytest.approx(np.sqrt((1 * 9 + 3 * 1) / 4))
    assert one(patch, (-1, -1), (4, 4)) == pytest.approx(np.sqrt((2 * 9 + 3) / 5))  # through it, along the diagonal
    assert one(patch, (0, -1), (0, 1)) == pytest.approx(np.sqrt(5.0))  # half along its boundary, which belongs to it


def test_the_largest_factor_counts_where_patches_overlap():
    patches = [Patch(SQUARE, 2.0), Patch(SQUARE + [1.0, 0.0], 5.0), Patch(SQUARE - [2.0, 0.0], 0.5)]
    for order in (patches, patches[::-1]):
        assert one(order, (-1, 1), (4, 1)) == pytest.approx(np.sqrt((0.25 + 4 + 2 * 25 + 1) / 5))
        places = np.array([[-1.0, 1.0], [0.0, 1.0], [0.5, 1.0], [1.5, 1.0], [3.0, 2.0], [3.1, 2.0]])
        assert noise_factors(order, places, places).tolist() == [0.5, 2.0, 2.0, 5.0, 5.0, 1.0]


def test_stretches_and_turns_in_one_call():
    starts, ends = np.array([[1.0, 1.0], [1.0, 1.0], [5.0, 5.0]]), np.array([[1.0, 1.0], [3.0, 1.0], [5.0, 5.0]])
    assert noise_factors([Patch(SQUARE, 3.0)], starts, ends) == pytest.approx([3.0, np.sqrt(5.0), 1.0])
    assert noise_factors([Patch(SQUARE, 3.0)], starts[:0], ends[:0]).shape == (0,)
    assert World("plain", (SQUARE,)).noise_factors(starts, ends).tolist() == [1.0, 1.0, 1.0]


def test_against_places_sampled_along_the_stretch():
    star = Patch(np.array([[0.0, 0.0], [4.0, 1.0], [1.0, 1.5], [3.0, 4.0], [-1.0, 3.0]]), 4.0)
    patches = [Patch(SQUARE, 2.0), star]
    starts, ends = np.random.default_rng(5).uniform(-3, 5, (2, 300, 2))
    fractions = (np.arange(2000)[:, None] + 0.5) / 2000
    squares = np.ones((300, 2000))
    for patch in patches:  # the larger factor is the later one
        for k in range(300):
            inside = shapely.contains_xy(patch.polygon, starts[k] + fractions * (ends[k] - starts[k]))
            squares[k, inside] = patch.noise_factor**2
    # each of at most 8 crossings is a sample off, by a jump of at most 15
    np.testing.assert_allclose(noise_factors(patches, starts, ends) ** 2, squares.mean(axis=1), atol=15 * 8 / 2000)


def test_what_a_walk_over_a_patch_adds_up_to_does_not_depend_on_the_steps():
    """Variance per metre: over any split of the walk the sum of length times squared factor is the same."""
    patches, corners = [Patch(SQUARE, 3.0)], np.array([[-1.0, 0.3], [3.0, 1.7]])
    whole = one(patches, *corners) ** 2
    for steps in (2, 9, 100):
        ends = corners[0] + np.linspace(0, 1, steps + 1)[:, None] * (corners[1] - corners[0])
        assert np.mean(noise_factors(patches, ends[:-1], ends[1:]) ** 2) == pytest.approx(whole)


def test_patches_are_read_and_written_again(tmp_path):
    data = collection(
        slippery(noise_factor=3, name="ice", description="at the door"),
        slippery([RING[::-1]], noise_factor=0.5, units="m"),
    )
    world = world_from_geojson(data)
    assert [patch.noise_factor for patch in world.patches] == [3.0, 0.5]
    assert [patch.ring.tolist() for patch in world.patches] == [RING[:-1], RING[:0:-1]]
    path = tmp_path / "hall.geojson"
    path.write_text(json.dumps(world.to_geojson()))
    again = load_world(path)
    assert (again.n, again.name) == (4, world.name)
    assert [p.ring.tolist() for p in again.patches] == [p.ring.tolist() for p in world.patches]
    assert [p.noise_factor for p in again.patches] == [3.0, 0.5]
    assert world_from_geojson(collection()).to_geojson()["type"] == "Feature"  # without patches as ever


BAD_PATCHES = {
    "no factor": (slippery(), "noise_factor is missing; a number more than zero and at most 100 expected"),
    "null": (slippery(noise_factor=None), "properties.noise_factor is None; a number more than zero and at most 100"),
    "misspelt": (
        slippery(noise_facter=3),
        "unknown property 'noise_facter'; known properties: kind, noise_factor, name, description, units",
    ),
    "text": (slippery(noise_factor="3"), "properties.noise_factor is '3'"),
    "true": (slippery(noise_factor=True), "properties.noise_factor is True"),
    "zero": (slippery(noise_factor=0), "properties.noise_factor is 0"),
    "negative": (slippery(noise_factor=-1.5), "properties.noise_factor is -1.5"),
    "large": (slippery(noise_factor=101), "properties.noise_factor is 101"),
    "nan": (slippery(noise_factor=float("nan")), "properties.noise_factor is nan"),
    "infinite": (slippery(noise_factor=float("inf")), "properties.noise_factor is inf"),
    "huge": (slippery(noise_factor=10**400), "properties.noise_factor is 1000"),
    "feet": (slippery(noise_factor=2, units="ft"), "properties.units is 'ft'; \"m\" (metres) expected"),
    "point": (slippery([1, 1], "Point", noise_factor=2), "the geometry is 'Point'; a Polygon expected"),
    "parts": (slippery([[RING]], "MultiPolygon", noise_factor=2), "the geometry is 'MultiPolygon'; a Polygon expected"),
    "no geometry": (slippery(noise_factor=2) | {"geometry": None}, "the geometry is None; a Polygon expected"),
    "no rings": (slippery([], noise_factor=2), "the polygon has no rings"),
    "hole": (slippery([RING, RING], noise_factor=2), "the polygon has 2 rings; one (no holes) expected"),
    "open": (slippery([RING[:-1]], noise_factor=2), "ring is not closed"),
    "no number": (slippery([[[0, "1"], *RING[1:]]], noise_factor=2), "vertex 0 has a coordinate that is no number"),
    "far": (slippery([[[0, 0], [1e9, 0], [0, 1], [0, 0]]], noise_factor=2), "coordinates reach 1e+09 m; at most 1e+08"),
    "bow tie": (slippery([[[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]]], noise_factor=2), "ring 0 (outer) crosses itself"),
    "flat": (slippery([[[0, 0], [2, 0], [6, 0], [0, 0]]], noise_factor=2), "fold back on each other"),
    "crs": (slippery(noise_factor=2) | {"crs": {"type": "name"}}, "has a crs member"),
}


@pytest.mark.parametrize("feature, said", BAD_PATCHES.values(), ids=BAD_PATCHES)
def test_bad_patches_are_refused_in_one_line(feature, said, tmp_path):
    path = tmp_path / "bad.geojson"
    path.write_text(json.dumps(collection(feature)))
    with pytest.raises(BadInput) as caught:
        load_world(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and said in line and "\n" not in line
    if feature.get("crs") is None:
        assert line.startswith(f"{path}: feature 1 (slippery): ")


def test_a_patch_is_no_world():
    with pytest.raises(BadInput, match="no polygons found"):
        world_from_geojson(slippery(noise_factor=2))


@pytest.mark.parametrize("factor", [0.0, -1.0, 100.1, float("nan"), float("inf")])
def test_a_patch_made_by_hand_refuses_what_cannot_be(factor):
    with pytest.raises(BadInput, match="noise_factor"):
        Patch(SQUARE, factor)


def test_the_slippery_hall_is_slippery_by_a_third_in_whole_rooms():
    world = load_world("slippery_hall")
    slick = shapely.union_all([patch.polygon for patch in world.patches])
    assert {patch.noise_factor for patch in world.patches} == {3.0}
    assert slick.intersection(world.polygon).area == pytest.approx(world.area_m2 / 3, rel=0.05)
    # the patches end inside walls and in two doorways: only there free space is cut
    cut = slick.boundary.intersection(world.polygon)
    assert cut.length == pytest.approx(2 * 1.0)
    triangles = shapely.constrained_delaunay_triangles(world.polygon).geoms
    covered = np.array([triangle.intersection(slick).area / triangle.area for triangle in triangles])
    assert np.count_nonzero(covered > 0.99) >= 8 and np.count_nonzero(covered < 0.01) >= 24
