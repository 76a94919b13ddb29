"""How edges err, as far as calibration is concerned, and which of them are believed.

    offset of a point = what the model is wrong by + bias of its label + error of its group + error of the point

A group is a label in one picture (`calibration_edges.groups_of`). A bias is the same in all pictures; errors of points
and groups are independent, with variances scale^2 sigma^2 and tau^2. scale comes from the scatter within groups, tau
from the scatter of groups, by restricted maximum likelihood (Patterson and Thompson 1971), with a few imagined groups
of the usual size so that few pictures do not make it vanish.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tracker.edges import Kind, ModelEdges

CAUCHY_SIGMAS = 2.385  # 95 % efficiency for normal errors (Holland and Welsch 1977)
TAUS_PX = (0.02, 0.05)  # usual errors of groups: on the target; of silhouettes, where light falls off and blur mixes
BIASES_PX = (0.01, 0.05)  # the same for biases; rendered pictures show 0.005 and 0.03
IMAGINED = 4  # groups of the usual size
LEAST_FREE = 0.02  # of the information on a group's error
TARGET, SILHOUETTE = 0, 1


@dataclass(frozen=True, slots=True)
class Noise:
    """Of measured edges."""

    scale: float = 1.0  # of the sigmas that profiles have by themselves
    taus_px: tuple[float, float] = TAUS_PX  # of a group in a picture: on the target, of a silhouette


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Edges of one picture, N of them in G groups, against a model."""

    edges: ModelEdges
    offsets: np.ndarray  # (N,) px
    sigmas: np.ndarray  # (N,) px, as measured
    jacobian: np.ndarray  # (N, U) of the edges' places along their normals; the last three by x, y, theta
    labels: np.ndarray  # (G,)
    groups: list[np.ndarray]  # indices of the points of each

    @property
    def classes(self) -> list[int]:
        """TARGET or SILHOUETTE of each group."""
        return [class_of(label) for label in self.labels]


@dataclass(frozen=True, slots=True, eq=False)
class Weights:
    """Robust weights in one picture, 0 to 1."""

    points: np.ndarray  # (N,)
    groups: np.ndarray  # (G,)


def class_of(label: int) -> int:
    """TARGET or SILHOUETTE, of a label of `groups_of`."""
    return SILHOUETTE if label // 10 % 10 == Kind.SILHOUETTE else TARGET


def whitened(one: Measured, weights: Weights, noise: Noise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, U) Jacobian and (N,) offsets with unit covariance, and (N,) ones alike, without the weights of groups.

    The inverse square root of D + tau^2 1 1' is (I - c u u') D^-1/2, with u = D^-1/2 1; c undoes the eigenvalue
    1 + tau^2 |u|^2 of u.
    """
    u = np.sqrt(weights.points) / (noise.scale * one.sigmas)
    rows = np.column_stack([one.jacobian, one.offsets, np.ones(len(u))]) * u[:, None]
    for own, weight, kind in zip(one.groups, weights.groups, one.classes, strict=True):
        size = float(u[own] @ u[own])
        shrink = 1.0 - 1.0 / np.sqrt(1.0 + noise.taus_px[kind] ** 2 * size)
        rows[own] -= shrink / size * np.outer(u[own], u[own] @ rows[own])
        rows[own, :-1] *= np.sqrt(weight)
    return rows[:, :-2], rows[:, -2], rows[:, -1]


def robust_weights(one: Measured, residual: np.ndarray) -> Weights:
    """Of points against the median of their group, by Cauchy's loss; its scale is that of the group itself."""
    points = np.ones(len(residual))
    for own in one.groups:
        away = residual[own] - np.median(residual[own])
        spread = np.maximum(1.4826 * np.median(np.abs(away)), one.sigmas[own])
        points[own] = 1.0 / (1.0 + (away / (CAUCHY_SIGMAS * spread)) ** 2)
    return Weights(points, np.ones(len(one.groups)))


