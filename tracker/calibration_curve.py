"""Figure 1b of the paper: where the ends of the pattern are in the picture, against distance."""

from dataclasses import dataclass

import numpy as np

from tracker.calibration import Calibrated
from tracker.calibration_edges import edges_of
from tracker.data_sheet import DataSheet
from tracker.edges import Kind, ModelEdges
from tracker.tag_edges import KIND as TAG_SIDE

UPRIGHT = 0.7  # share of an edge's normal along the columns, from which on it is one of an end


@dataclass(frozen=True, slots=True, eq=False)
class EndErrors:
    """By how many pixels the ends of the pattern are lower in n pictures than a sheet says at the known distance."""

    before_px: np.ndarray  # (n, 2) by the nominal sheet: lower end, upper end; NaN where not found
    after_px: np.ndarray  # (n, 2) by the calibrated one


def end_rows(sheet: DataSheet, ranges_m: np.ndarray) -> np.ndarray:
    """(R, 2) rows of the lower and upper end straight ahead of the camera, where they face it; NaN outside."""
    yaw, target = sheet.camera.mount.yaw_rad, sheet.target
    nearer = target.radius_m if sheet.helix is not None else target.face_m / 2
    if sheet.helix is not None:
        heights = (target.bottom_m, target.top_m)
    else:
        middle = target.bottom_m + target.face_m / 2
        heights = (middle - target.tag_m / 2, middle + target.tag_m / 2)
    along = np.asarray(ranges_m, dtype=float) - nearer
    rows = []
    for height in heights:
        points = np.column_stack([along * np.cos(yaw), along * np.sin(yaw), np.full(len(along), height)])
        pixels, seen = sheet.camera.project(points)
        rows.append(np.where(seen, pixels[:, 1], np.nan))
    return np.stack(rows, axis=1)


def end_errors(calibrated: Calibrated) -> EndErrors:
    """Of all pictures that were used, where the calibrated fit has the target."""
    ends = []
    for sheet in (calibrated.nominal, calibrated.sheet):
        own = []
        for view, pose in zip(calibrated.located, calibrated.fit.poses, strict=True):
            edges = edges_of(sheet, pose)
            offsets, _, found = view.measure(edges, 0.0)
            own.append(_ends(edges.where(found), offsets[found]))
        ends.append(np.array(own))
    return EndErrors(*ends)


def _ends(edges: ModelEdges, offsets: np.ndarray) -> list[float]:
    """Median errors of the lower and the upper end, down the columns."""
    down = edges.normals[:, 1]
    end = np.isin(edges.kind, (Kind.RING, TAG_SIDE))
    found = []
    for own in (end & (down > UPRIGHT), end & (down < -UPRIGHT)):
        found.append(float(np.median(offsets[own] * down[own])) if own.any() else np.nan)
    return found
