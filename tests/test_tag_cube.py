"""The cube of AprilTags: hand-worked corners, faces against OpenCV's own drawing of the tags."""

from dataclasses import replace
from math import nan

import cv2
import numpy as np
import pytest

from coopslam.errors import BadInput
from tracker.tag_cube import TagCube

CUBE = TagCube(face_m=0.4, tag_m=0.2, bottom_m=0.1, side_ids=(7, 3, 586, 0), top_id=12, forward_m=0.5)
NORMALS = {7: (1, 0, 0), 3: (0, 1, 0), 586: (-1, 0, 0), 0: (0, -1, 0), 12: (0, 0, 1)}


def test_hand_worked_corners():
    """Clockwise from the upper left, as somebody in front of the face sees them."""
    corners = CUBE.corners()
    assert list(corners) == [7, 3, 586, 0, 12]
    front = [[0.7, -0.1, 0.4], [0.7, 0.1, 0.4], [0.7, 0.1, 0.2], [0.7, -0.1, 0.2]]
    left = [[0.6, 0.2, 0.4], [0.4, 0.2, 0.4], [0.4, 0.2, 0.2], [0.6, 0.2, 0.2]]
    top = [[0.6, 0.1, 0.5], [0.6, -0.1, 0.5], [0.4, -0.1, 0.5], [0.4, 0.1, 0.5]]
    for tag, expected in ((7, front), (3, left), (12, top)):
        np.testing.assert_allclose(corners[tag], expected, atol=1e-15)


def test_corners_run_clockwise_around_the_outward_normal():
    for tag, corner in CUBE.corners().items():
        up, left = corner[1] - corner[2], corner[3] - corner[2]
        np.testing.assert_allclose(np.cross(up, left), 0.04 * np.array(NORMALS[tag]), atol=1e-15)


def test_faces_show_what_opencv_draws():
    """Each module's middle, found from the corners: dark where OpenCV's picture is; white around it."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    across = (np.arange(-1, 9) + 0.5) / 8
    for tag, corner in CUBE.corners().items():
        picture = np.pad(cv2.aruco.generateImageMarker(dictionary, tag, 8), 1, constant_values=255)
        right, down = corner[1] - corner[0], corner[3] - corner[0]
        points = corner[0] + across[None, :, None] * right + across[:, None, None] * down
        look = CUBE.look(points.reshape(-1, 3).T)
        np.testing.assert_array_equal(look.reflectance.reshape(10, 10), np.where(picture == 0, CUBE.dark, CUBE.light))
        np.testing.assert_array_equal(look.normals, np.repeat([NORMALS[tag]], 100, axis=0).T)
        assert len(set(look.patch)) == 2


def test_patches_tell_all_faces_apart():
    faces = 0.2 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]).T
    off_tag = 0.15 * (1 - np.abs(np.sign(faces)))
    look = CUBE.look(CUBE.centre_body[:, None] + faces + off_tag)
    assert len(set(look.patch)) == 6 and look.patch.max() < 16


def test_rays_meet_the_cube_where_it_is():
    rng = np.random.default_rng(1)
    eye = np.array([3.0, 2.0, 0.9])  # sees the front, the left and the top
    for axis in range(3):
        points = rng.uniform(-0.1999, 0.1999, (3, 200))
        points[axis] = 0.2
        points += CUBE.centre_body[:, None]
        np.testing.assert_allclose(CUBE.distances(eye, points - eye[:, None]), 1.0, atol=1e-9)
    beside = CUBE.centre_body + [0.2, -0.2001, 0.0]
    behind = eye - CUBE.centre_body
    assert not np.isfinite(CUBE.distances(eye, np.stack([beside - eye, behind], axis=1))).any()


def test_without_a_tag_the_top_is_white():
    cube = replace(CUBE, top_id=None)
    assert 12 not in cube.corners()
    x, y = np.random.default_rng(2).uniform(-0.19, 0.19, (2, 100))
    look = cube.look(np.stack([0.5 + x, y, np.full(100, 0.5)]))
    np.testing.assert_array_equal(look.reflectance, cube.light)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("face_m", 0.0),
        ("tag_m", 0.33),  # no white border of a module
        ("tag_m", nan),
        ("bottom_m", -0.1),
        ("side_ids", (0, 1, 2, 587)),
        ("side_ids", (0, 1, 2, 2)),
        ("side_ids", (0, 1, 2)),
        ("top_id", -1),
        ("dark", 0.9),
        ("light", 0.0),
        ("forward_m", nan),
    ],
)
def test_an_impossible_cube_is_refused(field, value):
    with pytest.raises(BadInput, match="^light: " if field == "dark" else f"^{field}: "):
        replace(CUBE, **{field: value})
