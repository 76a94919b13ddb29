"""How constants of sensors should change when the trajectory may follow: a Gauss-Newton step, the poses marginalized.

A graph of native factors is linearized by GTSAM around its solution, A dx = b. The constants p of all robots move what
was measured, which adds columns: A dx + J dp = b. Eliminating dx leaves S dp = g, S the Schur complement of A'A; its
inverse is the marginal covariance of the constants. Robust losses enter by their weights, as GTSAM linearizes them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import splu

from coopslam.errors import UnderDetermined
from coopslam.estimation.calibration import PARAMETERS
from coopslam.estimation.driven_path import DrivenPath, between, residual_twists
from coopslam.estimation.keys import is_landmark, robot_index
from coopslam.estimation.loss import Loss
from coopslam.estimation.tracks import Edge

COUNT = len(PARAMETERS)
DEFAULTS = np.array([0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
_STEPS = np.array([0, 0, 0, 1e-4, 1e-4, 1e-4, 1e-4, 0.02, 0])  # for numeric derivatives of dead reckoning
_RANGE_OFFSET, _RANGE_SCALE, _BEARING_OFFSET, _HEADING_OFFSET = 0, 1, 2, 8
_ODOMETRY = range(3, 8)
_AT_ONE_SIGMA = Loss("cauchy").applied(gtsam.noiseModel.Unit.Create(1)).robust().weight(1.0)  # 1 / (1 + 1 / k^2)
_CAUCHY_SQ = _AT_ONE_SIGMA / (1.0 - _AT_ONE_SIGMA)  # k^2


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """What a graph says about the constants, whatever the trajectory does."""

    information: np.ndarray  # (P, P)
    gradient: np.ndarray  # (P,) information times the step that is best without priors
    follow: np.ndarray  # (n, P) by how much the trajectory goes back for a change of the constants
    descent: np.ndarray  # (n,) what the trajectory lacks to its own minimum
    keys: list[int]  # of the variables, in the order of the n coordinates

    def moved(self, values: gtsam.Values, change: np.ndarray) -> gtsam.Values:
        """The trajectory after (P,) constants have changed."""
        dx, step, at = self.descent - self.follow @ change, gtsam.VectorValues(), 0
        for key in self.keys:
            size = 2 if is_landmark(key) else 3
            step.insert(key, dx[at : at + size])
            at += size
        return values.retract(step)


def reduced(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    legs: Iterable[Edge],
    stamps_s: Mapping[int, float],
    paths: Sequence[DrivenPath | None],
    constants: np.ndarray,
) -> Reduced:
    """Linearize and eliminate the trajectory.

    legs: of odometry in the graph.  stamps_s: of pose variables.  paths: raw odometry of each robot, by its index.
    constants: (robots, 9), with which the measurements in the graph were calibrated; its robust losses are
    Cauchy's.  Raises UnderDetermined when the trajectory has an open direction.
    """
    linear = graph.linearize(values)
    i, j, entries = linear.sparseJacobian_()
    keys = sorted(values.keys())
    n = sum(2 if is_landmark(key) else 3 for key in keys)
    factors = [graph.at(k) for k in range(graph.size())]
    first = np.concatenate([[0], np.cumsum([factor.dim() for factor in factors])])
    i, j = i.astype(int) - 1, j.astype(int) - 1
    right = j == n
    b = np.zeros(first[-1])
    b[i[right]] = entries[right]
    A = csr_matrix((entries[~right], (i[~right], j[~right])), shape=(first[-1], n))
    J = _columns(factors, first, b, legs, stamps_s, paths, constants)
    try:
        hessian = splu(
            csc_matrix(A.T @ A), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError as error:
        raise UnderDetermined(f"the log does not tie down the trajectory on which to calibrate: {error}") from error
    B = (A.T @ J).toarray()
    follow, descent = hessian.solve(B), hessian.solve(A.T @ b)
    information = (J.T @ J).toarray() - B.T @ follow
    return Reduced((information + information.T) / 2, J.T @ b - B.T @ descent, follow, descent, keys)


def _columns(factors, first, b, legs, stamps_s, paths, constants) -> csr_matrix:
    """(rows, 9 robots) derivatives of all whitened errors by the constants."""
    of_legs = {(leg.key_a, leg.key_b): leg.T_a_b for leg in legs}
    sightings: dict[int, list[tuple]] = {}  # number of rows -> row, columns, (rows, K) derivatives, noise
    driven: dict[int, list[tuple]] = {}  # robot -> row, keys of start and end, noise
    for factor, row in zip(factors, first.tolist(), strict=False):
        derivatives = _SIGHTINGS.get(type(factor))
        keys = factor.keys()
        robot = robot_index(keys[0])
        if derivatives is not None and robot is not None:
            block = derivatives(factor.measured(), constants[robot])
            sightings.setdefault(len(block), []).append((row, _columns_of(robot), block, factor.noiseModel()))
        elif isinstance(factor, gtsam.BetweenFactorPose2) and robot is not None:
            other = robot_index(keys[1])
            if other == robot and tuple(keys) in of_legs and of_legs[tuple(keys)].equals(factor.measured(), 1e-9):
                driven.setdefault(robot, []).append((row, *keys, factor.noiseModel()))
            elif other is not None and other != robot:
                block = _relative_pose(factor.measured(), constants[robot])
                sightings.setdefault(3, []).append((row, _columns_of(robot, other), block, factor.noiseModel()))
    entries = [_seen(own, b) for own in sightings.values()]
    for robot, own in driven.items():
        if paths[robot] is not None:
            entries.append(_driven(own, robot, stamps_s, paths[robot], constants[robot]))
    every = [np.concatenate([part[k].ravel() for part in entries]) for k in range(3)] if entries else ([], [], [])
    return csr_matrix((every[2], (every[0], every[1])), shape=(first[-1], constants.size))


def _seen(own: Sequence[tuple], b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and entries (each (N, n, K)) of sightings with n rows."""
    row, columns, blocks, noises = zip(*own, strict=True)
    blocks = np.array(blocks)
    rows = np.array(row)[:, None] + np.arange(blocks.shape[1])
    blocks = np.array([_root(noise) for noise in noises]) @ blocks
    robust = np.array([isinstance(noise, gtsam.noiseModel.Robust) for noise in noises])
    # the weight w that a residual d has got: b^2 = w d^2 with w = 1 / (1 + d^2 / k^2)
    weights = np.where(robust, np.maximum(1.0 - (b[rows] ** 2).sum(axis=1) / _CAUCHY_SQ, 1e-9), 1.0)
    rows, columns = np.broadcast_arrays(rows[:, :, None], np.array(columns)[:, None, :])
    return rows, columns, blocks * np.sqrt(weights)[:, None, None]


