"""Helpers for tests of the filters: runs, their batch solutions, and sightings of posts."""

import gtsam
import numpy as np
from leapfrog import ROBOTS

from coopslam.estimation.batch import BatchEstimate, solve_batch
from coopslam.estimation.ekf import Ekf
from coopslam.records import BearingRangeFix

R0, R1 = ROBOTS
STEP_COV = np.diag([0.02, 0.01, 0.01]) ** 2
SEEN_COV = np.diag([0.01, 0.03]) ** 2
POST = np.array([3.0, 2.0])


def run(world, estimator=None):
    estimator = estimator or Ekf(ROBOTS)
    for group in world.groups:
        estimate = estimator.update(group)
    return estimator, estimate


def batch_of(estimator):
    return BatchEstimate(estimator.timeline, estimator.graph, solve_batch(estimator.graph, estimator.values()))


def without(graph, places):
    """The graph without the factors at these places."""
    rest = gtsam.NonlinearFactorGraph()
    for i in set(range(graph.size())) - set(places):
        rest.push_back(graph.at(i))
    return rest


def seen(stamp_s, observer, target, T_world_observer, point, noise=(0.0, 0.0)):
    there = T_world_observer.transformTo(point)
    bearing = np.arctan2(there[1], there[0]) + noise[0]
    return BearingRangeFix(stamp_s, observer, target, bearing, np.hypot(*there) + noise[1], SEEN_COV)
