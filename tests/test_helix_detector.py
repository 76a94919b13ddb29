"""The helix detector against the poses that pictures were rendered from, and against pictures without the helix."""

from dataclasses import replace
from math import atan2, hypot

import numpy as np
import pytest
from scipy.stats import chi2
from tracker_scenes import CLEAN, SHEETS, error_of, full_scene, pictures, square_of

from coopslam.errors import BadInput
from coopslam.records import BearingRangeFix
from coopslam.se2 import Pose2, rotation, wrap, xytheta
from tracker.background import Background
from tracker.data_sheet import load_data_sheet
from tracker.helix_detector import Belief, HelixDetector, HelixDetectorSettings
from tracker.helix_search import HelixSearch
from tracker.pyramid import pyramid_of
from tracker.render import Occluder, RenderSettings, render, render_background, target_box

SHEET = load_data_sheet(SHEETS / "helix_640x480.toml")
CAMERA, HELIX = SHEET.camera, SHEET.helix
DETECTOR = HelixDetector(CAMERA, HELIX)


def clean_picture(pose: Pose2, helix=HELIX, camera=CAMERA, settings=CLEAN) -> np.ndarray:
    return render(camera, helix, pose, settings, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("range_m", "range_percent", "heading_deg"), [(0.5, 0.05, 0.3), (1.5, 0.05, 0.3), (3.0, 0.1, 0.5), (6.0, 0.2, 1.0)]
)
def test_range_bearing_and_heading(range_m, range_percent, heading_deg):
    """Medians of the demand (1 % at 3 m, 2.5 % at 6 m, 0.1 and 2 degrees) with much to spare, and an honest NEES."""
    squares, errors, missed = [], [], 0
    for pose, picture in pictures(SHEET, range_m, 0.35 if range_m > 1 else 0.1, 30):
        found = DETECTOR.detect(picture)
        if found is None:
            missed += 1
            continue
        assert found.heading_known
        true, seen = xytheta(pose)[:2], xytheta(found.T_observer_target)[:2]
        bearing = atan2(seen[1], seen[0]) - atan2(true[1], true[0])
        errors.append((hypot(*seen) / range_m - 1, bearing, error_of(found, pose)[2]))
        squares.append(square_of(found, pose))
    medians = np.median(np.abs(errors), axis=0)
    assert (medians < [range_percent / 100, np.radians(0.02), np.radians(heading_deg)]).all()
    assert missed <= 1
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(squares))
    assert 0.6 * low < np.sum(squares) < 1.5 * high  # sandwiches of a few dozen clusters are known to some 40 %


@pytest.mark.parametrize("sheet", ["helix_640x480.toml", "helix_1280x960.toml"])
def test_without_noise_the_pose_is_exact_to_a_thousandth(sheet):
    """What is left is the difference between the blurred prediction and the renderer, which are independent."""
    sheet = load_data_sheet(SHEETS / sheet)
    detector, pose = HelixDetector(sheet.camera, sheet.helix), Pose2(2.0, -0.5, 2.0)
    found = detector.detect(clean_picture(pose, sheet.helix, sheet.camera))
    assert found.heading_known
    assert np.abs(error_of(found, pose)[:2]).max() < 1e-3 and abs(error_of(found, pose)[2]) < 5e-3


def test_the_reference_point_of_a_robot_whose_helix_stands_before_it():
    """And of an observer with its camera turned; the covariance belongs to the reference point as well."""
    helix, camera = replace(HELIX, forward_m=0.2, body=()), CAMERA.panned(0.8)
    pose = Pose2(1.8, 2.0, -1.0)
    found = HelixDetector(camera, helix).detect(clean_picture(pose, helix, camera))
    assert np.abs(error_of(found, pose)[:2]).max() < 2e-3
    arm = rotation(pose.theta()) @ [0.2, 0.0]
    by_axis = np.array([[1, 0, -arm[1]], [0, 1, arm[0]], [0, 0, 1.0]])  # axis = reference point + arm
    axis = by_axis @ found.cov_observer @ by_axis.T
    sigma = np.sqrt(np.diag(axis))
    assert sigma[:2].max() < 2e-3 and found.cov_observer[2, 2] == pytest.approx(axis[2, 2])
    assert np.sqrt(np.diag(found.cov_observer))[:2].max() > sigma[:2].max()  # the heading's error moves it


def test_several_stripes_turn_the_same_picture():
    """With two stripes the heading is known but for half a turn; the search finds one of both."""
    helix = replace(HELIX, stripes=2, pitch_m=0.36)
    pose = Pose2(2.5, 0.3, 0.9)
    found = HelixDetector(CAMERA, helix).detect(clean_picture(pose, helix))
    error = error_of(found, pose)
    assert np.abs(error[:2]).max() < 2e-3
    assert abs(wrap(2 * error[2])) < 0.02


def test_pictures_without_a_helix():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        assert DETECTOR.detect(render_background(CAMERA, full_scene(rng), rng)) is None


def test_other_targets_are_not_this_robot():
    pose = Pose2(2.0, 0.0, 0.3)
    picture = clean_picture(pose)
    cube = load_data_sheet(SHEETS / "tag_cube_640x480.toml").target
    others = [
        np.ascontiguousarray(picture[:, ::-1]),  # a left-handed screw
        255 - picture,  # dark collars and light rings
        clean_picture(pose, replace(HELIX, pitch_m=0.12, body=())),
        clean_picture(
            pose, replace(HELIX, bottom_m=0.08, top_m=0.23, radius_m=0.05, ring_m=0.02, pitch_m=0.1, body=())
        ),
        clean_picture(pose, cube),
    ]
    assert DETECTOR.detect(picture) is not None
    assert [DETECTOR.detect(other) for other in others] == [None] * len(others)


