import gtsam
import numpy as np
import pytest

from coopslam.errors import UnderDetermined
from coopslam.estimation.factors import gauge_prior, odometry_leg
from coopslam.estimation.graph_check import check, complaints
from coopslam.estimation.keys import landmark_key, pose_key, vertex_key
from coopslam.se2 import Pose2

ROBOTS = ("robot0", "robot1")


def graph_of(*factors):
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def values_of(*keys):
    values = gtsam.Values()
    for key in keys:
        values.insert(key, Pose2())
    return values


def leg(a, b):
    return odometry_leg(a, b, Pose2(1, 0, 0), np.eye(3))


P0, P1, Q0, Q1, V = pose_key(0, 0), pose_key(0, 1), pose_key(1, 0), pose_key(1, 1), vertex_key(4)
RANGE = gtsam.RangeFactorPose2(P0, V, 1.0, gtsam.noiseModel.Isotropic.Sigma(1, 0.1))


@pytest.mark.parametrize(
    ("factors", "keys", "expected"),
    [
        ([gauge_prior(P0), leg(P0, P1)], [P0, P1], []),
        ([gauge_prior(P0), leg(P0, P1)], [P0, P1, V], ["vertex 4 appear in no factor"]),
        (
            [gauge_prior(P0), leg(P0, P1), leg(Q0, Q1)],
            [P0, P1, Q0, Q1],
            ["robot1 pose 0, robot1 pose 1 are not connected to a prior"],
        ),
        ([leg(P0, P1)], [P0, P1], ["robot0 pose 0, robot0 pose 1 are not connected to a prior"]),
        ([gauge_prior(P0), leg(P0, P1)], [P0], ["robot0 pose 1 have factors but no value"]),
        ([gauge_prior(P0), RANGE], [P0, V], ["vertex 4 have fewer equations than unknowns"]),
    ],
)
def test_what_is_missing_is_said(factors, keys, expected):
    graph, values = graph_of(*factors), values_of(*keys)
    assert complaints(graph, values, ROBOTS) == expected
    if expected:
        with pytest.raises(UnderDetermined, match=expected[0]):
            check(graph, values, ROBOTS)
    else:
        check(graph, values, ROBOTS)


def test_a_long_list_is_shortened():
    keys = [pose_key(1, i) for i in range(50)]
    [line] = complaints(graph_of(*map(leg, keys[:-1], keys[1:])), values_of(*keys), ROBOTS)
    assert line.endswith("robot1 pose 4 and 45 more are not connected to a prior")


def test_nothing_lacks_nothing_and_removed_factors_count_for_nothing():
    assert complaints(graph_of(), values_of()) == []
    graph = graph_of(gauge_prior(P0), leg(P0, P1))
    graph.remove(1)
    assert complaints(graph, values_of(P0, P1), ROBOTS) == ["robot0 pose 1 appear in no factor"]
    graph.remove(0)
    assert complaints(graph, values_of(P0), ROBOTS) == ["robot0 pose 0 appear in no factor"]
    assert complaints(graph_of(leg(P0, P1)), values_of(), ROBOTS) == [
        "robot0 pose 0, robot0 pose 1 have factors but no value"
    ]


def test_a_landmark_has_two_unknowns():
    landmark, noise = landmark_key(3), gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    values = values_of(P0)
    values.insert(landmark, np.zeros(2))
    graph = graph_of(gauge_prior(P0), gtsam.RangeFactor2D(P0, landmark, 1.0, noise))
    assert complaints(graph, values) == ["landmark #3 have fewer equations than unknowns"]
    graph.push_back(gtsam.BearingFactor2D(P0, landmark, gtsam.Rot2(0.1), noise))
    assert complaints(graph, values) == []


def test_a_prior_on_a_variable_without_value_holds_nothing():
    graph = graph_of(gauge_prior(V), leg(P0, P1))
    assert complaints(graph, values_of(P0, P1), ROBOTS) == [
        "vertex 4 have factors but no value",
        "robot0 pose 0, robot0 pose 1 are not connected to a prior",
    ]
