"""What people use today: a cube with an AprilTag (family 36h11) on each side, behind the same interface as the helix.

Side k faces the azimuth k * 90 degrees of the robot: 0 forward, 1 left, 2 back, 3 right. A tag is 8 x 8 modules, its
black border included, in the middle of a white face.
"""

from dataclasses import dataclass
from functools import cache
from math import pi

import cv2
import numpy as np

from coopslam.errors import BadInput, require_between, require_positive
from tracker.target import Drum, Look, require_ends

FAMILY = cv2.aruco.DICT_APRILTAG_36h11
MODULES = 8
TAGS = 587  # of the family
SIDES = 4
TOP = 4  # number of the top face


@dataclass(frozen=True, slots=True)
class TagCube:
    """A cube with tags on a robot. Heights are above the floor. Raises BadInput naming the field."""

    face_m: float = 0.30  # edge of the cube
    tag_m: float = 0.24  # edge of a tag, outer side of its black border
    bottom_m: float = 0.18
    side_ids: tuple[int, int, int, int] = (0, 1, 2, 3)
    top_id: int | None = None  # on the upper face, its upper edge towards the robot's front; None: no tag there
    dark: float = 0.05  # reflectance
    light: float = 0.85
    forward_m: float = 0.0  # of the cube's axis from the robot's reference point
    body: tuple[Drum, ...] = ()  # what else is seen of the robot

    def __post_init__(self):
        require_positive(10.0, face_m=self.face_m)
        if not 0 < self.tag_m * (1 + 2 / MODULES) <= self.face_m * (1 + 1e-9):
            most = self.face_m / (1 + 2 / MODULES)
            raise BadInput(f"tag_m: at most {most:g} expected (white border of one module), got {self.tag_m}")
        require_ends(self.bottom_m, self.top_m)
        for field, ids in (("side_ids", self.side_ids), ("top_id", () if self.top_id is None else (self.top_id,))):
            if not all(isinstance(tag, int) and not isinstance(tag, bool) and 0 <= tag < TAGS for tag in ids):
                raise BadInput(f"{field}: ids from 0 to {TAGS - 1} expected, got {ids}")
        if len(self.side_ids) != SIDES or len(set(self.ids)) != len(self.ids):
            raise BadInput(f"side_ids: {SIDES} ids, none of them twice, expected, got {self.ids}")
        require_between(0.0, 1.0, dark=self.dark, light=self.light)
        if not self.dark < self.light:
            raise BadInput(f"light: more than dark ({self.dark:g}) expected, got {self.light}")
        require_between(-10.0, 10.0, forward_m=self.forward_m)

    @property
    def top_m(self) -> float:
        """Height of the upper face."""
        return self.bottom_m + self.face_m

    @property
    def ids(self) -> tuple[int, ...]:
        """Tag of each face that has one, in the order of the faces."""
        return self.side_ids if self.top_id is None else (*self.side_ids, self.top_id)

    @property
    def solids(self) -> tuple:
        """See Target."""
        return (self, *self.body)

    @property
    def centre_body(self) -> np.ndarray:
        """(3,) middle of the cube."""
        return np.array([self.forward_m, 0.0, self.bottom_m + self.face_m / 2])

    def face_axes(self, face: int) -> np.ndarray:
        """(3, 3) rows: right, up and outward of a face as somebody in front of it sees them, in the robot's body."""
        if face == TOP:
            return np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        c, s = np.round([np.cos(face * pi / 2), np.sin(face * pi / 2)])
        return np.array([[-s, c, 0.0], [0.0, 0.0, 1.0], [c, s, 0.0]])

    def corners(self) -> dict[int, np.ndarray]:
        """Tag id -> (4, 3) its corners in the robot's body, in cv2.aruco's order: clockwise from the upper left."""
        square = self.tag_m / 2 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
        found = {}
        for face, tag in enumerate(self.ids):
            right, up, out = self.face_axes(face)
            found[tag] = self.centre_body + square[:, :1] * right + square[:, 1:] * up + self.face_m / 2 * out
        return found

    def distances(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """See Solid.  Slabs (Kay and Kajiya 1986)."""
        half, start = self.face_m / 2, (origin - self.centre_body)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):  # a ray along a slab never leaves it
            one, other = (-half - start) / directions, (half - start) / directions
        enter, leave = np.minimum(one, other).max(axis=0), np.maximum(one, other).min(axis=0)
        return np.where((enter > 0) & (enter <= leave), enter, np.inf)

    def look(self, points: np.ndarray) -> Look:
        """See Solid.  Patch 2 k is what is light of face k, 2 k + 1 what is dark; 12 is the lower face."""
        from_centre = (points - self.centre_body[:, None]) / (self.face_m / 2)
        axis = np.abs(from_centre).argmax(axis=0)
        positive = np.take_along_axis(from_centre, axis[None], axis=0)[0] > 0
        normals, dark, patch = np.zeros_like(points), np.zeros(points.shape[1], bool), np.full(points.shape[1], 12)
        faces = np.choose(axis, [np.where(positive, 0, 2), np.where(positive, 1, 3), np.where(positive, TOP, TOP + 1)])
        normals[2, faces == TOP + 1] = -1.0
        for face in range(SIDES + 1):
            there = np.flatnonzero(faces == face)
            right, up, out = self.face_axes(face)
            normals[:, there] = out[:, None]
            if face < len(self.ids):
                dark[there] = self._is_dark(self.ids[face], right @ from_centre[:, there], up @ from_centre[:, there])
            patch[there] = 2 * face + dark[there]
        return Look(normals, np.where(dark, self.dark, self.light), patch)

    def extent(self) -> np.ndarray:
        """See Solid: its eight corners."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return self.centre_body + self.face_m / 2 * signs

    def _is_dark(self, tag: int, right: np.ndarray, up: np.ndarray) -> np.ndarray:
        """Whether a face with a tag is dark; right, up: (N,) from its middle, in half edges of the face."""
        scale = self.face_m / self.tag_m * MODULES / 2
        column = np.floor(right * scale + MODULES / 2).astype(int)
        row = np.floor(MODULES / 2 - up * scale).astype(int)
        on_tag = (column >= 0) & (column < MODULES) & (row >= 0) & (row < MODULES)
        return on_tag & _modules(tag)[row.clip(0, MODULES - 1), column.clip(0, MODULES - 1)]


@cache
def _modules(tag: int) -> np.ndarray:
    """(8, 8) which modules of a tag are dark."""
    return cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(FAMILY), tag, MODULES) == 0