@pytest.mark.parametrize("side", ["left", "right", "lower"])
@pytest.mark.parametrize("radiance", [0.1, 0.6])
def test_a_third_of_it_hidden(side, radiance):
    pose, rng = Pose2(2.5, 0.2, 2.0), np.random.default_rng(1)
    rows, columns = target_box(CAMERA, HELIX.solids[:1], pose)
    wide, high = columns.stop - columns.start, rows.stop - rows.start
    left = columns.start - wide if side == "left" else columns.stop - wide / 3
    upper = rows.start - high if side == "upper" else rows.stop - high / 3
    if side in ("left", "right"):
        bar = Occluder(left, rows.start - high, wide * 4 / 3, 3 * high, radiance)
    else:
        bar = Occluder(columns.start - wide, upper, 3 * wide, high * 4 / 3, radiance)
    settings = RenderSettings(background=Background("plain"), occluders=(bar,))
    found = DETECTOR.detect(render(CAMERA, HELIX, pose, settings, rng))
    assert found is not None
    assert square_of(found, pose) < chi2.ppf(0.9999, 3)
    assert np.abs(error_of(found, pose)[:2]).max() < 0.02


def test_half_of_it_out_of_the_picture():
    """A camera that looks higher loses the pattern's lower end at half a metre."""
    camera = replace(CAMERA, mount=replace(CAMERA.mount, tilt_rad=0.25))
    pose = Pose2(0.5, 0.0, 1.0)
    lower = camera.project([[0.4, 0.0, HELIX.helix_bottom_m]])[1]
    assert not lower.any()
    found = HelixDetector(camera, HELIX).detect(clean_picture(pose, camera=camera))
    assert np.abs(error_of(found, pose)[:2]).max() < 2e-3 and abs(error_of(found, pose)[2]) < 0.02


def test_a_heading_that_is_known_too_badly_is_withheld():
    careful = HelixDetector(CAMERA, HELIX, HelixDetectorSettings(whole=Belief(heading_sigma_max_rad=1e-5)))
    pose = Pose2(3.0, 0.5, 1.0)
    found = careful.detect(render(CAMERA, HELIX, pose, RenderSettings(), np.random.default_rng(0)))
    assert not found.heading_known
    fix = found.record(2.0, "ann", "bob")
    assert isinstance(fix, BearingRangeFix) and fix.range_m == pytest.approx(hypot(3.0, 0.5), rel=1e-3)


@pytest.mark.parametrize(
    ("helix", "expected"),
    [
        (replace(HELIX, radius_m=5.0, body=()), "radius_m: less than 3.14 expected, got 5"),
        (
            replace(HELIX, ring_m=0.0, lower_collar_m=0.0, upper_collar_m=0.0, pitch_m=10.0),
            "ring_m: a ring, or a smaller pitch_m, expected",
        ),
    ],
)
def test_a_target_that_cannot_be_searched_for_is_one_line(helix, expected):
    with pytest.raises(BadInput, match=expected):
        HelixDetector(CAMERA, helix)


def test_a_thin_target_needs_no_gigabytes():
    thin = replace(HELIX, radius_m=0.005, body=())
    assert HelixDetector(CAMERA, thin).detect(clean_picture(Pose2(2.0, 0.0, 0.3))) is None


def test_farther_targets_are_found_when_they_are_looked_for():
    """At 12 m, where few pixels show the target: the search's own limit counts, not that of a belief."""
    sheet, pose = load_data_sheet(SHEETS / "helix_1280x960.toml"), Pose2(12.0, 0.5, 1.0)
    settings = RenderSettings(background=Background("plain"))
    picture = render(sheet.camera, sheet.target, pose, settings, np.random.default_rng(0))
    assert HelixDetector(sheet.camera, sheet.target).detect(picture) is None
    found = HelixDetector(sheet.camera, sheet.target, HelixDetectorSettings(farthest_m=20.0)).detect(picture)
    assert np.hypot(found.T_observer_target.x(), found.T_observer_target.y()) == pytest.approx(12.0, abs=0.05)


def test_what_is_drawn_lies_on_the_target():
    pose = Pose2(3.0, 0.5, 1.0)
    lower, upper, *silhouettes = DETECTOR.detect(clean_picture(pose)).features_px
    rows, columns = target_box(CAMERA, HELIX.solids[:1], pose)
    for line in (lower, upper, *silhouettes):
        assert (line >= [columns.start, rows.start]).all() and (line <= [columns.stop, rows.stop]).all()
    assert lower[:, 1].min() > upper[:, 1].max()


def test_candidates_of_the_search():
    """Two robots: a candidate for each, as far as they are, with the azimuth that faces the camera."""
    near, far = Pose2(1.5, 0.5, 0.4), Pose2(5.0, -1.0, 2.0)
    one, other = clean_picture(near), clean_picture(far)
    rows, columns = target_box(CAMERA, HELIX.solids, near)
    both = other.copy()
    both[rows, columns] = one[rows, columns]
    search = HelixSearch(CAMERA, HELIX, 11.0)
    found = search.candidates(pyramid_of(both, search.levels), 2, 0.6)
    for pose in (near, far):
        off = [hypot(*(candidate.axis - xytheta(pose)[:2])) for candidate in found]
        assert min(off) < 0.06 * hypot(*xytheta(pose)[:2])
        azimuth = found[int(np.argmin(off))].azimuth_rad
        assert abs(wrap(azimuth - HELIX.facing_azimuth_rad(pose, CAMERA.mount.forward_m))) < 0.7  # one step
    assert search.candidates(pyramid_of(both, search.levels), 1, 0.6)[0].score == found[0].score
    assert search.candidates(pyramid_of(np.full_like(both, 90), search.levels), 3, 0.3) == []
