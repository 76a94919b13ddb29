"""The tracker's benchmarks: their statistics against closed forms and scipy, their pictures, and small runs."""

import csv
import json
import re
import sys
import time
from dataclasses import replace
from math import nan, pi
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import binomtest, chi2

SCRIPTS = Path(__file__).parents[1] / "scripts"
sys.path[:0] = [str(SCRIPTS), str(SCRIPTS / "benchmarks")]

import tracker_accuracy  # noqa: E402
import tracker_false_alarms  # noqa: E402
import tracker_time  # noqa: E402
from _accuracy import Job, Sample, sampled  # noqa: E402
from _accuracy_table import line_of, over_bound, table_of  # noqa: E402
from _aruco_pose import ArucoPose  # noqa: E402
from _cli import run  # noqa: E402
from _empty_scenes import KINDS, empty_picture  # noqa: E402
from _files import without_nan  # noqa: E402
from _scenes import random_scene, sheet_of  # noqa: E402

from coopslam.se2 import Pose2, wrap, xytheta  # noqa: E402
from tracker.detector import Detection  # noqa: E402
from tracker.render import RenderSettings, render, target_box  # noqa: E402
from tracker.sensor import Sensor  # noqa: E402

SAMPLE = Sample("helix", "640x480", False, 2.0, 0, 2.0, 0.1, 1.0, "plain", True, True)


@pytest.mark.parametrize("times", [1.0, 3.0])
def test_ratios_to_the_bound_are_those_of_gaussian_errors(times):
    """20 000 errors of a sigma that is so many times the bound: both figures are known to 1 %; a few wild ones change
    the median by as much as they are, and the trimmed rms not much more."""
    rng = np.random.default_rng(0)
    bound = rng.uniform(1e-4, 1e-2, 20000)
    error = times * bound * rng.standard_normal(20000)
    robust, rms = over_bound(error, bound)
    assert robust == pytest.approx(times, rel=0.03) and rms == pytest.approx(times, rel=0.03)
    error[:200] *= 1e6
    assert over_bound(error, bound)[1] == pytest.approx(times, rel=0.05)
    assert np.isnan(over_bound(np.array([]), np.array([]))).all()


def test_a_line_by_hand():
    """Three of four seen, one of them without heading; one heading 6 sigmas off."""
    samples = [
        replace(SAMPLE, range_error_m=0.02, bearing_error_rad=0.01, heading_error_rad=0.06, heading_sigma_rad=0.01,
                nees=36.0, dof=3),
        replace(SAMPLE, range_error_m=-0.04, bearing_error_rad=-0.03, heading_error_rad=-0.02, heading_sigma_rad=0.01,
                nees=4.0, dof=3),
        replace(SAMPLE, heading_known=False, range_error_m=0.06, bearing_error_rad=0.02, nees=1.0, dof=2),
        replace(SAMPLE, detected=False, heading_known=False),
    ]  # fmt: skip
    line = line_of(samples)
    assert (line["n"], line["detected"], line["heading_known"]) == (4, 0.75, 0.5)
    assert line["range_error_percent_median"] == pytest.approx(2.0)
    assert line["bearing_error_deg_median"] == pytest.approx(np.degrees(0.02))
    assert line["heading_error_deg_median"] == pytest.approx(np.degrees(0.04))
    assert line["nees_per_dof"] == pytest.approx(41 / 8)
    assert (line["nees_low"], line["nees_high"]) == pytest.approx(tuple(chi2.interval(0.95, 8) / np.array(8.0)))
    assert (line["headings_wrong"], line["headings_judged"]) == (1, 2)
    assert np.isnan(line["range_over_bound"])
    assert "1/2" in table_of([{"range": 2.0} | line])


def test_a_line_of_nothing_is_all_dashes():
    line = line_of([replace(SAMPLE, detected=False, heading_known=False)])
    assert line["detected"] == 0 and np.isnan(line["nees_per_dof"]) and np.isnan(line["range_error_percent_median"])
    assert "nan" not in table_of([{"range": 2.0} | line])


