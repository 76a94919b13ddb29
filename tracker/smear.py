"""A step smeared by a Gaussian, fast: lens, motion and pixels blur every edge of a picture about so."""

import numpy as np

ROOT = float(1 / np.sqrt(2 * np.pi))
ONE = float(np.sqrt(2 / np.pi))
THREE = 0.044715
FAR = 64.0  # squared sigmas, from which on nothing is left; beyond, exponentials would have slow, denormal values


def smeared_step(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal distribution at x (in sigmas) and its density, of any shape; as precise as 3e-4.

    The hyperbolic tangent of a cubic (Page 1977, "Approximations to the cumulative normal function") takes a tenth of
    the time of scipy's.
    """
    square = np.minimum(x * x, FAR)
    return 0.5 + 0.5 * np.tanh(ONE * x * (1.0 + THREE * square)), ROOT * np.exp(-0.5 * square)
