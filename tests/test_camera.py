"""The camera against OpenCV's projection and undistortion."""

from dataclasses import replace
from math import inf, nan, pi, radians, tan

import cv2
import numpy as np
import pytest

from coopslam.errors import BadInput
from tracker.camera import Camera, Mount
from tracker.lens import Lens, pixel_corners

PINHOLE = Lens(640, 480, 480.0, 470.0, 319.5, 239.5)
LENS = replace(PINHOLE, k1=-0.10, k2=0.02, p1=0.0005, p2=-0.0003, k3=0.001)
CAMERA = Camera(LENS, Mount(height_m=0.6, tilt_rad=0.42, forward_m=0.04, yaw_rad=0.3))


def opencv_pixels(camera: Camera, points_body: np.ndarray) -> np.ndarray:
    """(N, 2) by cv2.projectPoints, with the camera's axes written down from the meaning of tilt and yaw."""
    t, y = camera.mount.tilt_rad, camera.mount.yaw_rad
    axis = np.array([np.cos(t) * np.cos(y), np.cos(t) * np.sin(y), -np.sin(t)])
    right = np.array([np.sin(y), -np.cos(y), 0.0])
    R_camera_body = np.stack([right, np.cross(axis, right), axis])
    position = np.array([camera.mount.forward_m, 0.0, camera.mount.height_m])
    lens = camera.lens
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    distortion = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    vector = cv2.Rodrigues(R_camera_body)[0]
    return cv2.projectPoints(np.asarray(points_body), vector, -R_camera_body @ position, matrix, distortion)[0][:, 0]


def points_ahead(rng, count=400) -> np.ndarray:
    """(N, 3) points in the body, in front of CAMERA and up to twice as far aside as its picture reaches."""
    sideways = rng.uniform(-1.2, 1.2, (count, 2))
    points_camera = np.column_stack([sideways, np.ones(count)]) * rng.uniform(0.2, 12, (count, 1))
    return points_camera @ CAMERA.mount.R_body_camera.T + CAMERA.mount.position_body


def test_projects_as_opencv_does():
    points = points_ahead(np.random.default_rng(1))
    pixels, visible = CAMERA.project(points)
    expected = opencv_pixels(CAMERA, points)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    inside = (np.abs(expected - [319.5, 239.5]) <= [320, 240]).all(axis=1)
    assert visible.tolist() == inside.tolist()
    assert 50 < visible.sum() < 350  # both answers occur


def test_rays_are_those_that_opencv_undistorts():
    rng = np.random.default_rng(2)
    pixels = rng.uniform([-0.5, -0.5], [639.5, 479.5], (500, 2))
    rays = CAMERA.rays(pixels)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    expected = cv2.undistortPoints(pixels[:, None], LENS.matrix, LENS.distortion, criteria=until)[:, 0]
    in_camera = rays @ CAMERA.mount.R_body_camera
    np.testing.assert_allclose(in_camera[:, :2] / in_camera[:, 2:], expected, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, rtol=1e-12)


def test_a_ray_points_at_what_its_pixel_shows():
    points = points_ahead(np.random.default_rng(3))
    pixels, visible = CAMERA.project(points)
    towards = points[visible] - CAMERA.mount.position_body
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(CAMERA.rays(pixels[visible]), towards, atol=1e-10)


def test_hand_worked_pixels():
    """Tilted by 45 degrees at 1 m: the axis meets the floor 1 m ahead; straight ahead is 45 degrees above the axis."""
    camera = Camera(PINHOLE, Mount(height_m=1.0, tilt_rad=pi / 4))
    aside = np.sqrt(2) * 0.1  # of a point sqrt(2) m along the axis: a tenth of the focal length
    pixels, visible = camera.project([[1, 0, 0], [1, aside, 0], [5, 0, 1], [0, 0, 2]])
    np.testing.assert_allclose(pixels[0], [319.5, 239.5], atol=1e-9)
    np.testing.assert_allclose(pixels[1], [319.5 - 48, 239.5], atol=1e-9)  # left in the body is left in the picture
    np.testing.assert_allclose(pixels[2], [319.5, 239.5 - 470], atol=1e-9)
    assert np.isnan(pixels[3]).all()  # behind: above the camera, at a right angle and more to the axis
    assert visible.tolist() == [True, True, False, False]


def test_transform_is_rigid_and_takes_the_axis_along():
    T = CAMERA.T_body_camera
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(T @ [0, 0, 0, 1], [0.04, 0, 0.6, 1])


def test_panning_moves_a_bearing_to_the_middle():
    bearing = 2.0
    panned = Camera(PINHOLE, CAMERA.mount).panned(bearing)
    far = [[0.04 + 5 * np.cos(bearing), 5 * np.sin(bearing), 0.3]]
    pixels, visible = panned.project(far)
    assert visible[0] and pixels[0, 0] == pytest.approx(319.5, abs=1e-9)
    assert not CAMERA.project(far)[1][0]


def test_what_folds_back_into_the_picture_is_not_seen():
    """With k1 = -0.3 the radius r (1 - 0.3 r^2) grows up to r = 1 / sqrt(0.9) = 1.054 only, and is zero at 1.826."""
    lens = replace(PINHOLE, fx_px=1000.0, fy_px=1000.0, k1=-0.3)
    pixels = lens.pixels(np.array([[1.05, 0.0], [1.06, 0.0], [1.8, 0.0]]))
    assert np.isfinite(pixels[0]).all() and np.isnan(pixels[1:]).all()
    at_fold = 1000 * 1.0541 * (1 - 0.3 * 1.0541**2)
    assert np.isnan(lens.normalised([[319.5 + at_fold + 1, 239.5]])).all()
    folded = opencv_pixels(Camera(lens, Mount(0.6)), np.array([[1.0, -1.8, 0.6]]))
    assert lens.contains(folded).all()  # cv2 alone would have put it into the picture


def test_lens_is_bilinear_within_a_pixel():
    """What the renderer relies on: points half-way between the corners; a hundredth of the 0.02 px that it promises."""
    corners = pixel_corners(LENS)
    assert corners.shape == (481, 641, 2)
    middle = (corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:] + corners[1:, 1:]) / 4
    v, u = np.mgrid[0:480, 0:640]
    found = LENS.pixels(middle)
    assert np.abs(found - np.stack([u, v], axis=-1)).max() < 2e-4


def test_field_of_view_of_a_pinhole():
    lens = Lens(640, 480, 320 / tan(radians(30)), 500.0, 319.5, 239.5)
    edge = lens.normalised(np.array([[639.5, 239.5]]))
    assert np.arctan(edge[0, 0]) == pytest.approx(radians(30))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("width_px", 0),
        ("width_px", 640.0),
        ("height_px", -480),
        ("height_px", True),
        ("fx_px", -480.0),
        ("fy_px", 0.0),
        ("fx_px", nan),
        ("cx_px", 700.0),
        ("cy_px", inf),
        ("k1", nan),
        ("k1", -1.0),  # folds inside the picture
    ],
)
def test_an_impossible_lens_is_refused(field, value):
    with pytest.raises(BadInput, match=f"^{field}: "):
        replace(LENS, **{field: value})


@pytest.mark.parametrize(
    ("field", "value"), [("height_m", 0.0), ("height_m", nan), ("tilt_rad", pi), ("forward_m", inf), ("yaw_rad", 7.0)]
)
def test_an_impossible_mount_is_refused(field, value):
    with pytest.raises(BadInput, match=f"^{field}: "):
        replace(CAMERA.mount, **{field: value})