def _columns_of(observer: int, target: int | None = None) -> list[int]:
    """Of range offset, range scale, bearing offset of who looks, and heading offset of a robot whose pose is seen."""
    columns = [COUNT * observer + parameter for parameter in (_RANGE_OFFSET, _RANGE_SCALE, _BEARING_OFFSET)]
    return columns if target is None else [*columns, COUNT * target + _HEADING_OFFSET]


def _driven(own: Sequence[tuple], robot: int, stamps_s, path: DrivenPath, constants: np.ndarray) -> tuple:
    """Rows, columns and entries (each (N, 3, 5)) of legs of odometry."""
    row, start, end, noises = zip(*own, strict=True)
    starts_s, ends_s = (np.array([stamps_s[key] for key in keys]) for keys in (start, end))
    roots = np.array([_root(noise) for noise in noises])
    rows, columns = np.broadcast_arrays(
        np.array(row)[:, None, None] + np.arange(3)[:, None], COUNT * robot + np.array(_ODOMETRY)
    )
    return rows, columns, roots @ _leg_derivatives(path, starts_s, ends_s, constants)


# (rows, 3) derivatives of a sighting's error by offset and scale of the range and offset of the bearing; of a relative
# pose a fourth column by the offset of the heading


def _bearing_range(measured, constants: np.ndarray) -> list[list[float]]:
    scale = constants[_RANGE_SCALE]
    return [[0.0, 0.0, 1.0], [1.0 / scale, measured.range() / scale, 0.0]]


def _range(measured: float, constants: np.ndarray) -> list[list[float]]:
    return [[1.0 / constants[_RANGE_SCALE], measured / constants[_RANGE_SCALE], 0.0]]


def _bearing(measured, constants: np.ndarray) -> list[list[float]]:
    return [[0.0, 0.0, 1.0]]


