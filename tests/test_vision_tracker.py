"""The tracker as a camera in simulated runs: pictures against poses and cv2, and whole explorations."""

from dataclasses import replace
from math import inf, pi
from pathlib import Path

import cv2
import numpy as np
import pytest
from explore_script import call, summary_of
from scipy.stats import binom, chi2
from script_calls import load, require_one_line

from coopslam.errors import BadInput
from coopslam.io.run_log import read_run_log
from coopslam.records import BearingRangeFix, PosePrior, RelativePoseFix
from coopslam.se2 import Pose2, position, wrap, xytheta
from sim.noise import TYPICAL, TrackerLimits
from sim.sensors import Circumstances
from sim.vision import Eye, VisionSensors, motion_blurred
from sim.vision_settings import VisionSettings, limits_m
from tracker.background import Background
from tracker.detector import Detection
from tracker.sensor import Sensor
from tracker.sheets import load_sheet

HOUSE = Path(__file__).parents[2] / "shared" / "data" / "worlds" / "house_0000.geojson"
SHEETS = {"helix": load_sheet("helix_640x480"), "apriltag": load_sheet("tag_cube_640x480")}
CLEAN = VisionSettings(background=Background("plain"), sensor=Sensor(electrons_per_level=inf, vignetting=0.0))


def eye(tracker="apriltag", settings=None, seed=0) -> Eye:
    return Eye(SHEETS[tracker], settings or VisionSettings(), np.random.default_rng(seed))


def sensors_with(looking) -> VisionSensors:
    return VisionSensors(TYPICAL, TYPICAL, np.random.default_rng(0), tracker_limits=TrackerLimits(9.0), eye=looking)


class Scripted:
    """An eye that sees what it is told: True is the truth with an error, False nothing."""

    def __init__(self, looks, error=None):
        self.looks, self.error, self.asked = list(looks), error or Pose2(), []

    def look(self, T_observer_target: Pose2, seen) -> Detection | None:
        self.asked.append(T_observer_target)
        shown = self.error * T_observer_target
        return Detection(shown, 1e-4 * np.eye(3), True) if self.looks.pop(0) else None


@pytest.mark.parametrize("tracker", SHEETS)
def test_a_look_in_any_direction_is_the_truth_within_its_covariance(tracker):
    """Half of the squared distances are below the median of chi-square: two-sided binomial band, one in ten thousand.

    Of pictures in all directions, so that a pose or a covariance in wrong axes would show. How heavy the tails of a
    detector's errors are is a matter of its own tests.
    """
    looking, rng, squares = eye(tracker, seed=4), np.random.default_rng(5), []
    for bearing in np.linspace(-pi, pi, 36, endpoint=False) + 0.01:
        range_m = rng.uniform(1.5, 5.0)
        true = Pose2(range_m * np.cos(bearing), range_m * np.sin(bearing), rng.uniform(-pi, pi))
        found = looking.look(true, Circumstances(rng.uniform(-pi, pi), rng.uniform(-0.5, 0.5, 2)))
        if found is not None and found.heading_known:
            error = xytheta(found.T_observer_target) - xytheta(true)
            error[2] = wrap(error[2])
            squares.append(error @ np.linalg.solve(found.cov_observer, error))
    assert len(squares) >= 30
    low, high = binom.ppf([5e-5, 1 - 5e-5], len(squares), 0.5)
    assert low <= np.count_nonzero(np.array(squares) < chi2.median(3)) <= high


def test_light_comes_from_one_side_of_the_world():
    """An observer that turns by one direction of its camera sees the same picture in the next one."""
    looking, step = eye(settings=CLEAN), VisionSettings().pan_step_rad
    view = Pose2(2.0, 0.1, 0.4)
    first = looking.picture(view, 2 * step, Circumstances(0.7))
    same = looking.picture(view, step, Circumstances(0.7 + step))
    other = looking.picture(view, 2 * step, Circumstances(0.7 + pi / 2))
    assert (first == same).all()
    assert np.abs(first.astype(int) - other).max() > 10


