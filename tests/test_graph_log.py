from collections import Counter

import gtsam
import numpy as np
import pytest

from coopslam.errors import BadInput
from coopslam.io.graph_log import UNKNOWN_SIGMAS, graph_log
from coopslam.io.pose_graph import Direction, Distance, Node, Point, PoseGraph, PriorPoint, PriorPose, RelativePose
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    LandmarkPrior,
    LoopClosure,
    Odometry,
    PosePrior,
    RangeFix,
    RelativePoseFix,
)
from coopslam.se2 import Pose2, observer_to_target_axes, xytheta

COV = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]])


def two_robots(*edges, priors=(), count=3):
    """A0 at 0 s, A1 at 1 s, ...; the same for B; landmark L6; all odometry is there."""
    graph = PoseGraph()
    graph.add_point("here", "L6", "L6")
    for robot in "BA":
        for index in range(count):
            graph.add_pose("here", f"{robot}{index}", Node(robot, index, float(index)))
        for index in range(count - 1):
            odometry = RelativePose("here", f"{robot}{index}", f"{robot}{index + 1}", Pose2(1, 0, 0.5), COV)
            graph.edges.append(odometry)
    graph.edges += edges
    graph.priors += priors
    return graph


def others(log):
    return [record for record in log.records if not isinstance(record, Odometry)]


def relative(start, end, pose=None):
    return RelativePose("here", start, end, pose or Pose2(0.5, -1.0, 2.0), COV)


def test_odometry_in_the_order_of_time():
    log = graph_log("g", two_robots(), "")
    assert log.header.robots == ("A", "B")
    assert log.header.landmarks == ()  # nobody saw L6
    steps = [(step.start_s, step.stamp_s, step.robot) for step in log.records]
    assert steps == [(0, 1, "B"), (0, 1, "A"), (1, 2, "B"), (1, 2, "A")]
    for step in log.records:
        assert step.T_start_now.equals(Pose2(1, 0, 0.5), 0)
        np.testing.assert_array_equal(step.cov_now, COV)


def test_an_edge_between_robots_at_one_instant_is_a_fix_in_the_observers_axes():
    (fix,) = others(graph_log("g", two_robots(relative("B1", "A1")), ""))
    assert isinstance(fix, RelativePoseFix)
    assert (fix.stamp_s, fix.observer, fix.target) == (1, "B", "A")
    c, s = np.cos(2.0), np.sin(2.0)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])  # from the axes of A to those of B
    np.testing.assert_allclose(fix.cov_observer, turn @ COV @ turn.T, atol=1e-15)
    np.testing.assert_allclose(observer_to_target_axes(fix.T_observer_target, fix.cov_observer), COV, atol=1e-15)


@pytest.mark.parametrize(("start", "end"), [("A0", "A2"), ("A2", "A0"), ("B0", "A2"), ("A2", "B0"), ("A2", "B1")])
def test_a_closure_goes_from_the_earlier_to_the_later_and_weighs_the_same(start, end):
    """gtsam's error of the edge as it was written and as it was recorded, for poses 1e-4 away from it."""
    edge = relative(start, end)
    (closure,) = others(graph_log("g", two_robots(edge), ""))
    assert isinstance(closure, LoopClosure)
    assert closure.earlier_s < closure.stamp_s
    assert {(closure.earlier_robot, closure.earlier_s), (closure.robot, closure.stamp_s)} == {
        (name[0], float(name[1])) for name in (start, end)
    }
    rng = np.random.default_rng(4)
    for _ in range(20):
        T_start = Pose2(*rng.normal(size=3))
        T_end = T_start * edge.T_start_end * Pose2(*rng.normal(size=3) * 1e-4)
        values = gtsam.Values()
        values.insert(0, T_start)
        values.insert(1, T_end)
        noise = gtsam.noiseModel.Gaussian.Covariance(COV)
        written = gtsam.BetweenFactorPose2(0, 1, edge.T_start_end, noise).error(values)
        flipped = (closure.robot, closure.stamp_s) != (end[0], float(end[1]))
        noise = gtsam.noiseModel.Gaussian.Covariance(closure.cov_now)
        recorded = gtsam.BetweenFactorPose2(int(flipped), int(not flipped), closure.T_earlier_now, noise).error(values)
        assert recorded == pytest.approx(written, rel=1e-3)  # first order in 1e-4


