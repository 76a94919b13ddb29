"""The Cramer-Rao bound against closed forms (straight edge, regression line) and the scatter of a likelihood fit."""

from dataclasses import dataclass, replace
from math import inf, pi

import numpy as np
import pytest
from scipy.optimize._numdiff import approx_derivative
from scipy.stats import chi2, norm

from coopslam.se2 import Pose2, wrap, xytheta
from tracker.background import Background
from tracker.camera import Camera, Mount
from tracker.helix import Helix
from tracker.information import marginal_information, pixel_variance, pose_bound, pose_information, sighting_sigmas
from tracker.lens import Lens
from tracker.render import RenderSettings, render
from tracker.scene_light import Light
from tracker.sensor import Sensor
from tracker.target import Look

WIDTH, HEIGHT, FOCAL = 65, 40, 80.0
CAMERA = Camera(Lens(WIDTH, HEIGHT, FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2), Mount(1.0))
BOARD_M = 2.0  # distance
DARK, LIGHT, LARGEST = 0.2, 0.8, 255.0
READ = Sensor(100.0, 10.0, 5e3, 1e4, vignetting=0.0)  # 2 grey levels of read noise and hardly any photons'
VARIANCE = 4 + 50 / 5e3 + 1 / 12  # at the edge: read-out, photons of the mean signal, rounding


@dataclass(frozen=True)
class Board:
    """An upright board that fills the picture; dark left and light right of the robot's axis, seen from in front."""

    def distances(self, origin, directions):
        with np.errstate(divide="ignore"):
            depth = -origin[0] / directions[0]
        return np.where(depth > 0, depth, np.inf)

    def look(self, points):
        light = points[1] < 0
        normals = np.tile(np.array([[-1.0], [0.0], [0.0]]), points.shape[1])
        return Look(normals, np.where(light, LIGHT, DARK), light.astype(int))

    def extent(self):
        return np.array([[0.0, y, z] for y in (-3, 3) for z in (-2, 4)])


@dataclass(frozen=True)
class BoardTarget:
    solids: tuple = (Board(),)


def edge_information(sensor: Sensor, camera: Camera = CAMERA) -> np.ndarray | None:
    settings = RenderSettings(Light(ambient=1.0, direct=0.0), Background("plain"), sensor)
    background = np.zeros((HEIGHT, WIDTH), np.float32)
    return pose_information(camera, BoardTarget(), Pose2(BOARD_M, 0.0, 0.0), settings, background)


def gaussian_kernel(sigma_px: float) -> np.ndarray:
    """Share of a blurred line's light that pixels get; the line lies in the middle of one."""
    return np.diff(norm.cdf((np.arange(-12, 14) - 0.5) / sigma_px))


@pytest.mark.parametrize("sigma_px", [0.6, 1.5])
def test_a_straight_edge_that_is_blurred(sigma_px):
    """var = sigma^2 / sum(gradient^2): a column of pixels changes by contrast * kernel when the edge moves by a pixel.

    Of the nuisances only the mean level takes something away, 1 / width: the edge lies in the middle of a pixel, so
    that what blur and contrast change is odd about it, and the gradient is even. It lies between two cells, a quarter
    of a pixel from the middle of either: what moves over it is shared by both.
    """
    kernel = gaussian_kernel(np.sqrt(sigma_px**2 + 1 / 16))
    gradient_sq = (100.0 * (LIGHT - DARK)) ** 2 * (np.sum(kernel**2) - 1 / WIDTH)
    expected = (FOCAL / BOARD_M) ** 2 * HEIGHT * gradient_sq / VARIANCE
    information = edge_information(replace(READ, defocus_px=sigma_px))
    assert information[1, 1] == pytest.approx(expected, rel=0.02)  # edges are rendered true to 1 % of the step
    others = np.array([information[0, 0], information[2, 2]])  # moving along the line of sight or turning shows nothing
    assert (others < 1e-4 * expected).all()


def test_the_same_edge_by_the_formula_of_a_continuous_blur():
    """sum(gradient^2) = contrast^2 / (2 sqrt(pi) s), the integral of a squared Gaussian; a defocus of 2 pixels is
    smooth, and the pixel's own width adds 1 / 12 to its variance. Tolerance as above.
    """
    gradient_sq = (100.0 * (LIGHT - DARK)) ** 2 * (1 / (2 * np.sqrt(pi * (4 + 1 / 12))) - 1 / WIDTH)
    expected = (FOCAL / BOARD_M) ** 2 * HEIGHT * gradient_sq / VARIANCE
    assert edge_information(replace(READ, defocus_px=2.0))[1, 1] == pytest.approx(expected, rel=0.02)


def test_what_clips_says_nothing():
    """At four times the gain the light side is white, and of the edge a foot is left; at forty times nothing."""
    kernel, across = gaussian_kernel(1.0), np.arange(-12, 13)
    grey = 10.0 + 400.0 * (DARK + (LIGHT - DARK) * (np.cumsum(kernel) - kernel / 2))
    unclipped = kernel[grey < LARGEST]
    assert 0 < len(unclipped) < len(across)
    most = HEIGHT * (FOCAL / BOARD_M * 400 * (LIGHT - DARK)) ** 2 * np.sum(unclipped**2) / (4 + 1 / 12)
    assert 0 < edge_information(replace(READ, gain=400.0, defocus_px=1.0))[1, 1] < most
    assert (edge_information(replace(READ, gain=4000.0, defocus_px=1.0)) == 0).all()


