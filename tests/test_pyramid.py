"""Lines of sight and the image pyramid against the camera's rays, an impulse and noise that is drawn."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from tracker.data_sheet import load_data_sheet
from tracker.pyramid import pyramid_noise, pyramid_of, pyramid_variance, sight_of
from tracker.smear import smeared_step

CAMERA = load_data_sheet(Path(__file__).parents[1] / "datasets" / "calibrations" / "helix_640x480.toml").camera


@pytest.mark.parametrize("level", [0, 2])
def test_a_pixel_looks_along_the_cameras_ray(level):
    sight = sight_of(CAMERA, level)
    u, v = 5, 7
    ray = CAMERA.rays([[u * 2**level, v * 2**level]])[0]
    place = v, u
    bend = 1e-4 * 4**level  # of the field within a pixel's blur, at most
    assert sight.azimuth[place] == pytest.approx(np.arctan2(ray[1], ray[0]), abs=bend)
    assert sight.climb[place] == pytest.approx(ray[2] / np.hypot(*ray[:2]), abs=bend)
    assert (sight.forward[place], sight.left[place]) == pytest.approx(ray[:2] / np.hypot(*ray[:2]), abs=1e-6)
    beside = CAMERA.rays([[(u + 1) * 2**level, v * 2**level], [u * 2**level, (v + 1) * 2**level]])
    turns = np.arctan2(beside[:, 1], beside[:, 0]) - np.arctan2(ray[1], ray[0])
    assert sight.turn_sq[place] == pytest.approx(np.sum(turns**2), rel=0.05)  # differences to one side


@pytest.mark.parametrize("level", [1, 3])
def test_smoothing_of_the_pyramid(level):
    """A point in the middle of a large picture: its second moment, in pixels of the level."""
    size = 65 * 2**level
    point = np.zeros((size, size), np.float32)
    point[32 * 2**level, 32 * 2**level] = 1.0
    spread = pyramid_of(point, level + 1)[level].sum(axis=0).astype(float)
    place = np.arange(len(spread)) - 32
    assert np.sum(spread * place) == pytest.approx(0.0, abs=1e-6)
    assert np.sum(spread * place**2) / spread.sum() == pytest.approx(pyramid_variance(level), rel=1e-3)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_noise_that_pixels_of_a_level_share(level):
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((1024, 1024)).astype(np.float32)
    seen = pyramid_of(noise, level + 1)[level].astype(float)
    blocks = seen[: len(seen) // 16 * 16, : len(seen) // 16 * 16].reshape(len(seen) // 16, 16, -1, 16).mean(axis=(1, 3))
    ratio = blocks.var() * 16**2 / seen.var()
    edge = (1 - 2 ** (level > 0) / 16) ** 2  # a block's border pixels share with others: a few percent
    assert ratio == pytest.approx(pyramid_noise(level), rel=0.25) and ratio > edge * 0.8 * pyramid_noise(level)


def test_a_smeared_step_is_the_normal_distribution():
    x = np.linspace(-6, 6, 2001)
    step, bell = smeared_step(x)
    np.testing.assert_allclose(step, ndtr(x), atol=4e-4)
    np.testing.assert_allclose(bell, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), atol=1e-12)