def test_odometry_that_was_written_backwards():
    graph = two_robots(count=2)
    graph.edges = [relative("A1", "A0", Pose2(1, 0, 0.5).inverse()), relative("B0", "B1")]
    steps = [record for record in graph_log("g", graph, "").records if record.robot == "A"]
    assert [(type(step), step.start_s, step.stamp_s) for step in steps] == [(Odometry, 0, 1)]
    assert steps[0].T_start_now.equals(Pose2(1, 0, 0.5), 1e-12)


def test_a_second_edge_between_neighbours_is_a_closure():
    (closure,) = others(graph_log("g", two_robots(relative("A0", "A1")), ""))
    assert isinstance(closure, LoopClosure)
    assert (closure.earlier_s, closure.stamp_s, closure.T_earlier_now.x()) == (0, 1, 0.5)


def test_motion_that_no_edge_measures_is_unknown_and_counted():
    graph = two_robots()
    del graph.edges[0]
    log = graph_log("g", graph, "")
    assert log.dropped == {"odometry: none between consecutive poses; taken as unknown motion": 1}
    (bridge,) = [step for step in log.records if step.robot == "B" and step.start_s == 0]
    assert not xytheta(bridge.T_start_now).any()
    np.testing.assert_array_equal(np.sqrt(np.diag(bridge.cov_now)), UNKNOWN_SIGMAS)


def test_poses_need_not_be_numbered_one_by_one():
    graph = PoseGraph()
    for index in (7, 40, 12):
        graph.add_pose("here", index, Node("a", index, float(index)))
    graph.edges = [relative(12, 40), relative(7, 12), relative(7, 40)]
    log = graph_log("g", graph, "")
    assert Counter(type(record) for record in log.records) == {Odometry: 2, LoopClosure: 1}
    assert not log.dropped


def test_a_point_becomes_bearing_and_range_by_a_numeric_derivative():
    cov, xy = COV[:2, :2], np.array([-1.5, 0.8])
    (fix,) = others(graph_log("g", two_robots(Point("here", "B2", "L6", xy, cov)), ""))
    assert isinstance(fix, BearingRangeFix)
    assert (fix.stamp_s, fix.observer, fix.target) == (2, "B", "L6")

    def polar(p):
        return np.array([np.arctan2(p[1], p[0]), np.hypot(*p)])

    np.testing.assert_allclose([fix.bearing_rad, fix.range_m], polar(xy), rtol=1e-15)
    h = 1e-6
    J = np.column_stack([(polar(xy + h * e) - polar(xy - h * e)) / (2 * h) for e in np.eye(2)])
    np.testing.assert_allclose(fix.cov, J @ cov @ J.T, rtol=1e-7)


def test_distances_and_directions():
    edges = (
        Distance("here", "A0", "B0", 3.0, 0.1),
        Distance("here", "A1", "L6", 4.0, 0.2),
        Direction("here", "A2", "B2", -0.3, 0.01),
        Direction("here", "A2", "L6", 0.4, 0.02),
        Point("here", "B2", "A2", np.array([1.0, 0.0]), np.eye(2)),
    )
    log = graph_log("g", two_robots(*edges), "")
    said = [(type(fix), fix.stamp_s, fix.observer, fix.target) for fix in others(log)]
    assert said == [
        (RangeFix, 0, "A", "B"),
        (RangeFix, 1, "A", "L6"),
        (BearingFix, 2, "A", "B"),
        (BearingFix, 2, "A", "L6"),
        (BearingRangeFix, 2, "B", "A"),
    ]
    assert [others(log)[1].range_m, others(log)[1].sigma_m] == [4.0, 0.2]
    assert [others(log)[2].bearing_rad, others(log)[2].sigma_rad] == [-0.3, 0.01]
    assert log.header.landmarks == ("L6",)
    assert not log.dropped


