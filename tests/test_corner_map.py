"""What places are recognized by: relative covariances against bare gtsam, and the way over `dual_graph.json`."""

import json

import gtsam
import networkx as nx
import numpy as np
import pytest
from explorations import run
from surveys import survey

from coopslam.errors import BadInput
from coopslam.exploration.mission import Budget
from coopslam.planning.corner_map import corner_map, inverse_adjoints, relative_poses, stored_corner_map
from coopslam.planning.dual_graph import dual_graph
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.recorded_odometry import RecordedOdometry
from coopslam.se2 import Pose2, adjoint, relative_covariance, wrap, xytheta


@pytest.fixture(scope="module")
def begun():
    return run("paper_one_obstacle", "typical", seed=1, budget=Budget(moves=9))


def test_in_a_robots_frame_the_covariance_is_that_of_a_graph_fixed_to_the_robot(begun):
    """Bare gtsam with the prior on the robot instead of on the start."""
    estimate, graph = begun.smoothed(), gtsam.NonlinearFactorGraph()
    robot = estimate.pose_key("robot1")
    for i in range(begun.driver.graph.size()):
        if not isinstance(begun.driver.graph.at(i), gtsam.PriorFactorPose2):
            graph.push_back(begun.driver.graph.at(i))
    values, T_start_robot = begun.driver.values(), estimate.value(robot)
    moved = gtsam.Values()
    for key in values.keys():  # noqa: SIM118 - Values is no dict
        moved.insert(key, T_start_robot.inverse() * estimate.value(key))
    graph.push_back(gtsam.PriorFactorPose2(robot, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    keys = [estimate.vertex_key(vertex) for vertex in begun.free_map.fans]
    ordering = gtsam.Ordering()
    for key in [*keys, *(key for key in moved.keys() if key not in keys)]:  # noqa: SIM118
        ordering.push_back(key)
    information, _ = graph.linearize(moved).hessian(ordering)
    expected = np.linalg.inv(information)[: 3 * len(keys), : 3 * len(keys)]

    corners = corner_map(begun.free_map, estimate, 0.01, "robot1")
    for k, key in enumerate(keys):
        assert gtsam.Pose2(*corners.poses[k]).equals(moved.atPose2(key), 1e-9)
    joint = corners.covariance.reshape(3 * len(keys), -1)
    assert joint == pytest.approx(expected, abs=1e-8)  # variances from 1e-5 on; the priors leave 1e-12 open


def test_the_map_in_a_file_is_the_map(begun):
    estimate, graph = begun.smoothed(), begun.driver.graph
    free_map = begun.free_map
    saved = dual_graph(free_map, estimate, RecordedOdometry(graph, estimate))
    data = json.loads(json.dumps(nx.node_link_data(saved, edges="edges")))
    loaded = stored_corner_map(MapGraph.from_graph(nx.node_link_graph(data, edges="edges")), 0.01)
    made = corner_map(free_map, estimate, 0.01)
    assert loaded.ids == made.ids and loaded.is_complete is made.is_complete is False
    for name in ("poses", "interior_angles", "leaving", "arriving", "triangles", "gates"):
        assert getattr(loaded, name) == pytest.approx(getattr(made, name))
    assert loaded.covariance == pytest.approx(made.covariance, abs=1e-12)


def test_walls_and_gates_are_those_of_the_free_map(begun):
    corners = corner_map(begun.free_map, begun.smoothed(), 0.01)
    walls = [(k, int(end)) for k, end in enumerate(corners.leaving) if end >= 0]
    assert sorted(walls) == sorted(begun.free_map.walls())
    assert all(corners.arriving[end] == start for start, end in walls)
    assert {tuple(gate) for gate in corners.gates.tolist()} == set(begun.free_map.gates)


def test_a_file_without_the_joint_covariance_says_so(begun):
    estimate = begun.smoothed()
    saved = dual_graph(begun.free_map, estimate, RecordedOdometry(begun.driver.graph, estimate))
    saved.graph["joint_covariance"] = None
    with pytest.raises(BadInput, match="joint covariance"):
        stored_corner_map(MapGraph.from_graph(saved), 0.01)


def test_adjoints_of_many_poses():
    poses = np.random.default_rng(0).normal(size=(5, 3))
    expected = [adjoint(Pose2(*pose).inverse()) for pose in poses]
    assert inverse_adjoints(poses) == pytest.approx(np.array(expected), abs=1e-12)
    assert wrap(poses[:, 2]) == pytest.approx(poses[:, 2])


def test_relative_poses_of_many_corners():
    corners = survey([[0, 0], [6, 0], [6, 4], [4, 4], [4, 5], [0, 5]], np.random.default_rng(5))
    poses, covariances = relative_poses(corners, 2, np.array([0, 4]))
    for k, other in enumerate([0, 4]):
        T = Pose2(*corners.poses[2]).between(Pose2(*corners.poses[other]))
        joint = corners.covariance[np.ix_([2, other], range(3), [2, other], range(3))].reshape(6, 6)
        assert poses[k] == pytest.approx(xytheta(T))
        assert covariances[k] == pytest.approx(relative_covariance(T, joint))
