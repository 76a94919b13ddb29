"""Parameters of a data sheet and the poses in all pictures, fitted together to edges: Gauss-Newton, robust.

Each round measures the edges around where the model is now, and solves

    minimize  sum over pictures of (r - J d)' S^-1 (r - J d)  +  what the nominal sheet and the tape measure say

for the change d of parameters, poses and biases of edges. S is what edges err by (`calibration_noise`), which is
estimated along the way. The covariance is that of the maximum a posteriori estimate, the inverse of the normal matrix.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from coopslam.errors import UnderDetermined
from coopslam.se2 import Pose2, wrap
from tracker.calibration_edges import View, edges_of, groups_of, moved_by
from tracker.calibration_noise import (
    BIASES_PX,
    Measured,
    Noise,
    class_of,
    estimated_noise,
    reweighted,
    rms_px,
    robust_weights,
    whitened,
)
from tracker.calibration_parameters import tolerances_of, values_of, with_values
from tracker.data_sheet import DataSheet

DERIVATIVE_SHARE = 0.01  # of a tolerance: half the step of numeric derivatives by parameters
CONVERGED = 0.02  # of a posterior sigma
ROUNDS = 12
REWEIGHTED = 2  # times in a round
FEWEST_EDGES = 16  # in a picture


@dataclass(frozen=True, slots=True)
class Shot:
    """What is known of a picture's pose: the target robot's place in the observer's body; None: unknown."""

    name: str
    distance_m: float | None
    bearing_rad: float | None = None
    heading_rad: float | None = None
    distance_sigma_m: float = 0.002
    bearing_sigma_rad: float = 0.01
    heading_sigma_rad: float = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Where Gauss-Newton ended."""

    values: np.ndarray  # (P,)
    cov: np.ndarray  # (P, P)
    poses: list[Pose2]
    noise: Noise
    measured: list[Measured]  # against the model before the last step
    residuals: list[np.ndarray]  # (N,) what is left of the offsets after it, px
    residual_rms_px: float  # of the edges that were believed
    step_sigmas: float  # the last step, in posterior sigmas
    sheet: DataSheet = field(repr=False)


def fit(
    sheet: DataSheet,
    names: Sequence[str],
    shots: Sequence[Shot],
    views: Sequence[View],
    poses: Sequence[Pose2],
    reach_px: float,
    nominal: DataSheet | None = None,
    noise: Noise | None = None,
    rounds: int = ROUNDS,
    fixed_noise: bool = False,
) -> Fit:
    """From a sheet and (n,) poses near the best ones.

    nominal: what the parameters are held to, within its tolerances; None: `sheet`.  fixed_noise: keep `noise`.
    Raises UnderDetermined when a picture shows too few edges, BadInput when a parameter leaves what can be.
    """
    nominal, noise, poses = nominal or sheet, noise or Noise(), list(poses)
    values, prior, P = values_of(sheet, names), values_of(nominal, names), len(names)
    tolerances = tolerances_of(nominal, names)
    for _ in range(rounds):
        measured = measured_edges(with_values(nominal, names, values), names, tolerances, shots, views, poses, reach_px)
        known = _known(shots, poses, values - prior, tolerances, measured)
        weights = [robust_weights(one, one.offsets) for one in measured]
        for _ in range(REWEIGHTED):
            cov, step, left = _solved(measured, weights, known, noise)
            weights = reweighted(measured, left, noise)
            if not fixed_noise:
                noise = estimated_noise(measured, left, weights, [cov[np.ix_(*own)] for own in _owns(measured)], noise)
        cov, step, left = _solved(measured, weights, known, noise)
        values = values + step[:P]
        shared = len(step) - 3 * len(shots)
        poses = [_moved(pose, step[shared + 3 * k :]) for k, pose in enumerate(poses)]
        kept = np.r_[0:P, shared : len(step)]  # biases start anew in each round
        moved = float(np.max(np.abs(step[kept]) / np.sqrt(np.diag(cov)[kept]), initial=0.0))
        if moved < CONVERGED:
            break
    rms = rms_px(measured, left, weights)
    return Fit(values, cov[:P, :P], poses, noise, measured, left, rms, moved, with_values(nominal, names, values))


def measured_edges(sheet, names, tolerances, shots, views, poses, reach_px) -> list[Measured]:
    """Edges of all pictures, with derivatives by parameters, biases of labels, and poses."""
    steps = DERIVATIVE_SHARE * tolerances
    here = values_of(sheet, names)
    pairs = [
        (with_values(sheet, names, here + each), with_values(sheet, names, here - each)) for each in np.diag(steps)
    ]
    found = []
    for shot, view, pose in zip(shots, views, poses, strict=True):
        edges = edges_of(sheet, pose)
        offsets, sigmas, seen = view.measure(edges, reach_px)
        columns = [moved_by(edges, edges_of(ahead, pose), edges_of(back, pose)) for ahead, back in pairs]
        jacobian = np.column_stack(
            [*(column / (2 * step) for column, step in zip(columns, steps, strict=True)), edges.by_pose]
        )
        use = seen & np.isfinite(jacobian).all(axis=1)
        if np.count_nonzero(use) < FEWEST_EDGES // 2:  # some may be lost while the model improves
            raise UnderDetermined(
                f"{shot.name}: {np.count_nonzero(use)} edges of the target found; at least {FEWEST_EDGES // 2} expected"
            )
        found.append((edges.where(use), offsets[use], sigmas[use], jacobian[use]))
    every = np.unique(np.concatenate([groups_of(edges) for edges, *_ in found]))
    return [_grouped(*one, len(names), every) for one in found]


def _grouped(edges, offsets, sigmas, jacobian, P: int, every: np.ndarray) -> Measured:
    """With a column for the bias of each label, of which every[b] is one, between parameters and pose."""
    own = groups_of(edges)
    labels = np.unique(own)
    biases = (own[:, None] == every).astype(float)
    columns = np.column_stack([jacobian[:, :P], biases, jacobian[:, P:]])
    return Measured(edges, offsets, sigmas, columns, labels, [np.flatnonzero(own == label) for label in labels])


def _owns(measured) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each picture the places of its own unknowns among all, for rows and columns."""
    shared = measured[0].jacobian.shape[1] - 3
    owns = [np.r_[0:shared, shared + 3 * k : shared + 3 * k + 3] for k in range(len(measured))]
    return [(own, own) for own in owns]


