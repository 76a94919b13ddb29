"""What pixels show of the mantle: against the renderer, which samples areas, and against numeric derivatives."""

from dataclasses import replace
from math import inf, pi
from pathlib import Path

import numpy as np
import pytest

from coopslam.se2 import Pose2
from tracker.background import Background
from tracker.data_sheet import load_data_sheet
from tracker.helix_fit import Sought, pixels_of
from tracker.helix_model import Part, shown
from tracker.render import RenderSettings, render
from tracker.scene_light import Light
from tracker.sensor import Sensor

SHEET = load_data_sheet(Path(__file__).parents[1] / "datasets" / "calibrations" / "helix_640x480.toml")
CAMERA, HELIX = SHEET.camera, replace(SHEET.helix, body=())
HEIGHT = CAMERA.mount.height_m
SENSOR = Sensor(gain=200.0, black_level=10.0, electrons_per_level=inf, vignetting=0.0, defocus_px=0.9)
BLUR_PX = float(np.sqrt(0.9**2 + 1 / 12))


def pixels_at(pose: Pose2, helix=HELIX):
    settings = RenderSettings(Light(ambient=1.0, direct=0.0), Background("plain", wall=0.4), SENSOR)
    picture = render(CAMERA, helix, pose, settings, np.random.default_rng(0))
    axis = np.array([pose.x(), pose.y()]) - CAMERA.mount.position_body[:2]
    return pixels_of(Sought([picture], CAMERA, helix), 0, axis, Part()), axis


@pytest.mark.parametrize(
    ("helix", "pose"),
    [
        (HELIX, Pose2(3.0, 0.5, 0.7)),
        (HELIX, Pose2(6.0, -1.0, -2.0)),
        (replace(HELIX, stripes=2, duty=0.4, start_rad=1.0), Pose2(2.5, -0.3, 2.0)),
    ],
)
def test_predicted_grey_levels_are_the_renderers(helix, pose):
    """Even light, so grey = black + gain * reflectance. The blur of the renderer works on whole pixels, which differs
    from a Gaussian by up to 3 % of a step at places; the mean must be far better, and inside the silhouette only."""
    pixels, axis = pixels_at(pose, helix)
    s = shown(pixels, helix, HEIGHT, axis, pose.theta(), BLUR_PX)
    mantle = 10 + 200 * (helix.dark + (helix.light - helix.dark) * s.light)
    expected = s.cover * mantle + (1 - s.cover) * (10 + 200 * 0.4)
    inner = (s.below < 0.01) & (s.above < 0.01)
    off = (pixels.grey - expected)[inner] / (200 * (helix.light - helix.dark))
    assert np.sqrt(np.mean(off**2)) < 0.015
    assert abs(np.mean(off)) < 0.002


@pytest.mark.parametrize("turned", [0.0, pi / 2, 2.5])
def test_derivatives_by_pose_and_blur(turned):
    pose = Pose2(3.0, 0.5, turned)
    pixels, axis = pixels_at(pose)
    s = shown(pixels, HELIX, HEIGHT, axis, turned, BLUR_PX)
    slope = HELIX.pitch_m / (2 * pi)
    steps = {"forward": (2e-4, 0, 0, 0), "left": (0, 2e-4, 0, 0), "turn": (0, 0, 1e-3, 0), "blur": (0, 0, 0, 1e-3)}
    by_p, by_q = {"forward": pixels.forward, "left": pixels.left}, {"forward": -pixels.left, "left": pixels.forward}
    inner = np.abs(s.sine) < 0.9
    for name, (dx, dy, turn, log) in steps.items():
        ends = [
            shown(
                pixels,
                HELIX,
                HEIGHT,
                axis + sign * np.array([dx, dy]),
                turned + sign * turn,
                BLUR_PX * np.exp(sign * log),
            )
            for sign in (1, -1)
        ]
        width = 2 * max(dx, dy, turn, log)
        dp, dq = by_p.get(name, 0.0), by_q.get(name, 0.0) * s.moves
        rise = pixels.climb * (dp + s.tangent * dq)
        expected = s.by_height * rise + s.by_screw * (rise - slope * (dq * s.turning - (name == "turn")))
        expected = expected + s.by_blur * (name == "blur")
        numeric = (ends[0].light - ends[1].light) / width
        scale = np.abs(expected[inner]).max()
        assert np.sqrt(np.mean((numeric - expected)[inner] ** 2)) < 0.02 * scale  # kinks where stripe and ring meet
        cover = s.cover_by_aside * by_q.get(name, 0.0) + s.cover_by_blur * (name == "blur")
        numeric = (ends[0].cover - ends[1].cover) / width
        np.testing.assert_allclose(numeric, cover, atol=0.01 * max(np.abs(cover).max(), 1.0))


def test_parts_of_a_target():
    pose = Pose2(2.0, 0.0, 0.5)
    whole, axis = pixels_at(pose)
    picture = np.zeros((480, 640), np.uint8)
    right = pixels_of(Sought([picture], CAMERA, HELIX), 0, axis, Part(left=0.2))
    upper = pixels_of(Sought([picture], CAMERA, HELIX), 0, axis, Part(lower=0.5))
    assert shown(right, HELIX, HEIGHT, axis, 0.5, BLUR_PX).sine.min() > 0.15
    assert right.azimuth.max() < np.median(whole.azimuth)  # the right has the lower azimuths
    assert 0.4 < len(upper.grey) / len(whole.grey) < 0.6
    assert upper.climb.min() > np.median(whole.climb) - 0.01


def test_too_few_pixels_or_none():
    picture = np.zeros((480, 640), np.uint8)
    for axis in ([-3.0, 0.0], [0.05, 0.0], [3.0, 30.0], [60.0, 0.0]):  # behind, around the camera, beside, far away
        assert pixels_of(Sought([picture], CAMERA, HELIX), 0, np.array(axis), Part()) is None
