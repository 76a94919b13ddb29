"""Where a helix target may be in a picture: the whole pattern is looked for at every place on the floor.

The robot stands on the floor and the camera's height is known, so at a bearing and a distance its pattern has exactly
one place and size in the picture. Places are laid out beforehand, along rays from the camera, closer than the width of
a ring; at each, the generator of the cylinder that faces the camera is sampled from end to end. Collars and rings are
known, the stripe between them is one of a few phases: the correlation coefficient with each of these patterns does not
depend on the light, and generators beside each other must show phases that fit the screw.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from coopslam.errors import BadInput
from tracker.camera import Camera
from tracker.helix import Helix

NEAREST_RADII = 3.5  # nearest distance that is looked at, in radii of the target
DISTANCE_RATIO = 1.08  # between neighbours; moves the pattern's ends by half a ring at most
SAMPLES = 12  # of a generator
PHASES = 9  # of one stripe: 40 degrees
BEARING_STEP = float(np.sin(2 * np.pi / PHASES))  # between neighbours, in radii of the target: as much on the cylinder
RING_PX = 4.5  # height of a ring above which a coarser picture will do
FLAT_GREY = 4.0  # a generator with less contrast than this, one sigma, is flat
TURN_SAMPLES = 5  # phases are averaged over so many generators within one step
BEST = 40  # places among which candidates are looked for
MOST_PLACES = 30_000  # that cv2.remap samples at once
APART_RADII = 1.5  # candidates are so far apart, in the picture


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A place where the target may be."""

    axis: np.ndarray  # (2,) of the cylinder, x and y in the observer's body
    azimuth_rad: float  # of the target's body, which faces the camera
    score: float  # mean correlation coefficient of three generators, at most 1


@dataclass(frozen=True, slots=True, eq=False)
class _Layer:
    """Places that are looked for in one picture of the pyramid."""

    level: int
    maps: tuple[np.ndarray, np.ndarray]  # where to sample, (SAMPLES, P), as cv2.remap wants it


