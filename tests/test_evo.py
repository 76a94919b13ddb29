"""Errors against those of evo (GPL-3, so it is imported here only); left out when it is not installed."""

import numpy as np
import pytest

from coopslam.estimation.estimate import Trajectory
from coopslam.evaluation.relative_error import joined, path_errors, robot_pair_errors
from coopslam.evaluation.trajectory_error import interpolate_se2, team_errors, trajectory_error
from coopslam.se2 import Pose2

pytest.importorskip("evo", reason="evo is not installed: pip install evo")
from evo.core import metrics  # noqa: E402
from evo.core.trajectory import PosePath3D  # noqa: E402

ROBOTS = ("a", "b", "c")
EXACT = 1e-9  # both sum some thousand numbers of order 10 m in double precision


def noisy_team(seed):
    """Robots that drive, turn and at times stand still; estimates drift, jump and live in a frame of their own."""
    rng = np.random.default_rng(seed)
    T_other_world = Pose2(*rng.normal(size=2) * 20, rng.uniform(-np.pi, np.pi))
    truth, estimated = {}, {}
    for i, robot in enumerate(ROBOTS):
        n = 300 + 50 * i
        drives = rng.random(n) < 0.8
        pose, drifting = Pose2(*rng.normal(size=2) * 5, rng.uniform(-np.pi, np.pi)), Pose2()
        poses, wrong = [], []
        for k in range(n):
            delta = Pose2(*(np.array([0.12, 0.0, 0.15]) * drives[k] + rng.normal(size=3) * 0.1 * drives[k]))
            drift = Pose2(*rng.normal(size=3) * 0.01)
            pose, drifting = pose * delta, drifting * drift
            poses.append(pose)
            wrong.append(T_other_world * pose * drifting * Pose2(*rng.normal(size=3) * 0.05))
        stamps_s = np.cumsum(rng.uniform(0.1, 0.4, n))
        truth[robot], estimated[robot] = Trajectory(stamps_s, poses), Trajectory(stamps_s, wrong)
    return estimated, truth


def path_of(poses):
    """Planar poses for evo."""
    matrices = []
    for pose in poses:
        T = np.eye(4)
        c, s = np.cos(pose.theta()), np.sin(pose.theta())
        T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], [pose.x(), pose.y()]
        matrices.append(T)
    return PosePath3D(poses_se3=matrices)


def ape(truth, estimated, relation):
    metric = metrics.APE(relation)
    metric.process_data((truth, estimated))
    return metric


@pytest.mark.parametrize("seed", [0, 1])
def test_absolute_errors_of_the_joined_team_are_evo_s(seed):
    estimated, truth = noisy_team(seed)
    ours = trajectory_error(estimated, truth)
    reference = path_of([pose for robot in ROBOTS for pose in truth[robot].poses])
    aligned = path_of([pose for robot in ROBOTS for pose in estimated[robot].poses])
    aligned.align(reference)  # Umeyama in space; all points lie in the plane
    position = ape(reference, aligned, metrics.PoseRelation.translation_part)
    heading = ape(reference, aligned, metrics.PoseRelation.rotation_angle_rad)
    assert ours.ate_rmse_m > 0.1
    assert (ours.ate_rmse_m, ours.ate_median_m, ours.ate_max_m) == pytest.approx(
        [position.get_statistic(s) for s in (metrics.StatisticsType.rmse, metrics.StatisticsType.median)]
        + [position.get_statistic(metrics.StatisticsType.max)],
        rel=EXACT,
    )
    # evo takes the angle from a matrix: arc cosine or logarithm, half of the digits
    assert ours.heading_rmse_rad == pytest.approx(heading.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
    by_robot = team_errors(estimated, truth)
    np.testing.assert_allclose(by_robot.joined.position_errors_m, position.error, rtol=EXACT)
    np.testing.assert_allclose(np.abs(by_robot.joined.heading_errors_rad), heading.error, atol=1e-6)
    first = len(truth["a"].poses)
    assert by_robot.robots["a"].ate_rmse_m == pytest.approx(np.sqrt((position.error[:first] ** 2).mean()), rel=EXACT)


def rpe(truth, estimated, distance_m, relation):
    metric = metrics.RPE(
        relation,
        delta=distance_m,
        delta_unit=metrics.Unit.meters,
        rel_delta_tol=0.1,
        all_pairs=True,
        pairs_from_reference=True,
    )
    metric.process_data((path_of(truth), path_of(estimated)))
    return metric.error


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("distance_m", [1.0, 5.0, 10.0])
def test_relative_errors_over_driven_distances_are_evo_s(seed, distance_m):
    estimated, truth = noisy_team(seed)
    ours = path_errors(estimated, truth, [distance_m], tolerance=0.1)
    together = []
    for robot in ROBOTS:
        found = ours[robot][distance_m]
        poses = truth[robot].poses, estimated[robot].poses
        translation = rpe(*poses, distance_m, metrics.PoseRelation.translation_part)
        rotation = rpe(*poses, distance_m, metrics.PoseRelation.rotation_angle_rad)
        assert found.count == len(translation) > 50
        np.testing.assert_allclose(found.translation_errors_m, translation, rtol=EXACT)
        np.testing.assert_allclose(np.abs(found.rotation_errors_rad), rotation, atol=1e-6)
        together.append(translation)
    rmse = np.sqrt((np.concatenate(together) ** 2).mean())
    assert joined(e[distance_m] for e in ours.values()).translation_rmse_m == pytest.approx(rmse, rel=EXACT)


def test_truth_at_other_stamps_is_interpolated_before_pairs_are_made():
    estimated, truth = noisy_team(2)
    at_s = np.linspace(1.0, 60.0, 200)
    rare = Trajectory(at_s, interpolate_se2(estimated["a"].stamps_s, estimated["a"].poses, at_s))
    ours = path_errors({"a": rare}, truth, [2.0])["a"][2.0]
    there = interpolate_se2(truth["a"].stamps_s, truth["a"].poses, at_s)
    evo = rpe(there, rare.poses, 2.0, metrics.PoseRelation.translation_part)
    np.testing.assert_allclose(ours.translation_errors_m, evo, rtol=EXACT)


def test_relative_poses_between_robots_are_evo_s_absolute_errors_of_them():
    """T_a_b over time is a path too; evo compares it without an alignment."""
    estimated, truth = noisy_team(3)
    stamps_s = np.linspace(1.0, 60.0, 150)
    both = [
        {r: Trajectory(stamps_s, interpolate_se2(t[r].stamps_s, t[r].poses, stamps_s)) for r in "ab"}
        for t in (estimated, truth)
    ]
    ours = robot_pair_errors(*both)["a", "b"]
    relative = [
        path_of([a.between(b) for a, b in zip(t["a"].poses, t["b"].poses, strict=True)]) for t in reversed(both)
    ]
    position = ape(*relative, metrics.PoseRelation.translation_part)
    heading = ape(*relative, metrics.PoseRelation.rotation_angle_rad)
    np.testing.assert_allclose(ours.translation_errors_m, position.error, rtol=EXACT)
    np.testing.assert_allclose(np.abs(ours.rotation_errors_rad), heading.error, atol=1e-6)
