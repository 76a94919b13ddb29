"""Does a scatter of samples have the covariance that somebody claims: a test on whitened samples."""

import numpy as np


def require_covariance(samples: np.ndarray, cov: np.ndarray, sigmas: float = 5.0) -> None:
    """Samples (N, d) of zero mean against a regular (d, d) covariance; `sigmas` standard deviations of each entry.

    Whitened, the sample covariance is the identity with a standard deviation of sqrt(2 / N) on the diagonal and
    sqrt(1 / N) beside it, and the mean is zero with 1 / sqrt(N).
    """
    white = np.linalg.solve(np.linalg.cholesky(cov), samples.T)
    count = samples.shape[0]
    np.testing.assert_allclose(white.mean(axis=1), 0.0, atol=sigmas / np.sqrt(count))
    spread = white @ white.T / count
    np.testing.assert_allclose(np.diag(spread), 1.0, atol=sigmas * np.sqrt(2 / count))
    beside = spread[~np.eye(len(cov), dtype=bool)]
    np.testing.assert_allclose(beside, 0.0, atol=sigmas / np.sqrt(count))
