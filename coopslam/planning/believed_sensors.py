"""What the robots that mapped a place believed of their sensors, read off the factors that were smoothed.

A log need not say by which law its covariances were made, and the robots may be anybody's; but variances grow in
proportion to metres, radians and squared ranges, so the law follows from the covariances themselves: least squares
with coefficients of zero or more, relative to what is fitted.
"""

from collections.abc import Sequence

import gtsam
import numpy as np
from scipy.optimize import nnls

from coopslam.estimation.factor_kinds import kind_of
from coopslam.planning.recorded_odometry import MOVED_M, Leg
from coopslam.planning.sensor_laws import OdometryLaw, SensorLaws, SightingLaw
from coopslam.se2 import planar_rotation, xytheta

TURNED_RAD = 1e-3  # a smaller turn is none
_TRACKER = ("relative pose", "bearing-range of a robot")


def believed_sensors(graph: gtsam.NonlinearFactorGraph, legs: Sequence[Leg]) -> SensorLaws:
    """The laws of odometry, corner finder and robot tracker, by the covariances of a graph's factors.

    legs: the odometry among them.
    """
    seen: dict[str, list[tuple]] = {}
    for i in range(graph.size()):
        factor = graph.at(i)
        kind = "tracker" if (found := kind_of(factor)) in _TRACKER else found
        if kind in ("tracker", "corner"):
            seen.setdefault(kind, []).append(_line_variances(factor))
    return SensorLaws(_odometry(graph, legs), _sighting(seen.get("corner")), _sighting(seen.get("tracker")))


def _odometry(graph: gtsam.NonlinearFactorGraph, legs: Sequence[Leg]) -> OdometryLaw | None:
    moves = [leg for leg in legs if leg.distance_m > MOVED_M]
    if not moves:
        return None
    distance = np.array([leg.distance_m for leg in legs])
    turn = np.abs([graph.at(leg.factor).measured().theta() for leg in legs])
    heading = np.array([leg.cov[2, 2] for leg in legs])
    acted = (distance > MOVED_M) | (turn > TURNED_RAD)
    along = _law([leg.distance_m for leg in moves], [leg.axes[0] @ leg.cov @ leg.axes[0] for leg in moves])
    turned = _law(np.column_stack([distance, turn])[acted], heading[acted])
    return OdometryLaw(*np.sqrt([*along, *turned]).tolist())


def _sighting(seen: list[tuple] | None) -> SightingLaw | None:
    """The law of sightings, each (range, variances along, across and of heading or None)."""
    if not seen:
        return None
    ranges = np.array([sighting[0] for sighting in seen])
    growing = np.column_stack([np.ones(len(ranges)), ranges**2])
    along, across = (np.sqrt(_law(growing, [sighting[k] for sighting in seen])).tolist() for k in (1, 2))
    headings = [sighting[3] for sighting in seen if sighting[3] is not None]
    heading = float(np.sqrt(np.mean(headings))) if headings else None
    return SightingLaw(*along, *across, heading, float(ranges.max()))


def _line_variances(factor: gtsam.NonlinearFactor) -> tuple[float, float, float, float | None]:
    """Range, m, and variances of a sighting along and across its line, m^2, and of the heading, rad^2."""
    noise = factor.noiseModel()
    noise = noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise
    cov, measured = noise.covariance(), factor.measured()
    if not isinstance(measured, gtsam.Pose2):
        range_m = measured.range()
        return range_m, cov[1, 1], cov[0, 0] * range_m**2, None
    x, y, theta = xytheta(measured)
    turn = planar_rotation(theta - np.arctan2(y, x))  # the factor's covariance is in the axes of the target
    along, across, heading = np.diag(turn @ cov @ turn.T)
    return float(np.hypot(x, y)), along, across, heading


def _law(causes, variances) -> np.ndarray:
    """(c,) coefficients of zero or more, with variances = causes @ coefficients; (n,) or (n, c) causes."""
    variances = np.maximum(np.asarray(variances, float), 1e-18)
    causes = np.reshape(np.asarray(causes, float), (len(variances), -1))
    return nnls(causes / variances[:, None], np.ones(len(variances)))[0]
