"""The mantle of a helix target pixel by pixel: what pattern a pixel shows, and how that moves with the pose.

A ray with azimuth g over the floor passes the axis a of the cylinder, seen from the camera, at p = a . h ahead and
q = a . n aside (h along the ray, n to its left, both level). It meets the mantle at the level distance t = p - w,
w = sqrt(R^2 - q^2), at the height z = z_camera + climb t and the azimuth g + pi + asin(q / R). All derivatives follow
from dp and dq: by a turn of the ray (blur), dp = q and dq = -p; by the axis (pose), dp = h . da and dq = n . da.

The blur is a Gaussian; an edge is smeared across itself, by as much of its coordinate (height, or height less rise of
the screw) as changes within the blur.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from tracker.helix import Helix
from tracker.pyramid import Sight
from tracker.smear import ROOT, smeared_step

FARTHEST = -4.0  # sigmas outside the silhouette; what is farther is as if it were there
LEAST_DEPTH = 0.03  # of the blur: at the limb itself everything changes at an infinite rate
BESIDE_PX = 2.8  # pixels beyond the limb that still matter
CORNER = 6.0  # squared sigmas from both edges, within which their blurs are not those of edges
ENDS_PX = 0.7  # pixels of the collars' ends that are not looked at: what is above or below them shines in


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """N pixels around a target, row by row; each row in two halves, the halves numbered. float32 but the last two."""

    grey: np.ndarray
    azimuth: np.ndarray
    climb: np.ndarray
    forward: np.ndarray
    left: np.ndarray
    turn_sq: np.ndarray
    climb_sq: np.ndarray
    cross: np.ndarray
    row: np.ndarray  # -1 to 1
    starts: np.ndarray  # first pixel of each half row
    half: np.ndarray  # number of the half row of each pixel


class Shown(NamedTuple):
    """What the pixels show at a pose; (N,) each. Lengths in m."""

    light: np.ndarray  # 0 in the dark, 1 in the light parts of the pattern
    by_height: np.ndarray  # derivative of `light` by the height of what is met
    by_screw: np.ndarray  # by that less the rise of the screw; by_height does not contain it
    by_blur: np.ndarray  # by the logarithm of the blur
    cover: np.ndarray  # share of the pixel within the silhouette
    cover_by_aside: np.ndarray  # its derivative by q
    cover_by_blur: np.ndarray
    below: np.ndarray  # share that lies under the lower collar's end
    above: np.ndarray  # over the upper one's
    sine: np.ndarray  # q / R
    cosine: np.ndarray  # w / R
    tangent: np.ndarray  # derivative of -w by q, and
    turning: np.ndarray  # of the azimuth, 1 / m
    moves: np.ndarray  # derivative of what is met of q by q: less than one at the limb
    corner: np.ndarray  # 0 to 1: how near a stripe's edge ends at a ring


class Part(NamedTuple):
    """Of a target: what is not hidden."""

    left: float = -np.inf  # from this sine of the angle from the facing generator, to the right,
    right: float = np.inf  # to that
    lower: float = -np.inf  # from this share of the height, collars included,
    upper: float = np.inf  # to that

    @property
    def is_one_sided(self) -> bool:
        """Whether only one silhouette is in it."""
        return self.left > -np.inf or self.right < np.inf


WHOLE = Part()


def select(
    sight: Sight, image: np.ndarray, box, axis: np.ndarray, helix: Helix, camera_height_m: float, part: Part
) -> Pixels | None:
    """The pixels in a box (rows, columns) that show the mantle of a cylinder, or what is right beside it.

    axis: (2,) from the camera.  None when they are too few.
    """
    forward, left, climb = sight.forward[box], sight.left[box], sight.climb[box]
    ahead, aside = axis[0] * forward + axis[1] * left, axis[1] * forward - axis[0] * left
    pixel_m = ahead * np.sqrt(sight.turn_sq[box])
    off = np.abs(aside)
    distance = ahead - np.sqrt(np.maximum(helix.radius_m**2 - aside * aside, 0.0))
    height = camera_height_m + climb * distance
    step = ENDS_PX * distance * np.sqrt(sight.climb_sq[box])
    low, high = helix.bottom_m - helix.lower_collar_m, helix.top_m + helix.upper_collar_m
    used = (off < helix.radius_m + BESIDE_PX * pixel_m) & (height > low + step) & (height < high - step) & (ahead > 0)
    if part != WHOLE:
        used &= (aside > part.left * helix.radius_m) & (aside < part.right * helix.radius_m)
        used &= (height > low + part.lower * (high - low)) & (height < low + part.upper * (high - low))
    place = np.flatnonzero(used)
    if len(place) < 60:
        return None
    row = place // used.shape[1]
    key = 2 * row + (aside.ravel()[place] < 0)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(key)) + 1])
    half = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(key))))
    fields = (image[box], *(getattr(sight, name)[box] for name in Sight.__slots__))
    middle = (row[0] + row[-1]) / 2
    flat = [field.ravel()[place].astype(np.float32, copy=False) for field in fields]
    scaled = ((row - middle) / max(row[-1] - middle, 1)).astype(np.float32)
    return Pixels(*flat, scaled, starts, half)


def shown(pixels: Pixels, helix: Helix, camera_height_m: float, axis, heading: float, blur_px: float) -> Shown:
    """What the pixels show of a cylinder with its axis (2,) from the camera; blur_px: sigma of all blur there is."""
    radius, slope = np.float32(helix.radius_m), np.float32(helix.pitch_m / (2 * np.pi))
    ax, ay, blur = np.float32(axis[0]), np.float32(axis[1]), np.float32(blur_px)
    p, q = ax * pixels.forward + ay * pixels.left, ay * pixels.forward - ax * pixels.left
    turn = np.sqrt(pixels.turn_sq)
    smear = p * turn * blur
    inside = np.minimum(np.maximum((radius - np.abs(q)) / smear, FARTHEST), -FARTHEST * 2)
    cover, edge = ndtr(inside), ROOT * np.exp(-0.5 * inside * inside)
    mills = edge / cover
    moves = np.maximum(1 - mills * (mills + inside), 0.0)
    sign = np.sign(q)
    # of what the blur leaves of q within the silhouette; `apart` is its sigma
    middle = np.minimum(np.maximum(q - sign * smear * mills, -radius), radius)
    apart = smear * np.sqrt(moves)
    aside = np.stack([middle + apart, middle - apart])
    aside = np.minimum(np.maximum(aside, -radius), radius)
    w = np.sqrt(np.maximum(radius * radius - aside * aside, LEAST_DEPTH * radius * smear))
    arc = np.arcsin(aside / radius)
    depth = np.sqrt(np.maximum(radius * radius - middle * middle, LEAST_DEPTH * radius * smear))
    distance = p - depth
    away = apart / p
    climbing = pixels.climb * ((w[1] - w[0]) / 2 - middle * away)
    turning = (arc[0] - arc[1]) / 2 - away
    upright = blur * distance
    tilted = 2 * pixels.cross / turn
    rise_sq = upright * (upright * pixels.climb_sq - climbing * tilted) + climbing * climbing
    winding = climbing - slope * turning
    skew_sq = upright * (upright * pixels.climb_sq - winding * tilted) + winding * winding
    bow = pixels.climb * (depth - (w[0] + w[1]) / 2)  # mean over the blur, less its middle; counts along edges
    height = np.float32(camera_height_m) + pixels.climb * distance
    sine = middle / radius
    middle_arc = np.arcsin(sine)
    twist = bow - slope * ((arc[0] + arc[1]) / 2 - middle_arc)
    turned = pixels.azimuth + middle_arc + np.float32(np.pi - heading - helix.start_rad)
    screw = height - np.float32(helix.helix_bottom_m) - slope * turned + twist * (1 - winding * winding / skew_sq)
    height += bow * (1 - climbing * climbing / rise_sq)
    return Shown(
        **_pattern(helix, height, screw, np.sqrt(rise_sq), np.sqrt(skew_sq)),
        cover=cover,
        cover_by_aside=-sign * edge / smear,
        cover_by_blur=-edge * inside,
        sine=sine,
        cosine=depth / radius,
        tangent=(aside[0] / w[0] + aside[1] / w[1]) / 2,
        turning=(1 / w[0] + 1 / w[1]) / 2,
        moves=moves,
    )


def _pattern(helix: Helix, height, screw, rise, skew) -> dict:
    """What depends on the pattern alone: (N,) fields of Shown.

    height: (N,) of what is met, m; screw: that less the rise of the screw; rise, skew: sigmas of both within the blur.
    """
    period = np.float32(helix.pitch_m / helix.stripes)
    up, down = (screw - np.float32(edge) * period for edge in (0.0, helix.duty))
    up, down = up - period * np.rint(up / period), down - period * np.rint(down / period)
    x = np.empty((8, len(height)), np.float32)
    ends = helix.bottom_m, helix.top_m, helix.helix_bottom_m, helix.helix_top_m
    low, high = helix.bottom_m - helix.lower_collar_m, helix.top_m + helix.upper_collar_m
    for k, end in enumerate((*ends, low, high)):
        np.subtract(height, np.float32(end), out=x[k])
    x[:6] /= rise
    x[6], x[7] = up / skew, down / skew
    near = np.maximum(1 - np.square(x[2:4]) / CORNER, 0.0), np.maximum(1 - np.square(x[6:]) / CORNER, 0.0)
    free = (x[6:] < x[2]) & (x[6:] > x[3])  # a stripe's edge beyond the helix counts as the ring's
    x[6:] = np.minimum(np.maximum(x[6:], x[3]), x[2])
    step, bell = smeared_step(x)
    open_ = down <= up
    light = 1 - step[0] + step[1] - step[6] + step[7]
    light += open_ * (step[2] - step[3])
    moment = bell * x
    held = ~free
    by_height = bell[1] - bell[0] + open_ * (bell[2] - bell[3]) - held[0] * bell[6] + held[1] * bell[7]
    return {
        "light": light,
        "by_height": by_height / rise,
        "by_screw": (free[1] * bell[7] - free[0] * bell[6]) / skew,
        "by_blur": moment[0] - moment[1] + moment[6] - moment[7] - open_ * (moment[2] - moment[3]),
        "below": 1 - step[4],
        "above": step[5],
        "corner": (near[0][0] + near[0][1]) * (near[1][0] + near[1][1]),
    }
