"""Where one frame lies in another, from points that are known in both: robust rigid alignment.

Robots whose start poses are unknown map in frames of their own. Two such frames share points: a landmark that both
have seen, a robot that was seen from the one frame and knows its own way in the other. Some of these pairs are false
(a barcode read wrong), so each pair of pairs proposes an alignment, the one that most pairs agree with wins (consensus:
Fischler and Bolles 1981), and a least-squares fit over those that agree refines it (`se2.fit_pose`).
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import least_squares

from coopslam.errors import require_between, require_positive
from coopslam.se2 import Pose2, adjoint, fit_pose, position, rotation, wrap, xytheta

_MOST_PROPOSALS = 600
_STARTS = 16  # of the search over directions when there are only ranges


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """When two frames are brought together."""

    pairs_min: int = 4  # that agree
    share_min: float = 0.6  # of all pairs
    heading_sigma_max_rad: float = 0.1  # of the result
    ranges_min: int = 20  # when there is nothing but ranges
    gate_sigmas: float = 3.0  # how far two points that agree may be apart
    drift_sigma_m: float = 0.05  # of points in a frame that hangs on odometry, beside their own sigma
    caution: float = 3.0  # sigmas are multiplied with this: drift is shared by all points

    def __post_init__(self):
        require_between(2, 1000, pairs_min=self.pairs_min)
        require_between(0.0, 1.0, share_min=self.share_min)
        require_between(4, 1000, ranges_min=self.ranges_min)
        require_positive(
            heading_sigma_max_rad=self.heading_sigma_max_rad,
            gate_sigmas=self.gate_sigmas,
            drift_sigma_m=self.drift_sigma_m,
            caution=self.caution,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Frame b in frame a, and how well that is known at the centre of the points that agreed."""

    T_a_b: Pose2
    centre: np.ndarray  # (2,) in frame b
    cov_centre: np.ndarray  # (3, 3) of a pose at the centre, in the axes of b; m, m, rad
    agreed: int

    def covariance_at(self, T_b_body: Pose2) -> np.ndarray:
        """(3, 3) covariance of T_a_b * T_b_body in the axes of the body, T_b_body being sure."""
        T_body_centre = T_b_body.inverse() * Pose2(*self.centre, 0.0)
        carry = adjoint(T_body_centre)
        return carry @ self.cov_centre @ carry.T


def align(
    points_a: np.ndarray, points_b: np.ndarray, sigmas_m: np.ndarray, settings: AlignmentSettings
) -> Alignment | None:
    """The alignment that most pairs of points agree with; None when too few do, or heading or choice stay open.

    points_a, points_b: (N, 2), row k of both is the same point in either frame.  sigmas_m: (N,) of their difference.
    """
    count = len(points_a)
    if count < settings.pairs_min:
        return None
    sigmas = np.hypot(sigmas_m, settings.drift_sigma_m)
    angles, shifts = _proposals(points_a, points_b, sigmas * settings.gate_sigmas)
    if not len(angles):
        return None
    agree = _agreement(angles, shifts, points_a, points_b, sigmas * settings.gate_sigmas)
    votes = agree.sum(axis=1)
    best = int(votes.argmax())
    rivals = votes[np.abs(wrap(angles - angles[best])) > 0.5]
    chosen = agree[best]
    for _ in range(3):
        T_a_b = fit_pose(points_b[chosen], points_a[chosen], sigmas[chosen] ** -2)
        off = np.hypot(*(_moved(T_a_b, points_b) - points_a).T)
        chosen = off <= sigmas * settings.gate_sigmas
        if chosen.sum() < settings.pairs_min:
            return None
    if chosen.sum() < settings.share_min * count or len(rivals) and rivals.max() > 0.7 * chosen.sum():
        return None
    result = _with_covariance(T_a_b, points_b[chosen], off[chosen], sigmas[chosen], settings)
    return result if np.sqrt(result.cov_centre[2, 2]) <= settings.heading_sigma_max_rad * settings.caution else None


def align_by_ranges(
    points_a: np.ndarray, points_b: np.ndarray, ranges_m: np.ndarray, sigmas_m: np.ndarray, settings: AlignmentSettings
) -> Alignment | None:
    """The same from distances alone: point k of frame b is ranges_m[k] away from point k of frame a.

    Least squares with a robust loss from starts all around; None when two different answers fit about as well.
    """
    if len(ranges_m) < settings.ranges_min:
        return None
    sigmas = np.hypot(sigmas_m, settings.drift_sigma_m)

    def residuals(state: np.ndarray) -> np.ndarray:
        there = points_b @ rotation(state[2]).T + state[:2]
        return (np.hypot(*(there - points_a).T) - ranges_m) / sigmas

    found = []
    middle_a, middle_b, reach = points_a.mean(axis=0), points_b.mean(axis=0), float(np.median(ranges_m))
    for angle in np.linspace(-np.pi, np.pi, _STARTS, endpoint=False):
        for side in np.linspace(-np.pi, np.pi, 4, endpoint=False):
            start = middle_a + reach * np.array([np.cos(side), np.sin(side)]) - rotation(angle) @ middle_b
            found.append(least_squares(residuals, [*start, angle], loss="cauchy", max_nfev=60))
    found.sort(key=lambda result: result.cost)
    T_a_b = Pose2(*found[0].x)
    others = [result for result in found if _differ(T_a_b, Pose2(*result.x), middle_b, sigmas)]
    if others and others[0].cost < 1.5 * found[0].cost + 5.0:
        return None
    chosen = np.abs(residuals(found[0].x)) <= settings.gate_sigmas
    if chosen.sum() < settings.share_min * len(ranges_m):
        return None
    information = found[0].jac.T @ found[0].jac
    if np.linalg.cond(information) > 1e12:
        return None
    at_origin = np.linalg.inv(information) * settings.caution**2  # of (x, y, angle), x and y in the axes of a
    turn = np.eye(3)
    turn[:2, :2] = rotation(-T_a_b.theta())
    carry = adjoint(Pose2(*middle_b, 0.0).inverse())
    cov = carry @ turn @ at_origin @ turn.T @ carry.T
    if np.sqrt(cov[2, 2]) > settings.heading_sigma_max_rad * settings.caution:
        return None
    return Alignment(T_a_b, middle_b, cov, int(chosen.sum()))