def test_pictures_repeat_with_the_seed():
    pictures = [eye(seed=seed).picture(Pose2(3.0, 0.0, 1.0), 0.0, Circumstances()) for seed in (1, 1, 2)]
    assert (pictures[0] == pictures[1]).all() and (pictures[0] != pictures[2]).any()


def test_motion_blur_is_the_way_of_the_target_in_the_picture():
    """Pixels of its middle at both ends of the exposure, projected by cv2."""
    camera, cube = SHEETS["apriltag"].camera, SHEETS["apriltag"].tag_cube
    pose, way = Pose2(3.0, 0.4, 1.0), np.array([0.02, -0.03])
    R, t = camera.mount.R_body_camera, camera.mount.position_body
    ends = np.array([[3.0, 0.4, 0.33], [3.02, 0.37, 0.33]])  # the cube's middle: 0.18 m + 0.30 m / 2
    pixels = cv2.projectPoints(ends, cv2.Rodrigues(R.T)[0], -R.T @ t, camera.lens.matrix, camera.lens.distortion)[0]
    line = np.diff(pixels.reshape(2, 2), axis=0)[0]
    blurred = motion_blurred(Sensor(), camera, cube, pose, way)
    assert blurred.motion_px == pytest.approx(np.hypot(*line), rel=1e-6)
    assert blurred.motion_rad == pytest.approx(np.arctan2(line[1], line[0]), abs=1e-6)
    assert replace(blurred, motion_px=0.0, motion_rad=0.0) == Sensor()


def test_limits_of_camera_and_target():
    """The pattern is 0.30 m high, the tag 0.24 m, the focal length 480 pixels."""
    settings = VisionSettings(smallest_px=20.0)
    nearest, farthest = limits_m(SHEETS["helix"], settings)
    assert farthest == pytest.approx(480 * 0.30 / 20)
    assert limits_m(SHEETS["apriltag"], settings)[1] == pytest.approx(480 * 0.24 / 20)
    camera, height = SHEETS["helix"].camera, 0.60 - 0.12  # down to the lower end of its lower collar
    steepest = camera.mount.tilt_rad + np.arctan(240 / 480)  # the picture's lower border, without distortion
    assert nearest == pytest.approx(0.10 + height / np.tan(steepest), abs=0.05)
    with pytest.raises(BadInput, match="pan_step_rad"):
        limits_m(SHEETS["helix"], replace(settings, pan_step_rad=2.0))


def test_a_bearing_watched_for_errs_as_the_picture_does():
    """Turned by 0.02 rad about the observer; two pictures in vain."""
    looking = Scripted([False, False, True], Pose2(0.0, 0.0, 0.02))
    sensors = sensors_with(looking)
    assert sensors.bearing_error(Pose2(-3.0, 0.01, 1.0), Circumstances()) == pytest.approx(0.02)
    assert sensors.tally["pictures"] == 3 and sensors.tally["detections"] == 1
    assert sensors.bearing_error(None) == 0.0 and sensors.tally["pictures"] == 3
    assert sensors_with(Scripted([False] * 1000)).bearing_error(Pose2(3.0, 0.0, 1.0)) is None


def test_nearer_than_the_camera_sees_the_last_bearing_counts():
    looking = Scripted([True], Pose2(0.0, 0.0, 0.01))
    sensors = replace(sensors_with(looking), tracker_limits=TrackerLimits(9.0, min_range_m=0.6))
    assert sensors.bearing_error(Pose2(0.0, 0.1, 1.0)) == pytest.approx(0.01)
    np.testing.assert_allclose(position(looking.asked[0]), [0.0, 0.6], atol=1e-12)
    assert sensors.relative_pose(0.0, "a", "b", Pose2(0.0, 0.1, 1.0)) is None and len(looking.asked) == 1


def test_contact_seems_lost_after_as_many_pictures_in_vain():
    sensors = sensors_with(None)
    looks = iter([False] * 4 + [True])
    assert not sensors.contact_seems_lost(5, lambda: next(looks))
    looks = iter([False] * 5)
    assert sensors.contact_seems_lost(5, lambda: next(looks))
    assert list(looks) == []


# ---- whole runs ----


