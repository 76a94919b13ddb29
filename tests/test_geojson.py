import json

import numpy as np
import pytest
from shapely.geometry import shape

from coopslam.errors import BadInput
from coopslam.io.geojson import feature, read_json, write_feature_collection


def test_other_readers_see_the_same(tmp_path):
    square = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [0.0, 2.0]])
    hole = ((1.0, 0.5), (1.0, 1.0), (2.0, 1.0), (1.0, 0.5))  # closed already
    features = [
        feature("room", "Polygon", [square, hole], id=np.int64(3), vertices=(0, 1, 2)),
        feature("vertex", "Point", np.array([0.1, 1 / 3]), covariance=np.eye(2), convex=np.bool_(True)),
        feature("wall", "LineString", square[:2], vertices=[0, 1]),
    ]
    write_feature_collection(tmp_path / "map.geojson", features)
    collection = json.loads((tmp_path / "map.geojson").read_text())
    room, point, wall = collection["features"]
    assert collection["type"] == "FeatureCollection"
    assert [item["type"] for item in collection["features"]] == ["Feature"] * 3
    assert room["properties"] == {"kind": "room", "id": 3, "vertices": [0, 1, 2]}
    assert point["properties"] == {"kind": "vertex", "covariance": [[1.0, 0.0], [0.0, 1.0]], "convex": True}
    assert shape(room["geometry"]).area == 6.0 - 0.25
    assert len(room["geometry"]["coordinates"][0]) == 5 and len(room["geometry"]["coordinates"][1]) == 4
    assert shape(point["geometry"]).coords[0] == (0.1, 1 / 3)
    assert shape(wall["geometry"]).length == 3.0
    assert read_json(tmp_path / "map.geojson") == collection


def test_an_empty_collection(tmp_path):
    write_feature_collection(tmp_path / "map.geojson", [])
    assert read_json(tmp_path / "map.geojson")["features"] == []


def test_numbers_that_are_not_finite_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_feature_collection(tmp_path / "map.geojson", [feature("vertex", "Point", [np.nan, 0.0])])
    assert not (tmp_path / "map.geojson").exists()


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "line 1"),
        (b'{"a": 1,\n "b" 2}', "line 2"),
        (b'{"a": NaN}', "NaN"),
        (b"\x89MCAP\xff\xfe", "not a text file"),
        (b"[" * 200_000, "not usable JSON"),
        (b"[" + b"1" * 10_000 + b"]", "not usable JSON"),
    ],
)
def test_broken_json_is_one_line_with_its_place(tmp_path, content, expected):
    path = tmp_path / "map.geojson"
    path.write_bytes(content)
    with pytest.raises(BadInput, match=expected) as caught:
        read_json(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(BadInput, match=r"none\.json: cannot read the file: No such file"):
        read_json(tmp_path / "none.json")
