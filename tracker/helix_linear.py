"""The picture about a pose of a helix target: what every pixel of its mantle says of the pose, all else eliminated.

Lambert's law makes the light on the mantle a function of the normal alone: 1, sin and cos of the angle from the facing
generator, and four products of these where a part of it lies in its own shade; besides, it may grow with the height,
there may be haze, and what is below and above the mantle has its own grey. What is beside the silhouette is unknown:
one grey level for each half of each row. Both enter linearly and are eliminated (variable projection: Golub and Pereyra
1973, Kaufman 1975).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tracker.helix import Helix
from tracker.helix_model import Pixels, Shown, shown
from tracker.pyramid import usual_blur

BLUR_SIGMA = 0.4  # of the logarithm of the blur, before it is seen
OUTLIER = 3.0  # sigmas; beyond, weights fall with the square, so that the pull of what is far off vanishes
LEAST_VARIANCE = 1 / 12  # of a grey level: it is rounded
QUANTILE, QUANTILE_SIGMAS = 0.25, 0.31864  # of a normal distribution's absolute values
LEAST_PIXELS = 20
BESIDE_SIGMA = 100.0  # grey levels: what is beside the target
BETWEEN = 2.0  # of half a row's variance: what its level differs from the neighbours'
UNEVEN = 8.0  # what is beside a half row varies by more than is left after its mean is taken
CORNER_GREY = 0.05  # of the contrast: how wrong a pixel at a corner may be
LEVELS = 11  # linear parameters of the light


class State(NamedTuple):
    """What is searched for."""

    axis: np.ndarray  # (2,) of the cylinder from the camera, in the observer's axes, m
    heading_rad: float
    blur_log: float  # of the sigma of all blur, the pixel's square included, in pixels of the level


class Noise(NamedTuple):
    """Variance of a pixel in darkness, and how much more for each grey level."""

    dark: float
    slope: float


@dataclass(frozen=True, slots=True, eq=False)
class Linearized:
    """The picture about a state."""

    normal: np.ndarray  # (4, 4) information of axis, heading, logarithm of the blur
    gradient: np.ndarray  # (4,)
    residual: np.ndarray  # (N,) grey levels
    expected: np.ndarray  # (N,)
    weights: np.ndarray  # (N,) of squares
    jacobian: np.ndarray  # (4, N)
    contrast: np.ndarray  # (N,) light less dark
    dark: np.ndarray  # (N,) grey level of what is dark
    beside: np.ndarray  # (N,) grey level of what is beside the half row
    fitting: np.ndarray  # (N,) whether a pixel is no outlier
    shown: Shown


def first_blur_log(level: int) -> float:
    """Logarithm of the sigma of all blur at a level of the pyramid, in its pixels, before it is seen."""
    return 0.5 * float(np.log(usual_blur(level)))


def linearized(
    pixels: Pixels, helix: Helix, camera_height_m: float, state: State, noise: Noise, before, level: int
) -> Linearized:
    """before: Linearized at the state before, for the weights; or None."""
    s = shown(pixels, helix, camera_height_m, state.axis, state.heading_rad, float(np.exp(state.blur_log)))
    share = np.float32(helix.dark / helix.light)
    within = s.cover * (1 - s.below - s.above)
    lightness = share + (1 - share) * s.light
    columns = _columns(pixels, s, within, lightness)
    beside = columns[LEVELS + 1]
    weights, fitting = _weights(pixels, s, noise, beside, before)
    heavy = weights * beside
    sums = np.add.reduceat(columns * heavy, pixels.starts, axis=1)
    least = sums[LEVELS + 1] + 1 / BESIDE_SIGMA**2
    sums /= least
    free = columns[: LEVELS + 1] - np.take(sums[: LEVELS + 1], pixels.half, axis=1) * beside
    weighted = free[:LEVELS] * weights
    gram = (weighted @ free.T).astype(float)
    moment, gram = gram[:, LEVELS], gram[:, :LEVELS]
    gram[range(LEVELS), range(LEVELS)] *= 1 + 1e-5
    gram[range(LEVELS), range(LEVELS)] += 1e-3
    inverse = np.linalg.inv(gram)
    levels = (inverse @ moment).astype(np.float32)
    residual = free[LEVELS] - levels @ free[:LEVELS]
    beside_grey = np.take(sums[LEVELS] - levels @ sums[:LEVELS], pixels.half)
    sunlit = levels[0] + levels[1] * s.sine + s.cosine * (levels[2] + levels[3] * s.sine)
    sunlit += s.sine * s.sine * (levels[4] + levels[5] * s.cosine + levels[6] * s.sine) + levels[7] * pixels.row
    contrast = sunlit * (1 - share) - levels[8]
    target = levels @ columns[:LEVELS]  # already times cover
    excess = target / np.maximum(s.cover, 1e-6) - beside_grey
    jacobian = _jacobian(pixels, helix, s, levels, within, lightness, contrast, excess)
    sums_by = np.add.reduceat(jacobian * heavy, pixels.starts, axis=1) / least
    jacobian -= np.take(sums_by, pixels.half, axis=1) * beside
    jacobian -= ((jacobian @ weighted.T) @ inverse.astype(np.float32)) @ free[:LEVELS]
    heavy = jacobian * weights
    normal, gradient = (heavy @ jacobian.T).astype(float), (heavy @ residual).astype(float)
    normal[3, 3] += BLUR_SIGMA**-2
    gradient[3] += (first_blur_log(level) - state.blur_log) / BLUR_SIGMA**2
    return Linearized(
        normal=normal,
        gradient=gradient,
        residual=residual,
        expected=pixels.grey - residual,
        weights=weights,
        jacobian=jacobian,
        contrast=contrast,
        dark=sunlit - contrast,
        beside=beside_grey,
        fitting=fitting,
        shown=s,
    )


def _columns(pixels: Pixels, s: Shown, within, lightness) -> np.ndarray:
    """(LEVELS + 2, N) by how much grey levels change with each of the light's, the picture, and what is beside."""
    columns = np.empty((LEVELS + 2, len(lightness)), np.float32)
    lit = columns[0] = within * lightness
    np.multiply(lit, s.sine, out=columns[1])
    np.multiply(lit, s.cosine, out=columns[2])
    np.multiply(columns[1], s.cosine, out=columns[3])
    np.multiply(columns[1], s.sine, out=columns[4])
    np.multiply(columns[4], s.cosine, out=columns[5])
    np.multiply(columns[4], s.sine, out=columns[6])
    np.multiply(lit, pixels.row, out=columns[7])
    columns[8] = within * (1 - s.light)
    columns[9] = s.cover * s.below
    columns[10] = s.cover * s.above
    columns[LEVELS] = pixels.grey
    columns[LEVELS + 1] = 1 - s.cover
    return columns