def _relative_pose(T_observer_target: gtsam.Pose2, constants: np.ndarray) -> np.ndarray:
    """The error of a relative pose lives in the axes of the target."""
    x, y, heading = T_observer_target.x(), T_observer_target.y(), T_observer_target.theta()
    scale, range_m = constants[_RANGE_SCALE], max(np.hypot(x, y), 1e-9)
    c, s = np.cos(heading), np.sin(heading)
    to_target = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    along = np.array([x, y, 0.0]) / range_m / scale
    return to_target @ np.column_stack([along, range_m * along, [-y, x, 1.0], [0.0, 0.0, 1.0]])


def _leg_derivatives(path: DrivenPath, starts_s: np.ndarray, ends_s: np.ndarray, constants: np.ndarray) -> np.ndarray:
    """(N, 3, 5) derivatives of the errors of legs by the constants of odometry."""

    def legs(values: np.ndarray) -> np.ndarray:
        return between(path.at(starts_s, values), path.at(ends_s, values))

    blocks = np.empty((len(starts_s), 3, len(_ODOMETRY)))
    for k, parameter in enumerate(_ODOMETRY):
        step = np.where(np.arange(COUNT) == parameter, _STEPS, 0.0)
        blocks[:, :, k] = -residual_twists(legs(constants - step), legs(constants + step)) / (2 * _STEPS[parameter])
    return blocks


def _root(noise: gtsam.noiseModel.Base) -> np.ndarray:
    """(n, n) square root of the information, which whitens an error."""
    return (noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise).R()


_SIGHTINGS = {
    gtsam.BearingRangeFactor2D: _bearing_range,
    gtsam.BearingRangeFactorPose2: _bearing_range,
    gtsam.RangeFactor2D: _range,
    gtsam.RangeFactorPose2: _range,
    gtsam.BearingFactor2D: _bearing,
    gtsam.BearingFactorPose2: _bearing,
}


def best_change(
    found: Reduced, constants: np.ndarray, prior_sigmas: np.ndarray, free: np.ndarray, has_scale: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Change of the (robots, 9) constants, and their (robots, 9) standard deviations.

    prior_sigmas: (9,) about `DEFAULTS`.  free: (robots, 9) bool; the others go to their defaults.
    has_scale: something measures the size of the world. Otherwise odometry and ranges share an unknown scale, and the
    mean scale of odometry is held equal to the mean scale of ranges (to one where only one of the two is free).
    """
    robots = len(constants)
    precision = np.tile(prior_sigmas**-2.0, robots)
    S = found.information + np.diag(precision)
    deviation = (constants - DEFAULTS).ravel()
    change = np.where(free.ravel(), 0.0, -deviation)
    g = found.gradient - precision * deviation - S @ change
    chosen = np.flatnonzero(free.ravel())
    system, right = S[np.ix_(chosen, chosen)], g[chosen]
    gauge = np.zeros((0, len(chosen))) if has_scale else scale_gauge(free).ravel()[None, chosen]
    gauge = gauge[np.any(gauge != 0, axis=1)]
    # the mean of those that are not free is one, on both sides
    excess = gauge @ deviation[chosen]
    basis = np.eye(len(chosen))
    shift = np.zeros(len(chosen))
    if len(gauge):
        shift = -gauge.T[:, 0] * excess[0] / float(gauge[0] @ gauge[0])
        basis = np.linalg.svd(gauge)[2][1:].T  # of the changes that keep the gauge
    projected = basis.T @ system @ basis
    change[chosen] = shift + basis @ np.linalg.solve(projected, basis.T @ (right - system @ shift))
    covariance = basis @ np.linalg.inv(projected) @ basis.T
    sigmas = np.tile(prior_sigmas, robots)
    sigmas[chosen] = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return change.reshape(robots, COUNT), sigmas.reshape(robots, COUNT)


def scale_gauge(free: np.ndarray) -> np.ndarray:
    """(robots, 9) coefficients of mean odometry scale less mean range scale, of those that are free."""
    gauge = np.zeros(free.shape)
    for parameter, sign in ((3, 1.0), (_RANGE_SCALE, -1.0)):
        if free[:, parameter].any():
            gauge[:, parameter] = sign * free[:, parameter] / free[:, parameter].sum()
    return gauge