def _solved(measured, weights, known, noise: Noise) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Covariance and step of all unknowns, and the (N,) offsets that are then left in each picture."""
    H, g = known[0].copy(), known[1].copy()
    for one, weight, (own, _) in zip(measured, weights, _owns(measured), strict=True):
        J, r, _ = whitened(one, weight, noise)
        H[np.ix_(own, own)] += J.T @ J
        g[own] += J.T @ r
    cov = _inverse(H)
    step = cov @ g
    left = [one.offsets - one.jacobian @ step[own] for one, (own, _) in zip(measured, _owns(measured), strict=True)]
    return cov, step, left


def _known(shots, poses, deviation, tolerances, measured) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and gradient of what is known without pictures, of parameters, biases and poses."""
    P, shared = len(deviation), measured[0].jacobian.shape[1] - 3
    labels = np.unique(np.concatenate([one.labels for one in measured]))
    biases = np.array([BIASES_PX[class_of(label)] for label in labels])
    H, g = np.zeros((shared + 3 * len(shots),) * 2), np.zeros(shared + 3 * len(shots))
    H[range(shared), range(shared)] = np.concatenate([tolerances, biases]) ** -2.0
    g[:P] = -deviation * tolerances**-2.0
    for (own, _), shot, pose in zip(_owns(measured), shots, poses, strict=True):
        own = own[-3:]
        for error, row, sigma in _surveyed(shot, pose):
            H[np.ix_(own, own)] += np.outer(row, row) / sigma**2
            g[own] -= row * error / sigma**2
    return H, g


def _surveyed(shot: Shot, pose: Pose2) -> list[tuple[float, np.ndarray, float]]:
    """Error, derivative by x, y, theta, and sigma of what a tape measure or a protractor said of a pose."""
    x, y = pose.x(), pose.y()
    r = float(np.hypot(x, y))
    rows = []
    if shot.distance_m is not None:
        rows.append((r - shot.distance_m, np.array([x / r, y / r, 0.0]), shot.distance_sigma_m))
    if shot.bearing_rad is not None:
        row = np.array([-y / r**2, x / r**2, 0.0])
        rows.append((float(wrap(np.arctan2(y, x) - shot.bearing_rad)), row, shot.bearing_sigma_rad))
    if shot.heading_rad is not None:
        error = float(wrap(pose.theta() - shot.heading_rad))
        rows.append((error, np.array([0.0, 0.0, 1.0]), shot.heading_sigma_rad))
    return rows


def _inverse(H: np.ndarray) -> np.ndarray:
    scale = np.sqrt(np.diag(H))
    scaled = H / np.outer(scale, scale)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e13:
        raise UnderDetermined("the pictures do not tie down the poses in them")
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    return (inverse + inverse.T) / 2


def _moved(pose: Pose2, step: np.ndarray) -> Pose2:
    return Pose2(pose.x() + step[0], pose.y() + step[1], pose.theta() + step[2])
