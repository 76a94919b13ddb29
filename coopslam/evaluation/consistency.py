"""Are the covariances honest: normalized estimation errors squared (NEES) and the band they should lie in.

Errors are taken in the frame of the first robot's start, where the estimate lives: no alignment, which
would take error away that the covariance owns up to.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import chi2

from coopslam.errors import BadInput
from coopslam.estimation.estimate import Trajectory
from coopslam.evaluation.trajectory_error import Track, interpolate_se2, is_covered
from coopslam.se2 import Pose2, wrap, xytheta


def pose_nees(estimated: Sequence[Pose2], covariances: np.ndarray, truth: Sequence[Pose2]) -> np.ndarray:
    """(N,) NEES of poses with 3 degrees of freedom; all in one frame.

    covariances: (N, 3, 3), axes of each pose. The error is the right perturbation T_truth^-1 T_estimated.
    """
    errors = np.array([xytheta(t.between(e)) for e, t in zip(estimated, truth, strict=True)]).reshape(-1, 3)
    errors[:, 2] = wrap(errors[:, 2])
    return _quadratic(errors, covariances)


def position_nees(estimated: np.ndarray, covariances: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(N,) NEES of (N, 2) positions with 2 degrees of freedom; covariances: (N, 2, 2) in the axes of the frame."""
    return _quadratic(np.asarray(estimated, float) - np.asarray(truth, float), covariances)


def trajectory_nees(
    estimated: Mapping[str, Trajectory], truth: Mapping[str, Track], first: str
) -> dict[str, np.ndarray]:
    """NEES of each robot's poses; the anchored pose, the first of the first robot, is left out.

    estimated: in the frame of the first robot's start, with covariances.  truth: in any one frame; it is
    moved to the first robot's true start.  Poses outside the time that the truth covers are left out, and so are
    robots without truth; without that of the first robot's start there is no common frame, which raises BadInput.
    """
    if first not in truth:
        raise BadInput(f"there is no truth for {first}, in whose start the estimate has its origin")
    T_start_world = start_of(estimated[first], truth[first]).inverse()
    result = {}
    for robot, trajectory in estimated.items():
        if robot not in truth:
            continue
        if trajectory.covariances is None:
            raise BadInput(f"the trajectory of {robot} has no covariances to judge")
        chosen = np.flatnonzero(is_covered(trajectory.stamps_s, truth[robot].stamps_s))
        chosen = chosen[chosen > 0] if robot == first else chosen
        poses_truth = interpolate_se2(truth[robot].stamps_s, truth[robot].poses, trajectory.stamps_s[chosen])
        anchored = [T_start_world * pose for pose in poses_truth]
        poses = [trajectory.poses[i] for i in chosen]
        result[robot] = pose_nees(poses, trajectory.covariances[chosen], anchored)
    return result


def landmark_nees(
    estimated: Mapping[str, tuple[np.ndarray, np.ndarray]], truth: Mapping[str, np.ndarray], T_world_start: Pose2
) -> dict[str, float]:
    """NEES of landmarks with 2 degrees of freedom, by name; those without truth are left out.

    estimated: (2,) position and (2, 2) covariance, in the frame of the first robot's start.  truth: (2,) in any one
    frame.  T_world_start: true start of the first robot in that frame, as `start_of` finds it.  The truth of that one
    pose takes part in all: when its heading is wrong by 1 mrad, landmarks 10 m away are wrong by 1 cm.
    """
    names = [name for name in estimated if name in truth]
    points = np.array([estimated[name][0] for name in names], float).reshape(-1, 2)
    covariances = np.array([estimated[name][1] for name in names], float).reshape(-1, 2, 2)
    anchored = np.array([T_world_start.transformTo(np.asarray(truth[name], float)) for name in names]).reshape(-1, 2)
    return dict(zip(names, position_nees(points, covariances, anchored).tolist(), strict=True))


def start_of(estimated: Track, truth: Track) -> Pose2:
    """True pose, in the frame of the truth, at which the first robot's estimate starts: the estimate's origin."""
    return interpolate_se2(truth.stamps_s, truth.poses, estimated.stamps_s[:1])[0]


def chi_square_band(dof: int, samples: int, confidence: float = 0.95) -> tuple[float, float]:
    """Two-sided band in which the mean of independent NEES values lies with the given probability."""
    tail = (1.0 - confidence) / 2.0
    low, high = chi2.ppf([tail, 1.0 - tail], dof * samples) / samples
    return float(low), float(high)


def _quadratic(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    if not len(errors):
        return np.zeros(0)
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
