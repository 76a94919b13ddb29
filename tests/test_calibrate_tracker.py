"""scripts/calibrate_tracker.py as a black box: pictures in, a data sheet out; bad input is one line and exit code 2."""

import csv
import re
from math import pi
from pathlib import Path

import calibrate_tracker
import cv2
import numpy as np
import pytest
from script_calls import exit_code, require_refused
from shapely import Polygon, union_all
from shapely.geometry import Point

from coopslam.se2 import Pose2
from tracker.background import Background
from tracker.calibration_parameters import values_of, with_values
from tracker.data_sheet import load_data_sheet
from tracker.render import RenderSettings, render
from tracker.sheets import load_sheet

NAMES = ("height", "tilt", "radius", "fx", "fy")
HELIX = load_sheet("helix_640x480")
TRUE = with_values(HELIX, NAMES, values_of(HELIX, NAMES) + [0.008, np.radians(0.8), 0.002, 4.8, 4.8])
DISTANCES_M = (0.8, 1.2, 1.8, 2.5, 3.5, 5.0)
COLUMNS = ("file", "distance_m", "bearing_deg", "heading_deg")


def call(*arguments) -> int:
    return exit_code(calibrate_tracker.main, *arguments)


def write_rows(folder: Path, rows, columns=COLUMNS) -> None:
    with (folder / "distances.csv").open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream)
        table.writerow(columns)
        table.writerows(rows)


@pytest.fixture(scope="module")
def rows_and_images(tmp_path_factory):
    folder, rng, rows = tmp_path_factory.mktemp("images"), np.random.default_rng(2), []
    for k, distance in enumerate(DISTANCES_M):
        bearing, heading = rng.uniform(-0.4, 0.4), rng.uniform(-pi, pi)
        pose = Pose2(distance * np.cos(bearing), distance * np.sin(bearing), heading)
        image = render(TRUE.camera, TRUE.target, pose, RenderSettings(background=Background("clutter")), rng)
        cv2.imwrite(str(folder / f"{k}.png"), image)
        told = (np.degrees(bearing), np.degrees(heading)) if k == 2 else ("", "")
        rows.append((f"{k}.png", f"{distance:.3f}", *told))
    write_rows(folder, rows)
    return rows, folder


def test_a_sheet_in_and_a_better_one_out(rows_and_images, tmp_path, monkeypatch, capsys):
    _, folder = rows_and_images
    out = tmp_path / "calibrated.toml"
    options = ("--sheet", "helix_640x480", "--out", out, "--figures", tmp_path / "figures")
    assert call(folder, *options, "--estimate", ",".join(NAMES)) == 0
    found, said = load_data_sheet(out), capsys.readouterr().out
    error, before = values_of(found, NAMES) - values_of(TRUE, NAMES), values_of(HELIX, NAMES) - values_of(TRUE, NAMES)
    assert (np.abs(error) < 0.3 * np.abs(before)).all()
    sigmas = np.array([found.calibration.sigmas[name] for name in NAMES])
    assert (np.abs(error) < 4 * sigmas).all()
    assert found.calibration.pictures == len(DISTANCES_M)
    assert "root mean square" in said and "5.png" in said
    assert (tmp_path / "figures" / "calibration.png").stat().st_size > 30_000
    # calibrated once more from there, height and tilt stay; the note is of the new pictures
    monkeypatch.setattr(calibrate_tracker, "HELD_OUT_AT_MOST", 0)
    assert call(folder, "--sheet", out, "--out", out, "--estimate", "height,tilt") == 0
    again = load_data_sheet(out)
    assert list(again.calibration.sigmas) == ["height", "tilt"]
    assert np.abs(values_of(again, ("tilt",)) - values_of(found, ("tilt",)))[0] < 3 * sigmas[1]
    assert "something is wrong" not in said + capsys.readouterr().out


def test_what_the_parameters_cannot_explain_is_said(rows_and_images, tmp_path, monkeypatch, capsys):
    """Neither heights nor tilt explain a target that is larger than the sheet says, nor the focal length."""
    monkeypatch.setattr(calibrate_tracker, "HELD_OUT_AT_MOST", 0)
    _, folder = rows_and_images
    options = ("--sheet", "helix_640x480", "--out", tmp_path / "c.toml", "--estimate", "height,tilt,bottom,top")
    assert call(folder, *options) == 0
    said = capsys.readouterr().out
    assert "root mean square" not in said  # pictures are held out when there are few, or when it is asked for
    assert "something is wrong that is not among height, tilt, bottom, top" in said
    assert "height and bottom and top: changed together they leave these pictures as they are" in said


