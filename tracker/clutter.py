"""Things in a room that are not the target: upright ones drawn as flat figures in perspective, and marks on the floor.

They are meant to mislead a detector: light and dark bands, slanted stripes, people in striped shirts, shelves, table
legs, papers, floor tape, shadows. Drawn with cv2 from far to near, in 8 bits; the sensor's noise is added later.
"""

import cv2
import numpy as np

from tracker.camera import Camera

FIXED_POINT_BITS = 4  # of cv2's subpixel coordinates
FULL = 255.0  # radiance 1 while drawing
BLOTCH_PX = 24
HALF_VIEW_RAD = 0.75  # things stand within that of the optical axis


class _Canvas:
    """A picture on which polygons of the body frame are drawn in perspective."""

    def __init__(self, camera: Camera, radiance: np.ndarray):
        self.camera = camera
        self.image = np.clip(radiance * FULL, 0, 255).astype(np.uint8)

    def polygon(self, points_body: np.ndarray, radiance: float) -> None:
        """Nothing happens when a corner has no picture."""
        pixels, _ = self.camera.project(points_body)
        if np.isfinite(pixels).all() and np.abs(pixels).max() < 2**15:
            corners = np.rint(pixels * 2**FIXED_POINT_BITS).astype(np.int32)
            cv2.fillPoly(self.image, [corners], float(np.clip(radiance, 0, 1) * FULL), cv2.LINE_AA, FIXED_POINT_BITS)


class _Board:
    """An upright plane that faces the camera: figures on it have a lateral and a height coordinate in metres."""

    def __init__(self, canvas: _Canvas, distance_m: float, bearing_rad: float):
        self.canvas = canvas
        c, s = np.cos(bearing_rad), np.sin(bearing_rad)
        self.foot = np.array([canvas.camera.mount.forward_m + distance_m * c, distance_m * s, 0.0])
        self.left = np.array([-s, c, 0.0])

    def figure(self, lateral_m: np.ndarray, height_m: np.ndarray, radiance: float) -> None:
        height = np.asarray(height_m)[:, None] * [0.0, 0.0, 1.0]
        self.canvas.polygon(self.foot + np.asarray(lateral_m)[:, None] * self.left + height, radiance)

    def box(self, lateral_m, bottom_m, width_m, height_m, radiance, shear_m: float = 0.0) -> None:
        a, b = lateral_m - width_m / 2, lateral_m + width_m / 2
        top = bottom_m + height_m
        self.figure(np.array([a, b, b + shear_m, a + shear_m]), np.array([bottom_m, bottom_m, top, top]), radiance)

    def disc(self, lateral_m, height_m, radius_m, radiance) -> None:
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        self.figure(lateral_m + radius_m * np.cos(angle), height_m + radius_m * np.sin(angle), radiance)


def draw_clutter(camera: Camera, radiance: np.ndarray, settings, nearest_m: float, rng) -> np.ndarray:
    """(H, W) float32 of the room in `radiance`, with its clutter; `settings` is a Background."""
    canvas = _Canvas(camera, radiance)
    for _ in range(settings.marks):
        _mark(canvas, rng)
    far = max(settings.wall_m - 0.5, nearest_m + 0.5)
    for distance in np.sort(rng.uniform(nearest_m, far, settings.things))[::-1]:
        board = _Board(canvas, distance, camera.mount.yaw_rad + rng.uniform(-HALF_VIEW_RAD, HALF_VIEW_RAD))
        THINGS[rng.integers(len(THINGS))](board, rng)
    return np.maximum(canvas.image * np.float32(1 / FULL) + _blotches(radiance.shape, settings.texture, rng), 0)


