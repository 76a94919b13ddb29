"""Occupancy grids as the map_server of ROS reads them: a PGM picture and a YAML file that says where it lies.

Trinary mode: a pixel of value v is occupied with probability (255 - v) / 255; above `occupied_thresh` it is occupied,
below `free_thresh` free, unknown in between (http://wiki.ros.org/map_server). The same files serve nav2.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor
from pathlib import Path

import numpy as np
import shapely

from coopslam.errors import BadInput, require_positive

FREE, OCCUPIED, UNKNOWN = 254, 0, 205  # pixel values that map_server itself writes
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196  # 205 is a probability of 0.1961: free_thresh must lie below
MOST_CELLS = 50_000_000


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyMap:
    """Square cells over a stretch of the plane."""

    pixels: np.ndarray  # (rows, columns) uint8, FREE, OCCUPIED or UNKNOWN; row 0 at the top (greatest y)
    resolution_m: float  # side of a cell
    origin: tuple[float, float]  # x, y of the lower left corner of the lower left cell, m


def occupancy_of(
    free_space: shapely.Polygon | shapely.MultiPolygon,
    walls: Sequence[tuple[tuple[float, float], tuple[float, float]]],
    resolution_m: float,
) -> OccupancyMap:
    """Cells that a wall runs through are occupied, others whose centre is free are free, the rest is unknown.

    So obstacles are as thick as what was seen of them, their insides unknown. One unknown cell, at least, surrounds
    everything.  walls: (start, end) of each, m. Raises BadInput for a resolution that makes no picture.
    """
    require_positive(resolution_m=resolution_m)
    ends = np.reshape(np.asarray(walls, float), (-1, 2, 2))
    corners = np.concatenate([shapely.get_coordinates(free_space), ends.reshape(-1, 2)])
    if not len(corners):
        raise BadInput("nothing is mapped; expected free space or walls")
    low, high = corners.min(axis=0), corners.max(axis=0)
    with np.errstate(over="ignore"):
        count = float(np.prod((high - low) / resolution_m + 3))
        farthest = float(np.abs(corners).max() / resolution_m)
    if not (count <= MOST_CELLS and farthest < 2**53):  # cells must have numbers
        raise BadInput(f"resolution_m: {resolution_m:g} makes {count:.3g} cells; at most {MOST_CELLS:,} expected")
    x0, y0 = (floor(value / resolution_m) - 1 for value in low.tolist())  # in cells, so that maps fit on each other
    x1, y1 = (ceil(value / resolution_m) + 1 for value in high.tolist())
    columns, rows = x1 - x0, y1 - y0
    cells = np.full((rows, columns), UNKNOWN, np.uint8)  # row 0 at the bottom
    shapely.prepare(free_space)
    x = (x0 + np.arange(columns) + 0.5) * resolution_m
    for row in range(rows):
        cells[row, shapely.contains_xy(free_space, x, (y0 + row + 0.5) * resolution_m)] = FREE
    for start, end in ends:
        column, row = _crossed(start / resolution_m - (x0, y0), end / resolution_m - (x0, y0)).T
        cells[row, column] = OCCUPIED
    return OccupancyMap(cells[::-1], resolution_m, (x0 * resolution_m, y0 * resolution_m))


def write_occupancy_map(path: Path, grid: OccupancyMap) -> tuple[Path, Path]:
    """PATH.pgm (binary, 8 bits) and PATH.yaml; returns both."""
    picture, description = path.with_name(path.name + ".pgm"), path.with_name(path.name + ".yaml")
    rows, columns = grid.pixels.shape
    picture.write_bytes(f"P5\n{columns} {rows}\n255\n".encode("ascii") + np.ascontiguousarray(grid.pixels).tobytes())
    x, y = grid.origin
    lines = [
        f"image: {json.dumps(picture.name)}",
        "mode: trinary",
        f"resolution: {grid.resolution_m!r}",
        f"origin: [{x!r}, {y!r}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED_THRESH}",
        f"free_thresh: {FREE_THRESH}",
    ]
    description.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return picture, description


def _crossed(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(k, 2) column and row of each cell that a segment runs through; (2,) ends in cells from the grid's corner.

    The segment is cut at every line of the grid; the middle of a piece tells its cell.
    """
    cuts = [np.array([0.0, 1.0])]
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        if a != b:
            lines = np.arange(ceil(min(a, b)), floor(max(a, b)) + 1)
            cuts.append((lines - a) / (b - a))
    along = np.unique(np.clip(np.concatenate(cuts), 0.0, 1.0))
    middles = start + ((along[:-1] + along[1:]) / 2)[:, None] * (end - start)
    return np.floor(middles).astype(int)
