"""The target in a picture, at a distance that is known, when camera and target are only known nominally.

A wrong tilt or height of the camera moves the picture up or down, so the target is looked for at all bearings, headings
and vertical shifts. The shift that is found is the first measurement of tilt and height.
"""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np

from coopslam.se2 import Pose2, rotation, wrap
from tracker.camera import Camera
from tracker.data_sheet import DataSheet
from tracker.helix import Helix
from tracker.lens import Lens
from tracker.tag_cube import FAMILY, TagCube

SHIFT_MOST_RAD = 0.05  # of the picture, up or down
GENERATORS = np.radians([-60.0, -40.0, -20.0, 0.0, 20.0, 40.0, 60.0])  # from the facing one
HEIGHTS = 40  # samples of a generator
HEADINGS = 36
CUBE_HEADINGS = 180
BEARING_STEP = 0.25  # in radii of the target
KNOWN_BEARING_RAD, KNOWN_HEADING_RAD = 0.09, 0.35  # how far from a known one is looked
CORRELATION_MIN = 0.6
REFINEMENTS = 2  # each to a quarter of the step


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where the target roughly is."""

    pose: Pose2  # in the observer's body, at the known distance
    shift_px: float  # how much lower the picture is than the nominal sheet says


def find_target(
    image: np.ndarray, sheet: DataSheet, distance_m: float, bearing_rad: float | None, heading_rad: float | None
) -> Start | None:
    """None when it is not in the (H, W) uint8 picture. bearing_rad, heading_rad: of the target, where known."""
    if sheet.helix is None:
        return _find_cube(image, sheet.camera, sheet.tag_cube, distance_m, heading_rad)
    return _find_helix(image, sheet.camera, sheet.helix, distance_m, bearing_rad, heading_rad)


def _find_helix(image, camera: Camera, helix: Helix, distance_m: float, bearing_rad, heading_rad) -> Start | None:
    """The best correlation of seven generators with the pattern, coarse to fine."""
    lens, step = camera.lens, BEARING_STEP * helix.radius_m / distance_m
    if bearing_rad is None:
        low, high = _view(lens, camera.mount.yaw_rad)
        bearings = np.arange(low, high, step)
    else:
        bearings = np.arange(bearing_rad - KNOWN_BEARING_RAD, bearing_rad + KNOWN_BEARING_RAD + step, step)
    headings = np.arange(HEADINGS) * (2 * np.pi / HEADINGS)
    if heading_rad is not None:
        headings = headings[np.abs(wrap(headings - heading_rad)) < KNOWN_HEADING_RAD]
    pattern_px = lens.fy_px * (helix.top_m - helix.bottom_m) / distance_m
    shift_step = max(pattern_px / HEIGHTS, 0.5)
    most = SHIFT_MOST_RAD * lens.fy_px
    shifts = np.arange(-most, most + shift_step, shift_step)
    steps = np.array([step, 2 * np.pi / HEADINGS, shift_step])
    best = _best(image, camera, helix, distance_m, bearings, headings, shifts)
    around = np.linspace(-1.0, 1.0, 9)
    for _ in range(REFINEMENTS):
        at = best[:3] + steps * around[:, None]
        best = _best(image, camera, helix, distance_m, *at.T)
        steps = steps / 4
    bearing, heading, shift, correlation = best
    if not correlation > CORRELATION_MIN:
        return None
    return Start(Pose2(distance_m * np.cos(bearing), distance_m * np.sin(bearing), heading), float(shift))


def _best(image, camera: Camera, helix: Helix, distance_m: float, bearings, headings, shifts) -> np.ndarray:
    """(4,) bearing, heading, shift and correlation coefficient of the best on a grid of them."""
    bottom, top = helix.bottom_m - 0.6 * helix.lower_collar_m, helix.top_m + 0.6 * helix.upper_collar_m
    heights = np.linspace(bottom, top, HEIGHTS)
    best = np.array([0.0, 0.0, 0.0, -1.0])
    azimuth, z = (each.ravel() for each in np.meshgrid(GENERATORS, heights, indexing="ij"))
    # An axis that is not over the robot's reference point moves with the heading.
    turns = [headings] if helix.forward_m == 0 else [[heading] for heading in headings]
    for bearing, headings in itertools.product(bearings, turns):
        axis = distance_m * np.array([np.cos(bearing), np.sin(bearing)])
        axis = axis + helix.forward_m * np.array([np.cos(headings[0]), np.sin(headings[0])])
        away = camera.mount.position_body[:2] - axis
        facing = np.arctan2(away[1], away[0])
        around = facing + azimuth
        xy = axis + helix.radius_m * np.column_stack([np.cos(around), np.sin(around)])
        pixels, _ = camera.project(np.column_stack([xy, z]))
        if not np.isfinite(pixels).all():
            continue
        rows = pixels[None, :, 1] + shifts[:, None]
        columns = np.broadcast_to(pixels[None, :, 0], rows.shape)
        seen = cv2.remap(
            image, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        ).astype(float)
        patterns = helix.reflectance(around - np.asarray(headings)[:, None], z)
        found = _unit(seen) @ _unit(patterns).T
        k, h = np.unravel_index(found.argmax(), found.shape)
        if found[k, h] > best[3]:
            best = np.array([bearing, headings[h], shifts[k], found[k, h]])
    return best


def _find_cube(image, camera: Camera, cube: TagCube, distance_m: float, heading_rad) -> Start | None:
    """What aruco reads, at the known distance, turned so that the corners fit best but for one shift of them all."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILY)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(np.ascontiguousarray(image))
    own = {} if ids is None else dict(zip(ids.ravel().tolist(), corners, strict=True))
    tags = [tag for tag in cube.side_ids if tag in own]
    if not tags:
        return None
    seen = np.concatenate([own[tag].reshape(4, 2) for tag in tags]).astype(float)
    points = np.concatenate([cube.corners()[tag] for tag in tags])
    headings = np.arange(CUBE_HEADINGS) * (2 * np.pi / CUBE_HEADINGS)
    if heading_rad is not None:
        headings = headings[np.abs(wrap(headings - heading_rad)) < KNOWN_HEADING_RAD]
    ray = camera.rays(seen.mean(axis=0))[0]
    bearing = float(np.arctan2(ray[1], ray[0]))
    found = []
    for heading in headings:
        at = distance_m * np.array([np.cos(bearing), np.sin(bearing)])
        turned = points[:, :2] @ rotation(heading).T + at
        away = seen - camera.project(np.column_stack([turned, points[:, 2]]))[0]
        spread = float(np.sum((away - away.mean(axis=0)) ** 2))
        found.append((spread if np.isfinite(spread) else np.inf, float(heading), away.mean(axis=0)))
    spread, heading, shift = min(found, key=lambda one: one[0])
    if not np.isfinite(spread):
        return None
    bearing -= shift[0] / camera.lens.fx_px
    return Start(Pose2(distance_m * np.cos(bearing), distance_m * np.sin(bearing), heading), float(shift[1]))


def _view(lens: Lens, yaw_rad: float) -> tuple[float, float]:
    """Bearings at the right and left border of the picture's middle row."""
    ends = lens.normalised(np.array([[-0.5, lens.cy_px], [lens.width_px - 0.5, lens.cy_px]]))[:, 0]
    left, right = np.arctan(-ends)
    reach = 0.1 * (left - right)  # a camera that looks down sees further to the sides than its middle row
    return float(yaw_rad + right - reach), float(yaw_rad + left + reach)


def _unit(rows: np.ndarray) -> np.ndarray:
    """Each row without its mean, of length one."""
    rows = rows - rows.mean(axis=1, keepdims=True)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)