def _blotches(shape, sigma: float, rng) -> np.ndarray:
    coarse = rng.standard_normal((shape[0] // BLOTCH_PX + 2, shape[1] // BLOTCH_PX + 2), dtype=np.float32)
    return np.float32(sigma) * cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_LINEAR)


def _mark(canvas: _Canvas, rng) -> None:
    """A quadrilateral on the floor: a rug, a paper, a shadow, or a long strip of tape."""
    distance = rng.uniform(0.4, 8.0)
    bearing = canvas.camera.mount.yaw_rad + rng.uniform(-HALF_VIEW_RAD, HALF_VIEW_RAD)
    long_side = rng.uniform(0.2, 2.0)
    short_side = 0.05 if rng.random() < 0.4 else rng.uniform(0.2, 1.0)
    turn = rng.uniform(0, np.pi)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2 * [long_side, short_side]
    c, s = np.cos(turn), np.sin(turn)
    flat = corners @ [[c, s], [-s, c]] + distance * np.array([np.cos(bearing), np.sin(bearing)])
    canvas.polygon(np.column_stack([flat, np.zeros(4)]), rng.uniform(0.05, 0.9))


def _person(board: _Board, rng) -> None:
    tall, trousers, shirt, skin = rng.uniform(1.5, 1.9), *rng.uniform(0.05, 0.8, 3)
    stride = rng.uniform(0.0, 0.15)
    for side in (-1, 1):
        board.box(side * (0.09 + stride), 0, 0.13, 0.47 * tall, trousers, -side * stride)
        board.box(side * 0.27, 0.47 * tall, 0.09, 0.35 * tall, shirt * 0.9, -side * 0.04)
    board.box(0, 0.47 * tall, 0.42, 0.36 * tall, shirt)
    if rng.random() < 0.5:
        for height in np.arange(0.49 * tall, 0.8 * tall, 0.12):
            board.box(0, height, 0.42, 0.06, 1 - shirt)
    board.disc(0, 0.92 * tall, 0.065 * tall, skin)


def _table(board: _Board, rng) -> None:
    wide, tall, radiance = rng.uniform(0.8, 1.8), rng.uniform(0.45, 0.78), rng.uniform(0.05, 0.8)
    for lateral in (-wide / 2 + 0.05, wide / 2 - 0.05, -wide / 2 + 0.2, wide / 2 - 0.2):
        board.box(lateral, 0, 0.05, tall, radiance * 0.7)
    board.box(0, tall, wide, 0.05, radiance)


def _chair(board: _Board, rng) -> None:
    radiance = rng.uniform(0.05, 0.8)
    for lateral in (-0.2, 0.2):
        board.box(lateral, 0, 0.04, 0.9, radiance)
    board.box(0, 0.42, 0.44, 0.06, radiance * 0.8)
    for height in (0.55, 0.68, 0.81):
        board.box(0, height, 0.44, 0.07, radiance)


def _shelf(board: _Board, rng) -> None:
    wide, tall, radiance = rng.uniform(0.6, 1.2), rng.uniform(0.7, 2.0), rng.uniform(0.2, 0.7)
    board.box(0, 0, wide, tall, radiance)
    for bottom in np.arange(0.06, tall - 0.3, 0.36):
        board.box(0, bottom, wide - 0.08, 0.30, radiance * 0.3)
        for lateral in np.arange(-wide / 2 + 0.08, wide / 2 - 0.08, 0.06):
            if rng.random() < 0.8:
                board.box(lateral, bottom, 0.05, rng.uniform(0.15, 0.28), rng.uniform(0.05, 0.9))


def _bin(board: _Board, rng) -> None:
    """A drum of the target's size with level bands: nearly the helix."""
    wide, tall = rng.uniform(0.12, 0.35), rng.uniform(0.3, 0.9)
    light, dark = rng.uniform(0.5, 0.9), rng.uniform(0.03, 0.3)
    board.box(0, 0, wide, tall, light)
    for bottom in np.arange(rng.uniform(0, 0.1), tall - 0.05, rng.uniform(0.1, 0.25)):
        board.box(0, bottom, wide, min(rng.uniform(0.03, 0.1), tall - bottom), dark)


def _poster(board: _Board, rng) -> None:
    """Slanted stripes on a stand, as the edge of a stripe looks near the facing generator."""
    wide, tall, bottom = rng.uniform(0.2, 0.8), rng.uniform(0.3, 0.9), rng.uniform(0.0, 0.4)
    light, dark, rise = rng.uniform(0.5, 0.9), rng.uniform(0.03, 0.3), rng.uniform(-0.2, 0.2)
    board.box(0, bottom, wide, tall, light)
    for height in np.arange(bottom + 0.05, bottom + tall - 0.1, rng.uniform(0.1, 0.25)):
        ends = np.array([height, height + rise, height + rise + 0.06, height + 0.06]).clip(bottom, bottom + tall)
        board.figure(np.array([-wide, wide, wide, -wide]) / 2, ends, dark)


THINGS = (_person, _table, _chair, _shelf, _bin, _poster)
