"""Calibration of the robot tracker against sheets that pictures or edges were made with, numeric derivatives, cv2."""

from dataclasses import replace
from math import inf, pi
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from coopslam.errors import BadInput, UnderDetermined
from coopslam.se2 import Pose2, wrap
from tracker.background import Background
from tracker.calibration import calibrate_tracker, calibrated_by_views, weak_directions
from tracker.calibration_accuracy import expected_curve, expected_sigmas, held_out, measured_pose
from tracker.calibration_curve import end_rows
from tracker.calibration_edges import Expected, Located, edges_of, groups_of
from tracker.calibration_fit import Shot, measured_edges
from tracker.calibration_noise import Noise, Weights, class_of, whitened
from tracker.calibration_parameters import require_known, tolerances_of, usual_parameters, values_of, with_values
from tracker.calibration_search import find_target
from tracker.data_sheet import CalibrationNote, dump_data_sheet, load_data_sheet
from tracker.edges import measure
from tracker.render import RenderSettings, render
from tracker.scene_light import Light
from tracker.sensor import Sensor
from tracker.tag_edges import tag_edges

SHEETS = Path(__file__).parents[1] / "datasets" / "calibrations"
HELIX, CUBE = (load_data_sheet(SHEETS / f"{name}_640x480.toml") for name in ("helix", "tag_cube"))
DISTANCES_M = (0.7, 1.0, 1.4, 2.0, 2.7, 3.5, 4.5, 6.0)
TAPE_SIGMA_M = 0.002


def wrong(sheet):
    """The sheet as it really is: 8 mm higher, 0.8 degrees steeper, 2 mm larger, focal lengths 1 % longer."""
    size = "radius" if sheet.helix is not None else "tag"
    names = ("height", "tilt", size, "fx", "fy")
    return names, with_values(sheet, names, values_of(sheet, names) + [0.008, np.radians(0.8), 0.002, 4.8, 4.8])


def pose_at(distance_m: float, rng) -> Pose2:
    bearing = rng.uniform(-0.4, 0.4)
    return Pose2(distance_m * np.cos(bearing), distance_m * np.sin(bearing), rng.uniform(-pi, pi))


def pictures(true, seed: int):
    """Pictures of a true sheet at distances that a tape measured."""
    rng = np.random.default_rng(seed)
    shots, images = [], []
    for k, distance in enumerate(DISTANCES_M):
        light = Light(rng.uniform(0.3, 0.6), rng.uniform(0.1, 0.6), rng.uniform(-pi, pi), rng.uniform(0.2, 1.2))
        settings = RenderSettings(light, Background("clutter"))
        images.append(render(true.camera, true.target, pose_at(distance, rng), settings, rng))
        shots.append(Shot(f"picture {k}", distance + TAPE_SIGMA_M * rng.standard_normal()))
    return shots, images


def simulated(true, seed: int, distances_m=DISTANCES_M, sigma_px=0.03, tau_px=0.02):
    """Edges of a true sheet with errors of points and groups, and poses near the true ones."""
    rng = np.random.default_rng(seed)
    shots, views, poses = [], [], []
    for k, distance in enumerate(distances_m):
        pose = pose_at(distance, rng)
        edges = edges_of(true, pose)
        labels = groups_of(edges)
        offsets = sigma_px * rng.standard_normal(len(labels))
        for label in np.unique(labels):
            offsets[labels == label] += tau_px * rng.standard_normal()
        views.append(Located.of(edges, offsets, np.full(len(labels), sigma_px)))
        shots.append(Shot(f"set {k}", distance + TAPE_SIGMA_M * rng.standard_normal()))
        poses.append(Pose2(pose.x(), pose.y(), pose.theta() + 0.002))
    return shots, views, poses


@pytest.mark.parametrize(
    ("sheet", "names"), [(HELIX, ("height", "tilt", "radius", "top", "fx")), (CUBE, ("height", "tilt", "tag", "fx"))]
)
def test_parameters_are_as_far_off_as_their_covariance_says(sheet, names):
    """NEES over 20 sets whose true sheets are drawn from the tolerances, in the band that one in a thousand leaves."""
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(1000 + seed)
        truth = values_of(sheet, names) + 0.3 * tolerances_of(sheet, names) * rng.standard_normal(len(names))
        shots, views, poses = simulated(with_values(sheet, names, truth), seed, DISTANCES_M[:7])
        found = calibrated_by_views(sheet, names, shots, views, poses)
        error = found.fit.values - truth
        squares.append(error @ np.linalg.solve(found.fit.cov, error))
    low, high = chi2.ppf([0.0005, 0.9995], len(names) * len(squares))
    assert low < sum(squares) < high
    assert (found.sigmas < 0.2 * tolerances_of(sheet, names)).all()  # and that is worth something


