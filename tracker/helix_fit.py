"""The pose of a helix target from every pixel of its mantle: predicted grey levels are fitted to the picture.

Gauss-Newton finds the axis, the heading and the blur, first in a coarse picture, then in a fine one, with weights that
fall for what the target cannot be. The covariance is that of independent pixels, scaled by their
residuals, or by what a sandwich (White 1980) exceeds it, where one does: with the pixels of half a row as a cluster,
which share how the row lies to an edge; with columns as clusters, which share how they lie to the silhouette and to
the light; with the two limbs, and the upper and the lower half between them, which show when something beside the
target pulls at it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from tracker.camera import Camera
from tracker.helix import Helix
from tracker.helix_linear import Linearized, Noise, State, first_blur_log, linearized, noise_of
from tracker.helix_model import WHOLE, Part, Pixels, select
from tracker.helix_search import Candidate
from tracker.pyramid import pyramid_noise, sight_of

FINE_PX, COARSE_PX = 64.0, 22.0  # height of the pattern in the pictures that are fitted, at most
FLOORS = (0.20, 0.07)  # sigmas of the first steps, of the contrast: what does not fit may only be displaced
FIRST_GREY = 20.0  # sigma of the first residuals
STEPS = 6
CONVERGED = 1.0  # sigma of independent pixels: the step is still taken, and what the next would change is far less
COVERS = np.array([0.02, 0.16, 0.5, 0.84, 0.98])  # shares of a pixel within the silhouette: one sigma of blur apart
SINES = 8  # steps from the facing generator to the limb
LIMB_SINE = 0.85  # of the angle from the facing generator, from which on it is the silhouette that counts
PLAUSIBLE, PLAUSIBLE_PART = 0.85, 0.75  # share of the variance that a fit explains, the coarse one already
DARKNESS = 0.7  # light less dark, in dark, at least
MARGIN_PX = 4  # around the target
LEAST_SCALE = 0.2  # of the variance by the residuals: few of them may be small by chance
PARAMETERS = 15  # that are fitted, those of the light included
# Of them, what rows tell apart (pose, blur, slope of the light, haze, what is below and above) and what columns do
# (pose, blur, six of the light): so many clusters are as good as lost.
ROW_PARAMETERS, COLUMN_PARAMETERS = 8, 9


class Sought(NamedTuple):
    """A target in a picture."""

    pyramid: list[np.ndarray]
    camera: Camera
    helix: Helix


@dataclass(frozen=True, slots=True, eq=False)
class HelixFit:
    """A minimum of the photometric error."""

    state: State
    cov: np.ndarray  # (3, 3) of axis and heading
    part: Part  # of the target that was looked at
    level: int  # of the pyramid
    pixels: Pixels
    last: Linearized  # one step before the state

    @property
    def size(self) -> int:
        """Number of pixels that show the target."""
        return int(np.count_nonzero(self.last.shown.cover > 0.5))

    @property
    def range_sigma_m(self) -> float:
        """Standard deviation of the distance from the camera."""
        ahead = self.state.axis / np.hypot(*self.state.axis)
        return float(np.sqrt(ahead @ self.cov[:2, :2] @ ahead))


def fit_helix(sought: Sought, candidate: Candidate, part: Part = WHOLE) -> HelixFit | None:
    """The minimum near a candidate, by a part of the target. None when there is none."""
    camera, helix, levels = sought.camera, sought.helix, len(sought.pyramid)
    away = candidate.axis - camera.mount.position_body[:2]
    heading = float(np.arctan2(-away[1], -away[0])) - candidate.azimuth_rad
    high_px = (helix.top_m - helix.bottom_m) / float(np.hypot(*away)) * camera.lens.fy_px
    coarse, fine = (int(np.clip(np.ceil(np.log2(high_px / most)), 0, levels - 1)) for most in (COARSE_PX, FINE_PX))
    state = State(away, heading, first_blur_log(coarse))
    passes = ((coarse, FLOORS, len(FLOORS)), (fine, (), STEPS)) if coarse > fine else ((fine, FLOORS, STEPS),)
    noise = Noise(FIRST_GREY**2, 0.0)
    for level, floors, steps in passes:
        pixels = pixels_of(sought, level, state.axis, part)
        found = None if pixels is None else _descended(sought, pixels, level, state, noise, floors, steps)
        if found is None or not _is_plausible(pixels, found[1], PLAUSIBLE if part == WHOLE else PLAUSIBLE_PART):
            return None
        state, last, noise = found
        if level > fine:
            state = state._replace(blur_log=first_blur_log(fine))
    return HelixFit(state, _covariance(pixels, state, last, fine), part, fine, pixels, last)


def pixels_of(sought: Sought, level: int, axis: np.ndarray, part: Part) -> Pixels | None:
    """Pixels of a level that show a part of the target with its axis (2,) from the camera; None: too few."""
    camera, helix, image = sought.camera, sought.helix, sought.pyramid[level]
    ahead = axis / np.hypot(*axis)
    aside = np.array([-ahead[1], ahead[0]])
    around = axis + helix.radius_m * np.array([-ahead, aside - ahead, -aside - ahead, aside, -aside])
    low, high = helix.bottom_m - helix.lower_collar_m, helix.top_m + helix.upper_collar_m
    points = np.array([[*place, z - camera.mount.height_m] for z in (low, high) for place in around])
    points = points @ camera.mount.R_body_camera
    if points[:, 2].min() < helix.radius_m / 10:
        return None
    zero = np.zeros(3)
    pixels = cv2.projectPoints(points, zero, zero, camera.lens.matrix, camera.lens.distortion)[0][:, 0] / 2**level
    size = np.array(image.shape[::-1])
    first = np.clip(np.floor(pixels.min(axis=0)) - MARGIN_PX, 0, size).astype(int)
    last = np.clip(np.ceil(pixels.max(axis=0)) + MARGIN_PX + 1, 0, size).astype(int)
    if (first >= last).any():
        return None
    box = slice(first[1], last[1]), slice(first[0], last[0])
    return select(sight_of(camera, level), image, box, axis, helix, camera.mount.height_m, part)


def _descended(sought: Sought, pixels: Pixels, level: int, state: State, noise: Noise, floors, steps: int):
    """State, linearization and noise after Gauss-Newton; None when it leads astray."""
    last, distance = None, float(np.hypot(*state.axis))
    for step in range(steps):
        last = linearized(pixels, sought.helix, sought.camera.mount.height_m, state, noise, last, level)
        noise = noise_of(last)
        if step < len(floors):
            floor = (floors[step] * float(np.median(np.abs(last.contrast)))) ** 2
            noise = Noise(max(noise.dark, floor), noise.slope)
        try:
            inverse = np.linalg.inv(last.normal)
        except np.linalg.LinAlgError:
            return None
        change = inverse @ last.gradient
        if not np.isfinite(change).all():
            return None
        small = np.abs(change[:3]) < CONVERGED * np.sqrt(np.abs(np.diag(inverse)[:3]))
        change *= min(1.0, 0.06 * distance / np.hypot(*change[:2]), 0.5 / abs(change[2]), 0.4 / abs(change[3]))
        state = State(state.axis + change[:2], state.heading_rad + change[2], state.blur_log + change[3])
        if abs(np.hypot(*state.axis) - distance) > 0.3 * distance:
            return None
        if step > len(floors) and small.all():
            break
    return state, last, noise


def _is_plausible(pixels: Pixels, last: Linearized, share: float) -> bool:
    on = last.shown.cover > 0.5
    if not on.any() or last.contrast[on].mean() < max(last.dark[on].mean(), 0.0) * DARKNESS:
        return False
    return bool(last.residual[on].var() < (1 - share) * pixels.grey[on].var())


def _covariance(pixels: Pixels, state: State, last: Linearized, level: int) -> np.ndarray:
    """(3, 3) of axis and heading; stretched along and across the line of sight and in heading, each by its own."""
    inverse, share = np.linalg.inv(last.normal), pyramid_noise(level)
    squares = last.weights * last.residual**2
    dof = len(squares) - PARAMETERS - 0.5 * len(pixels.starts)  # a half row's own level is seen by half of them
    plain = inverse[:3, :3] * (max(float(squares.sum()) / dof, LEAST_SCALE) * share)
    ahead = state.axis / np.hypot(*state.axis)
    sight = np.array([[*ahead, 0.0], [-ahead[1], ahead[0], 0.0], [0.0, 0.0, 1.0]])
    expected = np.diag(sight @ plain @ sight.T)
    pulls = last.jacobian * (last.weights * last.residual)
    limb = np.abs(last.shown.sine) > LIMB_SINE
    part = 2 * limb + np.where(limb, last.shown.sine > 0, pixels.row > 0)
    shown, count = last.shown, len(COVERS) + SINES + 1
    column = np.where(
        shown.cover < COVERS[-1], np.searchsorted(COVERS, shown.cover), len(COVERS) + np.abs(shown.sine) * SINES
    )
    column = column.astype(int) + count * (shown.sine > 0)
    # A sum along a row or a column has the noise that smoothing took along it already, and lacks that of the other way.
    by_row = np.add.reduceat(pulls, pixels.starts, axis=1) * share**0.25
    by_column = np.stack([np.bincount(column, pull, 2 * count) for pull in pulls]) * share**0.25
    by_part = pulls @ (part[:, None] == np.arange(4))  # has it both ways; of four clusters no scatter can be told
    columns = np.count_nonzero(np.bincount(column))
    ratios = []
    for sums, few in (
        (by_row, _small_sample(by_row.shape[1], ROW_PARAMETERS)),
        (by_column, _small_sample(columns, COLUMN_PARAMETERS)),
        (by_part, 1.0),
    ):
        ratios.append(few * np.sum((sight @ (inverse @ sums)[:3]) ** 2, axis=1) / expected)
    stretch = np.sqrt(np.maximum(1.0, np.max(ratios, axis=0)))
    turn = sight.T @ (stretch[:, None] * sight)
    cov = turn @ plain @ turn.T
    return (cov + cov.T) / 2


def _small_sample(clusters: int, lost: int) -> float:
    """How much larger a squared error is, on average, than a sandwich of few clusters says: what the parameters took
    (MacKinnon and White 1985), and that the sandwich scatters itself, as a chi-square with the rest's degrees of
    freedom does."""
    left = max(clusters - lost, lost)
    return clusters / (left - 2)