class HelixSearch:
    """Looks for one target with one camera. Raises BadInput for a target that cannot be searched for."""

    def __init__(self, camera: Camera, helix: Helix, farthest_m: float):
        self.templates = _templates(helix)
        places, rows = _places(camera, helix, farthest_m)
        self.places, self.distance = places, np.hypot(*(places - camera.mount.position_body[:2]).T)
        self.nearer, self.farther = _neighbours(camera, places, rows)
        self.layers = _layers(camera, helix, places)
        self.levels = max(layer.level for layer in self.layers) + 1
        self.helix, self.camera = helix, camera
        self.middle = _middles(camera, helix, places)

    def _sampled(self, pyramid: list[np.ndarray]) -> np.ndarray:
        """(SAMPLES, P) grey levels on the generators of all places, from below. pyramid: see pyramid_of."""
        layers = [
            cv2.remap(pyramid[layer.level], *layer.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for layer in self.layers
        ]
        return np.concatenate(layers, axis=1).astype(np.float32)

    def candidates(self, pyramid: list[np.ndarray], most: int, score_min: float) -> list[Candidate]:
        """The best places, best first. pyramid: as of pyramid_of, with `levels` levels."""
        grey = self._sampled(pyramid)
        grey -= grey.mean(axis=0)
        norm = np.sqrt(np.einsum("sp,sp->p", grey, grey) + SAMPLES * FLAT_GREY**2)
        alike = (self.templates @ grey) / norm  # (PHASES, P)
        total = alike.copy()
        # the place to the left shows a generator that has a lower azimuth, by one step
        turn = self.helix.stripes
        total[:, 1:] += np.roll(alike, turn, axis=0)[:, :-1]
        total[:, :-1] += np.roll(alike, -turn, axis=0)[:, 1:]
        best = total.max(axis=0) / 3
        return self._separate(total, best, most, score_min)

    def _separate(self, total, best, most: int, score_min: float) -> list[Candidate]:
        count = min(BEST, len(best) - 1)
        order = np.argpartition(best, -count)[-count:]
        order = order[np.argsort(-best[order])]
        found, taken = [], []
        for k in order:
            if best[k] < score_min or len(found) == most:
                break
            u, v, radius = self.middle[k]
            if all(
                abs(u - a) > APART_RADII * max(radius, r) or abs(v - b) > APART_RADII * max(radius, r)
                for a, b, r in taken
            ):
                taken.append((u, v, radius))
                found.append(self._candidate(total, best, k))
        return found

    def _candidate(self, total, best, k: int) -> Candidate:
        """The best place, to a fraction of the steps by a parabola through its neighbours along each of them."""
        camera = self.camera.mount.position_body[:2]
        phase = int(total[:, k].argmax())
        phases = total[(phase - 1) % PHASES, k], total[phase, k], total[(phase + 1) % PHASES, k]
        azimuth = 2 * np.pi / self.helix.stripes * (phase + _peak(*phases)) / PHASES
        along = _peak(best[self.nearer[k]], best[k], best[self.farther[k]])
        aside = _peak(best[max(k - 1, 0)], best[k], best[min(k + 1, len(best) - 1)])
        ahead = self.places[k] - camera
        turn = -aside * BEARING_STEP * self.helix.radius_m / self.distance[k]
        axis = (ahead + turn * np.array([-ahead[1], ahead[0]])) * DISTANCE_RATIO**along
        azimuth -= turn * self.distance[k] / self.helix.radius_m  # what faces the camera is another generator there
        return Candidate(axis + camera, float(azimuth), float(best[k]))


def _peak(before: float, at: float, after: float) -> float:
    """Where the parabola through three equidistant values is highest, from the middle one, -0.5 to 0.5."""
    bend = 2 * at - before - after
    return float(np.clip((after - before) / (2 * bend), -0.5, 0.5)) if bend > 0 else 0.0


def _neighbours(camera: Camera, places: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(P,) the place one step nearer in about the same direction, and (P,) one step farther; itself at the ends."""
    away = places - camera.mount.position_body[:2]
    bearings = np.arctan2(away[:, 1], away[:, 0]) - camera.mount.yaw_rad
    bearings = (bearings + np.pi) % (2 * np.pi) - np.pi
    found = []
    for step in (-1, 1):
        other = np.arange(len(places))
        for row in range(rows[-1] + 1):
            own, next_ = np.flatnonzero(rows == row), np.flatnonzero(rows == row + step)
            if len(next_):
                other[own] = next_[_nearest(bearings[own], bearings[next_])]
        found.append(other)
    return found[0], found[1]


def _nearest(values: np.ndarray, falling: np.ndarray) -> np.ndarray:
    """(N,) which of some falling numbers is nearest to each value."""
    after = np.searchsorted(-falling, -values).clip(1, max(len(falling) - 1, 1))
    before = after - 1
    after = after.clip(max=len(falling) - 1)
    return np.where(np.abs(falling[after] - values) < np.abs(falling[before] - values), after, before)


def _templates(helix: Helix) -> np.ndarray:
    """(PHASES, SAMPLES) light and dark along generators, mean zero, length one."""
    heights = _heights(helix)
    spread = (np.arange(4) + 0.5) / 4 - 0.5
    z = heights[:, None] + spread * (heights[1] - heights[0])
    step = 2 * np.pi / helix.stripes / PHASES
    turns = (np.arange(TURN_SAMPLES) / (TURN_SAMPLES - 1) - 0.5) * step
    azimuths = step * np.arange(PHASES)[:, None] + turns
    light = 1.0 - helix.is_dark(azimuths[:, :, None, None], z[None, None]).mean(axis=(1, 3))
    light -= light.mean(axis=1, keepdims=True)
    contrast = np.linalg.norm(light, axis=1, keepdims=True)
    if not contrast.min() > 0:
        raise BadInput("ring_m: a ring, or a smaller pitch_m, expected: a part of the pattern is all of one colour")
    return (light / contrast).astype(np.float32)


def _heights(helix: Helix) -> np.ndarray:
    low = helix.bottom_m - min(helix.lower_collar_m, helix.ring_m)
    high = helix.top_m + min(helix.upper_collar_m, helix.ring_m)
    return low + (np.arange(SAMPLES) + 0.5) / SAMPLES * (high - low)


def _places(camera: Camera, helix: Helix, farthest_m: float) -> tuple[np.ndarray, np.ndarray]:
    """(P, 2) axes in the observer's body, by distance, then from left to right; (P,) number of the distance."""
    nearest = NEAREST_RADII * helix.radius_m
    if not nearest < farthest_m:
        raise BadInput(f"radius_m: less than {farthest_m / NEAREST_RADII:.3g} expected, got {helix.radius_m:g}")
    count = int(np.ceil(np.log(farthest_m / nearest) / np.log(DISTANCE_RATIO))) + 1
    pixels = np.array([[-0.5, v] for v in np.linspace(0, camera.lens.height_px - 1, 9)])
    pixels = np.concatenate([pixels, pixels + [camera.lens.width_px, 0]])
    rays = camera.rays(pixels)
    sides = np.arctan2(rays[:, 1], rays[:, 0]) - camera.mount.yaw_rad
    half = float(np.max(np.abs((sides + np.pi) % (2 * np.pi) - np.pi)))
    places, rows = [], []
    for k, distance in enumerate(nearest * DISTANCE_RATIO ** np.arange(count)):
        step = BEARING_STEP * helix.radius_m / distance
        bearings = camera.mount.yaw_rad + np.arange(np.floor(half / step), -np.ceil(half / step) - 1, -1) * step
        places.append(distance * np.column_stack([np.cos(bearings), np.sin(bearings)]))
        rows.append(np.full(len(bearings), k))
    return np.concatenate(places) + camera.mount.position_body[:2], np.concatenate(rows)


def _layers(camera: Camera, helix: Helix, places: np.ndarray) -> list[_Layer]:
    away = places - camera.mount.position_body[:2]
    distance = np.hypot(*away.T)
    facing = places - helix.radius_m * away / distance[:, None]
    heights = _heights(helix)
    points = np.concatenate([np.column_stack([facing, np.full(len(facing), z)]) for z in heights])
    pixels, _ = camera.project(points)
    pixels = np.where(np.isfinite(pixels), pixels, -1e4).reshape(SAMPLES, -1, 2)
    ring_px = max(helix.ring_m, 0.02) * camera.lens.fy_px / distance
    level = np.maximum(np.ceil(np.log2(ring_px / RING_PX)), 0).astype(int)
    layers = []
    for each in sorted(set(level.tolist()), reverse=True):
        own = pixels[:, level == each]
        where = (own / 2**each).clip(-1e3, 3e4).astype(np.float32)
        for first in range(0, where.shape[1], MOST_PLACES):
            part = np.ascontiguousarray(where[:, first : first + MOST_PLACES])
            layers.append(_Layer(each, cv2.convertMaps(part, None, cv2.CV_16SC2)))
    return layers


def _middles(camera: Camera, helix: Helix, places: np.ndarray) -> np.ndarray:
    """(P, 3) pixels of the target's middle, and its radius there."""
    height = np.full(len(places), (helix.bottom_m + helix.top_m) / 2)
    pixels, _ = camera.project(np.column_stack([places, height]))
    distance = np.hypot(*(places - camera.mount.position_body[:2]).T)
    return np.column_stack([np.nan_to_num(pixels, nan=-1e4), helix.radius_m / distance * camera.lens.fx_px])
