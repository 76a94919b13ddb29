import numpy as np
import pytest

from coopslam.errors import BadInput
from coopslam.io.pose_graph import Distance, Node, Point, PoseGraph, PriorPoint, PriorPose, RelativePose
from coopslam.se2 import Pose2


@pytest.fixture
def graph():
    graph = PoseGraph()
    for index in range(2):
        graph.add_pose("here", f"A{index}", Node("A", index, float(index)))
    graph.add_point("here", "L6", "L6")
    return graph


def test_vertices_are_there_once(graph):
    for node, pose in (("A0", Node("B", 0, 0.0)), ("L6", Node("B", 0, 0.0)), ("A00", Node("A", 0, 0.0))):
        with pytest.raises(BadInput, match=f"^f.g2o: line 3: {node} is there already; expected every vertex once$"):
            graph.add_pose("f.g2o: line 3", node, pose)
    for node, landmark in (("A0", "L7"), ("L6", "L7"), ("L06", "L6")):
        with pytest.raises(BadInput, match=f"{node} is there already"):
            graph.add_point("f.g2o: line 3", node, landmark)
    assert (len(graph.poses), len(graph.points)) == (2, 1)


def test_edges_join_vertices_of_their_kind(graph):
    graph.edges = [
        RelativePose("x", "A0", "A1", Pose2(), np.eye(3)),
        Point("x", "A0", "L6", np.ones(2), np.eye(2)),
        Distance("x", "A0", "A1", 1.0, 1.0),
    ]
    graph.priors = [PriorPose("x", "A1", Pose2(), np.eye(3)), PriorPoint("x", "L6", np.ones(2), np.eye(2))]
    graph.check()


@pytest.mark.parametrize(
    ("edges", "priors", "node", "kind"),
    [
        ([RelativePose("x", "A0", "L6", Pose2(), np.eye(3))], [], "L6", "pose"),
        ([RelativePose("x", "A7", "A1", Pose2(), np.eye(3))], [], "A7", "pose"),
        ([Distance("x", "L6", "A1", 1.0, 1.0)], [], "L6", "pose"),
        ([Point("x", "A0", "L9", np.ones(2), np.eye(2))], [], "L9", "pose or landmark"),
        ([], [PriorPose("x", "L6", Pose2(), np.eye(3))], "L6", "pose"),
        ([], [PriorPoint("x", "A0", np.ones(2), np.eye(2))], "A0", "landmark"),
    ],
)
def test_an_edge_to_nowhere_is_named(graph, edges, priors, node, kind):
    graph.edges, graph.priors = edges, priors
    with pytest.raises(BadInput, match=f"^x: there is no vertex {node} that is a {kind}; expected vert"):
        graph.check()