def reweighted(measured: Sequence[Measured], residuals: Sequence[np.ndarray], noise: Noise) -> list[Weights]:
    """Also of groups against zero; the scale is that of all groups of the class, or tau when that is more."""
    weights = [robust_weights(one, residual) for one, residual in zip(measured, residuals, strict=True)]
    means = [
        np.array([np.average(residual[own], weights=weight.points[own] / one.sigmas[own] ** 2) for own in one.groups])
        for one, residual, weight in zip(measured, residuals, weights, strict=True)
    ]
    every, kinds = np.concatenate(means), np.concatenate([one.classes for one in measured])
    spreads = [
        max(1.4826 * float(np.median(np.abs(every[kinds == kind]))), noise.taus_px[kind])
        if (kinds == kind).any()
        else noise.taus_px[kind]
        for kind in (TARGET, SILHOUETTE)
    ]
    return [
        Weights(weight.points, 1.0 / (1.0 + (mean / (CAUCHY_SIGMAS * np.take(spreads, one.classes))) ** 2))
        for one, weight, mean in zip(measured, weights, means, strict=True)
    ]


def estimated_noise(
    measured: Sequence[Measured],
    residuals: Sequence[np.ndarray],
    weights: Sequence[Weights],
    covs: Sequence[np.ndarray],
    before: Noise,
) -> Noise:
    """From (N,) residuals of each picture and the (U, U) covariance of its unknowns; a step of a fixed-point iteration.

    tau^2 <- tau^2 (r' P V_g P r) / tr(P V_g), P = V^-1 - V^-1 J cov J' V^-1, V_g = dV / d tau^2: at rest the likelihood
    of what the fit leaves has its maximum (Searle, Casella and McCulloch 1992, section 6.6).
    """
    within, found, expected = [], np.zeros(2), np.zeros(2)
    for one, residual, weight, cov in zip(measured, residuals, weights, covs, strict=True):
        J, _, ones = whitened(one, weight, before)
        rows = whitened(_with_offsets(one, residual), weight, before)[1]
        for own, kind in zip(one.groups, one.classes, strict=True):
            lever = ones[own] @ J[own]
            found[kind] += float(ones[own] @ rows[own]) ** 2
            free = float(
                ones[own] @ ones[own]
            )  # the covariance is that of the weights before: less than nothing may be
            expected[kind] += max(free - float(lever @ cov @ lever), LEAST_FREE * free)  # left, early on
            if len(own) > 2:
                information = weight.points[own] / one.sigmas[own] ** 2
                away = residual[own] - float(information @ residual[own] / information.sum())
                within.append(away / one.sigmas[own] * np.sqrt(len(own) / (len(own) - 1)))
    scale = 1.4826 * float(np.median(np.abs(np.concatenate(within)))) if within else 1.0
    squares, usual = np.square(before.taus_px), np.square(TAUS_PX)
    squares = squares * (found + IMAGINED * usual / squares**2) / (expected + IMAGINED / squares)
    return Noise(max(scale, 1.0), tuple(np.sqrt(squares).tolist()))


def rms_px(measured: Sequence[Measured], residuals: Sequence[np.ndarray], weights: Sequence[Weights]) -> float:
    """Of the points on the target that are believed: they weigh more than a third, as those within 3.4 sigmas do."""
    kept = []
    for one, residual, weight in zip(measured, residuals, weights, strict=True):
        total = weight.points.copy()
        for own, of_group, kind in zip(one.groups, weight.groups, one.classes, strict=True):
            total[own] *= of_group if kind == TARGET else 0.0
        kept.append(residual[total > 1 / 3])
    every = np.concatenate(kept)
    return float(np.sqrt(np.mean(every**2))) if len(every) else 0.0


def _with_offsets(one: Measured, offsets: np.ndarray) -> Measured:
    return Measured(one.edges, offsets, one.sigmas, one.jacobian, one.labels, one.groups)