@pytest.mark.parametrize(("events", "trials"), [(0, 2000), (3, 1000), (5, 5)])
def test_the_rate_that_false_alarms_may_have(events, trials):
    expected = binomtest(events, trials, alternative="less").proportion_ci(0.95, method="exact").high
    assert tracker_false_alarms.upper_limit(events, trials) == pytest.approx(expected)


def test_helix_and_cube_get_the_same_scenes():
    scenes = [random_scene(sheet_of(t, "640x480"), 3.0, False, np.random.default_rng(4)) for t in ("helix", "tag_cube")]
    assert scenes[0].T_observer_target.equals(scenes[1].T_observer_target, 0)
    assert scenes[0].settings == scenes[1].settings
    np.testing.assert_array_equal(scenes[0].background, scenes[1].background)


def test_a_bar_hides_a_tenth_to_four_tenths_of_the_target():
    sheet = sheet_of("helix", "640x480")
    for seed in range(40):
        scene = random_scene(sheet, 3.0, True, np.random.default_rng(seed))
        (bar,) = scene.settings.occluders
        rows, columns = target_box(sheet.camera, sheet.target.solids[:1], scene.T_observer_target)
        v, u = np.mgrid[rows, columns] + 0.5
        across = (u > bar.left_px) & (u < bar.left_px + bar.width_px)
        down = (v > bar.upper_px) & (v < bar.upper_px + bar.height_px)
        assert 0.07 < np.mean(across & down) < 0.43  # 30 to 100 pixels: counting them errs by some hundredths


def test_the_target_is_in_the_picture_with_all_its_width():
    """Of the marked solid, from 1 m on; nearer, the cube is wider than that."""
    for target in ("helix", "tag_cube"):
        sheet = sheet_of(target, "640x480")
        for seed in range(100):
            scene = random_scene(sheet, 1.0, False, np.random.default_rng(seed))
            _, columns = target_box(sheet.camera, sheet.target.solids[:1], scene.T_observer_target)
            assert columns.start > 0 and columns.stop < 640


def test_the_pose_of_the_library_is_that_of_the_cube():
    """Two faces seen aslant from 1 m, without noise: the library's corners are good to a tenth of a pixel."""
    sheet = sheet_of("tag_cube", "1280x960")
    pose = Pose2(1.2, 0.2, 2.3)
    sensor = Sensor(electrons_per_level=np.inf, vignetting=0.0)
    image = render(sheet.camera, sheet.target, pose, RenderSettings(sensor=sensor), np.random.default_rng(0))
    error = xytheta(ArucoPose(sheet).pose(image)) - xytheta(pose)
    assert np.abs([*error[:2], wrap(error[2])]).max() < 0.01
    assert ArucoPose(sheet).pose(np.full((960, 1280), 90, np.uint8)) is None


def test_samples_compare_with_the_truth():
    """A picture of the cube without an occluder: the errors are those of the poses, the bound is below them."""
    own, library = sampled(Job("tag_cube", "640x480", 3, 0, 0, False, True))
    assert own.method == "tag_cube" and library.method == "aruco"
    assert own.range_m == pytest.approx(3.0, rel=0.05)
    assert own.detected and own.heading_known and own.dof == 3 and library.dof == 0
    assert abs(own.range_error_m) < 0.01 < 0.1 * library.range_m
    assert 0 < own.range_bound_m < 1e-3 and own.range_bound_m == library.range_bound_m
    assert sampled(Job("tag_cube", "640x480", 3, 0, 0, False, False))[0].range_error_m == own.range_error_m


