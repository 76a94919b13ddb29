"""What the figures of replayed logs show: estimators on the same records, as plain numbers in SI units and radians."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from coopslam.report.study_panels import Dimension, StudyResults

PLACES_AT_MOST, GROUPS = 12, 8  # numbers of role exchanges that are kept apart; beyond, so many groups of them


@dataclass(frozen=True, slots=True, eq=False)
class RobotErrors:
    """One robot by one estimator, over time; everything that needs truth is empty without it."""

    stamps_s: np.ndarray  # (N,) s after the beginning of the log
    path: np.ndarray  # (N, 2) m, in the frame of the truth where there is one
    error_stamps_s: np.ndarray  # (M,) where the truth covers the estimate
    position_errors_m: np.ndarray  # (M,) after the alignment with the truth, as ATE
    heading_errors_rad: np.ndarray  # (M,) signed; after the alignment
    error_sigmas_m: np.ndarray  # (M,) along the worst direction, relative to the first robot's start; empty: none known
    heading_sigmas_rad: np.ndarray  # (M,)
    nees: np.ndarray  # (M,) 3 degrees of freedom; in the frame of the first robot's start; NaN of the anchored pose
    # what may be compared with sigmas: without alignment, in the frame of the first robot's true start, as NEES
    anchored_position_errors_m: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (M,), or empty: not known
    anchored_heading_errors_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (M,), or empty; signed

    @property
    def is_anchored(self) -> bool:
        """Whether there are errors that may be compared with sigmas."""
        return len(self.anchored_position_errors_m) > 0

    @property
    def shown_position_errors_m(self) -> np.ndarray:
        """(M,) the anchored ones where they are known."""
        return self.anchored_position_errors_m if self.is_anchored else self.position_errors_m

    @property
    def shown_heading_errors_rad(self) -> np.ndarray:
        """(M,) the anchored ones where they are known."""
        return self.anchored_heading_errors_rad if self.is_anchored else self.heading_errors_rad


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorView:
    """One estimator on the log."""

    name: str
    scores: dict  # as in summary.json: ate_rmse_m, heading_rmse_rad, causal_ate_rmse_m, nees_mean, wall_seconds, ...
    robots: dict[str, RobotErrors]  # final
    causal: dict[str, RobotErrors]  # as known at each moment, without covariances; empty when there is none
    landmarks: dict[str, np.ndarray]  # (2,) m, frame of the paths
    landmark_covariances: dict[str, np.ndarray]  # (2, 2) m^2, the same axes
    latencies_s: np.ndarray  # (U,) of each update; empty for one that takes everything at once
    latency_poses: np.ndarray  # (U,) pose variables then
    exchange_errors_m: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (E,) the mover's, after each leg
    note: str = ""  # why it has no result, in words


@dataclass(frozen=True, slots=True, eq=False)
class ComparisonView:
    """Several estimators on one log."""

    log: str
    summary: dict  # log, robots, duration_s, records, estimators
    estimators: list[EstimatorView]
    true_paths: dict[str, np.ndarray]  # (N, 2) m; empty without truth
    true_landmarks: dict[str, np.ndarray]


def study_of(rows: Sequence[Mapping]) -> StudyResults:
    """Rows as the results of a study with three dimensions: noise, role exchanges, estimator.

    More than PLACES_AT_MOST numbers of role exchanges are put into groups that stand at their medians.
    """
    rows = [row for row in rows if row.get("role_exchanges") is not None]
    noises = list(dict.fromkeys(row["noise"] for row in rows))
    noises = sorted(noises) if all(isinstance(noise, int | float) for noise in noises) else noises
    estimators = list(dict.fromkeys(row["estimator"] for row in rows))
    exchanges = np.array([float(row["role_exchanges"]) for row in rows])
    places, which = np.unique(exchanges, return_inverse=True)
    if len(places) > PLACES_AT_MOST:
        group = np.searchsorted(np.quantile(exchanges, np.arange(1, GROUPS) / GROUPS), exchanges, side="right")
        held, which = np.unique(group, return_inverse=True)
        places = np.array([np.median(exchanges[group == one]) for one in held])
    dimensions = (
        Dimension("noise", "noise", tuple(map(str, noises)), None),
        Dimension("role_exchanges", "role exchanges", tuple(f"{p:g}" for p in places), tuple(places.tolist())),
        Dimension("estimator", "estimator", tuple(map(str, estimators)), None),
    )
    index = [(noises.index(row["noise"]), which[r], estimators.index(row["estimator"])) for r, row in enumerate(rows)]
    texts = [{k: "" if v is None else str(v) for k, v in row.items()} | {"success": "true"} for row in rows]
    return StudyResults("", dimensions, np.array(index, int).reshape(-1, 3), texts)
