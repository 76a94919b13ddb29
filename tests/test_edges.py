"""Model edges against geometry and numeric derivatives; measured offsets against steps whose place is known."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import chi2

from coopslam.se2 import Pose2
from tracker.background import Background
from tracker.data_sheet import load_data_sheet
from tracker.edges import Kind, ModelEdges, measure, model_edges, projected
from tracker.render import RenderSettings, render
from tracker.sensor import Sensor

SHEET = load_data_sheet(Path(__file__).parents[1] / "datasets" / "calibrations" / "helix_640x480.toml")
CAMERA, HELIX = SHEET.camera, SHEET.helix
POSE = Pose2(2.0, 0.4, 1.1)
AXIS = np.array([POSE.x(), POSE.y()])  # the helix is not off the robot's middle


def edges_at(pose: Pose2 = POSE) -> ModelEdges:
    return model_edges(CAMERA, HELIX, pose)


def test_pixels_are_those_of_cv2():
    edges = edges_at()
    R, t = CAMERA.mount.R_body_camera, CAMERA.mount.position_body
    seen = cv2.projectPoints(
        edges.points_body, cv2.Rodrigues(R.T)[0], -R.T @ t, CAMERA.lens.matrix, SHEET.camera.lens.distortion
    )
    np.testing.assert_allclose(edges.pixels, seen[0].reshape(-1, 2), atol=1e-8)


def test_derivative_of_the_projection():
    points = edges_at().points_body
    _, by_point = projected(CAMERA, points)
    for k in range(3):
        step = np.eye(3)[k] * 1e-6
        numeric = (CAMERA.project(points + step)[0] - CAMERA.project(points - step)[0]) / 2e-6
        np.testing.assert_allclose(by_point[:, :, k], numeric, atol=1e-4)


def test_light_changes_across_rings_and_stripes_and_sight_is_tangent_at_silhouettes():
    edges = edges_at()
    from_axis = edges.points_body[:, :2] - AXIS
    np.testing.assert_allclose(np.hypot(*from_axis.T), HELIX.radius_m, atol=1e-12)
    azimuth, height = np.arctan2(from_axis[:, 1], from_axis[:, 0]) - POSE.theta(), edges.points_body[:, 2]
    pattern = edges.kind != Kind.SILHOUETTE
    above, below = (HELIX.is_dark(azimuth, height + step)[pattern] for step in (1e-6, -1e-6))
    assert (above != below).all()
    sight = edges.points_body[~pattern, :2] - CAMERA.mount.position_body[:2]
    np.testing.assert_allclose(np.sum(sight * from_axis[~pattern], axis=1), 0.0, atol=1e-12)


@pytest.mark.parametrize("k", range(3))
def test_how_edges_move_with_the_pose(k):
    """A point of the target has the same name at another pose; silhouettes move with the cylinder to first order."""
    step, change = 1e-5, np.eye(3)[k] * 1e-5
    ends = [edges_at(Pose2(*(np.array([2.0, 0.4, 1.1]) + sign * change))) for sign in (1, -1)]
    ahead, back = (dict(zip(each.names.tolist(), each.pixels, strict=True)) for each in ends)
    edges = edges_at()
    assert len(set(edges.names.tolist())) == len(edges.names)
    shared = [i for i, name in enumerate(edges.names.tolist()) if name in ahead and name in back]
    assert len(shared) > 0.95 * len(edges.names)
    numeric = [edges.normals[i] @ (ahead[edges.names[i]] - back[edges.names[i]]) / (2 * step) for i in shared]
    np.testing.assert_allclose(edges.by_pose[shared, k], numeric, atol=1e-5)


def test_normals_point_to_the_light_side_of_a_picture():
    sensor = Sensor(electrons_per_level=np.inf, defocus_px=0.3)
    picture = render(CAMERA, HELIX, POSE, RenderSettings(sensor=sensor), np.random.default_rng(0)).astype(float)
    edges = edges_at()
    edges = edges.where(edges.signed & (edges.room_px > 5))
    ahead, back = ((edges.pixels + sign * 2 * edges.normals).round().astype(int) for sign in (1, -1))
    assert (picture[ahead[:, 1], ahead[:, 0]] > picture[back[:, 1], back[:, 0]] + 10).all()


def upright_steps(offset_px: float, noise: float, rng, blur_px: float = 0.9) -> tuple[np.ndarray, ModelEdges]:
    """A picture that is dark left of u = 30 + offset, and edges that expect it at 30, each in rows of its own."""
    u = np.arange(60) - 30 - offset_px
    grey = 60 + 80 * ndtr(u / blur_px) + noise * rng.standard_normal((400, 60))
    v = np.arange(4.0, 396.0, 4.0)
    count, pixels = len(v), np.column_stack([np.full(len(v), 30.0), v])
    normals = np.tile([1.0, 0.0], (count, 1))
    rest = np.zeros((count, 3)), pixels, normals, np.zeros((count, 3)), np.full(count, 50.0)
    edges = ModelEdges(np.arange(count), *rest, np.full(count, Kind.RING), np.ones(count, bool))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), edges


@pytest.mark.parametrize("offset_px", [-2.3, 0.0, 0.4, 3.7])
def test_a_step_is_found_where_it_is_and_its_scatter_is_as_said(offset_px):
    picture, edges = upright_steps(offset_px, 2.0, np.random.default_rng(1))
    offsets, sigmas, found = measure(picture, edges)
    assert found.all()
    errors = offsets - offset_px
    assert (
        abs(errors.mean()) < 4 * sigmas.mean() / np.sqrt(len(errors)) + 0.005
    )  # rows are whole: interpolation blurs u
    low, high = chi2.ppf([0.001, 0.999], len(errors))
    assert 0.4 * low < np.sum((errors / sigmas) ** 2) < high  # whole rows are not smoothed: said with (2/3)^2 to spare


def test_what_is_not_there_is_not_found():
    rng = np.random.default_rng(2)
    flat = np.clip(np.rint(100 + 3 * rng.standard_normal((400, 60))), 0, 255).astype(np.uint8)
    picture, edges = upright_steps(0.0, 2.0, rng)
    assert measure(flat, edges)[2].mean() < 0.02
    assert not measure(255 - picture, edges)[2].any()  # light on the wrong side
    assert measure(255 - picture, replace(edges, signed=np.zeros(len(edges.names), bool)))[2].all()
    offsets, _, found = measure(np.roll(picture, 9, axis=1), edges, reach_px=6.0)  # too far
    assert not found.any() and np.isnan(offsets).all()


def test_edges_of_a_picture_are_found_to_a_tenth_of_a_pixel():
    picture = render(CAMERA, HELIX, POSE, RenderSettings(background=Background("plain")), np.random.default_rng(0))
    edges = edges_at()
    offsets, _, found = measure(picture, edges)
    assert found.mean() > 0.9
    for kind in Kind:
        assert np.median(np.abs(offsets[found & (edges.kind == kind)])) < 0.1


def test_without_a_view_there_are_no_edges():
    for pose in (Pose2(-3.0, 0.0, 0.0), Pose2(0.05, 0.0, 0.0)):  # behind, and around the camera
        edges = edges_at(pose)
        assert len(edges.names) == 0 and edges.pixels.shape == (0, 2)
        assert [len(each) for each in measure(np.zeros((480, 640), np.uint8), edges)] == [0, 0, 0]
