"""Where one frame lies in another, from points that are known in both: robust rigid alignment.

Robots whose start poses are unknown map in frames of their own. Two such frames share points: a landmark that both
have seen, a robot that was seen from the one frame and knows its own way in the other. Some of these pairs are false
(a barcode read wrong), so each pair of pairs proposes an alignment, the one that most pairs agree with wins (consensus:
Fischler and Bolles 1981), and a least-squares fit over those that agree refines it (`se2.fit_pose`).
"""

from dataclasses import dataclass

import numpy as np

from coopslam.errors import require_between, require_positive
from coopslam.se2 import Pose2, adjoint, fit_pose, position, rotation, wrap

_MOST_PROPOSALS = 600
_OTHER_HEADING_RAD = 0.5  # two alignments that differ by more are two answers
_RIVAL_SHARE = 0.7  # another answer that so large a part of the agreeing pairs would support makes the choice open


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """When two frames are brought together."""

    pairs_min: int = 4  # that agree
    share_min: float = 0.6  # of all pairs
    heading_sigma_max_rad: float = 0.1  # of the result
    ranges_min: int = 20  # when there is nothing but ranges
    gate_sigmas: float = 3.0  # how far two points that agree may be apart
    drift_sigma_m: float = 0.05  # of points in a frame that hangs on odometry, beside their own sigma
    caution: float = 3.0  # sigmas are multiplied with this: the same fixes are used again once the frames are one

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
    gates = sigmas * settings.gate_sigmas
    angles, shifts = _proposals(points_a, points_b, gates)
    if not len(angles):
        return None
    agree = _agreement(angles, shifts, points_a, points_b, gates)
    votes = agree.sum(axis=1)
    best = int(votes.argmax())
    chosen = agree[best]
    for _ in range(3):
        T_a_b = fit_pose(points_b[chosen], points_a[chosen], sigmas[chosen] ** -2)
        off = np.hypot(*(_moved(T_a_b, points_b) - points_a).T)
        chosen = off <= gates
        if chosen.sum() < settings.pairs_min:
            return None
    rivals = votes[_is_elsewhere(angles, shifts, best, points_b[chosen].mean(axis=0), 2 * gates.max())]
    if chosen.sum() < settings.share_min * count or rivals.max(initial=0) > _RIVAL_SHARE * chosen.sum():
        return None
    result = _with_covariance(T_a_b, points_b[chosen], off[chosen], sigmas[chosen], settings)
    return result if np.sqrt(result.cov_centre[2, 2]) <= settings.heading_sigma_max_rad * settings.caution else None


def _proposals(points_a: np.ndarray, points_b: np.ndarray, gates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M,) angles and (M, 2) shifts by which two points of b come upon their partners in a."""
    i, j = _choices(len(points_a))
    a, b = points_a[j] - points_a[i], points_b[j] - points_b[i]
    long_a, long_b = np.hypot(*a.T), np.hypot(*b.T)
    gate = gates[i] + gates[j]
    possible = (np.abs(long_a - long_b) <= gate) & (np.minimum(long_a, long_b) > gate)
    i, j, a, b = i[possible], j[possible], a[possible], b[possible]
    angles = np.arctan2(a[:, 1], a[:, 0]) - np.arctan2(b[:, 1], b[:, 0])
    middle_b = (points_b[i] + points_b[j]) / 2
    return angles, (points_a[i] + points_a[j]) / 2 - _turned(angles, middle_b)


def _choices(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Two different ones of so many, in all ways; of too many ways some of each distance in the list."""
    if count * (count - 1) // 2 <= _MOST_PROPOSALS:
        return np.triu_indices(count, 1)
    strides = np.unique(np.geomspace(1, count // 2, max(_MOST_PROPOSALS // count, 12)).astype(int))
    chosen = np.linspace(0, count * len(strides) - 1, _MOST_PROPOSALS).astype(int)
    i = chosen % count
    return i, (i + strides[chosen // count]) % count


def _agreement(
    angles: np.ndarray, shifts: np.ndarray, points_a: np.ndarray, points_b: np.ndarray, gates: np.ndarray
) -> np.ndarray:
    """(M, N) whether proposal m brings point n of b to its partner."""
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x = c * points_b[:, 0] - s * points_b[:, 1] + shifts[:, :1] - points_a[:, 0]
    y = s * points_b[:, 0] + c * points_b[:, 1] + shifts[:, 1:] - points_a[:, 1]
    return np.hypot(x, y) <= gates


def _is_elsewhere(
    angles: np.ndarray, shifts: np.ndarray, best: int, centre_b: np.ndarray, distance_m: float
) -> np.ndarray:
    """(M,) whether a proposal is another answer than the best one: turned, or with the centre at another place."""
    centres = _turned(angles, centre_b[None]) + shifts
    apart = np.hypot(*(centres - centres[best]).T)
    return (np.abs(wrap(angles - angles[best])) > _OTHER_HEADING_RAD) | (apart > distance_m)


def _with_covariance(
    T_a_b: Pose2, points_b: np.ndarray, off: np.ndarray, sigmas: np.ndarray, settings: AlignmentSettings
) -> Alignment:
    """First order: shift and turn of a weighted rigid fit about the weighted centre of its points are independent.

    Where the points fit worse than their sigmas say, the sigmas are scaled up. What points drift together does not
    become less with their number.
    """
    weights = sigmas**-2
    scale = max(float(np.mean(weights * off**2)) / 2, 1.0)
    centre = weights @ points_b / weights.sum()
    arms = max(float(weights @ ((points_b - centre) ** 2).sum(axis=1)), 1e-12)
    variance = scale / weights.sum() + settings.drift_sigma_m**2
    by_arms = weights.sum() / arms
    cov = settings.caution**2 * variance * np.diag([1.0, 1.0, by_arms])
    return Alignment(T_a_b, centre, cov, len(points_b))


def _moved(T_a_b: Pose2, points_b: np.ndarray) -> np.ndarray:
    return points_b @ rotation(T_a_b.theta()).T + position(T_a_b)


def _turned(angles: np.ndarray, points: np.ndarray) -> np.ndarray:
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=1)
