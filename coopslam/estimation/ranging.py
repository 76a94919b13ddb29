"""What distances alone, or directions alone, say about a point or about two frames.

Distances have several answers where points lie on a line, and a search that begins near a wrong one stays there. So the
cost is looked at all around, the best places of it are refined, and where two different ones fit about as well there is
no answer yet.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from coopslam.estimation.alignment import Alignment, AlignmentSettings
from coopslam.se2 import Pose2, planar_rotation, rotation, wrap

_REFINED = 8  # of the starts
_MOST_RESIDUALS = 300  # looked at in one search


def align_by_ranges(
    points_a: np.ndarray, points_b: np.ndarray, ranges_m: np.ndarray, sigmas_m: np.ndarray, settings: AlignmentSettings
) -> Alignment | None:
    """Frame b in frame a from distances: point k of frame b is ranges_m[k] away from point k of frame a.

    points_a, points_b: (N, 2).  ranges_m, sigmas_m: (N,).  Least squares with Cauchy's loss; None when too few fit, or
    when two different answers fit about as well.
    """
    if len(ranges_m) < settings.ranges_min:
        return None
    some = np.unique(np.linspace(0, len(ranges_m) - 1, _MOST_RESIDUALS).astype(int))
    points_a, points_b, ranges_m, sigmas_m = points_a[some], points_b[some], ranges_m[some], sigmas_m[some]
    sigmas = np.hypot(sigmas_m, settings.drift_sigma_m)
    middle_b = points_b.mean(axis=0)
    arms = points_b - middle_b

    def difference(states: np.ndarray) -> np.ndarray:
        """(..., N, 2) from a to b. states: (..., 3) where the middle of b is in a, and the angle of b in a."""
        c, s = np.cos(states[..., 2:]), np.sin(states[..., 2:])
        turned = np.stack([c * arms[:, 0] - s * arms[:, 1], s * arms[:, 0] + c * arms[:, 1]], axis=-1)
        return turned + states[..., None, :2] - points_a

    def residuals(states: np.ndarray) -> np.ndarray:
        return (_length(difference(states)) - ranges_m) / sigmas

    def jacobian(state: np.ndarray) -> np.ndarray:
        apart = difference(state)
        turned = arms @ rotation(state[2]).T
        towards = apart / np.maximum(_length(apart), 1e-9)[:, None]
        by_angle = towards[:, 1] * turned[:, 0] - towards[:, 0] * turned[:, 1]
        return np.column_stack([towards, by_angle]) / sigmas[:, None]

    angles = np.linspace(-np.pi, np.pi, 24, endpoint=False)
    places = _around(points_a, ranges_m)
    starts = np.column_stack([np.tile(places, (len(angles), 1)), np.repeat(angles, len(places))])
    found = _minima(residuals, jacobian, starts)
    best, limit = found[0], 10 * float(np.median(sigmas)) + 0.1
    if _is_open(found, lambda x: np.hypot(*(x - best.x)[:2]) > limit or abs(wrap(x[2] - best.x[2])) > 0.3):
        return None
    chosen = np.abs(residuals(best.x)) <= settings.gate_sigmas
    if chosen.sum() < settings.share_min * len(ranges_m):
        return None
    weighted = jacobian(best.x)[chosen]
    information = weighted.T @ weighted
    if np.linalg.eigvalsh(information)[0] <= (settings.heading_sigma_max_rad * settings.caution * 1e4) ** -2:
        return None
    turn = planar_rotation(-best.x[2])
    drift = settings.drift_sigma_m**2 * np.diag([1.0, 1.0, 1.0 / max(float(np.mean(arms**2)) * 2, 1e-12)])  # of all
    cov = (turn @ np.linalg.inv(information) @ turn.T + drift) * settings.caution**2
    if np.sqrt(cov[2, 2]) > settings.heading_sigma_max_rad * settings.caution:
        return None
    T_a_b = Pose2(*best.x) * Pose2(*-middle_b, 0.0)
    return Alignment(T_a_b, middle_b, cov, int(chosen.sum()))


def locate(points: np.ndarray, ranges_m: np.ndarray, sigmas_m: np.ndarray) -> np.ndarray | None:
    """(2,) a point from its distances to (N, 2) points; None when two different places fit about as well."""
    if len(ranges_m) < 4:
        return None

    def residuals(places: np.ndarray) -> np.ndarray:
        return (_length(places[..., None, :] - points) - ranges_m) / sigmas_m

    def jacobian(place: np.ndarray) -> np.ndarray:
        apart = place - points
        return apart / (np.maximum(_length(apart), 1e-9) * sigmas_m)[:, None]

    found = _minima(residuals, jacobian, _around(points, ranges_m))
    best, limit = found[0], 10 * float(np.median(sigmas_m)) + 0.1
    if _is_open(found, lambda x: np.hypot(*(x - best.x)) > limit) or np.median(np.abs(residuals(best.x))) >= 3.0:
        return None
    information = jacobian(best.x).T @ jacobian(best.x)
    return best.x if np.linalg.eigvalsh(information)[0] * (0.2 * np.median(ranges_m)) ** 2 > 1.0 else None


def intersect(
    points: np.ndarray, directions_rad: np.ndarray, sigmas_rad: np.ndarray, point_sigma_m: float = 0.0
) -> np.ndarray | None:
    """(2,) where rays from (N, 2) points meet; None when they are too few, too nearly parallel, miss or meet behind.

    point_sigma_m: how well each ray's point is known, beside its direction.
    """
    if len(points) < 3:
        return None
    along = np.stack([np.cos(directions_rad), np.sin(directions_rad)], axis=1)
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
    offsets = (normals * points).sum(axis=1)
    weights = np.ones(len(points))
    for _ in range(2):  # a ray's distance from the point grows with its length
        information = (normals * weights[:, None]).T @ normals
        if np.linalg.eigvalsh(information)[0] < 1e-6 * weights.sum():
            return None
        meeting = np.linalg.solve(information, (normals * weights[:, None]).T @ offsets)
        lengths = ((meeting - points) * along).sum(axis=1)
        if (lengths <= 0).any():
            return None
        weights = 1.0 / ((lengths * sigmas_rad) ** 2 + point_sigma_m**2)
    missed = np.abs(normals @ meeting - offsets) * np.sqrt(weights)
    sigma = np.sqrt(1.0 / np.linalg.eigvalsh((normals * weights[:, None]).T @ normals)[0])
    return meeting if sigma < 0.2 * np.median(lengths) and np.median(missed) < 3.0 else None


def _around(points: np.ndarray, ranges_m: np.ndarray) -> np.ndarray:
    """(M, 2) places all over the disc about points from which the distances can be."""
    middle = points.mean(axis=0)
    reach = float(_length(points - middle).mean() + np.median(ranges_m))
    angles = np.linspace(-np.pi, np.pi, 24, endpoint=False)
    radii = reach * np.linspace(0.1, 1.1, 6)
    rings = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return middle + rings.reshape(-1, 2)


def _minima(residuals: Callable, jacobian: Callable, starts: np.ndarray) -> list[OptimizeResult]:
    """Local minima of Cauchy's loss near the best of (M, n) starts, best first.

    residuals: (..., n) -> (..., N).  jacobian: (n,) -> (N, n).
    """
    costs = np.abs(residuals(starts)).sum(axis=-1)  # from afar, Cauchy's loss looks the same everywhere
    reach = np.ptp(starts[:, :2], axis=0).max()
    chosen: list[np.ndarray] = []
    for start in starts[np.argsort(costs)]:
        if not any(_is_near(start, other, reach) for other in chosen):
            chosen.append(start)
        if len(chosen) == _REFINED:
            break
    found = []
    for start in chosen:
        near = least_squares(residuals, start, jacobian, loss="soft_l1", max_nfev=50)
        found.append(least_squares(residuals, near.x, jacobian, loss="cauchy", max_nfev=50))
    return sorted(found, key=lambda result: result.cost)


def _is_near(start: np.ndarray, other: np.ndarray, reach: float) -> bool:
    """Whether two starts are so much alike that one of them suffices."""
    step = start - other
    return bool(np.hypot(step[0], step[1]) < 0.2 * reach and (np.abs(wrap(step[2:])) < 0.6).all())


def _is_open(found: list[OptimizeResult], is_other: Callable[[np.ndarray], bool]) -> bool:
    """Whether a different answer than the first fits about as well."""
    return any(is_other(result.x) and result.cost < 1.5 * found[0].cost + 5.0 for result in found[1:])


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.hypot(vectors[..., 0], vectors[..., 1])
