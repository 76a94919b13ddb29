"""Errors of relative poses: along each robot's own path, and between robots at the same time. No alignment needed.

The error of an estimated relative pose T_i_j is E = T_i_j(true)^-1 T_i_j(estimated): the length of its translation,
which is the distance between the two positions of j in the frame of i, and its angle.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import inf

import numpy as np

from coopslam.errors import require_between, require_positive
from coopslam.evaluation.trajectory_error import Track, interpolate_states, is_covered, matched, rms, states_of
from coopslam.se2 import wrap

DISTANCES_M = (1.0, 5.0, 10.0)  # driven, over which the drift is told


@dataclass(frozen=True, slots=True, eq=False)
class RelativeErrors:
    """Of one or more relative poses."""

    stamps_s: np.ndarray  # (N,) of the later pose
    translation_errors_m: np.ndarray  # (N,) distances
    rotation_errors_rad: np.ndarray  # (N,) estimated less true, in (-pi, pi]

    @property
    def count(self) -> int:
        """Number of relative poses."""
        return len(self.stamps_s)

    @property
    def translation_rmse_m(self) -> float:
        """Root mean square of the distances."""
        return rms(self.translation_errors_m)

    @property
    def rotation_rmse_rad(self) -> float:
        """Root mean square of the angles."""
        return rms(self.rotation_errors_rad)


def path_errors(
    estimated: Mapping[str, Track],
    truth: Mapping[str, Track],
    distances_m: Sequence[float] = DISTANCES_M,
    tolerance: float = 0.1,
    gap_max_s: float = inf,
) -> dict[str, dict[float, RelativeErrors]]:
    """Relative pose error (RPE) over driven distances: robot -> distance -> errors.

    Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012; over distances instead of times as
    in Zhang and Scaramuzza, A Tutorial on Quantitative Trajectory Evaluation, IROS 2018.  Truth is interpolated at the
    estimate's times, and pairs are those of `path_pairs` on the polygon through these true positions: evo's RPE of
    the same poses with `delta_unit=Unit.meters, all_pairs=True, pairs_from_reference=True, rel_delta_tol=tolerance`.
    What has no truth or no pair is not in the result.  gap_max_s: as in `is_covered`.
    """
    require_positive(**{f"distances_m[{i}]": distance for i, distance in enumerate(distances_m)})
    require_between(0.0, 1.0, tolerance=tolerance)
    result = {}
    for robot in (robot for robot in estimated if robot in truth):
        stamps_s, e, t = matched(estimated[robot], truth[robot], gap_max_s)
        result[robot] = {}
        for distance_m in distances_m:
            i, j = path_pairs(t[:, :2], distance_m, tolerance * distance_m).T
            if len(i):
                result[robot][distance_m] = _relative_errors(stamps_s[j], e[i], e[j], t[i], t[j])
    return result


def path_pairs(positions: np.ndarray, distance_m: float, tolerance_m: float) -> np.ndarray:
    """(M, 2) indices i < j of (N, 2) positions that lie a distance apart along the path through all of them.

    Each i has at most one partner: the later j whose path length from i is nearest to `distance_m`, the earliest of
    several; none when that misses by more than the tolerance. Pairs overlap, and a robot that stands still at many
    stamps is counted as often.
    """
    if len(positions) < 2:
        return np.zeros((0, 2), int)
    path_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(positions, axis=0).T))])
    i = np.arange(len(path_m) - 1)
    # the nearest is the first that is as far or further, or the first of those that are equally far before it
    beyond = np.maximum(np.searchsorted(path_m, path_m[:-1] + distance_m), i + 1)
    before = np.maximum(np.searchsorted(path_m, path_m[beyond - 1]), i + 1)
    beyond = np.minimum(beyond, len(path_m) - 1)
    misses_m = np.abs([path_m[before] - path_m[i] - distance_m, path_m[beyond] - path_m[i] - distance_m])
    j = np.where(misses_m[1] < misses_m[0], beyond, before)
    return np.stack([i, j], axis=1)[misses_m.min(axis=0) <= tolerance_m]


def robot_pair_errors(
    estimated: Mapping[str, Track], truth: Mapping[str, Track], gap_max_s: float = 1.0
) -> dict[tuple[str, str], RelativeErrors]:
    """Errors of T_a_b, robot b in the frame of robot a at the same time, by pair (a, b) in the order of `estimated`.

    At the times of a's estimated poses; the estimate of b and both truths are interpolated.  gap_max_s: times between
    two stamps of b or of a truth that are further apart are left out (`is_covered`), for a straight line between
    them says little.  Pairs without truth or without such a time are not in the result.
    """
    result = {}
    for a, b in combinations([robot for robot in estimated if robot in truth], 2):
        at_s = np.asarray(estimated[a].stamps_s, float)
        tracks = (estimated[b], truth[a], truth[b])
        chosen = np.flatnonzero(np.all([is_covered(at_s, track.stamps_s, gap_max_s) for track in tracks], axis=0))
        if not len(chosen):
            continue
        e_a = states_of(estimated[a].poses[i] for i in chosen)
        e_b, t_a, t_b = (interpolate_states(track.stamps_s, track.poses, at_s[chosen]) for track in tracks)
        result[a, b] = _relative_errors(at_s[chosen], e_a, e_b, t_a, t_b)
    return result


def joined(errors: Iterable[RelativeErrors]) -> RelativeErrors | None:
    """Errors of several robots or pairs as one; None without any."""
    errors = list(errors)
    names = ("stamps_s", "translation_errors_m", "rotation_errors_rad")
    return RelativeErrors(*(np.concatenate([getattr(e, name) for e in errors]) for name in names)) if errors else None


def _relative_errors(
    stamps_s: np.ndarray, e_i: np.ndarray, e_j: np.ndarray, t_i: np.ndarray, t_j: np.ndarray
) -> RelativeErrors:
    """Of (N, 3) estimated and true states."""
    miss = _between(e_i, e_j) - _between(t_i, t_j)
    return RelativeErrors(stamps_s, np.hypot(miss[:, 0], miss[:, 1]), wrap(miss[:, 2]))


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, 3) states of b in the frames of a; headings not wrapped."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    x, y, heading = (b - a).T
    return np.stack([c * x + s * y, c * y - s * x, heading], axis=1)