@pytest.mark.parametrize(("sheet", "better"), [(HELIX, 10), (CUBE, 10)])
def test_rendered_pictures(sheet, better):
    names, true = wrong(sheet)
    found = calibrate_tracker(sheet, names, *pictures(true, 3))
    errors = found.fit.values - values_of(true, names)
    assert (np.abs(errors) < 3.5 * found.sigmas).all()  # five of them; one in 400 would fail
    assert (np.abs(errors) < [0.001, 0.001, 0.0003, 1.5, 1.5]).all()
    assert len(found.shots) >= 7 and found.weak == ()
    ranges = held_out(found)
    before, after = (
        np.array([[getattr(one, field) - one.distance_m for one in ranges if one.before_m is not None]])
        for field in ("before_m", "after_m")
    )
    assert np.sqrt(np.mean(after**2)) < np.sqrt(np.mean(before**2)) / better
    z = [(one.after_m - one.distance_m) / np.hypot(one.sigma_m, TAPE_SIGMA_M) for one in ranges]
    assert np.max(np.abs(z)) < 4.0
    assert found.sheet.calibration.sigmas["tilt"] == pytest.approx(found.sigmas[1])


def test_the_target_is_found_when_the_sheet_is_wrong():
    for sheet in (HELIX, CUBE):
        _, true = wrong(sheet)
        rng = np.random.default_rng(8)
        for distance in (0.7, 2.0, 5.0):
            pose = pose_at(distance, rng)
            image = render(true.camera, true.target, pose, RenderSettings(background=Background("clutter")), rng)
            start = find_target(image, sheet, distance, None, None)
            bearing = np.arctan2(start.pose.y(), start.pose.x()) - np.arctan2(pose.y(), pose.x())
            assert abs(bearing) < 0.01 and abs(wrap(start.pose.theta() - pose.theta())) < 0.2
            # lower in the picture by what a pinhole shows of 8 mm height at its distance, less the tilt
            expected_px = 480 * (0.008 / distance - np.radians(0.8))
            assert start.shift_px == pytest.approx(expected_px, abs=3.0)


@pytest.mark.parametrize("forward_m", [0.15, -0.15])
def test_the_target_is_found_when_its_axis_is_not_over_the_robot(forward_m):
    sheet = replace(HELIX, helix=replace(HELIX.helix, forward_m=forward_m))
    pose = Pose2(0.8 * np.cos(0.1), 0.8 * np.sin(0.1), 2.0)
    settings, rng = RenderSettings(background=Background("plain")), np.random.default_rng(0)
    start = find_target(render(sheet.camera, sheet.target, pose, settings, rng), sheet, 0.8, None, None)
    assert abs(wrap(start.pose.theta() - 2.0)) < 0.2 and abs(start.shift_px) < 3.0


def test_no_target_no_start():
    clutter = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    assert find_target(clutter, HELIX, 2.0, None, None) is None
    assert find_target(clutter, CUBE, 2.0, None, None) is None


def test_tag_edges_are_where_they_are_rendered_and_move_as_they_say():
    pose = Pose2(1.5, 0.2, 0.7)
    clean = RenderSettings(background=Background("plain"), sensor=Sensor(electrons_per_level=inf, vignetting=0.0))
    image = render(CUBE.camera, CUBE.tag_cube, pose, clean, np.random.default_rng(0))
    edges = tag_edges(CUBE.camera, CUBE.tag_cube, pose)
    offsets, _, found = measure(image, edges)
    assert found.mean() > 0.95 and len(found) >= 64
    assert np.sqrt(np.mean(offsets[found] ** 2)) < 0.03
    for k, change in enumerate(1e-6 * np.eye(3)):
        moved = [Pose2(*(np.array([1.5, 0.2, 0.7]) + sign * change)) for sign in (1, -1)]
        ahead, back = (tag_edges(CUBE.camera, CUBE.tag_cube, each).pixels for each in moved)
        np.testing.assert_allclose(
            edges.by_pose[:, k], np.sum((ahead - back) * edges.normals, axis=1) / 2e-6, rtol=1e-4, atol=1e-2
        )


