"""Occupancy maps, read back by OpenCV, Pillow and PyYAML, against shapely's answer cell by cell."""

import cv2
import numpy as np
import pytest
import shapely
from PIL import Image
from visibility_graph import OWN_WORLDS, load_polygon

from coopslam.errors import BadInput
from coopslam.io.occupancy_map import FREE, OCCUPIED, UNKNOWN, occupancy_of, write_occupancy_map

ROOM = shapely.box(0.0, 0.0, 2.0, 1.0)


def walls_of(polygon: shapely.Polygon) -> list:
    rings = [np.array(ring.coords) for ring in (polygon.exterior, *polygon.interiors)]
    return [pair for ring in rings for pair in zip(ring[:-1].tolist(), ring[1:].tolist(), strict=True)]


def read_yaml(path) -> dict:
    yaml = pytest.importorskip("yaml")
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_read_back_by_others(tmp_path):
    """Every cell as shapely judges it, from the picture and the description alone."""
    polygon = load_polygon(OWN_WORLDS[0])
    walls = walls_of(polygon)
    picture, description = write_occupancy_map(tmp_path / "map", occupancy_of(polygon, walls, 0.1))
    said = read_yaml(description)
    pixels = cv2.imread(str(picture.with_name(said["image"])), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(pixels, np.array(Image.open(picture))) and pixels.dtype == np.uint8
    rows, columns = pixels.shape
    (x0, y0, yaw), side = said["origin"], said["resolution"]
    assert yaw == 0.0 and said["negate"] == 0 and said["mode"] == "trinary"
    x = x0 + side * np.arange(columns)
    y = y0 + side * (rows - 1 - np.arange(rows))  # the first row is the top one
    boxes = shapely.box(x[None, :], y[:, None], x[None, :] + side, y[:, None] + side)
    lines = shapely.MultiLineString(walls)
    crossed = shapely.length(shapely.intersection(boxes, lines)) > 1e-6
    centre_free = shapely.contains_xy(polygon, x[None, :] + side / 2, y[:, None] + side / 2)
    inner = shapely.box(x[None, :] + 1e-6, y[:, None] + 1e-6, x[None, :] + side - 1e-6, y[:, None] + side - 1e-6)
    through = shapely.length(shapely.intersection(inner, lines)) > 1e-6  # not along the border between two cells
    assert (pixels[through] == OCCUPIED).all() and (crossed[pixels == OCCUPIED]).all()
    rest = ~crossed
    assert (pixels[rest & centre_free] == FREE).all() and (pixels[rest & ~centre_free] == UNKNOWN).all()
    assert (rest & centre_free).sum() > 1000 and (rest & ~centre_free).sum() > 100 and through.sum() > 100


def test_values_mean_what_map_server_takes_them_for(tmp_path):
    """Its rule, p = (255 - v) / 255 against the two thresholds of the file."""
    _, description = write_occupancy_map(tmp_path / "m", occupancy_of(ROOM, walls_of(ROOM), 0.1))
    said = read_yaml(description)

    def meaning(value):
        p = (255 - value) / 255
        return "occupied" if p > said["occupied_thresh"] else "free" if p < said["free_thresh"] else "unknown"

    assert [meaning(v) for v in (FREE, OCCUPIED, UNKNOWN)] == ["free", "occupied", "unknown"]


def test_a_room_by_hand():
    """2 m by 1 m in cells of 0.5 m: walls on lines of the grid belong to the cell above and to the right of them."""
    grid = occupancy_of(ROOM, walls_of(ROOM), 0.5)
    o, f, u = OCCUPIED, FREE, UNKNOWN
    assert grid.origin == (-0.5, -0.5) and grid.resolution_m == 0.5
    assert grid.pixels.tolist() == [
        [u, o, o, o, o, u],
        [u, o, f, f, f, o],
        [u, o, o, o, o, o],
        [u, u, u, u, u, u],
    ]


def test_beyond_an_open_gate_is_unknown_and_not_occupied():
    grid = occupancy_of(ROOM, [((0, 0), (2, 0)), ((0, 1), (0, 0)), ((2, 1), (0, 1))], 0.1)  # no wall at x = 2
    row = grid.pixels[len(grid.pixels) // 2]
    assert row[-1] == UNKNOWN and row[-2] == FREE and OCCUPIED not in row[5:]


def test_maps_of_one_frame_fit_on_each_other():
    """Their origins are whole numbers of cells apart."""
    one = occupancy_of(ROOM, [], 0.05)
    other = occupancy_of(shapely.box(0.513, -0.27, 3.1, 0.7), [], 0.05)
    apart = (np.array(other.origin) - one.origin) / 0.05
    assert apart == pytest.approx(np.round(apart), abs=1e-9)


@pytest.mark.parametrize("resolution_m", [0.0, -0.1, float("nan"), float("inf"), 1e-5, 1e-320])
def test_resolutions_that_make_no_picture(resolution_m):
    with pytest.raises(BadInput, match="^resolution_m: "):
        occupancy_of(ROOM, walls_of(ROOM), resolution_m)


def test_nothing_mapped():
    with pytest.raises(BadInput, match="nothing is mapped"):
        occupancy_of(shapely.Polygon(), [], 0.1)
