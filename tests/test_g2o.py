import json

import gtsam
import numpy as np
import pytest

from coopslam.errors import BadInput
from coopslam.io.g2o import BearingEdge, PointEdge, PoseEdge, RangeEdge, read_g2o, write_g2o, write_keys
from coopslam.se2 import Pose2, xytheta


def random_information(rng, size):
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


@pytest.fixture
def graph():
    rng = np.random.default_rng(5)
    poses = [(key, Pose2(*rng.normal(size=3))) for key in (0, 1, 2, 70_000)]
    points = [(3, rng.normal(size=2)), (4, rng.normal(size=2))]
    edges = [
        BearingEdge(0, 4, 0.5, 100.0),
        PoseEdge(0, 1, Pose2(*rng.normal(size=3)), random_information(rng, 3)),
        PointEdge(1, 3, rng.normal(size=2), random_information(rng, 2)),
        BearingEdge(2, 70_000, -1e-7, 1e12),
        PoseEdge(1, 70_000, Pose2(*rng.normal(size=3)), random_information(rng, 3)),
    ]
    return poses, points, edges


def test_gtsam_reads_the_same_poses_points_and_pose_edges(tmp_path, graph):
    poses, points, edges = graph
    write_g2o(tmp_path / "graph.g2o", poses, points, edges, fixed=[0])
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), False)
    assert values.size() == len(poses) + len(points)
    for key, pose in poses:
        assert values.atPose2(key).equals(pose, 1e-15)
    for key, point in points:
        np.testing.assert_array_equal(values.atPoint2(gtsam.symbol("l", key)), point)
    pose_edges = [edge for edge in edges if isinstance(edge, PoseEdge)]
    assert factors.size() == len(pose_edges)
    for index, edge in enumerate(pose_edges):
        factor = factors.at(index)
        assert factor.keys() == [edge.start, edge.end]
        assert factor.measured().equals(edge.T_start_end, 1e-15)
        np.testing.assert_allclose(factor.noiseModel().information(), edge.information, rtol=1e-12)


def test_gtsam_weighs_an_edge_in_the_axes_we_say(tmp_path):
    """Half of e' I e with e in the axes of the end pose, from the definition."""
    rng = np.random.default_rng(6)
    information, T_measured, error = random_information(rng, 3), Pose2(1.0, 2.0, 2.0), rng.normal(size=3) * 1e-5
    poses = [(0, Pose2(3.0, -1.0, 0.7)), (1, Pose2(3.0, -1.0, 0.7) * T_measured * Pose2(*error))]
    write_g2o(tmp_path / "graph.g2o", poses, [], [PoseEdge(0, 1, T_measured, information)])
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), False)
    assert factors.error(values) == pytest.approx(0.5 * error @ information @ error, rel=1e-4)  # first order in 1e-5


def test_round_trip(tmp_path, graph):
    poses, points, edges = graph
    write_g2o(tmp_path / "graph.g2o", poses, points, edges, fixed=[0, 3])
    again = read_g2o(tmp_path / "graph.g2o")
    assert [key for key, _ in again.poses] == [key for key, _ in poses]
    assert [key for key, _ in again.points] == [key for key, _ in points]
    assert [(type(edge), edge.start, edge.end) for edge in again.edges] == [(type(e), e.start, e.end) for e in edges]
    assert again.fixed == [0, 3]
    np.testing.assert_allclose([xytheta(p) for _, p in again.poses], [xytheta(p) for _, p in poses], rtol=1e-15)
    np.testing.assert_array_equal([xy for _, xy in again.points], [xy for _, xy in points])
    for edge, other in zip(edges, again.edges, strict=True):
        np.testing.assert_allclose(other.information, edge.information, rtol=1e-12)
    assert again.edges[3].bearing_rad == -1e-7
    np.testing.assert_array_equal(again.edges[2].xy, edges[2].xy)


