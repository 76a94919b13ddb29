"""Where calibration finds edges: in a picture, or remembered from one; and which of them err together.

Neighbouring points of an edge do not err independently. Light that grows across a silhouette, a ring that is printed
half a millimetre too high, blur beside another edge: these move a whole edge of one picture. So all points of one kind
that face the same way are a group (upper and lower ring, ends and beginnings of stripes, the sides of a tag). What is
behind a silhouette changes along it, so each is cut into some groups.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from coopslam.se2 import Pose2
from tracker.data_sheet import DataSheet
from tracker.edges import SILHOUETTE_POINTS, Kind, ModelEdges, measure, model_edges
from tracker.tag_edges import tag_edges

LEAST_ROOM_PX = 2.5  # to the next edge of the pattern; nearer ones move each other by their blur
LEAST_INSIDE_PX = 4.5  # from a silhouette, whose other side is unknown
SHARED_PX = 2.0  # along an edge: profiles that are nearer share pixels, since each is interpolated between two rows
COARSE_PX = 2.0  # sigma of a shift of the whole picture
SEGMENT = 8  # points of a silhouette in a group
FACE = 100_000  # names of a tag's edges, per face


class View(Protocol):
    """What one picture says of edges."""

    def measure(self, edges: ModelEdges, reach_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `tracker.edges.measure`."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """Edges are measured wherever they are asked for."""

    image: np.ndarray  # (H, W) uint8

    def measure(self, edges: ModelEdges, reach_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See View."""
        offsets, sigmas, found = measure(self.image, edges, reach_px)
        sigmas = sigmas * np.sqrt(np.maximum(1.0, SHARED_PX / spacings_px(edges)))
        return offsets, sigmas, found & clear_of_others(edges)


@dataclass(frozen=True, slots=True, eq=False)
class Shifted:
    """Before anything is measured: the whole picture is so much lower than the sheet says."""

    shift_px: float

    def measure(self, edges: ModelEdges, reach_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See View.  One measurement, shared by all points; none of the heading, nor along the rows."""
        count = len(edges.pixels)
        level = (np.abs(edges.normals[:, 1]) > 0.7) & (edges.kind != Kind.STRIPE)
        sigma = COARSE_PX * np.sqrt(max(np.count_nonzero(level), 1))
        return self.shift_px * edges.normals[:, 1], np.full(count, sigma), level


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Edges as they were found once, to fit other models to without the picture."""

    names: np.ndarray  # (N,) ascending, of `ModelEdges`
    points_px: np.ndarray  # (N, 2) on the edges that were found
    sigmas_px: np.ndarray  # (N,)

    @classmethod
    def of(cls, edges: ModelEdges, offsets: np.ndarray, sigmas: np.ndarray) -> "Located":
        """From measured offsets along the normals of N edges."""
        order = np.argsort(edges.names)
        points = edges.pixels + offsets[:, None] * edges.normals
        return cls(edges.names[order], points[order], sigmas[order])

    def measure(self, edges: ModelEdges, reach_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See View.  The reach is that of the names; a stripe further away than the next one may be that one."""
        at = np.searchsorted(self.names, edges.names).clip(0, max(len(self.names) - 1, 0))
        if not len(self.names) or not len(edges.names):
            nothing = np.full(len(edges.names), np.nan)
            return nothing, nothing, np.zeros(len(edges.names), bool)
        offsets = np.sum((self.points_px[at] - edges.pixels) * edges.normals, axis=1)
        found = (self.names[at] == edges.names) & ((edges.kind != Kind.STRIPE) | (np.abs(offsets) < edges.room_px))
        return offsets, self.sigmas_px[at], found


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What a picture would say if the model were right: to ask how well a pose will be known."""

    sigma_px: float  # of each edge

    def measure(self, edges: ModelEdges, reach_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See View."""
        count = len(edges.names)
        return np.zeros(count), np.full(count, self.sigma_px), np.ones(count, bool)


def edges_of(sheet: DataSheet, pose: Pose2) -> ModelEdges:
    """What the camera of a sheet should see of its target."""
    if sheet.helix is None:
        return tag_edges(sheet.camera, sheet.tag_cube, pose)
    return model_edges(sheet.camera, sheet.helix, pose)


def groups_of(edges: ModelEdges) -> np.ndarray:
    """(N,) integers: edges with the same one err together."""
    u, v = edges.normals.T
    facing = np.where(np.abs(u) > np.abs(v), np.where(u > 0, 0, 1), np.where(v > 0, 2, 3))
    face = np.where(edges.kind > max(Kind), edges.names // FACE, 0)
    segment = np.where(edges.kind == Kind.SILHOUETTE, edges.names % SILHOUETTE_POINTS // SEGMENT, 0)
    return (1000 * segment + 100 * face + 10 * edges.kind + facing).astype(int)


def clear_of_others(edges: ModelEdges) -> np.ndarray:
    """(N,) whether no other edge is so near that blur moves this one."""
    clear = edges.room_px >= LEAST_ROOM_PX
    limbs, labels = edges.kind == Kind.SILHOUETTE, groups_of(edges)
    for label in np.unique(labels[limbs]):
        own = labels == label
        inside = -(edges.pixels - edges.pixels[own].mean(axis=0)) @ edges.normals[own].mean(axis=0)
        clear &= inside >= LEAST_INSIDE_PX
    return clear | limbs


def spacings_px(edges: ModelEdges) -> np.ndarray:
    """(N,) mean distance of neighbouring points in the group of each, along the edge."""
    spacings = np.empty(len(edges.names))
    labels = groups_of(edges)
    for label in np.unique(labels):
        own = labels == label
        tangents = np.column_stack([-edges.normals[own, 1], edges.normals[own, 0]])
        along = np.sum(edges.pixels[own] * tangents.mean(axis=0), axis=1)
        spacings[own] = max(float(np.ptp(along)), 1.0) / np.count_nonzero(own)
    return spacings


def moved_by(edges: ModelEdges, ahead: ModelEdges, back: ModelEdges) -> np.ndarray:
    """(N,) how far edges move along their normals from `back` to `ahead`; NaN for one that either does not show."""
    return np.sum((_of_names(ahead, edges.names) - _of_names(back, edges.names)) * edges.normals, axis=1)


def _of_names(edges: ModelEdges, names: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of points by their names; NaN where there is none."""
    order = np.argsort(edges.names)
    if not len(order):
        return np.full((len(names), 2), np.nan)
    at = order[np.searchsorted(edges.names, names, sorter=order).clip(0, len(order) - 1)]
    return np.where((edges.names[at] == names)[:, None], edges.pixels[at], np.nan)
