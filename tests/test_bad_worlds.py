"""Files that are no worlds are refused in one line that says what was expected."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_world import HOLE, LON_LAT, OUTER, feature, outer_with, polygon, require_sound, scaled, shifted, stars

from coopslam.errors import BadInput
from sim.world import load_world, world_from_geojson, world_names

BAD_WORLDS = {
    "number": (7, "7 found; a GeoJSON object expected"),
    "no type": ({}, "no polygons found; exactly one expected"),
    "point": ({"type": "Point", "coordinates": [1, 2]}, "no polygons found; exactly one expected"),
    "no geometry": (feature(None), "no polygons found; exactly one expected"),
    "features not a list": ({"type": "FeatureCollection", "features": 3}, "features 3; a list expected"),
    "properties not an object": (
        {"type": "Feature", "properties": [1], "geometry": polygon(OUTER)},
        "properties are [1]; an object expected",
    ),
    "two polygons": (
        {"type": "FeatureCollection", "features": [feature(polygon(OUTER)), feature(polygon(HOLE))]},
        "2 polygons found; exactly one expected",
    ),
    "two parts": (
        {"type": "MultiPolygon", "coordinates": [[OUTER], [shifted(OUTER, 9, 0)]]},
        "2 polygons found; exactly one expected",
    ),
    "null feature": (
        {"type": "FeatureCollection", "features": [feature(polygon(OUTER)), None]},
        "feature 1: None found; a GeoJSON object expected",
    ),
    "text feature": (
        {"type": "FeatureCollection", "features": [feature(polygon(OUTER)), "a wall"]},
        "feature 1: 'a wall' found; a GeoJSON object expected",
    ),
    "kind": (
        {"type": "FeatureCollection", "features": [feature(polygon(OUTER)), feature(polygon(HOLE), kind="slipery")]},
        "feature 1: properties.kind is 'slipery'; kind must be \"slippery\" or absent",
    ),
    "kind of the world": (feature(polygon(OUTER), kind="room"), "properties.kind is 'room'; kind must be"),
    "nested collection": (
        {
            "type": "FeatureCollection",
            "features": [
                feature(polygon(OUTER)),
                {"type": "FeatureCollection", "features": [feature(polygon(HOLE), kind="slippery", noise_factor=2)]},
            ],
        },
        "feature 1: is a FeatureCollection in another; a Feature expected",
    ),
    "name": (feature(polygon(OUTER), name=3), "properties.name is 3; text expected"),
    "no coordinates": ({"type": "Polygon"}, "Polygon has coordinates None; a list expected"),
    "no rings": (polygon(), "the polygon has no rings; a list of closed rings expected"),
    "ring of numbers": (polygon(4), "ring 0 (outer) is not a list of positions"),
    "empty ring": (polygon([]), "ring 0 (outer) has 0 distinct points; at least 3 expected"),
    "two points": (polygon(OUTER, [[1, 1], [2, 2], [1, 1]]), "ring 1 (hole) has 2 distinct points; at least 3"),
    "open ring": (
        polygon(OUTER[:-1]),
        "ring 0 (outer), vertex 0 (0, 0) and vertex 3 (0, 4) differ; the first point repeated at the end expected",
    ),
    "repeated point": (
        polygon([[0, 0], [6, 0], [6, 0], [6, 4], [0, 0]]),
        "ring 0 (outer), vertex 1 (6, 0) and vertex 2 are the same point",
    ),
    "short wall": (
        polygon([[0, 0], [6, 0], [6, 0.0005], [0, 4], [0, 0]]),
        "wall from ring 0 (outer), vertex 1 (6, 0) to vertex 2 is 0.0005 m long, "
        "shorter than the smallest wall that the robots can follow (1 mm)",
    ),
    "bow tie": (
        polygon([[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]]),
        "ring 0 (outer) crosses itself at (2, 2), edge 0-1 and edge 2-3",
    ),
    "spike": (
        polygon([[0, 0], [6, 0], [6, 4], [8, 4], [3, 4], [0, 4], [0, 0]]),
        "the walls at ring 0 (outer), vertex 3 (8, 4) fold back on each other (a spike)",
    ),
    "flat ring": (
        polygon([[0, 0], [2, 0], [6, 0], [0, 0]]),
        "the walls at ring 0 (outer), vertex 0 (0, 0) fold back on each other (a spike)",
    ),
    "pinch": (
        polygon([[0, 0], [3, 2], [6, 0], [6, 4], [3, 2], [0, 4], [0, 0]]),
        "ring 0 (outer) touches itself at (3, 2), edge 0-1 and edge 4-5; walls apart expected (a corner",
    ),
    "walls on each other": (
        polygon([[0, 0], [6, 0], [6, 4], [4, 4], [4, 2], [5, 2], [5, 4], [3, 4], [3, 5], [0, 5], [0, 0]]),
        "ring 0 (outer) touches itself",
    ),
    "walls too close": (
        polygon([[0, 0], [3, 2 - 1e-7], [6, 0], [6, 4], [3, 2], [0, 4], [0, 0]]),
        "ring 0 (outer) touches itself at (3, 2)",
    ),
    "hole outside": (
        polygon(OUTER, HOLE, shifted(HOLE, 9, 0)),
        "ring 2 (hole), vertex 0 (10, 1) lies outside ring 0 (outer)",
    ),
    "hole around": (
        polygon(HOLE, OUTER),
        "ring 1 (hole), vertex 0 (0, 0) lies outside ring 0 (outer); holes inside it expected",
    ),
    "hole crosses outer": (
        polygon(OUTER, shifted(HOLE, 4.5, 0)),
        "ring 0 (outer) crosses ring 1 (hole) at (6, 1), edge 1-2 and edge 0-1",
    ),
    "hole crosses hole": (
        polygon(OUTER, HOLE, shifted(HOLE, 0.5, 0.5)),
        "ring 1 (hole) crosses ring 2 (hole) at (2, 1.5), edge 1-2 and edge 0-1",
    ),
    "nested holes": (
        polygon(OUTER, HOLE, [[1.2, 1.2], [1.8, 1.2], [1.5, 1.8], [1.2, 1.2]]),
        "ring 2 (hole), vertex 0 (1.2, 1.2) lies inside ring 1 (hole); no nested holes expected",
    ),
    "same hole twice": (polygon(OUTER, HOLE, HOLE), "ring 1 (hole) touches ring 2 (hole)"),
    "hole touches outer": (
        polygon(OUTER, [[3, 0], [4, 1], [2, 1], [3, 0]]),
        "ring 0 (outer) touches ring 1 (hole) at (3, 0), edge 0-1 and edge",
    ),
    "hole touches hole": (
        polygon(OUTER, HOLE, shifted(HOLE, 1, 1)),
        "ring 1 (hole) touches ring 2 (hole) at (2, 2)",
    ),
    "triangular rings touch": (
        polygon([[0, 0], [9, 0], [0, 9], [0, 0]], [[3, 0], [4, 1], [2, 1], [3, 0]]),
        "ring 0 (outer) touches ring 1 (hole) at (3, 0)",
    ),
    "text": (polygon(outer_with(1, ["6", 0])), "vertex 1 has a coordinate that is no number (str)"),
    "null": (polygon(outer_with(1, [None, 0])), "vertex 1 has a coordinate that is no number (NoneType)"),
    "true": (polygon(outer_with(1, [True, 0])), "vertex 1 has a coordinate that is no number (bool)"),
    "nan": (polygon(outer_with(2, [6, float("nan")])), "vertex 2 has the coordinate nan; finite metres expected"),
    "infinite": (polygon(outer_with(2, [float("inf"), 4])), "vertex 2 has the coordinate inf; finite"),
    "huge integer": (polygon(outer_with(2, [10**400, 4])), "vertex 2 has the coordinate inf; finite"),
    "no position": (polygon(outer_with(3, 5)), "vertex 3 has no list of coordinates; two (x, y) in metres"),
    "one coordinate": (polygon(outer_with(3, [5])), "vertex 3 has 1 coordinates; two (x, y) in metres expected"),
    "three coordinates": (polygon(outer_with(3, [0, 4, 1])), "ring 0 (outer), vertex 3 has 3 coordinates; two (x, y)"),
    "crs": (polygon(OUTER) | {"crs": {"type": "name", "properties": {"name": "EPSG:4326"}}}, "has a crs member"),
    "crs of a collection": (
        {"type": "FeatureCollection", "crs": {"type": "name"}, "features": [feature(polygon(OUTER))]},
        "has a crs member ({'type': 'name'}); plain metres without a crs expected",
    ),
    "feet": (feature(polygon(OUTER), units="ft"), "properties.units is 'ft'; \"m\" (metres) expected"),
    "degrees": (polygon(LON_LAT), "coordinates look like degrees (0.01 across); metres expected"),
    "too large": (polygon(scaled(1e5)), "the world is 600000 m across; at most 100000 m expected"),
    "overflow": (polygon(outer_with(2, [1e308, -1e308])), "at most 100000 m expected"),
    "too far": (polygon(scaled(1.0, 1e12)), "coordinates reach 1e+12 m; at most 1e+08 m expected"),
    "too small": (feature(polygon(scaled(1e-3)), units="m"), "the world is 0.006 m across; at least 0.05 m expected"),
}


def refusal(path_or_name) -> str:
    with pytest.raises(BadInput) as caught:
        load_world(path_or_name)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("data, said", BAD_WORLDS.values(), ids=BAD_WORLDS)
def test_bad_worlds_are_refused_in_one_line(data, said, tmp_path):
    path = tmp_path / "bad.geojson"
    path.write_text(json.dumps(data))
    line = refusal(path)
    assert line.startswith(f"{path}: ")
    assert said in line


BAD_FILES = {
    "empty": (b"", ", line 1: not JSON ("),
    "not JSON": (b'{"type":\n "Polygon",\n oops}', ", line 3: not JSON ("),
    "not UTF-8": (b'{"type": "\xff"}', ": byte 10 is not UTF-8 text"),
    "deep": (b"[" * 100_000, ": JSON nested too deeply"),
    "endless number": (b"[" + b"9" * 10_000 + b"]", ": cannot be read ("),
}


@pytest.mark.parametrize("content, said", BAD_FILES.values(), ids=BAD_FILES)
def test_bad_files_are_refused_in_one_line(content, said, tmp_path):
    path = tmp_path / "bad.geojson"
    path.write_bytes(content)
    assert refusal(path).startswith(f"{path}{said}")


def test_missing_and_unreadable_files(tmp_path):
    assert "none.geojson: cannot be read (No such file or directory)" in refusal(tmp_path / "none.geojson")
    assert "cannot be read (Is a directory)" in refusal(tmp_path)
    assert "cannot be read (" in refusal("nul\0.geojson")
    assert "cannot be read (File name too long)" in refusal("x" * 5000 + ".geojson")
    assert refusal("atlantis").endswith(f"one of: {', '.join(world_names())}")
    assert "no world ''" in refusal("")
    assert "no world 'xxx" in refusal("x" * 5000)


@st.composite
def mangled(draw):
    """A star with a star as its hole, after a few accidents."""
    rings = [draw(stars()), (0.04 * np.array(draw(stars()))).tolist()]
    anything = st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=3) | st.integers(),
        lambda inner: st.lists(inner, max_size=4),
        max_leaves=6,
    )
    for _ in range(draw(st.integers(1, 4))):
        ring = draw(st.sampled_from(rings))
        i, j = draw(st.integers(0, len(ring) - 1)), draw(st.integers(0, len(ring) - 1))
        match draw(st.sampled_from(["swap", "repeat", "move", "replace", "close", "share"])):
            case "swap":
                ring[i], ring[j] = ring[j], ring[i]
            case "repeat":
                ring.insert(i, ring[j])
            case "move":
                ring[i] = [draw(st.floats(-20, 20)), draw(st.floats(-20, 20))]
            case "replace":
                ring[i] = draw(anything)
            case "close":
                ring[-1] = ring[0]
            case "share":
                rings[1][i % len(rings[1])] = rings[0][j % len(rings[0])]
    return polygon(*rings)


@given(mangled())
def test_mangled_worlds_load_or_are_refused(data):
    try:
        world = world_from_geojson(data)
    except BadInput as error:
        assert "\n" not in str(error)
    else:
        require_sound(world)