def test_tags_and_upper_triangle(tmp_path):
    matrix = np.array([[1.0, 2, 3], [2, 4, 5], [3, 5, 6]])
    edges = [PoseEdge(0, 1, Pose2(), matrix), PointEdge(0, 2, np.array([7.0, 8]), matrix[:2, :2])]
    edges += [BearingEdge(0, 1, 0.5, 9.0), BearingEdge(0, 2, 0.5, 9.0)]
    write_g2o(tmp_path / "graph.g2o", [(0, Pose2()), (1, Pose2())], [(2, [1, 1])], edges, [0])
    assert (tmp_path / "graph.g2o").read_text().splitlines()[3:] == [
        "EDGE_SE2 0 1 0.0 0.0 0.0 1.0 2.0 3.0 4.0 5.0 6.0",
        "EDGE_SE2_XY 0 2 7.0 8.0 1.0 2.0 4.0",
        "EDGE_BEARING_SE2 0 1 0.5 9.0",
        "EDGE_BEARING_SE2_XY 0 2 0.5 9.0",
        "FIX 0",
    ]


def test_positions_and_ranges_of_poses_have_tags_of_their_own_and_come_back(tmp_path):
    edges = [PointEdge(0, 1, np.array([7.0, 8]), np.eye(2)), RangeEdge(0, 1, 3.0, 4.0), RangeEdge(0, 2, 5.0, 6.0)]
    write_g2o(tmp_path / "graph.g2o", [(0, Pose2()), (1, Pose2())], [(2, [1, 1])], edges)
    assert (tmp_path / "graph.g2o").read_text().splitlines()[3:] == [
        "EDGE_POSITION_SE2 0 1 7.0 8.0 1.0 0.0 1.0",
        "EDGE_RANGE_SE2 0 1 3.0 4.0",
        "EDGE_RANGE_SE2_XY 0 2 5.0 6.0",
    ]
    position, near, far = read_g2o(tmp_path / "graph.g2o").edges
    assert isinstance(position, PointEdge) and position.xy.tolist() == [7.0, 8.0]
    assert [(type(edge), edge.end, edge.range_m, edge.information) for edge in (near, far)] == [
        (RangeEdge, 1, 3.0, 4.0),
        (RangeEdge, 2, 5.0, 6.0),
    ]


def test_misuse_is_refused(tmp_path):
    path, two = tmp_path / "graph.g2o", [(0, Pose2()), (1, Pose2())]
    with pytest.raises(ValueError, match="same id"):
        write_g2o(path, two, [(1, np.zeros(2))], [])
    with pytest.raises(ValueError, match="PoseEdge 0 -> 2 joins"):
        write_g2o(path, two, [(2, np.zeros(2))], [PoseEdge(0, 2, Pose2(), np.eye(3))])
    with pytest.raises(ValueError, match="BearingEdge 0 -> 9 joins"):
        write_g2o(path, two, [], [BearingEdge(0, 9, 0.0, 1.0)])
    with pytest.raises(ValueError, match="not finite"):
        write_g2o(path, two, [], [PoseEdge(0, 1, Pose2(), np.full((3, 3), np.inf))])
    with pytest.raises(ValueError, match=r"\(3, 3\)"):
        write_g2o(path, two, [], [PoseEdge(0, 1, Pose2(), np.eye(2))])
    with pytest.raises(ValueError, match="fixed vertex 5"):
        write_g2o(path, two, [], [], fixed=[5])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "unknown tag"),
        ("VERTEX_SE2 0 0 0", "1 id.* and 3 finite numbers"),
        ("VERTEX_SE2 0.5 0 0 0", "0.5"),
        ("EDGE_SE2 0 1 0 0 0 1 0 0 1 0 nan", "9 finite numbers"),
        ("FIX", "1 id"),
    ],
)
def test_bad_lines_are_named(tmp_path, line, expected):
    path = tmp_path / "graph.g2o"
    path.write_text(f"VERTEX_SE2 0 0 0 0\n{line}\n")
    with pytest.raises(BadInput, match=expected) as caught:
        read_g2o(path)
    assert str(caught.value).startswith(f"{path}: line 2: ")


def test_keys_are_plain_json(tmp_path):
    keys = {0: {"robot": "a", "index": 0, "stamp_s": 0.1}, 7: {"vertex": 3}}
    write_keys(tmp_path / "keys.json", keys)
    assert json.loads((tmp_path / "keys.json").read_text()) == {str(key): what for key, what in keys.items()}
