"""Exact first and second moments of a robot that drives on odometry alone, however far its heading drifts.

Its heading error e is a random walk, so its place relative to the start, as a complex number, is the integral of
exp(i (planned heading + e)): for large e no longer linear in it, and the places where it may be form a bent cloud (the
banana of Long, Wolfe, Mashner and Chirikjian, The Banana Distribution is Gaussian, 2012). But with u = exp(i e) all
moments up to the second obey linear differential equations along the way (Ito's formula; the model is the one of Zhou
and Chirikjian, Probabilistic Models of Dead-Reckoning Error in Nonholonomic Mobile Robots, 2003), whose coefficients
are constant on a straight stretch of even ground: matrix exponentials solve them without approximation.
"""

import numpy as np
from scipy.linalg import expm

from coopslam.planning.sensor_laws import OdometryLaw

# what the moments are of: z: displacement, m; u = exp(i e); e: error of heading, rad; the star means conjugate
ONE, Z, U, UU, Z_STAR_U, ZU, Z_STAR_Z, ZZ, EU, EZ = range(10)


class Drift:
    """The moments on the way, changed by what the robot does. Heading errors are normal with mean zero."""

    def __init__(self, heading_variance: float):
        """heading_variance: at the start, rad^2."""
        self.start_variance = self.variance = heading_variance  # rad^2; at the start, and here
        self.planned = 0j  # displacement without error, m
        v = heading_variance
        self._moments = np.zeros(10, complex)
        self._moments[[ONE, U, UU, EU]] = 1.0, np.exp(-v / 2), np.exp(-2 * v), 1j * v * np.exp(-v / 2)

    def turn(self, angle_rad: float, law: OdometryLaw) -> None:
        """On the spot."""
        grown = law.heading_sigma_per_rad**2 * abs(angle_rad)
        self._moments = expm(_diffusion() * grown) @ self._moments
        self.variance += grown

    def drive(self, way: np.ndarray, law: OdometryLaw) -> None:
        """Straight, by (2,) m, on ground of one kind."""
        length, ahead = float(np.hypot(*way)), complex(*way)
        if length > 0.0:
            q = law.heading_sigma_per_m**2
            rates = q * _diffusion() + _motion(ahead / length, law.translation_sigma_per_m**2)
            self._moments = expm(rates * length) @ self._moments
            self.variance += q * length
            self.planned += ahead

    def square(self) -> np.ndarray:
        """(2, 2) mean of d d', with d the true less the planned displacement, m^2."""
        mean, planned = self._moments[Z], self.planned
        size = (self._moments[Z_STAR_Z] - 2 * mean * planned.conjugate()).real + abs(planned) ** 2
        skew = self._moments[ZZ] - 2 * mean * planned + planned**2
        return np.array([[size + skew.real, skew.imag], [skew.imag, size - skew.real]]) / 2

    def with_start(self, cov_with_heading: np.ndarray) -> np.ndarray:
        """(n, 2) mean of x d', of jointly normal x of mean zero, with (n,) covariances with the heading error at the
        start: by Stein's lemma E[x u] = i cov(x, e) E[u], and likewise for what u adds up to."""
        per_heading = 1j * self._moments[Z]
        return np.outer(cov_with_heading, [per_heading.real, per_heading.imag])

    def with_drift(self) -> np.ndarray:
        """(2,) mean of w d, with w the heading error that the robot picked up on the way."""
        mean = self._moments[EZ] - 1j * self.start_variance * self._moments[Z]
        return np.array([mean.real, mean.imag])


def _diffusion() -> np.ndarray:
    """(10, 10) rates of the moments while the variance of heading grows by one."""
    rates = np.zeros((10, 10), complex)
    for moment in (U, Z_STAR_U, ZU, EU):
        rates[moment, moment] = -0.5
    rates[UU, UU], rates[EU, U] = -2.0, 1j
    return rates


def _motion(ahead: complex, per_m: float) -> np.ndarray:
    """(10, 10) rates of the moments with every metre in a direction; per_m: variance along the way, m^2 per m."""
    rates = np.zeros((10, 10), complex)
    rates[Z, U] = ahead
    rates[Z_STAR_U, ONE] = ahead.conjugate()
    rates[ZU, UU] = ahead
    rates[Z_STAR_Z, Z_STAR_U], rates[Z_STAR_Z, ONE] = 2 * ahead, per_m  # of which the real part is meant
    rates[ZZ, ZU], rates[ZZ, UU] = 2 * ahead, per_m * ahead**2
    rates[EZ, EU] = ahead
    return rates
