"""Area sampling: the mean radiance and the covered share of each pixel, edges true to a small fraction of a pixel.

A pixel that only smooth patches meet is integrated by Simpson's rule over 3 x 3 points. A pixel that an edge crosses
(these points see different patches) is sampled at a lattice of 64 points, each in its own 64th of the width and of the
height, so an edge along rows or columns is placed to 1/128 pixel, a slanted one better. A straight edge cannot cross
a pixel and leave its corners alike; what is missed is thinner than half a pixel.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

SAMPLES = 64
GENERATOR = 19  # of the lattice: odd, its points well apart
CHUNK = 2048  # pixels with edges that are sampled at a time
SIMPSON = np.outer([1, 4, 1], [1, 4, 1]) / 36

Shade = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class Patch(NamedTuple):
    """A rectangle of the picture."""

    radiance: np.ndarray  # (h, w) light that what covers the pixel sends, already weighted with the coverage
    coverage: np.ndarray  # (h, w) share of the pixel that is covered


def sampled(corners: np.ndarray, shade: Shade) -> Patch:
    """What a rectangle of the picture shows.

    corners: (h + 1, w + 1, 2) normalised points of the pixels' corners.
    shade: (2, N) normalised points -> (N,) radiance (zero where nothing is hit) and (N,) label (-1: nothing).
    """
    h, w = corners.shape[0] - 1, corners.shape[1] - 1
    fine = _halved(corners)
    radiance, label = (each.reshape(2 * h + 1, 2 * w + 1) for each in shade(fine.reshape(-1, 2).T.copy()))
    views = [[np.s_[i : i + 2 * h - 1 : 2, j : j + 2 * w - 1 : 2] for j in range(3)] for i in range(3)]
    labels = np.stack([label[view] for row in views for view in row])
    low, high = labels.min(axis=0), labels.max(axis=0)
    coverage = (low >= 0).astype(float)
    mean = sum(SIMPSON[i, j] * radiance[views[i][j]] for i in range(3) for j in range(3))
    rows, columns = np.nonzero(low != high)
    for start in range(0, len(rows), CHUNK):
        some = rows[start : start + CHUNK], columns[start : start + CHUNK]
        mean[some], coverage[some] = _supersampled(corners, *some, shade)
    return Patch(mean, coverage)


def _supersampled(corners, rows, columns, shade: Shade) -> tuple[np.ndarray, np.ndarray]:
    """(E,) mean radiance and coverage of pixels; the lens is bilinear within each."""
    along = (np.arange(SAMPLES) + 0.5) / SAMPLES
    down = (np.arange(SAMPLES) * GENERATOR % SAMPLES + 0.5) / SAMPLES
    weights = np.stack([(1 - along) * (1 - down), along * (1 - down), (1 - along) * down, along * down])
    around = np.stack(
        [corners[rows + i, columns + j] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))], axis=-1
    )  # (E, 2, 4)
    points = np.moveaxis(around @ weights, 1, 0).reshape(2, -1)
    radiance, label = shade(points)
    shape = len(rows), SAMPLES
    return radiance.reshape(shape).mean(axis=1), (label.reshape(shape) >= 0).mean(axis=1)


def _halved(corners: np.ndarray) -> np.ndarray:
    """(2 h + 1, 2 w + 1, 2) the same grid with the midpoints."""
    fine = np.empty((2 * corners.shape[0] - 1, 2 * corners.shape[1] - 1, 2))
    fine[::2, ::2] = corners
    fine[1::2, ::2] = (corners[1:] + corners[:-1]) / 2
    fine[:, 1::2] = (fine[:, 2::2] + fine[:, :-2:2]) / 2
    return fine
