"""Pictures without a target that are meant to mislead a detector: rooms, stripes, people, banded columns, mosaics."""

from dataclasses import dataclass, replace
from math import pi

import cv2
import numpy as np
from _scenes import random_background, random_light, random_sensor

from coopslam.se2 import Pose2
from tracker.camera import Camera
from tracker.render import RenderSettings, in_cells, render, render_background
from tracker.target import Drum

KINDS = ("plain", "gradient", "clutter", "stripes", "people", "columns", "mosaics")


def empty_picture(kind: str, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """(H, W) uint8 picture of a kind, with random light, blur and noise."""
    settings = RenderSettings(random_light(rng), random_background(rng), random_sensor(rng))
    if kind in ("plain", "gradient", "clutter"):
        return render_background(camera, replace(settings, background=random_background(rng, kind)), rng)
    background = settings.background.radiance(camera, rng)
    if kind == "columns":
        pose = Pose2(rng.uniform(1.0, 8.0), rng.uniform(-0.5, 0.5), rng.uniform(-pi, pi))
        return render(camera, _columns(rng), pose, settings, rng, background)
    picture = background.copy()
    for _ in range(rng.integers(1, 8)):
        DRAWN[kind](picture, rng)
    return settings.sensor.picture(in_cells(picture), rng)


@dataclass(frozen=True, slots=True)
class _Columns:
    """Upright cylinders in a row, banded light and dark, of about the target's size."""

    solids: tuple[Drum, ...]


def _columns(rng: np.random.Generator) -> _Columns:
    drums = []
    for forward_m in rng.uniform(-1.0, 1.0, rng.integers(1, 4)):
        radius_m, is_light = rng.uniform(0.05, 0.18), bool(rng.integers(2))
        light, dark = rng.uniform(0.5, 0.9), rng.uniform(0.03, 0.3)
        heights = np.concatenate([[0.0], np.sort(rng.uniform(0.02, 0.7, rng.integers(3, 9)))])
        for bottom_m, top_m in zip(heights[:-1], heights[1:], strict=True):
            drums.append(Drum(radius_m, bottom_m, top_m + 1e-6, light if is_light else dark, forward_m))
            is_light = not is_light
    return _Columns(tuple(drums))


def _stripes(picture: np.ndarray, rng: np.random.Generator) -> None:
    """A grating of any direction, slant, period and share of dark, over all of the picture or a part of it."""
    rows, columns = _part(picture, rng)
    v, u = np.mgrid[rows, columns].astype(np.float32)
    direction = rng.choice([0.0, pi / 2, rng.uniform(0, pi)])
    across = u * np.cos(direction) + v * np.sin(direction) + rng.uniform(0, 20) * np.sin(u / rng.uniform(20, 200))
    wave = np.sin(2 * pi * across / np.exp(rng.uniform(np.log(4), np.log(120))))
    steep = np.exp(rng.uniform(0, 3))
    light, dark = rng.uniform(0.4, 0.9), rng.uniform(0.02, 0.4)
    share = 0.5 + 0.5 * np.clip(steep * (wave - rng.uniform(-0.5, 0.5)), -1, 1)
    picture[rows, columns] = dark + (light - dark) * share


def _person(picture: np.ndarray, rng: np.random.Generator) -> None:
    """Head, striped or plain body, two legs; of any size, from far away to before the camera."""
    height, width = picture.shape
    tall = np.exp(rng.uniform(np.log(0.1), np.log(1.5))) * height
    middle, feet = rng.uniform(0, width), rng.uniform(0.4, 1.3) * height
    skin, shirt, trousers = rng.uniform(0.05, 0.8, 3)

    def box(left: float, right: float, lower: float, upper: float, radiance: float) -> None:
        corners = [(middle + tall * left, feet - tall * upper), (middle + tall * right, feet - tall * lower)]
        cv2.rectangle(picture, *(tuple(np.rint(corner).astype(int).tolist()) for corner in corners), radiance, -1)

    box(-0.11, -0.01, 0.0, 0.48, trousers)
    box(0.01, 0.11, 0.0, 0.48, trousers)
    box(-0.13, 0.13, 0.46, 0.82, shirt)
    period = rng.uniform(0.02, 0.12)
    for upper in np.arange(0.46, 0.80, period) if rng.random() < 0.7 else ():
        box(-0.13, 0.13, upper, upper + rng.uniform(0.3, 0.7) * period, 0.9 - shirt)
    head = np.rint([middle, feet - 0.91 * tall]).astype(int).tolist()
    cv2.ellipse(picture, tuple(head), (max(int(0.06 * tall), 1), max(int(0.08 * tall), 1)), 0, 0, 360, skin, -1)


def _mosaic(picture: np.ndarray, rng: np.random.Generator) -> None:
    """Random dark and light squares in a frame, like a tag that is none, in any perspective."""
    height, width = picture.shape
    cells = int(rng.integers(3, 12))
    tile = np.pad(rng.integers(0, 2, (cells, cells)).astype(np.float32), 1)
    tile = np.pad(tile, 1, constant_values=1.0).repeat(16, axis=0).repeat(16, axis=1)
    tile = rng.uniform(0.02, 0.3) + rng.uniform(0.3, 0.6) * tile
    side = np.exp(rng.uniform(np.log(20), np.log(0.6 * height)))
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * side
    corners = square + rng.uniform(0, [width - side, height - side]) + rng.normal(0, 0.06 * side, (4, 2))
    edge = tile.shape[0] - 1
    source = np.array([[0, 0], [edge, 0], [edge, edge], [0, edge]], np.float32)
    warp = cv2.getPerspectiveTransform(source, corners.astype(np.float32))
    cv2.warpPerspective(tile, warp, (width, height), picture, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)


def _part(picture: np.ndarray, rng: np.random.Generator) -> tuple[slice, slice]:
    """All of a picture, or a rectangle in it."""
    if rng.random() < 0.2:
        return slice(0, picture.shape[0]), slice(0, picture.shape[1])
    sides = []
    for size in picture.shape:
        length = int(np.exp(rng.uniform(np.log(0.05), 0.0)) * size) + 1
        first = int(rng.integers(0, size - length + 1)) if length < size else 0
        sides.append(slice(first, min(first + length, size)))
    return tuple(sides)


DRAWN = {"stripes": _stripes, "people": _person, "mosaics": _mosaic}