def require_complete(out: Path, tracker: str) -> dict:
    summary = summary_of(out)
    assert summary["outcome"] == "complete"
    assert summary["triangles"] == summary["triangles_expected"]
    assert summary["covered_fraction"] == pytest.approx(1.0, abs=1e-9)
    said = summary["tracker"]
    assert (said["name"], said["pictures"] >= said["looks"]) == (tracker, True)
    _, records = read_run_log(out / "log.mcap")
    fixes = [record for record in records if isinstance(record, RelativePoseFix | BearingRangeFix)]
    with_heading = sum(isinstance(fix, RelativePoseFix) for fix in fixes)
    assert (said["fixes"], said["with_heading"]) == (len(fixes), with_heading)
    assert said["detections"] >= len(fixes) > 0.8 * said["looks"]
    return summary


def test_a_team_with_eyes_explores(tmp_path):
    """All of the paper's world, and better than odometry alone by far."""
    assert call("--tracker", "helix", "--figures", "none", "--out", tmp_path / "run") == 0
    summary = require_complete(tmp_path / "run", "helix")
    assert summary["vertex_rmse_m"] < 0.05
    errors = summary["estimators"]
    assert errors["batch"]["ate_rmse_m"] < 0.2 * errors["dead-reckoning"]["ate_rmse_m"]
    assert summary["tracker"]["range_error_rms_m"] < 0.1


@pytest.mark.slow
@pytest.mark.skipif(not HOUSE.is_file(), reason="needs a world that is not in the repository")
def test_a_team_with_eyes_explores_a_house(tmp_path):
    assert call("--world", HOUSE, "--tracker", "helix", "--figures", "none", "--out", tmp_path / "run") == 0
    assert require_complete(tmp_path / "run", "helix")["vertex_rmse_m"] < 0.1


def test_a_run_repeats_and_so_does_its_config(tmp_path):
    """Set up nearer than the camera sees: then people say how the second robot stands."""
    first, again = tmp_path / "first", tmp_path / "again"
    arguments = ["--figures", "none", "--max-moves", 3]
    assert call("--tracker", "apriltag", *arguments, "--out", first) == 3
    assert call("--config", first / "config.toml", *arguments, "--out", again) == 3
    one, other = summary_of(first), summary_of(again)
    assert one == other and one["tracker"]["pictures"] > 10
    _, records = read_run_log(first / "log.mcap")
    assert [record.robot for record in records if isinstance(record, PosePrior)] == ["robot1"]
    assert call("--config", first / "config.toml", "--tracker", "statistical", *arguments, "--out", tmp_path / "s") == 3
    assert "pictures" not in load(tmp_path / "s" / "summary.json")["tracker"]
    _, records = read_run_log(tmp_path / "s" / "log.mcap")
    assert not any(isinstance(record, PosePrior) for record in records)


def test_robots_too_far_apart_are_no_riddle(tmp_path, capsys):
    (tmp_path / "c.toml").write_text("[vision]\nsmallest_px = 60.0", encoding="utf-8")  # 480 * 0.24 / 60 = 1.92 m
    out = tmp_path / "run"
    assert call("--config", tmp_path / "c.toml", "--tracker", "apriltag", "--figures", "none", "--out", out) == 3
    require_one_line(capsys.readouterr().err, "contact lost because of distance", "reaches 1.92 m")
    assert summary_of(out)["outcome"] == "stuck"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--tracker", "helix", "--tracker-preset", "retroreflector"], ["tracker_preset", "retroreflector"]),
        (["--tracker", "helix", "--tracker-sheet", "tag_cube_640x480"], ["--tracker-sheet", "[helix] expected"]),
        (["--tracker", "helix", "--tracker-sheet", "nowhere.toml"], ["--tracker-sheet", "nowhere.toml"]),
        (["--tracker-sheet", "helix_640x480"], ["--tracker-sheet", "only with --tracker"]),
        (["--tracker", "sonar"], ["--tracker", "sonar"]),
    ],
)
def test_what_cannot_be_is_said_in_one_line(arguments, words, tmp_path, capsys):
    assert call(*arguments, "--out", tmp_path / "run") == 2
    require_one_line(capsys.readouterr().err, *words)
    assert not (tmp_path / "run").exists()
