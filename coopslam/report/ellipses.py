"""Covariance ellipses of map vertices, and by how much to magnify them so that they can be seen."""

import numpy as np

CHI_SQUARE_95 = 5.991  # 95 % quantile, 2 degrees of freedom


def ellipse_axes(covariances: np.ndarray, chi_square: float = CHI_SQUARE_95) -> tuple[np.ndarray, np.ndarray]:
    """Semi-axes (N, 2), longer first, m, and direction (N,) of the longer one, rad from the x axis.

    covariances: (N, 2, 2), m^2. The default is the region that holds the true point with 95 % probability.
    """
    variances, directions = np.linalg.eigh(np.reshape(covariances, (-1, 2, 2)))
    semi_axes = np.sqrt(chi_square * np.maximum(variances[:, ::-1], 0.0))
    return semi_axes, np.arctan2(directions[:, 1, 1], directions[:, 0, 1])


def magnification(largest_m: float, wanted_m: float) -> int:
    """The largest factor of 1, 2, 5, 10, 20, ... that keeps a length within the wanted one; at least 1."""
    if not 0 < largest_m < wanted_m:
        return 1
    ratio = wanted_m / largest_m * (1 + 1e-9)
    decade = 10 ** int(np.floor(np.log10(ratio)))
    return max(step * decade for step in (1, 2, 5) if step * decade <= ratio)