def test_whitening_is_the_inverse_of_the_covariance():
    """Against the dense matrix."""
    (one,) = measured_edges(HELIX, (), np.zeros(0), [Shot("", None)], [Expected(0.04)], [Pose2(2.0, 0.1, 1.0)], 0.0)
    rng = np.random.default_rng(4)
    noise = Noise(1.3, (0.02, 0.07))
    weights = Weights(rng.uniform(0.2, 1.0, len(one.offsets)), np.ones(len(one.groups)))
    S = np.diag((1.3 * one.sigmas) ** 2 / weights.points)
    for label, own in zip(one.labels, one.groups, strict=True):
        S[np.ix_(own, own)] += noise.taus_px[class_of(label)] ** 2
    J, _, ones = whitened(one, weights, noise)
    expected = one.jacobian.T @ np.linalg.solve(S, one.jacobian)
    np.testing.assert_allclose(J.T @ J, expected, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(ones @ ones, np.linalg.inv(S).sum(), rtol=1e-9)


def test_a_wrong_parameter_moves_the_pose_as_expected():
    """One parameter that is wrong by its sigma against what a pose fitted with it is wrong by."""
    pose, name, sigma = Pose2(3.0, 0.3, 0.5), "height", 0.0001
    view = Located.of(edges := edges_of(HELIX, pose), np.zeros(len(edges.names)), np.full(len(edges.names), 0.03))
    alone, both = expected_sigmas(HELIX, (name,), np.array([[sigma**2]]), pose, Noise(), view)
    off = with_values(HELIX, (name,), values_of(HELIX, (name,)) + sigma)
    found = measured_pose(off, view, pose, Noise())
    moved = np.hypot(found.poses[0].x(), found.poses[0].y()) - np.hypot(3.0, 0.3)
    assert np.sqrt(both[0] ** 2 - alone[0] ** 2) == pytest.approx(abs(moved), rel=0.02)


def test_a_better_calibration_expects_smaller_errors_and_never_less_than_the_pixels_allow():
    _, true = wrong(HELIX)
    shots, views, poses = simulated(true, 5)
    few = calibrated_by_views(HELIX, ("height", "tilt"), shots[2:5], views[2:5], poses[2:5])
    many = calibrated_by_views(HELIX, ("height", "tilt"), shots, views, poses)
    less, more = expected_curve(many, [1.0, 3.0, 6.0]), expected_curve(few, [1.0, 3.0, 6.0])
    assert (less[:, 1] >= less[:, 0]).all() and (np.diff(less[:, 0, 0]) > 0).all()
    assert (less[:, 1, 0] < more[:, 1, 0]).all()


def test_only_differences_of_heights_are_seen():
    shots, views, poses = simulated(HELIX, 1)
    names = ("height", "tilt", "bottom", "top", "start")
    found = calibrated_by_views(HELIX, names, shots, views, poses)
    assert len(found.weak) == 2
    assert found.weak[0].startswith("start: not observable")
    assert found.weak[1].startswith("height and bottom and top: changed together")
    step = np.array([0.001, 0, 0.001, 0.001, 0])  # the camera and the pattern lifted together
    lifted = with_values(HELIX, names, values_of(HELIX, names) + step)
    pixels = edges_of(lifted, poses[3]).pixels
    np.testing.assert_allclose(pixels, edges_of(HELIX, poses[3]).pixels, atol=1e-9)


def test_at_one_distance_a_height_looks_like_a_tilt():
    """Far away both only shift the picture; from near to far a height shifts it by its share of the distance."""
    alone, apart = (
        calibrated_by_views(HELIX, ("height", "tilt"), *simulated(HELIX, 2, distances))
        for distances in ((5.0, 5.0, 5.0), (0.7, 2.0, 5.0))
    )
    correlation = alone.fit.cov[0, 1] / np.prod(alone.sigmas)
    assert abs(correlation) > 0.95
    assert alone.sigmas[0] > 5 * apart.sigmas[0]


def test_known_bearings_and_headings_tell_yaw_and_start():
    names = ("yaw", "start")
    true = with_values(HELIX, names, np.array([0.02, -0.03]))
    rng = np.random.default_rng(6)
    shots, views, poses = simulated(true, 6)
    angles = [(np.arctan2(pose.y(), pose.x()), pose.theta() - 0.002) for pose in poses]
    told = [
        replace(shot, bearing_rad=b + 0.01 * rng.standard_normal(), heading_rad=h + 0.02 * rng.standard_normal())
        for shot, (b, h) in zip(shots, angles, strict=True)
    ]
    found = calibrated_by_views(HELIX, names, told, views, poses)
    assert (np.abs(found.fit.values - [0.02, -0.03]) < 3.5 * found.sigmas).all()
    assert found.sigmas[0] == pytest.approx(
        1 / np.sqrt(8 / 0.01**2 + 1 / 0.0175**2), rel=0.15
    )  # mean of 8 and the prior


def test_rows_of_the_ends_are_those_of_a_pinhole():
    """Hand-worked without distortion and tilt: row = cy + fy (height of the camera above the end) / distance."""
    lens = replace(HELIX.camera.lens, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    mount = replace(HELIX.camera.mount, tilt_rad=0.0, forward_m=0.0)
    sheet = replace(HELIX, camera=replace(HELIX.camera, lens=lens, mount=mount))
    rows = end_rows(sheet, np.array([2.1, 4.1]))
    np.testing.assert_allclose(rows, 239.5 + 480 * np.array([[0.42 / 2, 0.12 / 2], [0.42 / 4, 0.12 / 4]]), atol=1e-9)
    points = np.array([[1.85, 0.0, 0.33 - 0.12], [1.85, 0.0, 0.33 + 0.12]])  # of the tag that faces the camera at 2 m
    R, t = CUBE.camera.mount.R_body_camera, CUBE.camera.mount.position_body
    lens = CUBE.camera.lens
    pixels = cv2.projectPoints(points, cv2.Rodrigues(R.T)[0], -R.T @ t, lens.matrix, lens.distortion)[0][:, 0]
    np.testing.assert_allclose(end_rows(CUBE, np.array([2.0]))[0], pixels[:, 1], atol=1e-6)


def test_parameters_of_sheets():
    names = ("bottom", "top", "fx", "k1")
    values = np.array([0.5, 0.9, 490.0, -0.12])  # both ends above where the top was: changed at once
    sheet = with_values(HELIX, names, values)
    np.testing.assert_allclose(values_of(sheet, names), values)
    assert (sheet.helix.bottom_m, sheet.helix.top_m, sheet.camera.lens.fx_px) == (0.5, 0.9, 490.0)
    larger = with_values(CUBE, ("tag",), np.array([0.252]))
    assert larger.tag_cube.face_m == pytest.approx(0.315)  # 5 %, as the tag
    assert usual_parameters(CUBE) == ("height", "tilt", "tag")
    for bad, words in ((("height", "hue"), "hue"), (("tilt", "tilt"), "twice"), ((), "none"), (("tag",), "tag")):
        with pytest.raises(BadInput, match=words):
            require_known(HELIX, bad)


def test_what_nothing_was_learned_of_is_named():
    tolerances = tolerances_of(HELIX, ("height", "tilt"))
    known = np.diag((0.1 * tolerances) ** 2)
    assert weak_directions(HELIX, ("height", "tilt"), known) == ()
    (line,) = weak_directions(HELIX, ("height", "tilt"), np.diag((np.array([1.0, 0.1]) * tolerances) ** 2))
    assert line == "height: not observable with these pictures (100% of the sheet's tolerance is left, which holds it)"


def test_errors_are_said():
    shots, images = pictures(HELIX, 1)
    with pytest.raises(BadInput, match=r"picture 0: image: a picture of uint8 \(480, 640\)"):
        calibrate_tracker(HELIX, ("height",), shots, [image[:, :320] for image in images])
    blank = [np.full((480, 640), 90, np.uint8)] * 6
    with pytest.raises(BadInput, match="found in 2 of 8 pictures"):
        calibrate_tracker(HELIX, ("height",), shots, images[:2] + blank)
    with pytest.raises(UnderDetermined, match="0 edges"):
        measured_edges(HELIX, (), np.zeros(0), [Shot("x", None)], [Expected(0.1)], [Pose2(-3.0, 0.0, 0.0)], 0.0)


def test_the_note_of_a_calibrated_sheet(tmp_path):
    note = CalibrationNote(7, 0.04, {"height": 0.001, "tilt": 0.002}, ((1.0, 0.5), (0.5, 1.0)))
    np.testing.assert_allclose(note.cov, [[1e-6, 1e-6], [1e-6, 4e-6]])
    path = tmp_path / "sheet.toml"
    path.write_text(dump_data_sheet(replace(HELIX, calibration=note)), encoding="utf-8")
    assert load_data_sheet(path).calibration == note
    for old, new, words in (
        ("pictures = 7", "pictures = 0", "calibration.pictures: 1 to"),
        ("height = 0.001", "height = -0.001", "calibration.sigmas: height: zero or more"),
        ("tilt = 0.002\n", "", "calibration.correlation: a square of 1 rows"),
    ):
        text = dump_data_sheet(replace(HELIX, calibration=note))
        assert old in text
        path.write_text(text.replace(old, new), encoding="utf-8")
        with pytest.raises(BadInput, match=words):
            load_data_sheet(path)