def test_a_small_run(tmp_path, capsys):
    arguments = ["--targets", "tag_cube", "--sizes", "640x480", "--poses", "8", "--bounds", "0", "--processes", "1"]
    assert run(tracker_accuracy.main, [*arguments, "--seed", "1", "--out", str(tmp_path)]) == 0
    with (tmp_path / "samples.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 16 and {row["method"] for row in rows} == {"tag_cube", "aruco"}
    own, library = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["tables"]
    assert [line["n"] for line in own["lines"]] == [1] * 8 and own["all"]["n"] == library["all"]["n"] == 8
    errors = [
        100 * abs(float(row["range_error_m"])) / float(row["range_m"])
        for row in rows
        if row["method"] == "tag_cube" and row["detected"] == "True"
    ]
    assert own["all"]["range_error_percent_median"] == pytest.approx(np.median(errors))
    assert own["all"]["range_bound_percent"] is None
    picture = cv2.imread(str(tmp_path / "accuracy.png"))
    assert picture.shape[0] > 500 and np.ptp(picture) > 100
    assert "tag_cube at 640x480" in capsys.readouterr().out


@pytest.mark.parametrize("kind", KINDS)
def test_empty_pictures_have_something_to_look_at(kind):
    camera = sheet_of("helix", "640x480").camera
    one, same, other = (empty_picture(kind, camera, np.random.default_rng(seed)) for seed in (0, 0, 1))
    assert one.shape == (480, 640) and one.dtype == np.uint8
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()
    assert one.std() > 1.0


class Dreamer:
    """A detector that sees a robot everywhere."""

    def detect(self, image):
        return Detection(Pose2(2.0, 0.0, pi / 2), np.eye(3), True, (np.array([[10.0, 10.0], [60.0, 60.0]]),))


class Blind:
    def detect(self, image):
        return None


def test_false_alarms_are_counted_and_drawn(tmp_path, capsys, monkeypatch):
    camera = sheet_of("helix", "640x480").camera
    monkeypatch.setattr(
        tracker_false_alarms, "_detectors", lambda size: (camera, {"helix": Dreamer(), "tag_cube": Blind()})
    )
    (tmp_path / "false_helix_old.png").write_bytes(b"")
    arguments = ["--pictures", str(len(KINDS)), "--processes", "1", "--out", str(tmp_path)]
    assert run(tracker_false_alarms.main, arguments) == 0
    printed = capsys.readouterr().out
    assert re.search(rf"^all +{len(KINDS)} +{len(KINDS)} +0$", printed, re.MULTILINE)
    drawn = sorted(tmp_path.glob("false_*.png"))
    assert len(drawn) == len(KINDS) and not any(path.stem.endswith("old") for path in drawn)
    assert (cv2.imread(str(drawn[0]))[..., 2] == 255).any()


def test_times_are_those_of_the_methods():
    """A loop of 4 ms of process time beside a sleep, which uses none."""

    def busy(image):
        until = time.process_time() + 4e-3
        while time.process_time() < until:
            pass

    methods = {"busy": busy, "asleep": lambda image: time.sleep(4e-3)}
    spent = tracker_time.timed(methods, [np.zeros((2, 2), np.uint8)] * 3, 5, np.random.default_rng(0))
    assert ((spent[:, 0] >= 4.0) & (spent[:, 0] < 8.0)).all()
    assert (spent[:, 1] < 1.0).all()


def test_a_small_timing(capsys):
    assert run(tracker_time.main, ["--pictures", "1", "--repetitions", "1"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"^neither +1 .*\( 1\.00\)", printed, re.MULTILINE)
    assert all(name in printed for name in ("aruco none", "helix", "tag_cube"))


@pytest.mark.parametrize("script", [tracker_accuracy, tracker_false_alarms, tracker_time])
def test_bad_arguments_are_one_line(script, capsys):
    for arguments in (
        ["--seed", "x"],
        ["--seed", "-1"],
        ["--poses" if script is tracker_accuracy else "--pictures", "0"],
    ):
        with pytest.raises(SystemExit) as exit:
            script.main(arguments)
        assert exit.value.code == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_an_unknown_target_is_said(capsys):
    with pytest.raises(SystemExit):
        tracker_accuracy.main(["--targets", "helix,owl"])
    assert "--targets: helix, tag_cube expected" in capsys.readouterr().err


@pytest.mark.parametrize("script", [tracker_accuracy, tracker_false_alarms])
def test_a_file_in_the_place_of_the_directory_is_one_line(script, tmp_path, capsys):
    (tmp_path / "taken").write_text("kept")
    assert run(script.main, ["--out", str(tmp_path / "taken"), "--processes", "1"]) != 0
    assert re.fullmatch(r".*taken: a directory expected to write to \(.*\)\n", capsys.readouterr().err)
    assert (tmp_path / "taken").read_text() == "kept"


def test_nan_is_not_json():
    assert without_nan({"a": [nan, 1.0], "b": nan}) == {"a": [None, 1.0], "b": None}
