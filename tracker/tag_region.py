"""The pixels of a tag that say something of where it is."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from tracker.camera import Camera
from tracker.tag_corners import Tag
from tracker.tag_cube import FAMILY, MODULES, TagCube

HALF = MODULES / 2
MARGIN = 0.75  # modules around the tag that are looked at, at most
LEAST_MARGIN = 0.2
FROM_EDGE_PX = 1.3  # pixels are so far from the face's edge: what is beyond is unknown
NEAR_EDGE_PX = 3.0  # farther from every line between modules a pixel says nothing of the pose
MOST_PIXELS = 600  # of a tag
CELL_PX = 4.0  # edge of a cell whose pixels may err together, at least
SQUARE = np.array([[-HALF, -HALF], [HALF, -HALF], [HALF, HALF], [-HALF, HALF]])  # a tag's corners, t downwards


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """The pixels of one tag that are fitted, and the face that it is on."""

    grey: np.ndarray  # (N,) grey levels
    directions: np.ndarray  # (3, N) of the rays, in the observer's body, at depth 1 along the optical axis
    cells: np.ndarray  # (N,) number of the cell, one or a few modules, in which a pixel lies
    place: np.ndarray  # (N, 2) in the region, -1 to 1 along columns and rows
    dark: np.ndarray  # (8, 8) 1.0 where a module is dark; rows from the top
    middle: np.ndarray  # (3,) of the face, in the target's body
    axes: np.ndarray  # (3, 3) rows: right, up, outward, in the target's body
    modules_per_m: float
    face_edge: float  # modules from the face's middle to its edge
    module_px: float  # its edge in the picture


def region_of(image: np.ndarray, camera: Camera, cube: TagCube, tag: Tag, rays: np.ndarray) -> Region | None:
    """The pixels of a tag; None when they are too few. rays: (H, W, 2) normalised points of all pixels' centres."""
    size_px = np.sqrt(cv2.contourArea(tag.corners_px.astype(np.float32))) / MODULES
    pad = np.ceil((1 + MARGIN) * size_px)
    limit = np.array(image.shape[::-1])
    first = np.maximum(np.floor(tag.corners_px.min(axis=0) - pad), 0).astype(int)
    last = np.minimum(np.ceil(tag.corners_px.max(axis=0) + pad) + 1, limit).astype(int)
    seen = rays[first[1] : last[1], first[0] : last[0]].reshape(-1, 2)
    to_tag = cv2.getPerspectiveTransform(tag.corners.astype(np.float32), SQUARE.astype(np.float32))
    s, t, w = to_tag[:, :2] @ seen.T + to_tag[:, 2:]
    s, t = s / w, t / w
    off_edge_px = np.minimum(np.abs(s - np.rint(s)), np.abs(t - np.rint(t))) * size_px
    margin = float(np.clip(cube.face_m / cube.tag_m * HALF - HALF - FROM_EDGE_PX / size_px, LEAST_MARGIN, MARGIN))
    keep = np.flatnonzero((np.maximum(np.abs(s), np.abs(t)) < HALF + margin) & (off_edge_px < NEAR_EDGE_PX))
    rows, columns = np.divmod(keep, last[0] - first[0])
    stride = -(-len(keep) // MOST_PIXELS)
    if stride > 1:
        some = (5 * columns + 3 * rows) % stride == 0
        keep, rows, columns = keep[some], rows[some], columns[some]
    if len(keep) < MODULES**2:
        return None
    place = np.column_stack([columns, rows]).astype(float)
    place = 2 * (place - place.min(axis=0)) / np.maximum(np.ptp(place, axis=0), 1) - 1
    across = max(CELL_PX / size_px, 1.0)  # modules of a cell
    cells = np.floor((s[keep] + HALF) / across).astype(int), np.floor((t[keep] + HALF) / across).astype(int)
    axes = cube.face_axes(tag.face)
    return Region(
        grey=image[rows + first[1], columns + first[0]].astype(float),
        directions=camera.mount.R_body_camera @ np.vstack([seen[keep].T, np.ones(len(keep))]),
        cells=np.unique(cells[0] + 4 * MODULES * cells[1], return_inverse=True)[1],
        place=place,
        dark=_dark_modules(cube.ids[tag.face]),
        middle=cube.centre_body + cube.face_m / 2 * axes[2],
        axes=axes,
        modules_per_m=MODULES / cube.tag_m,
        face_edge=HALF * cube.face_m / cube.tag_m,
        module_px=float(size_px),
    )


@lru_cache(maxsize=64)
def _dark_modules(tag: int) -> np.ndarray:
    """(8, 8) 1.0 where a module is dark."""
    return (cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(FAMILY), tag, MODULES) == 0).astype(float)
