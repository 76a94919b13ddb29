"""Finds a robot by its helix: the whole pattern is searched for, every pixel of it is fitted, the rest is checked.

What the fit explains must be nearly everything, light and dark must differ as paint does, what lies beside the
silhouette must not carry the pattern on, and the lens must not be more blurred than it can be. The heading is withheld
where the stripe is hidden or another heading fits about as well.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from coopslam.errors import require_positive
from coopslam.se2 import Pose2, rotation, wrap, xytheta
from tracker.camera import Camera
from tracker.detector import Detection, require_picture
from tracker.helix import Helix
from tracker.helix_fit import HelixFit, Sought, fit_helix
from tracker.helix_linear import first_blur_log
from tracker.helix_model import Part
from tracker.helix_search import HelixSearch
from tracker.pyramid import pyramid_of

OUTSIDE = 0.2  # share of a pixel within the silhouette, at most, that counts as beside it
NEAR_LIMB = 0.6  # sine of the angle from the facing generator, from which on a pixel is near the silhouette
# What is looked at when something hides the rest.
PARTS = Part(left=-0.15), Part(right=0.15), Part(lower=0.42), Part(upper=0.58)
CONTRADICTION = 30.0  # squared Mahalanobis distance of two fits, of three degrees of freedom: one in a million
NOTHING = 0.01  # share of the variance that no pattern but the right one leaves, whatever its shape
LONE_MISSED = 0.005  # of the variance, at most, by a fit to one side when nothing confirms it: 1 in 20 misses more
FLAT_GREY = 4.0  # sigma below which what is beside is flat


@dataclass(frozen=True, slots=True)
class Belief:
    """When a fit is believed. Raises BadInput naming the field."""

    explained_min: float = 0.955  # share of the picture's variance on the target that the prediction explains
    fitting_min: float = 0.92  # share of the target's pixels that are no outliers
    pixels_min: int = 150  # of the target; what few of them show may be chance
    contrast_min: float = 10.0  # grey levels between light and dark
    darkness_min: float = 0.68  # light less dark, in light: 0.94 for the data sheets' paint without any haze
    alike_max: float = 0.65  # correlation of neighbouring residuals: of noise zero, at halved pictures 0.4
    beside_max: float = 0.65  # correlation of what is beside the silhouette with what is within, row by row
    blur_ratio_max: float = 2.6  # of the blur to the one that is expected, either way
    range_sigma_max: float = 0.05  # share of the range
    heading_sigma_max_rad: float = 0.3  # a heading that is known less well is none

    def __post_init__(self):
        for name in self.__slots__:
            require_positive(**{name: getattr(self, name)})


# Where few pixels show the target, something that hides a part of it may pass for it: what one in a hundred targets
# misses of which nothing is hidden.
SMALL = Belief(explained_min=0.98, fitting_min=0.965, alike_max=0.5)

# Where only a part is looked at, less speaks for it, and an edge of what hides the rest may fit as well.
PARTLY_SEEN = replace(SMALL, pixels_min=450, blur_ratio_max=1.6, range_sigma_max=0.01, heading_sigma_max_rad=0.06)


@dataclass(frozen=True, slots=True)
class HelixDetectorSettings:
    """What is looked for, and when it is believed. Raises BadInput naming the field."""

    farthest_m: float = 11.0  # that is looked for
    candidates: int = 3  # places that are fitted, at most
    score_min: float = 0.6  # correlation coefficient of a candidate
    small_pixels: int = 800  # a target that fewer pixels show is small
    whole: Belief = Belief()
    small: Belief = SMALL
    part: Belief = PARTLY_SEEN

    def __post_init__(self):
        for name in ("farthest_m", "candidates", "score_min", "small_pixels"):
            require_positive(**{name: getattr(self, name)})


class HelixDetector:
    """Detector of helix targets in the pictures of one camera."""

    def __init__(self, camera: Camera, helix: Helix, settings: HelixDetectorSettings | None = None):
        self.camera, self.helix, self.settings = camera, helix, settings or HelixDetectorSettings()
        self._search = HelixSearch(camera, helix, self.settings.farthest_m)

    def detect(self, image: np.ndarray) -> Detection | None:
        """The robot in a (H, W) uint8 picture, None without any. Raises BadInput for another size or type."""
        require_picture(image, self.camera.lens)
        pyramid = pyramid_of(image, self._search.levels)
        candidates = self._search.candidates(pyramid, self.settings.candidates, self.settings.score_min)
        sought = Sought(pyramid, self.camera, self.helix)
        for candidate in candidates:
            fit = fit_helix(sought, candidate)
            if fit is not None and self.is_believed(fit, self._limits(fit)):
                return self._detection(fit)
        fits = [fit_helix(sought, candidate, part) for candidate in candidates[:1] for part in PARTS]
        limits = self.settings.part
        fits = [fit for fit in fits if fit is not None and self.is_believed(fit, limits) and _is_turned(fit, limits)]
        if len(fits) == 1 and fits[0].part.is_one_sided and _missed(fits[0]) > LONE_MISSED:
            return None  # its silhouette may be the edge of what hides the other
        return self._agreed(fits) if fits else None

    def _limits(self, fit: HelixFit) -> Belief:
        return self.settings.whole if fit.size >= self.settings.small_pixels else self.settings.small

    def is_believed(self, fit: HelixFit, limits: Belief) -> bool:
        """Whether a fit is the target."""
        last, range_m = fit.last, float(np.hypot(*fit.state.axis))
        on = last.shown.cover > 0.5
        fitting = last.fitting[on]
        if (
            len(fitting) < limits.pixels_min
            or fitting.mean() < limits.fitting_min
            or range_m > self.settings.farthest_m
        ):
            return False
        contrast, dark = float(np.median(last.contrast[on])), float(np.median(last.dark[on]))
        missed = _missed(fit)
        return (
            contrast > limits.contrast_min
            and contrast > limits.darkness_min * (contrast + dark)
            and missed < 1 - limits.explained_min
            and abs(fit.state.blur_log - first_blur_log(fit.level)) < np.log(limits.blur_ratio_max)
            and fit.range_sigma_m < limits.range_sigma_max * range_m
            and (missed < NOTHING or alike_along(fit) < limits.alike_max)
            and alike_across(fit) < limits.beside_max
        )

    def _agreed(self, fits: list[HelixFit]) -> Detection:
        """The fit that leaves least shape, of fits to different parts. An edge of what hides the target may be taken
        for a silhouette: where fits contradict each other the heading is open, and the covariance is over them all."""
        found = [self._detection(fit) for fit in sorted(fits, key=alike_along)]
        best = found[0]
        away = [_between(best.T_observer_target, other.T_observer_target) for other in found]
        covs = [best.cov_observer + other.cov_observer for other in found]
        off = np.array([each @ np.linalg.solve(cov, each) for each, cov in zip(away, covs, strict=True)])
        if (off < CONTRADICTION).all():
            return best
        away = np.array(away)
        apart = away - away.mean(axis=0)
        cov = (sum(each.cov_observer for each in found) + apart.T @ apart) / len(found)
        mean = xytheta(best.T_observer_target) + away.mean(axis=0)
        return Detection(Pose2(*mean), (cov + cov.T) / 2, False, best.features_px)

    def _detection(self, fit: HelixFit) -> Detection:
        """The pose of the robot's reference point from that of the cylinder's axis."""
        heading = wrap(fit.state.heading_rad)
        offset = rotation(heading) @ [self.helix.forward_m, 0.0]
        place = fit.state.axis + self.camera.mount.position_body[:2] - offset
        by_fit = np.eye(3)
        by_fit[:2, 2] = [offset[1], -offset[0]]
        cov = by_fit @ fit.cov @ by_fit.T
        known = _is_turned(fit, self.settings.whole)
        return Detection(Pose2(*place, heading), (cov + cov.T) / 2, known, self._outlines(fit.state.axis))

    def _outlines(self, axis: np.ndarray) -> tuple[np.ndarray, ...]:
        """The ends of the pattern and its two silhouettes, for drawing."""
        helix, away = self.helix, -axis / np.hypot(*axis)
        limb = np.arccos(min(helix.radius_m / np.hypot(*axis), 1.0))
        angles = np.arctan2(away[1], away[0]) + np.linspace(-limb, limb, 13)
        arc = axis + helix.radius_m * np.column_stack([np.cos(angles), np.sin(angles)])
        heights = np.repeat([helix.bottom_m, helix.top_m], len(arc)) - self.camera.mount.height_m
        points = np.column_stack([np.tile(arc, (2, 1)), heights]) @ self.camera.mount.R_body_camera
        lens, zero = self.camera.lens, np.zeros(3)
        pixels = cv2.projectPoints(points, zero, zero, lens.matrix, lens.distortion)[0].reshape(2, len(arc), 2)
        lines = pixels[0], pixels[1], pixels[:, 0], pixels[:, -1]
        return lines


def _between(one: Pose2, other: Pose2) -> np.ndarray:
    """(3,) x, y, theta from one pose to another, in the axes of both's frame."""
    x, y, theta = xytheta(other) - xytheta(one)
    return np.array([x, y, wrap(theta)])


