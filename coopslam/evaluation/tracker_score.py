"""The robot tracker against the truth: errors of its fixes, and whether their covariances are honest."""

from collections.abc import Iterable, Mapping

import numpy as np

from coopslam.evaluation.trajectory_error import Track, rms
from coopslam.records import BearingRangeFix, Record, RelativePoseFix
from coopslam.se2 import Pose2, position, wrap, xytheta

STAMP_TOLERANCE_S = 1e-9
FAR_SIGMAS = 5.0


def score_fixes(records: Iterable[Record], truth: Mapping[str, Track]) -> dict:
    """Errors of the sightings of robots by robots; None where there are none.

    truth: a robot's poses in one frame, at every instant of a fix or before, if it stood still from then on.
    NEES: squared Mahalanobis distances of (x, y, heading), ideal 3, and of (bearing, range), ideal 2.
    """
    poses, points, lines = [], [], []
    for fix in records:
        if isinstance(fix, RelativePoseFix):
            true = _true_relative(fix, truth)
            error = xytheta(fix.T_observer_target) - xytheta(true)
            error[2] = wrap(error[2])
            poses.append((_distance_sq(error, fix.cov_observer), error[2], error[2] / np.sqrt(fix.cov_observer[2, 2])))
            lines.append(_bearing_range(fix.T_observer_target) - _bearing_range(true))
        elif isinstance(fix, BearingRangeFix) and fix.target in truth:
            error = np.array([fix.bearing_rad, fix.range_m]) - _bearing_range(_true_relative(fix, truth))
            error[0] = wrap(error[0])
            points.append(_distance_sq(error, fix.cov))
            lines.append(error)
    bearings, ranges = np.array(lines).reshape(-1, 2).T
    squares, headings, sigmas = np.array(poses).reshape(-1, 3).T
    return {
        "fixes": len(lines),
        "with_heading": len(poses),
        "range_error_rms_m": _if_any(rms, ranges),
        "bearing_error_rms_rad": _if_any(rms, wrap(bearings)),
        "heading_error_rms_rad": _if_any(rms, headings),
        "pose_nees_mean": _if_any(np.mean, squares),
        "pose_nees_median": _if_any(np.median, squares),
        "point_nees_mean": _if_any(np.mean, np.array(points)),
        "headings_beyond_5_sigma": int(np.count_nonzero(np.abs(sigmas) > FAR_SIGMAS)),
    }


def _true_relative(fix: RelativePoseFix | BearingRangeFix, truth: Mapping[str, Track]) -> Pose2:
    observer, target = (_pose_at(truth[robot], fix.stamp_s) for robot in (fix.observer, fix.target))
    return observer.between(target)


def _pose_at(track: Track, stamp_s: float) -> Pose2:
    """The last pose that was noted until then."""
    return track.poses[max(int(np.searchsorted(track.stamps_s, stamp_s + STAMP_TOLERANCE_S, side="right")) - 1, 0)]


def _bearing_range(pose: Pose2) -> np.ndarray:
    x, y = position(pose)
    return np.array([np.arctan2(y, x), np.hypot(x, y)])


def _distance_sq(error: np.ndarray, cov: np.ndarray) -> float:
    return float(error @ np.linalg.solve(cov, error))


def _if_any(function, values: np.ndarray) -> float | None:
    return float(function(values)) if len(values) else None