def test_the_pattern_on_paper(tmp_path):
    """What is dark on the unrolled sheet is dark on the cylinder."""
    path = tmp_path / "target.svg"
    assert call("--sheet", "helix_640x480", "--print-target", path) == 0
    text, helix = path.read_text(encoding="utf-8"), HELIX.helix
    shapes = [
        Polygon([tuple(map(float, pair.split(","))) for pair in points.split()])
        for points in re.findall(r'<polygon points="([^"]+)"', text)
    ]
    rectangles = re.findall(r'<rect x="([\d.-]+)" y="([\d.-]+)" width="([\d.]+)" height="([\d.]+)"', text)
    for x, y, width, height in (map(float, numbers) for numbers in rectangles):
        shapes.append(Polygon([(x, y), (x + width, y), (x + width, y + height), (x, y + height)]))
    dark = union_all([shape.buffer(0) for shape in shapes])
    rng = np.random.default_rng(0)
    azimuths, heights = rng.uniform(-pi, pi, 300), rng.uniform(0.12, 0.51, 300)
    for azimuth, height, expected in zip(azimuths, heights, helix.is_dark(azimuths, heights), strict=True):
        point = Point((azimuth + pi) * 100.0, (0.51 - height) * 1000)  # radius 100 mm; from the upper collar's end down
        if dark.boundary.distance(point) > 0.05:
            assert dark.contains(point) == expected
    assert call("--sheet", "tag_cube_640x480", "--print-target", tmp_path / "cube.svg") == 0
    assert (tmp_path / "cube.svg").read_text(encoding="utf-8").count("<rect") > 4 * 28  # the black borders alone


def refused(capsys, *arguments) -> str:
    return require_refused(calibrate_tracker.main, capsys, *arguments)


def test_bad_input_is_one_line(rows_and_images, tmp_path, capsys):
    rows, images = rows_and_images
    out = ("--sheet", "helix_640x480", "--out", tmp_path / "c.toml")
    folder = tmp_path / "images"
    folder.mkdir()
    for path in images.glob("*.png"):
        (folder / path.name).symlink_to(path)

    def changed(rows, columns=COLUMNS) -> str:
        write_rows(folder, rows, columns)
        return refused(capsys, folder, *out)

    assert "distances.csv: cannot be read" in refused(capsys, folder, *out)
    assert "expected a folder" in refused(capsys, tmp_path / "nowhere", *out)
    assert "distances.csv:1: no column distance_m" in changed([("0.png", 1)], ("file", "distance"))
    assert "distances.csv:3: distance_m: more than zero" in changed([rows[0], ("1.png", -1.2, "", ""), *rows[2:]])
    assert "distances.csv:2: distance_m: a number expected, got 'far'" in changed([("0.png", "far", "", "")])
    assert "distances.csv:2: bearing_deg: -360 to 360" in changed([("0.png", 0.8, 400, ""), *rows[1:]])
    assert "distances.csv:2: file: '9.png' is not in" in changed([("9.png", 1, "", ""), *rows])
    assert "not there twice" in changed([*rows, rows[0]])
    assert "2 pictures; at least 3" in changed(rows[:2])
    (folder / "notes.png").write_text("no picture", encoding="utf-8")
    assert "notes.png: cannot be read as a picture" in changed([("notes.png", 1, "", ""), *rows])
    cv2.imwrite(str(folder / "small.png"), np.zeros((48, 64), np.uint8))
    assert "small.png: image: a picture of uint8 (480, 640)" in changed([("small.png", 1, "", ""), *rows])
    cv2.imwrite(str(folder / "blank.png"), np.full((480, 640), 99, np.uint8))
    (folder / "blank2.png").symlink_to(folder / "blank.png")
    assert "found in 1 of 3" in changed([rows[0], ("blank.png", 1, "", ""), ("blank2.png", 1, "", "")])
    write_rows(folder, rows)
    assert "'hue'" in refused(capsys, folder, *out, "--estimate", "hue")
    assert "distance_sigma" in refused(capsys, folder, *out, "--distance-sigma", 0)
    assert "no data sheet" in refused(capsys, folder, "--sheet", "hexagon", "--out", tmp_path / "c.toml")
    assert "IMAGES and --out expected" in refused(capsys, folder, "--sheet", "helix_640x480")
    (tmp_path / "other.toml").write_text("a = 1\n", encoding="utf-8")
    assert "something else" in refused(capsys, folder, "--sheet", "helix_640x480", "--out", tmp_path / "other.toml")
    assert "ends in .svg" in refused(capsys, "--sheet", "helix_640x480", "--print-target", tmp_path / "t.txt")
    assert not (tmp_path / "c.toml").exists()
