"""Judge a triangulation against the true polygon; its triangles stand on true vertices."""

from collections.abc import Sequence

import numpy as np
import shapely

from coopslam.errors import BadInput

AREA_TOLERANCE = 1e-9  # of the polygon's area; less than this outside the polygon is rounding


def judge(
    triangles: Sequence[tuple[int, int, int]], points: np.ndarray, polygon: shapely.Polygon
) -> tuple[float, float, bool]:
    """Covered fraction and overlap fraction of the polygon's area, and whether all triangles are free.

    triangles: indices into points, counter-clockwise.  points: (n, 2), the outer ring's vertices, then the holes'.
    Covered: area of the union inside the polygon.  Overlap: what the areas exceed their union by.
    Free: not clockwise, and no part outside the polygon.  Triangles without area are legal.
    """
    corners = _corners(triangles, np.asarray(points, float))
    if not len(corners):
        return 0.0, 0.0, True
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    signed = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2.0
    tolerance = AREA_TOLERANCE * polygon.area
    solid = shapely.polygons(corners[np.abs(signed) > tolerance / len(corners)])
    union = _union(solid, polygon)
    covered = shapely.area(shapely.intersection(union, polygon)) / polygon.area
    overlap = max(float(shapely.area(solid).sum() - union.area), 0.0) / polygon.area
    all_free = bool((signed >= -tolerance).all()) and _inside(solid, polygon, tolerance)
    return float(covered), overlap, all_free


def _corners(triangles, points: np.ndarray) -> np.ndarray:
    """(m, 3, 2)."""
    indices = np.asarray(triangles, dtype=int).reshape(-1, 3)
    if len(indices) and not 0 <= indices.min() <= indices.max() < len(points):
        raise BadInput(f"triangles name vertices {indices.min()} to {indices.max()}; the world has {len(points)}")
    return points[indices]


def _union(solid: np.ndarray, polygon: shapely.Polygon):
    """Area that the triangles cover together; on a fine grid where exact coordinates defeat GEOS."""
    try:
        return shapely.union_all(solid)
    except shapely.errors.GEOSException:
        return shapely.union_all(solid, grid_size=1e-9 * np.sqrt(polygon.area))


def _inside(solid: np.ndarray, polygon: shapely.Polygon, tolerance: float) -> bool:
    """Whether no triangle leaves the polygon by more than the tolerance."""
    shapely.prepare(polygon)
    doubtful = solid[~shapely.covers(polygon, solid)]
    return bool((shapely.area(shapely.difference(doubtful, polygon)) <= tolerance).all())
