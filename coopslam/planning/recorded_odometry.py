"""How slippery the ground is: the odometry error that was recorded while a part of the map was explored.

Every leg of odometry is compared with the smoothed estimate. Along the leg let R be the believed variance,
P that of the smoothed leg and e the difference. What all other measurements say of the leg has the variance
Q = 1 / (1 / P - 1 / R), and the odometry differs from it by v = e (R + Q) / R with variance R_true + Q. So
v^2 - Q estimates R_true without bias, whatever was believed of the odometry.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import shapely

from coopslam.estimation.estimate import Estimate
from coopslam.exploration.free_map import FreeMap
from coopslam.se2 import Pose2, adjoint, position, xytheta

POOLED_LEGS = 4  # how many legs' worth the average over the whole map counts in each part of it
LEAST_OF_MEAN = 0.25  # of the map's mean sigma


@dataclass(frozen=True, slots=True)
class Leg:
    """One odometry factor: what it adds to the sums of v^2 - Q and of metres, with its weight."""

    middle: tuple[float, float]  # where it was driven, m
    excess_m2: float  # v^2 - Q
    distance_m: float
    weight: float  # 1 / (R + Q)^2


class SlipByTriangle:
    """Sums of legs by triangle; thin data are pooled with the average over the map."""

    def __init__(self, legs_of: Mapping[int, Sequence[Leg]], legs: Sequence[Leg]):
        self._legs_of = legs_of
        metres = sum(leg.weight * leg.distance_m for leg in legs)
        self._mean = max(sum(leg.weight * leg.excess_m2 for leg in legs) / metres, 0.0) if metres > 0 else 0.0
        self._share = POOLED_LEGS * metres / len(legs) if legs else 0.0

    def pooled(self, triangles: Sequence[int]) -> float:
        """Odometry error in some triangles, m per sqrt(m); at least a quarter of the map's mean.

        v^2 - Q of a few legs can add up to less than zero, and no ground is without slip.
        """
        legs = [leg for triangle in triangles for leg in self._legs_of.get(triangle, ())]
        metres = sum(leg.weight * leg.distance_m for leg in legs) + self._share
        if metres <= 0:
            return float(np.sqrt(self._mean))
        excess = sum(leg.weight * leg.excess_m2 for leg in legs) + self._share * self._mean
        return float(np.sqrt(max(excess / metres, LEAST_OF_MEAN**2 * self._mean)))


class RecordedOdometry:
    """The legs of a run, compared with an estimate that smoothed them."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, estimate: Estimate):
        """graph: the factors that the estimate smoothed."""
        chains = {
            key: (robot, k) for robot in estimate.robots for k, key in enumerate(estimate.timeline.tracks[robot].keys)
        }
        self.legs = []
        for i in range(graph.size()):
            factor = graph.at(i)
            if not isinstance(factor, gtsam.BetweenFactorPose2):
                continue
            start, end = factor.keys()
            if start in chains and end in chains and chains[end] == (chains[start][0], chains[start][1] + 1):
                leg = _leg(estimate, start, end, factor.measured(), factor.noiseModel().covariance())
                if leg is not None:
                    self.legs.append(leg)

    def by_triangle(self, free_map: FreeMap, places: Mapping[int, np.ndarray]) -> SlipByTriangle:
        """Which leg was driven where; a leg along an edge counts for the triangles on both sides.

        places: vertex -> (2,) in the frame of the estimate.
        """
        triangles = list(free_map.triangles)
        legs_of = defaultdict(list)
        if self.legs and triangles:
            areas = shapely.polygons([[places[v] for v in free_map.triangles[t]] for t in triangles])
            tree = shapely.STRtree(areas)
            points = shapely.points([leg.middle for leg in self.legs])
            for leg, area in zip(*tree.query(points, predicate="dwithin", distance=0.02), strict=True):
                legs_of[triangles[area]].append(self.legs[leg])
        return SlipByTriangle(legs_of, self.legs)


def _leg(estimate: Estimate, start: int, end: int, measured: Pose2, cov: np.ndarray) -> Leg | None:
    distance = float(np.hypot(measured.x(), measured.y()))
    if distance < 1e-6:
        return None
    ahead = np.append(position(measured), 0.0) @ _to_end_axes(measured) / distance
    smoothed = estimate.value(start).between(estimate.value(end))
    error = ahead @ xytheta(smoothed.between(measured))
    jacobian = np.hstack([-adjoint(smoothed.inverse()), np.eye(3)])
    joint = estimate.joint_covariance([start, end])
    believed, known = ahead @ cov @ ahead, ahead @ jacobian @ joint @ jacobian.T @ ahead
    if known >= believed * (1 - 1e-6):
        return None  # nothing but the odometry itself speaks of this leg
    others = 1.0 / (1.0 / known - 1.0 / believed)
    differs = error * (believed + others) / believed
    middle = position(estimate.value(start)) / 2 + position(estimate.value(end)) / 2
    return Leg(tuple(middle), float(differs**2 - others), distance, float((believed + others) ** -2))


def _to_end_axes(measured: Pose2) -> np.ndarray:
    """(3, 3) turns row vectors from the axes of a leg's start into those of its end."""
    c, s = np.cos(measured.theta()), np.sin(measured.theta())
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
