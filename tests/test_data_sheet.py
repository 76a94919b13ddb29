"""Data sheets: those of the repository hold what the design promises; what cannot be is refused with file and key."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coopslam.errors import BadInput
from tracker.data_sheet import dump_data_sheet, load_data_sheet
from tracker.helix import Helix
from tracker.tag_cube import TagCube

SHEETS = Path(__file__).parents[1] / "datasets" / "calibrations"
NAMES = ["helix_640x480", "helix_1280x960", "tag_cube_640x480", "tag_cube_1280x960"]
HELIX = (SHEETS / "helix_640x480.toml").read_text(encoding="utf-8")


def sheet(name):
    return load_data_sheet(SHEETS / f"{name}.toml")


@pytest.mark.parametrize("name", NAMES)
def test_the_repositorys_sheets(name):
    found = sheet(name)
    kind, size = name.rsplit("_", 1)
    assert isinstance(found.target, Helix if kind == "helix" else TagCube)
    assert f"{found.camera.lens.width_px}x{found.camera.lens.height_px}" == size
    assert (found.target.bottom_m, found.target.top_m) == pytest.approx((0.18, 0.48))  # the same for both targets
    assert replace(found.target, body=()) == type(found.target)()  # the defaults are the design
    half = np.arctan(found.camera.lens.normalised(np.array([[-0.5, found.camera.lens.cy_px]]))[0, 0])
    assert 60 < -2 * np.degrees(half) < 70  # horizontal field of view


def test_both_sizes_are_one_camera():
    """Twice the pixels: a pixel centre u of the small picture is at 2 u + 0.5 in the large one."""
    small, large = sheet("helix_640x480").camera, sheet("helix_1280x960").camera
    points = np.random.default_rng(1).uniform([1, -0.5, 0], [8, 0.5, 0.6], (100, 3))
    np.testing.assert_allclose(large.project(points)[0], 2 * small.project(points)[0] + 0.5, atol=1e-9)


@pytest.mark.parametrize("distance", [0.5, 1.0, 3.0, 6.0, 10.0])
def test_both_ends_of_the_pattern_are_in_the_picture(distance):
    found = sheet("helix_640x480")
    nearest = [[distance - found.helix.radius_m, 0.0, height] for height in (0.18, 0.48)]
    assert found.camera.project(nearest)[1].all()


@pytest.mark.parametrize(("distance", "whole"), [(0.5, False), (0.6, True), (10.0, True)])
def test_a_facing_tag_is_in_the_picture_from_60_cm_on(distance, whole):
    found = sheet("tag_cube_640x480")
    front = found.tag_cube.corners()[0] * [-1, -1, 1] + [distance, 0, 0]  # a robot that looks back at the observer
    assert found.camera.project(front)[1].all() == whole


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_does_not_see_itself(name):
    found = sheet(name)
    own = np.concatenate([solid.extent() for solid in found.target.solids if solid not in found.target.body[-2:]])
    assert not found.camera.project(own)[1].any()  # without mast and housing, which hold the camera


@pytest.mark.parametrize("name", NAMES)
def test_written_and_read_again(name, tmp_path):
    path = tmp_path / "sheet.toml"
    path.write_text(dump_data_sheet(sheet(name)), encoding="utf-8")
    assert load_data_sheet(path) == sheet(name)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("fx_px = 480.0", "fx_px = -480.0", "camera.lens.fx_px: more than zero"),
        ("fx_px = 480.0\n", "", r"\[camera.lens\] no key 'fx_px'"),
        ("width_px = 640", "width_px = 640.5", "camera.lens.width_px: expected integer, got 640.5"),
        ("k1 = -0.10", "k1 = -2.0", "camera.lens.k1: "),
        ("k1 = -0.10", "k1 = nan", "camera.lens.k1: expected finite number"),
        ("k1 = -0.10", "k9 = -0.10", r"\[camera.lens\] unknown key 'k9'"),
        ("height_m = 0.60", "height_m = 0", "camera.mount.height_m: more than zero"),
        ("height_m = 0.60\n", "", r"\[camera.mount\] no key 'height_m'"),
        ("top_m = 0.48", "top_m = 0.10", "helix.top_m: more than bottom_m"),
        ("pitch_m = 0.20", 'pitch_m = "0.20"', "helix.pitch_m: expected number"),
        ("stripes = 1", "stripes = 0", "helix.stripes: an integer from 1"),
        ("reflectance = 0.22", "reflectance = 2", "reflectance: 0 to 1 expected"),
        ("# Heights", "[tag_cube]\n# Heights", r"one table \[helix\] or \[tag_cube\] expected"),
        ("[camera.mount]", "[camera.mounting]", r"\[camera\] unknown key 'mounting'"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, old, new, words):
    assert old in HELIX
    path = tmp_path / "sheet.toml"
    path.write_text(HELIX.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(BadInput, match=words) as error:
        load_data_sheet(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_a_sheet_without_a_target_or_a_file(tmp_path):
    path = tmp_path / "sheet.toml"
    path.write_text(HELIX[: HELIX.index("# Heights")], encoding="utf-8")
    with pytest.raises(BadInput, match=r"one table \[helix\] or \[tag_cube\] expected"):
        load_data_sheet(path)
    with pytest.raises(BadInput, match="absent.toml"):
        load_data_sheet(tmp_path / "absent.toml")
