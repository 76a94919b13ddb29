"""The pose of a robot from every pixel of its tags: predicted grey levels are fitted to the picture.

A face is light with dark modules; lens and motion smear it as a Gaussian of covariance [[A, C], [C, B]] pixels^2, and
the pixels' area as a box. Along a straight edge only the smear across it matters, so

    light(s, t) = 1 - sum_ij D_ij box_j(s) box_i(t),    box_k(s) = step(s - s_k) - step(s - s_k+1), smeared,

with (s, t) where the ray through a pixel's centre meets the face, in modules from its middle, right and down. Grey
levels are linear in a dark level, a gain, its slopes across the picture, and what lies beyond the edges of a small
face. These are eliminated (variable projection: Golub and Pereyra 1973, Kaufman 1975); Gauss-Newton finds the others.
The covariance is that of independent pixels, scaled by how much the sandwich of White (1980) exceeds it on average over
x, y and heading; the pixels of a module are a cluster: they may err together. Of tiny tags the largest ratio counts.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from tracker.camera import Camera
from tracker.tag_region import HALF, Region

ROOT = float(1 / np.sqrt(2 * np.pi))
STEPS = 15
NOISE_STEPS = 3  # after which the noise of the pixels is known
CONVERGED = 0.1  # sigmas of the pose
BLUR_START = np.array([0.4, 0.4, 0.0])  # A, B, C, px^2
BLUR_SIGMA = np.array([0.6, 0.6, 0.15])  # and how well that is known
LEAST_BLUR = 0.02  # of A and B, px^2
HUBER = 4.0  # sigmas
LEAST_VARIANCE = 1 / 12  # of a grey level: it is rounded
SMALL_PX = 6.0  # modules below which the face's edges smear into what is looked at
TINY_PX = 3.2  # modules below which there are few cells, and the prediction is a little too simple
TINY_RATIO = 2.0  # then, at least: what few cells show may be too good by chance
LEAST_RATIO = 0.8  # of the sandwich to the covariance of independent pixels; it is known to some 10 % only
LINES = np.arange(-HALF, HALF + 1, dtype=np.float32)  # between modules
DARK, LIGHT = 0.1, 0.9  # what is less or more than that is taken for the noise of dark and light


class Noise(NamedTuple):
    """Variance of a pixel: of dark ones, and how much more of light ones."""

    dark: float
    slope: float

    def variance(self, light: np.ndarray) -> np.ndarray:
        return self.dark + self.slope * np.clip(light, 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class TagFit:
    """A minimum of the photometric error."""

    pose: np.ndarray  # (3,) x, y, theta of the target in the observer's body
    cov: np.ndarray  # (3, 3)
    chi_square: float  # of the pixels' noise as it is believed
    scale: float  # what a degree of freedom contributes to it, correlation included; 1 where that belief is right
    noise: Noise
    blur: np.ndarray  # (3,) A, B, C, px^2
    explained: float  # share of the picture's variance in the regions, at worst over the tags
    contrast: float  # grey levels between light and dark, at worst over the tags


class Linearized(NamedTuple):
    """One region about a pose and a blur: projected residual and Jacobian, whitened."""

    residual: np.ndarray  # (N,) grey levels: picture less prediction
    jacobian: np.ndarray  # (N, 6) of the prediction, grey levels
    light: np.ndarray  # (N,) 0 to 1
    weights: np.ndarray  # (N,) of squares
    contrast: float


def fit_tags(regions: list[Region], camera: Camera, pose: np.ndarray, noise: Noise | None = None) -> TagFit | None:
    """The minimum near a pose. noise: of the pixels, when it is known; None: as the residuals say.

    None when the faces are turned away or nothing constrains the pose.
    """
    blur, now = BLUR_START.copy(), np.array(pose, float)
    known, noise = noise is not None, noise or Noise(4.0, 0.0)
    for step in range(STEPS):
        parts = [linearized(region, camera, now, blur, noise) for region in regions]
        if any(part is None for part in parts):
            return None
        hessian = sum(np.einsum("ni,n,nj->ij", part.jacobian, part.weights, part.jacobian) for part in parts)
        gradient = sum(part.jacobian.T @ (part.weights * part.residual) for part in parts)
        hessian[3:, 3:] += np.diag(1 / BLUR_SIGMA**2)
        gradient[3:] += (BLUR_START - blur) / BLUR_SIGMA**2
        try:
            inverse = np.linalg.inv(hessian + 1e-9 * np.diag(np.diag(hessian)))
        except np.linalg.LinAlgError:
            return None
        change = inverse @ gradient
        if 0 < step <= NOISE_STEPS and not known:
            noise = _noise_of(parts)
        sigmas = np.sqrt(np.maximum(np.diag(inverse)[:3], 0))
        if step > 1 and (np.abs(change[:3]) < CONVERGED * sigmas).all():
            break
        change[:3] *= min(1.0, 0.3 / max(np.abs(change[:3]).max(), 1e-12))
        now, blur = now + change[:3], _possible(blur + change[3:])
    return _concluded(regions, parts, now, blur, inverse, noise)


def _possible(blur: np.ndarray) -> np.ndarray:
    a, b = np.maximum(blur[:2], LEAST_BLUR)
    most = 0.9 * np.sqrt(a * b)
    return np.array([a, b, np.clip(blur[2], -most, most)])


def linearized(region: Region, camera: Camera, pose: np.ndarray, blur: np.ndarray, noise: Noise) -> Linearized | None:
    """The prediction about a (3,) pose and a (3,) blur A, B, C, px^2. None when the face is turned away."""
    met = rays_met(region, camera, pose)
    if met is None:
        return None
    s, t, ds, dt, across_s, across_t = met
    (share_s, sigma_s, width_s), (share_t, sigma_t, width_t) = (_smear(blur, across) for across in (across_s, across_t))
    # single precision takes half the time
    box_s, box_s_by_s, box_s_by_sigma = smeared_modules(*map(np.float32, (s, sigma_s, width_s)))
    box_t, box_t_by_t, box_t_by_sigma = smeared_modules(*map(np.float32, (t, sigma_t, width_t)))
    columns, rows = box_s @ region.dark.T, box_t  # (N, 8) over the rows of the tag
    light = 1 - np.sum(columns * rows, axis=1)
    by_s = -np.sum((box_s_by_s @ region.dark.T) * rows, axis=1)
    by_t = -np.sum(columns * box_t_by_t, axis=1)
    by_sigma_s = -np.sum((box_s_by_sigma @ region.dark.T) * rows, axis=1)
    by_sigma_t = -np.sum(columns * box_t_by_sigma, axis=1)
    by_pose = by_s * ds + by_t * dt
    by_blur = by_sigma_s / (2 * sigma_s) * share_s + by_sigma_t / (2 * sigma_t) * share_t
    basis = [np.ones_like(light), light, light * region.place[:, 0], light * region.place[:, 1]]
    if region.module_px < SMALL_PX:
        edge = region.face_edge
        basis += [ndtr((-edge - s) / sigma_s), ndtr((s - edge) / sigma_s)]
        basis += [ndtr((-edge - t) / sigma_t), ndtr((t - edge) / sigma_t)]
    basis = np.stack(basis, axis=1)
    weights = 1 / noise.variance(light)
    gram = basis.T @ (weights[:, None] * basis)
    gram += 1e-6 * np.diag(np.diag(gram)) + 1e-9 * np.eye(len(gram))
    project = np.linalg.solve(gram, basis.T * weights)
    levels = project @ region.grey
    residual = region.grey - basis @ levels
    far = np.abs(residual) * np.sqrt(weights)
    scale = max(1.4826 * np.median(far), 1.0)
    weights = weights * np.minimum(1.0, HUBER * scale / np.maximum(far, 1e-9))
    gain = levels[1] + region.place @ levels[2:4]
    slopes = np.concatenate([by_pose, by_blur]).T * gain[:, None]
    jacobian = slopes - basis @ (project @ slopes)
    return Linearized(residual, jacobian, light, weights, float(levels[1]))


def rays_met(region: Region, camera: Camera, pose: np.ndarray):
    """Where the rays meet the face: (N,) s and t in modules, right and down; their (3, N) derivatives by the pose, and
    (2, N) by pixels along columns and rows. None when a ray does not meet its front."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    right, up, out = region.axes @ turn.T
    carried = turn @ region.middle
    offset = carried + [pose[0], pose[1], 0.0] - camera.mount.position_body
    along, reach = out @ region.directions, out @ offset
    if reach >= 0 or not (along < 0).all():
        return None
    depth = reach / along
    from_middle = depth * region.directions - offset[:, None]
    moved = np.zeros((3, 3))  # of the face's middle, by x, y, theta
    moved[0, 0] = moved[1, 1] = 1.0
    moved[:, 2] = [-carried[1], carried[0], 0.0]
    spin = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    depth_moved = np.repeat((out @ moved)[:, None], len(depth), axis=1) / along
    out_turned = spin @ out
    depth_moved[2] += (out_turned @ offset - depth * (out_turned @ region.directions)) / along
    scale = region.modules_per_m
    found = []
    for axis in (right, -up):
        axis_moved = (axis @ region.directions) * depth_moved - (axis @ moved)[:, None]
        axis_moved[2] += (spin @ axis) @ from_middle
        pixels = []
        for column, focal in enumerate((camera.lens.fx_px, camera.lens.fy_px)):
            step = camera.mount.R_body_camera[:, column]
            pixels.append(depth * (axis @ step - (out @ step) / along * (axis @ region.directions)) / focal)
        found.append((scale * (axis @ from_middle), scale * axis_moved, scale * np.array(pixels)))
    (s, ds, across_s), (t, dt, across_t) = found
    return s, t, ds, dt, across_s, across_t