def _is_turned(fit: HelixFit, limits: Belief) -> bool:
    """Whether the fit knows the heading."""
    return bool(fit.cov[2, 2] <= limits.heading_sigma_max_rad**2)


def _missed(fit: HelixFit) -> float:
    """Share of the picture's variance on the target that the prediction does not explain, outliers aside."""
    on = (fit.last.shown.cover > 0.5) & fit.last.fitting
    return float(np.mean(fit.last.residual[on] ** 2)) / max(float(np.var(fit.pixels.grey[on])), 1e-9)


def alike_along(fit: HelixFit) -> float:
    """Correlation of the residuals of neighbours in a row: what is left of a wrong pattern has a shape."""
    whitened = fit.last.residual * np.sqrt(fit.last.weights)
    same = fit.pixels.half[1:] == fit.pixels.half[:-1]
    return float(np.sum((whitened[1:] * whitened[:-1])[same]) / max(np.sum((whitened**2)[1:][same]), 1e-9))


def alike_across(fit: HelixFit) -> float:
    """Correlation, over half rows, of the grey level beside the silhouette with the one within it: stripes go on."""
    half, starts, cover = fit.pixels.half, fit.pixels.starts, fit.last.shown.cover
    outside, inside = cover < OUTSIDE, (cover > 1 - OUTSIDE) & (np.abs(fit.last.shown.sine) > NEAR_LIMB)
    own = np.bincount(half[inside], minlength=len(starts))
    known = (own > 0) & (np.bincount(half[outside], minlength=len(starts)) > 0)
    if not known.any():
        return 0.0
    within = np.bincount(half[inside], fit.pixels.grey[inside], len(starts)) / np.maximum(own, 1)
    beside, within = (each[known] - each[known].mean() for each in (fit.last.beside[starts], within))
    spread = np.sqrt(np.mean(np.square(beside)) * np.mean(np.square(within)))
    return float(np.mean(beside * within) / max(spread, FLAT_GREY**2))