def locate(points: np.ndarray, ranges_m: np.ndarray, sigmas_m: np.ndarray) -> np.ndarray | None:
    """(2,) a point from its distances to (N, 2) points; None when two different places fit about as well."""
    if len(ranges_m) < 4:
        return None

    def residuals(xy: np.ndarray) -> np.ndarray:
        return (np.hypot(*(points - xy).T) - ranges_m) / sigmas_m

    reach = float(np.median(ranges_m))
    around = np.linspace(-np.pi, np.pi, _STARTS, endpoint=False)
    starts = points.mean(axis=0) + reach * np.stack([np.cos(around), np.sin(around)], axis=1)
    found = sorted((least_squares(residuals, s, loss="cauchy") for s in starts), key=lambda result: result.cost)
    best, sigma = found[0], float(np.median(sigmas_m))
    others = [result for result in found if np.hypot(*(result.x - best.x)) > 10 * sigma + 0.1]
    if others and others[0].cost < 1.5 * best.cost + 5.0:
        return None
    return best.x if np.median(np.abs(residuals(best.x))) < 3.0 else None


def _proposals(points_a: np.ndarray, points_b: np.ndarray, gates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M,) angles and (M, 2) shifts by which two points of b come upon their partners in a."""
    count = len(points_a)
    if count * (count - 1) // 2 <= _MOST_PROPOSALS:
        i, j = np.array(list(combinations(range(count), 2))).T
    else:  # each with some others, near and far in the list
        strides = np.unique(np.geomspace(1, count // 2, max(_MOST_PROPOSALS // count, 2)).astype(int))
        i = np.tile(np.arange(count), len(strides))
        j = (i + np.repeat(strides, count)) % count
    a, b = points_a[j] - points_a[i], points_b[j] - points_b[i]
    long_a, long_b = np.hypot(*a.T), np.hypot(*b.T)
    gate = gates[i] + gates[j]
    possible = (np.abs(long_a - long_b) <= gate) & (np.minimum(long_a, long_b) > gate)
    i, j, a, b = i[possible], j[possible], a[possible], b[possible]
    angles = np.arctan2(a[:, 1], a[:, 0]) - np.arctan2(b[:, 1], b[:, 0])
    middle_b = (points_b[i] + points_b[j]) / 2
    return angles, (points_a[i] + points_a[j]) / 2 - _turned(angles, middle_b)


def _agreement(
    angles: np.ndarray, shifts: np.ndarray, points_a: np.ndarray, points_b: np.ndarray, gates: np.ndarray
) -> np.ndarray:
    """(M, N) whether proposal m brings point n of b to its partner."""
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x = c * points_b[:, 0] - s * points_b[:, 1] + shifts[:, :1] - points_a[:, 0]
    y = s * points_b[:, 0] + c * points_b[:, 1] + shifts[:, 1:] - points_a[:, 1]
    return np.hypot(x, y) <= gates


def _with_covariance(
    T_a_b: Pose2, points_b: np.ndarray, off: np.ndarray, sigmas: np.ndarray, settings: AlignmentSettings
) -> Alignment:
    """First order: shift and turn of a rigid fit about the centre of its points are independent."""
    variance = max(float(np.mean(off**2)) / 2, float(np.mean(sigmas**2))) * settings.caution**2
    centre = points_b.mean(axis=0)
    arms = float(((points_b - centre) ** 2).sum())
    cov = np.diag([variance / len(points_b), variance / len(points_b), variance / max(arms, 1e-12)])
    return Alignment(T_a_b, centre, cov, len(points_b))


def _differ(one: Pose2, other: Pose2, point: np.ndarray, sigmas: np.ndarray) -> bool:
    """Whether two alignments are different answers and not the same one found twice."""
    apart = np.hypot(*(position(one * Pose2(*point, 0.0)) - position(other * Pose2(*point, 0.0))))
    return apart > 10 * np.median(sigmas) + 0.1 or abs(wrap(xytheta(one)[2] - xytheta(other)[2])) > 0.3


def _moved(T_a_b: Pose2, points_b: np.ndarray) -> np.ndarray:
    return points_b @ rotation(T_a_b.theta()).T + position(T_a_b)


def _turned(angles: np.ndarray, points: np.ndarray) -> np.ndarray:
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=1)


def intersect(points: np.ndarray, directions_rad: np.ndarray, sigmas_rad: np.ndarray) -> np.ndarray | None:
    """(2,) where rays from (N, 2) points meet; None when they are too few or too nearly parallel, or meet behind."""
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
        weights = 1.0 / (lengths * sigmas_rad) ** 2
    sigma = np.sqrt(1.0 / np.linalg.eigvalsh((normals * weights[:, None]).T @ normals)[0])
    return meeting if sigma < 0.2 * np.median(lengths) else None