def _smear(blur: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What smears a point across the lines of the tag: (3, N) shares of A, B, C in the variance, (N,) sigma of the
    Gaussian, (N,) width of the box. A pixel's square is a box along its longer extent, a part of the sigma across."""
    share = np.stack([across[0] ** 2, across[1] ** 2, 2 * across[0] * across[1]])
    extent = np.abs(across)
    width = extent.max(axis=0)
    return share, np.sqrt(blur @ share + extent.min(axis=0) ** 2 / 12), width


def smeared_modules(s: np.ndarray, sigma: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, 8) share of each module under the smeared point, and its derivatives by s and by sigma.

    A step smeared by a Gaussian and a box is a difference of the Gaussian's second integral x Phi(x) + phi(x).
    """
    from_line, sigma, width = s[:, None] - LINES, sigma[:, None], width[:, None]
    steps = []
    for side in (0.5, -0.5):
        z = (from_line + side * width) / sigma
        bell, below = np.exp(-0.5 * z * z) * ROOT, ndtr(z)
        steps.append((sigma * (z * below + bell) / width, below / width, bell / width))
    step, by_s, by_sigma = (one - other for one, other in zip(*steps, strict=True))
    return step[:, :-1] - step[:, 1:], by_s[:, :-1] - by_s[:, 1:], by_sigma[:, :-1] - by_sigma[:, 1:]


def _noise_of(parts: list[Linearized]) -> Noise:
    """Robust variances of the dark and of the light pixels."""
    residual = np.concatenate([part.residual for part in parts])
    light = np.concatenate([part.light for part in parts])
    both = _variance(residual)
    dark, bright = residual[light < DARK], residual[light > LIGHT]
    if min(len(dark), len(bright)) < 30:
        return Noise(both, 0.0)
    low, high = _variance(dark), _variance(bright)
    return Noise(low, max(high - low, 0.0))


def _variance(residual: np.ndarray) -> float:
    return max(float(np.median(np.abs(residual)) * 1.4826) ** 2, LEAST_VARIANCE)


def _concluded(regions: list[Region], parts: list[Linearized], pose, blur, inverse, noise: Noise) -> TagFit:
    squares = [part.weights * part.residual**2 for part in parts]
    dof = sum(map(len, squares)) - 6 - 4 * len(parts)
    chi_square = float(sum(map(np.sum, squares)))
    scatter = np.zeros((6, 6))
    clusters = 0
    for region, part in zip(regions, parts, strict=True):
        pulls = part.jacobian * (part.weights * part.residual)[:, None]
        count = region.cells.max() + 1
        sums = np.stack([np.bincount(region.cells, pulls[:, k], count) for k in range(6)])
        scatter += sums @ sums.T
        clusters += count
    sandwich = inverse @ scatter @ inverse * (clusters / max(clusters - 6 - 4 * len(parts), 1))
    plain = inverse * max(chi_square / dof, 1e-3)
    ratios = np.diag(sandwich)[:3] / np.diag(plain)[:3]
    is_tiny = any(region.module_px < TINY_PX for region in regions)
    inflation = float(max(TINY_RATIO, ratios.max()) if is_tiny else max(LEAST_RATIO, ratios.mean()))
    explained = [
        1 - np.var(part.residual) / max(np.var(region.grey), 1e-9) for region, part in zip(regions, parts, strict=True)
    ]
    return TagFit(
        pose,
        plain[:3, :3] * inflation,
        chi_square,
        max(chi_square / dof, 1e-3) * inflation,
        noise,
        blur,
        float(min(explained)),
        min(part.contrast for part in parts),
    )