def test_what_cannot_be_a_record_is_counted():
    edges = (
        relative("A1", "A1"),
        Distance("here", "A0", "B1", 3.0, 0.1),
        Distance("here", "A0", "A1", 3.0, 0.1),
        Point("here", "A0", "L6", np.zeros(2), np.eye(2)),
    )
    log = graph_log("g", two_robots(*edges, priors=[PriorPose("here", "A1", Pose2(), COV)]), "")
    assert others(log) == []
    assert log.dropped == {
        "edge: joins a pose to itself": 1,
        "edge: a sighting between poses at different times": 2,
        "bearing_range: range zero": 1,
        "prior: none on the first pose of the first robot, which is the origin": 1,
    }


@pytest.mark.parametrize(
    "edge",
    [
        Distance("f: line 3", "A0", "L6", -1.0, 0.1),
        Point("f: line 3", "A0", "L6", np.ones(2), -np.eye(2)),
        RelativePose("f: line 3", "A0", "A2", Pose2(), np.diag([1.0, 1.0, -1.0])),
    ],
)
def test_numbers_that_cannot_be_are_named_by_their_line(edge):
    with pytest.raises(BadInput, match="^f: line 3: ") as caught:
        graph_log("g", two_robots(edge), "")
    assert "\n" not in str(caught.value)


def test_priors_in_the_frame_of_the_first_start_against_ten_thousand_surveys():
    """Origin, pose and landmark each surveyed with noise in the file's frame; how they lie to each other is sampled."""
    origin, pose, xy = Pose2(10, 5, 0.7), Pose2(12, 4, -1.0), np.array([9.0, 7.5])
    cov_origin, cov_pose = COV * 1e-4, COV[::-1, ::-1] * 1e-4
    cov_xy = np.array([[4e-6, 1e-6], [1e-6, 2e-6]])
    priors = [
        PriorPoint("here", "L6", xy, cov_xy),
        PriorPose("here", "B1", pose, cov_pose),
        PriorPose("here", "A0", origin, cov_origin),
    ]
    log = graph_log("g", two_robots(priors=priors), "")
    landmark, robot = others(log)
    assert isinstance(landmark, LandmarkPrior) and isinstance(robot, PosePrior)
    assert (landmark.stamp_s, landmark.landmark, robot.stamp_s, robot.robot) == (0, "L6", 1, "B")
    assert robot.T_start_robot.equals(origin.between(pose), 1e-12)
    np.testing.assert_allclose(landmark.xy, origin.transformTo(xy), atol=1e-12)
    assert log.header.landmarks == ("L6",)

    rng = np.random.default_rng(8)
    errors_pose, errors_xy = [], []
    for _ in range(10_000):
        true_origin = origin * Pose2(*rng.multivariate_normal(np.zeros(3), cov_origin))
        true_pose = pose * Pose2(*rng.multivariate_normal(np.zeros(3), cov_pose))
        true_xy = xy + rng.multivariate_normal(np.zeros(2), cov_xy)
        errors_pose.append(xytheta(robot.T_start_robot.between(true_origin.between(true_pose))))
        errors_xy.append(true_origin.transformTo(true_xy) - landmark.xy)
    for errors, cov in ((errors_pose, robot.cov_robot), (errors_xy, landmark.cov)):
        sampled = np.cov(np.array(errors).T)
        scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
        assert np.abs((cov - sampled) / scale).max() < 0.05  # 3.5 standard deviations of a variance of 10 000 samples


def test_stamps_that_do_not_ascend_give_way_to_the_numbers_of_the_poses():
    graph = two_robots(relative("A1", "B1"))
    graph.poses = {node: Node(pose.robot, pose.index, 5.0) for node, pose in graph.poses.items()}
    log = graph_log("g", graph, "")
    assert log.dropped == {"stamps: those of a robot do not ascend; the numbers of the poses are taken instead": 1}
    assert [(step.start_s, step.stamp_s) for step in log.records if isinstance(step, Odometry)] == [(0, 1)] * 2 + [
        (1, 2)
    ] * 2
    assert isinstance(others(log)[0], RelativePoseFix)


def test_a_graph_without_poses_or_edges_is_no_log():
    graph = two_robots()
    graph.edges = []
    with pytest.raises(BadInput, match="^g: no edges in it"):
        graph_log("g", graph, "")
    with pytest.raises(BadInput, match="^g: no poses in it"):
        graph_log("g", PoseGraph(), "")