def test_nuisances_as_in_a_regression_line():
    """Slope of a line with unknown intercept: var = sigma^2 / sum((x - mean)^2); twice the same nuisance is one."""
    x, ones = np.linspace(2.0, 5.0, 30)[:, None], np.ones((30, 1))
    expected = np.sum((x - x.mean()) ** 2) / 0.3
    for nuisance in (ones, np.hstack([ones, 5 * ones, np.zeros((30, 1))])):
        assert marginal_information(x, nuisance, np.full(30, 0.3))[0, 0] == pytest.approx(expected)
    assert marginal_information(x, np.zeros((30, 0)), np.full(30, 0.3))[0, 0] == pytest.approx(np.sum(x**2) / 0.3)


@pytest.mark.parametrize(("black_level", "radiance"), [(8.0, 0.05), (8.0, 0.6), (20.0, 0.3)])
def test_the_variance_of_pixels_is_that_of_the_sensor(black_level, radiance):
    """A flat picture of 40 000 pixels: its sample variance is known to 0.7 % (one sigma)."""
    sensor = Sensor(230.0, black_level, 12.0, 9.0, vignetting=0.0, defocus_px=0.0)
    flat = np.full((400, 400), radiance, np.float32)
    picture = sensor.picture(flat, np.random.default_rng(1))
    said = pixel_variance(sensor, sensor.exposed(flat))
    assert np.ptp(said) == 0
    assert picture.var() == pytest.approx(said[0, 0], rel=0.03)


def test_sigmas_of_range_bearing_and_heading():
    """To the left: y is along the line of sight, x across."""
    sigmas = sighting_sigmas(Pose2(0.0, 2.0, 0.3), np.diag([0.01, 0.04, 0.09]))
    np.testing.assert_allclose(sigmas, [0.2, 0.1 / 2, 0.3])


def test_a_target_behind_the_camera_and_a_picture_without_contrast_have_no_bound():
    settings = RenderSettings(Light(0.0, 0.0), Background("plain"), Sensor(vignetting=0.0))
    background = np.zeros((HEIGHT, WIDTH), np.float32)
    assert pose_information(CAMERA, Helix(), Pose2(-2.0, 0.0, 0.0), settings, background) is None
    assert pose_bound(CAMERA, Helix(), Pose2(2.0, 0.0, 0.0), settings, background) is None  # dark before dark


def test_a_maximum_likelihood_fit_scatters_as_the_bound_says():
    """50 pictures of one scene, fitted with everything that the bound takes for unknown, model and slopes from
    `render` and scipy. Band of the sum of 150 squares: 99.9 %."""
    camera = Camera(Lens(112, 84, 84.0, 84.0, 55.5, 41.5), Mount(0.6, 0.42))
    target, pose = Helix(), Pose2(1.1, 0.15, 2.0)
    sensor = Sensor(200.0, 8.0, 10.0, 8.0, defocus_px=0.8, motion_px=1.5, motion_rad=0.4)
    settings = RenderSettings(Light(0.45, 0.4, 1.5, 0.6), Background("gradient"), sensor)
    background = settings.background.radiance(camera, np.random.default_rng(0))
    truth = np.array([*xytheta(pose), 0.45, 0.4, 1.0, 8.0, 0.8, 1.5])

    def model(p: np.ndarray) -> np.ndarray:
        x, y, theta, ambient, direct, behind, black, defocus, motion = p
        now = replace(sensor, black_level=black, defocus_px=defocus, motion_px=motion)
        scene = RenderSettings(Light(ambient, direct, 1.5, 0.6), settings.background, Exposure(now))
        return render(camera, target, Pose2(x, y, theta), scene, None, np.float32(behind) * background).ravel()

    mean = model(truth)
    steps = np.array([2e-3, 1e-3, 5e-3, 1e-2, 1e-2, 1e-2, 0.1, 0.02, 0.05])
    slopes = approx_derivative(model, truth, method="3-point", rel_step=steps / np.abs(truth))
    weights = 1 / ((np.maximum(mean - 8.0, 0) / 10.0 + 0.64) + 1 / 12)
    gain = np.linalg.solve(slopes.T @ (weights[:, None] * slopes), slopes.T * weights)
    bound = pose_bound(camera, target, pose, settings, background)
    squares, rng = [], np.random.default_rng(5)
    for _ in range(50):
        picture = render(camera, target, pose, settings, rng, background).ravel().astype(float)
        p = truth.copy()
        for _ in range(3):
            p = p + gain @ (picture - model(p))
        error = (p - truth)[:3]
        error[2] = wrap(error[2])
        squares.append(error @ np.linalg.solve(bound, error))
    low, high = chi2.ppf([0.0005, 0.9995], 150)
    assert low < np.sum(squares) < high
    slack = np.linalg.inv(slopes.T @ (weights[:, None] * slopes))[:3, :3]
    np.testing.assert_allclose(np.diag(bound), np.diag(slack), rtol=0.05)  # other steps, other window


@dataclass(frozen=True)
class Exposure:
    """A sensor without noise and rounding."""

    sensor: Sensor

    def picture(self, radiance, rng):
        return self.sensor.exposed(radiance)


def test_without_noise_only_rounding_is_left():
    sensor = Sensor(100.0, 10.0, inf, 2.0, vignetting=0.0, defocus_px=1.0)
    np.testing.assert_allclose(pixel_variance(sensor, np.array([0.0, 10.0, 200.0])), 1 / 12)