def _weights(pixels: Pixels, s: Shown, noise: Noise, beside, before) -> tuple[np.ndarray, np.ndarray]:
    """(N,) of squares, and whether a pixel is no outlier.

    A pixel is worth less at a corner of the pattern, whose blur is not that of edges, and beside a silhouette where
    one grey level does not fit, within the half row or from one row to the next.
    """
    if before is None:
        return np.full(len(beside), 1 / noise.dark, np.float32), np.ones(len(beside), bool)
    expected = before.expected
    variance = noise.dark + noise.slope * np.maximum(expected, 0)
    variance = variance + (CORNER_GREY * s.corner * (expected.max() - expected.min())) ** 2
    off, outside = np.square(pixels.grey - expected), np.square(beside)
    uneven = np.add.reduceat(outside * (off - variance), pixels.starts)
    uneven /= np.add.reduceat(outside, pixels.starts) + 1e-3
    uneven = UNEVEN * np.maximum(uneven, 0.0) + BETWEEN * _between_rows(before.beside[pixels.starts])
    variance = variance + outside * np.take(uneven, pixels.half)
    pull = off / variance
    return np.minimum(1.0, OUTLIER**2 / np.maximum(pull, 1e-9)) / variance, pull < OUTLIER**2


def _between_rows(level: np.ndarray) -> np.ndarray:
    """(H,) half the mean square of the steps to the half rows above and below; half rows alternate in their side."""
    steps = np.square(level[2:] - level[:-2]) / 4
    found = np.zeros_like(level)
    found[2:] += steps
    found[:-2] += steps
    return found


def _jacobian(pixels: Pixels, helix: Helix, s: Shown, levels, within, lightness, contrast, excess) -> np.ndarray:
    """(4, N) derivative of the expected grey levels by the axis, the heading and the logarithm of the blur."""
    radius, slope = np.float32(helix.radius_m), np.float32(helix.pitch_m / (2 * np.pi))
    gain = within * contrast
    ahead = gain * (s.by_height + s.by_screw) * pixels.climb
    screw = gain * s.by_screw * slope
    bend = levels[1] - levels[2] * s.tangent + levels[3] * (s.cosine - s.sine * s.tangent)
    bend += s.sine * (2 * levels[4] + 3 * levels[6] * s.sine + levels[5] * (2 * s.cosine - s.sine * s.tangent))
    aside = s.moves * (ahead * s.tangent - screw * s.turning + within * lightness * bend / radius)
    aside += s.cover_by_aside * excess
    jacobian = np.empty((4, len(ahead)), np.float32)
    jacobian[0] = ahead * pixels.forward - aside * pixels.left
    jacobian[1] = ahead * pixels.left + aside * pixels.forward
    jacobian[2] = screw
    jacobian[3] = gain * s.by_blur + s.cover_by_blur * excess
    return jacobian


def noise_of(last: Linearized) -> Noise:
    """Robust variance of the residuals, of the darker and of the brighter half: by their lower quantiles, because
    something may hide a part of the target."""
    size = np.abs(last.residual)
    middle = (last.expected.min() + last.expected.max()) / 2
    bright = last.expected > middle
    found = []
    for side in (bright, ~bright):
        own = size[side]
        if len(own) < LEAST_PIXELS:
            return Noise(max(_quantile_variance(size), LEAST_VARIANCE), 0.0)
        found.append((_quantile_variance(own), float(last.expected[side].mean())))
    (high, light), (low, dark) = found
    slope = max(high - low, 0.0) / max(light - dark, 1.0)
    return Noise(max(low - slope * dark, 0.3 * low, LEAST_VARIANCE), slope)


def _quantile_variance(size: np.ndarray) -> float:
    place = int(QUANTILE * len(size))
    return float(np.partition(size, place)[place] / QUANTILE_SIGMAS) ** 2
