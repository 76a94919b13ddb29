import gtsam
import numpy as np
import pytest

from coopslam.estimation.batch import BatchEstimate, optimize, solve_batch
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.keys import landmark_key, pose_key
from coopslam.estimation.ordering import nested_dissection
from coopslam.estimation.robust import solve_robust
from coopslam.estimation.timeline import Timeline
from coopslam.se2 import Pose2

COV = np.diag([0.04, 0.01, 0.09])
NOISE = gtsam.noiseModel.Gaussian.Covariance(COV)
POINT_COV = np.array([[0.5, 0.1], [0.1, 0.3]])


def system(chain, alone, points=0):
    """A chain of poses with a prior at its start, further poses with nothing but a prior, and points with the same."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    keys = [pose_key(0, k) for k in range(chain + alone)]
    for k, key in enumerate(keys):
        values.insert(key, Pose2())
        if k == 0 or k >= chain:
            graph.push_back(gtsam.PriorFactorPose2(key, Pose2(k, 0, 0), NOISE))
        else:
            graph.push_back(gtsam.BetweenFactorPose2(keys[k - 1], key, Pose2(1, 0, 0), NOISE))
    for k in range(points):
        values.insert(landmark_key(k), np.zeros(2))
        noise = gtsam.noiseModel.Gaussian.Covariance(POINT_COV)
        graph.push_back(gtsam.PriorFactorPoint2(landmark_key(k), np.array([k, 2.0]), noise))
    return graph, values


# METIS as GTSAM calls it orders (4, 1) short, throws on others, and is killed by (20, 40).
@pytest.mark.parametrize("shape", [(1, 0), (1, 1), (0, 3), (4, 1), (4, 0, 1), (1, 0, 1), (20, 40, 20), (2, 1, 1)])
def test_every_variable_is_ordered_once_and_solved(shape):
    graph, values = system(*shape)
    for of_graph in (graph, graph.linearize(values)):
        ordering = nested_dissection(of_graph)
        assert sorted(ordering.at(i) for i in range(ordering.size())) == sorted(values.keys())
    for solved in (optimize(graph, values), solve_batch(graph, values), solve_robust(graph, [], values).values):
        assert graph.error(solved) < 1e-12
        for k in range(sum(shape[:2])):
            assert solved.atPose2(pose_key(0, k)).equals(Pose2(k, 0, 0), 1e-6)
    estimate = BatchEstimate(Timeline(("robot0",)), graph, solved)
    last = pose_key(0, sum(shape[:2]) - 1)
    if shape[1]:
        np.testing.assert_allclose(estimate.covariance(last), COV, rtol=1e-9, atol=1e-12)
    for k in range(sum(shape[2:])):
        np.testing.assert_allclose(Covariances(graph, solved).marginal(landmark_key(k)), POINT_COV, rtol=1e-9)
    joint = estimate.joint_covariance([pose_key(0, 0)] + [landmark_key(k) for k in range(sum(shape[2:]))])
    assert joint.shape == (3 + 2 * sum(shape[2:]),) * 2
    np.testing.assert_allclose(joint[:3, :3], COV, rtol=1e-9, atol=1e-9)
    assert not joint[:3, 3:].any()


def test_a_graph_without_factors_has_no_order():
    assert nested_dissection(gtsam.NonlinearFactorGraph()).size() == 0
    assert nested_dissection(gtsam.GaussianFactorGraph()).size() == 0


def test_removed_factors_are_passed_over():
    graph, _ = system(3, 1)
    graph.remove(1)
    assert nested_dissection(graph).size() == 4


def test_the_tree_of_a_long_chain_is_shallow():
    """COLAMD's is as deep as the chain is long."""
    graph, values = system(2000, 1)
    linear = graph.linearize(values)
    net, depth = linear.eliminateSequential(nested_dissection(linear)), {}
    for i in reversed(range(net.size())):
        conditional = net.at(i)
        parents = list(conditional.keys())[1:]
        depth[conditional.firstFrontalKey()] = 1 + max((depth[parent] for parent in parents), default=0)
    assert max(depth.values()) < 400
