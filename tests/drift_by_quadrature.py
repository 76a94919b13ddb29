"""What a robot that drifts on a straight leg errs by: double integrals over its random walk of heading."""

import numpy as np
from scipy.integrate import dblquad, quad

from coopslam.planning.sensor_laws import OdometryLaw


def straight_by_quadrature(length: float, law: OdometryLaw, start_variance: float) -> np.ndarray:
    """(3, 3) mean squares of (ahead, aside, picked up heading) less what was planned.

    From E cos a cos b = (exp(-var(a - b) / 2) + exp(-var(a + b) / 2)) / 2 of normal a and b, and likewise for sines.
    """
    q, along = law.heading_sigma_per_m**2, law.translation_sigma_per_m**2

    def difference(s, t):
        return np.exp(-q * abs(s - t) / 2)

    def total(s, t):
        return np.exp(-(4 * start_variance + q * abs(s - t) + 4 * q * min(s, t)) / 2)

    def double(sign):  # symmetric: twice the half below the diagonal, where nothing has a kink
        def half(t, s):
            return difference(s, t) + sign * total(s, t)

        return dblquad(half, 0, length, 0, lambda s: s, epsabs=1e-13)[0]

    def variance(s):
        return start_variance + q * s

    ahead = quad(lambda s: np.exp(-variance(s) / 2), 0, length)[0]
    white = quad(lambda s: (1 + np.exp(-2 * variance(s))) / 2, 0, length)[0]
    mixed = quad(lambda s: q * s * np.exp(-variance(s) / 2), 0, length)[0]
    xx = double(1) - 2 * length * ahead + length**2 + along * white
    yy = double(-1) + along * (length - white)
    return np.array([[xx, 0, 0], [0, yy, mixed], [0, mixed, q * length]])
