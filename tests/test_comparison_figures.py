"""Figures of replayed logs: drawn for whatever a log has, without a warning, and right where it can be read off."""

import dataclasses
import warnings
from itertools import product

import matplotlib.image
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from scipy.stats import chi2

from coopslam.report import comparison_figures, comparison_panels
from coopslam.report.comparison_figures import best_estimator, draw_comparison, draw_study
from coopslam.report.comparison_view import ComparisonView, EstimatorView, RobotErrors

ROBOTS = [f"robot{k}" for k in range(1, 6)]
DRAWN = ["trajectories.png", "errors.png", "bars.png", "consistency.png", "latency.png", "error_by_exchange.png"]
KINDS = {
    "odometry": {"count": 15_000, "mean_per_dof": 0.71},
    "bearing_range_landmark": {"count": 5_114, "mean_per_dof": 1.34},
    "bearing_range_robot": {"count": 1_920, "mean_per_dof": 0.98},
    "pose_prior": {"count": 1, "mean_per_dof": 0.0},
}
EMPTY = np.zeros(0)


def wandering(rng: np.random.Generator, points: int, size=(15.0, 8.0)) -> np.ndarray:
    """(N, 2) a smooth path that stays in a room."""
    headings = rng.uniform(-np.pi, np.pi) + 0.15 * rng.standard_normal(points).cumsum()
    free = rng.uniform(0, size) + 0.06 * np.stack([np.cos(headings), np.sin(headings)], axis=1).cumsum(axis=0)
    return np.abs((free + size) % (2 * np.array(size)) - size)  # reflected at the walls


def coloured(rng: np.random.Generator, points: int, keeps: float = 0.995) -> np.ndarray:
    """(N,) unit variance, correlated over time: how errors of an estimate look."""
    from scipy.signal import lfilter

    return lfilter([np.sqrt(1 - keeps**2)], [1, -keeps], rng.standard_normal(points))


def errors_of(rng, truth: np.ndarray, sigma_m: float, overconfident: float, claims=True) -> RobotErrors:
    """A robot whose errors are `overconfident` times what its covariance says."""
    n = len(truth)
    stamps_s = np.linspace(0.0, 1200.0, n)
    sigmas = sigma_m * (0.7 + 0.3 * np.sin(stamps_s / 90 + rng.uniform(0, 6)) ** 2)
    offsets = np.stack([coloured(rng, n) for _ in range(3)], axis=1) * overconfident
    if not claims:
        offsets = rng.standard_normal((n, 3)).cumsum(axis=0) / np.sqrt(n)  # odometry alone walks away
    off_m = offsets[:, :2] * sigmas[:, None]
    nees = (offsets**2).sum(axis=1)
    nees[:1] = np.nan  # the anchored pose
    known = [sigmas, sigmas, 0.3 * sigmas, nees] if claims else [EMPTY] * 4
    return RobotErrors(
        stamps_s, truth + off_m, known[0], stamps_s, np.hypot(*off_m.T), 0.3 * sigmas * offsets[:, 2], *known[1:]
    )


def estimator_of(rng, name: str, paths, landmarks, sigma_m: float, overconfident=1.0, causal=True) -> EstimatorView:
    robots = {r: errors_of(rng, p, sigma_m, overconfident, name != "dead-reckoning") for r, p in paths.items()}
    rms_m = float(np.sqrt(np.mean(np.concatenate([r.position_errors_m for r in robots.values()]) ** 2)))
    updates = 4800 if causal else 0
    poses = np.linspace(5, 15_000, updates)
    latencies_s = 1e-4 * (1 + poses / 3000) * rng.lognormal(0, 0.5, updates) * (1 + 20 * (rng.random(updates) < 0.01))
    cov = {m: (0.3 * sigma_m) ** 2 * np.array([[2.0, 0.6], [0.6, 1.0]]) for m in landmarks}
    scores = {
        "ate_rmse_m": rms_m,
        "heading_rmse_rad": 0.3 * rms_m,
        "rpe": {f"{d} m": {"translation_rmse_m": 0.01 * d, "rotation_rmse_rad": 0.005 * d} for d in (1, 5, 10)},
        "robots": {r: {"ate_rmse_m": rms_m, "heading_rmse_rad": 0.3 * rms_m} for r in robots},
        "wall_seconds": 3.2 * (1 + sigma_m),
        "dropped": {"sightings of unknown barcodes": 12},
    }
    if causal:
        scores |= {"causal_ate_rmse_m": 1.5 * rms_m, "causal_heading_rmse_rad": 0.4 * rms_m}
        scores |= {"latency_p50_seconds": 4e-4, "latency_p99_seconds": 3e-3}
    if name != "dead-reckoning":
        scores |= {"nees_mean": 3 * overconfident**2, "nis": KINDS}
    return EstimatorView(
        name,
        scores,
        robots,
        robots if causal else {},
        {m: rng.multivariate_normal(xy, cov[m]) for m, xy in landmarks.items()} if name != "dead-reckoning" else {},
        cov if name != "dead-reckoning" else {},
        latencies_s,
        poses,
        sigma_m * np.sqrt(np.arange(1.0, 40.0)) * rng.lognormal(0, 0.2, 39),
    )


def sample_view(points=3000, robots=5, landmarks=15) -> ComparisonView:
    """Four estimators on a log like MR.CLAM's."""
    rng = np.random.default_rng(3)
    paths = {robot: wandering(rng, points) for robot in ROBOTS[:robots]}
    points_xy = {f"landmark{k}": rng.uniform((0, 0), (15, 8)) for k in range(landmarks)}
    estimators = [
        estimator_of(rng, "dead-reckoning", paths, points_xy, 2.4),
        estimator_of(rng, "ekf", paths, points_xy, 0.06, overconfident=2.2),
        estimator_of(rng, "incremental", paths, points_xy, 0.05),
        estimator_of(rng, "batch", paths, points_xy, 0.04, causal=False),
    ]
    counts = {"Odometry": 60_000, "BearingRangeFix": 7034, "ignored": 0, "dropped": {"no such barcode": 31}}
    summary = {"log": "/data/log6", "robots": list(paths), "landmarks": list(points_xy), "duration_s": 1200.0}
    summary |= {"records": counts, "truth": list(paths), "estimators": {e.name: e.scores for e in estimators}}
    return ComparisonView("MRCLAM_Dataset6", summary, estimators, paths, points_xy)


def study_rows(seeds=20) -> list[dict]:
    rng = np.random.default_rng(5)
    rows = []
    levels = (("typical", 1.0), ("twice typical", 2.0), ("legged", 12.0))
    for (noise, sigma), exchanges, seed in product(levels, (2, 4, 8, 16, 32), range(seeds)):
        for estimator, worse in (("ekf", 1.0 + 0.05 * sigma), ("fixed-lag", 1.1), ("batch", 1.0)):
            ate_m = 0.01 * sigma * worse * np.sqrt(exchanges) * rng.lognormal(0, 0.4)
            row = {"seed": seed, "noise": noise, "role_exchanges": exchanges, "estimator": estimator}
            row |= {"ate_rmse_m": ate_m, "causal_ate_rmse_m": ate_m * (1 if estimator == "ekf" else 1.3)}
            row |= {"nees_mean": rng.chisquare(3 * 30) / 30 * worse**2, "crlb_ratio": worse * rng.lognormal(0.02, 0.3)}
            rows.append(row)
    return rows
