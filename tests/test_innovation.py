import gtsam
import numpy as np
import pytest
from leapfrog import ROBOTS, leapfrog
from scipy.linalg import block_diag
from scipy.stats import chi2

from coopslam.errors import BadInput
from coopslam.estimation import factors
from coopslam.estimation.batch import Batch, chi_square, optimize
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.keys import landmark_key, pose_key, vertex_key
from coopslam.evaluation.consistency import landmark_nees, trajectory_nees
from coopslam.evaluation.innovation import (
    Innovation,
    expected_square,
    innovation_statistics,
    kind_of,
    residual_statistics,
    squared_residual,
)
from coopslam.records import BearingFix, BearingRangeFix, RangeFix, WallDecision
from coopslam.se2 import Pose2

A, B, C, OTHER = pose_key(0, 0), pose_key(0, 1), pose_key(0, 2), pose_key(1, 2)
VERTEX, LANDMARK = vertex_key(3), landmark_key(4)
COV = np.diag([0.01, 0.04, 0.09])
NOISE = gtsam.noiseModel.Gaussian.Covariance(COV)
HUBER = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.345), NOISE)


def between(first, second, noise=NOISE):
    return gtsam.BetweenFactorPose2(first, second, Pose2(1, 0, 0), noise)


def sightings(target, is_point):
    both = BearingRangeFix(0.0, "a", "b", 0.1, 2.0, np.diag([0.01, 0.04]))
    return [
        factors.bearing_range(A, target, both, is_point),
        factors.distance(A, target, RangeFix(0.0, "a", "b", 2.0, 0.1), is_point),
        factors.bearing(A, target, BearingFix(0.0, "a", "b", 0.1, 0.1), is_point),
    ]


def test_kinds_are_told_by_type_and_keys():
    assert kind_of(between(A, B)) == "odometry" and kind_of(between(B, C)) == "odometry"
    assert kind_of(between(A, C)) == "loop closure" and kind_of(between(C, B)) == "loop closure"
    assert kind_of(between(C, OTHER)) == "relative pose" and kind_of(between(A, VERTEX)) == "corner"
    assert kind_of(factors.wall(VERTEX, vertex_key(4), WallDecision(0.0, 3, 4))) == "wall"
    assert kind_of(factors.gauge_prior(A)) == "pose prior"
    assert kind_of(gtsam.PriorFactorPoint2(LANDMARK, np.zeros(2), gtsam.noiseModel.Unit.Create(2))) == "landmark prior"
    assert [kind_of(f) for f in sightings(OTHER, False)] == [
        "bearing-range of a robot",
        "range of a robot",
        "bearing of a robot",
    ]
    assert [kind_of(f) for f in sightings(LANDMARK, True)] == [
        "bearing-range of a landmark",
        "range of a landmark",
        "bearing of a landmark",
    ]
    past = gtsam.LinearContainerFactor(gtsam.JacobianFactor(A, np.eye(3), np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
    assert kind_of(past) is None


def one_dimensional():
    """Odometry of 1 m along x, and a relative pose that says 1.3 m of the same."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(factors.gauge_prior(A))
    graph.add(between(A, B))
    graph.add(gtsam.BetweenFactorPose2(A, OTHER, Pose2(1.3, 0, 0), NOISE))
    graph.add(gtsam.BetweenFactorPose2(B, OTHER, Pose2(0, 0, 0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)))
    for key, x in ((A, 0.0), (B, 1.1), (OTHER, 1.1)):
        values.insert(key, Pose2(x, 0, 0))
    return graph, optimize(graph, values)


def test_two_measurements_of_the_same_share_their_difference():
    """Equal variances 0.01 m^2: the solution lies halfway, so each residual is 0.15 m, squared and normalized 2.25."""
    graph, values = one_dimensional()
    statistics = residual_statistics(graph, values, Covariances(graph, values).joint)
    odometry = statistics["odometry"]
    assert (odometry.count, odometry.dim) == (1, 3)
    assert odometry.mean_per_dim == pytest.approx(2.25 / 3, rel=1e-4)
    assert odometry.expected_per_dim == pytest.approx(0.5, rel=1e-4)  # each takes half of every dimension
    assert statistics["pose prior"].expected_per_dim == pytest.approx(0.0, abs=1e-9)


def test_squares_and_their_expectations_add_up_to_those_of_the_graph():
    world = leapfrog(np.random.default_rng(5), legs=8)
    batch = Batch(ROBOTS)
    batch.update(world.records)
    values = batch.values()
    statistics = residual_statistics(batch.graph, values, Covariances(batch.graph, values).joint)
    squares, dof = chi_square(batch.graph, values)
    assert set(statistics) == {"pose prior", "odometry", "relative pose", "corner"}
    assert sum(s.count * s.dim * s.mean_per_dim for s in statistics.values()) == pytest.approx(squares)
    assert sum(s.count * s.dim * s.expected_per_dim for s in statistics.values()) == pytest.approx(dof, rel=1e-6)
    assert residual_statistics(batch.graph, values)["corner"].expected_per_dim is None


def test_expectations_are_met_over_many_seeds():
    """A linear graph solved 400 times: points that are measured by three priors of different sigma."""
    rng, sigmas = np.random.default_rng(6), np.array([0.1, 0.2, 0.4])
    squares = []
    for _ in range(400):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for sigma in sigmas:
            noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
            graph.add(gtsam.PriorFactorPoint2(LANDMARK, sigma * rng.standard_normal(2), noise))
        values.insert(LANDMARK, np.zeros(2))
        values = optimize(graph, values)
        squares.append([squared_residual(graph.at(i), values) for i in range(3)])
    joint = Covariances(graph, values).joint
    expected = [expected_square(graph.at(i), values, joint) for i in range(3)]
    # standard error of a mean of 400 squares of 2 degrees of freedom: below 2 / 20
    np.testing.assert_allclose(np.mean(squares, axis=0), expected, atol=0.3)
    information = sigmas**-2.0
    np.testing.assert_allclose(expected, 2 - 2 * information / information.sum(), rtol=1e-9)


def test_a_robust_loss_is_looked_through():
    values = gtsam.Values()
    values.insert(A, Pose2())
    values.insert(B, Pose2(2.0, 0.6, 0.3))
    error = between(A, B).unwhitenedError(values)
    expected = float(error @ np.linalg.solve(COV, error))
    assert expected > 10 * 1.345**2  # far out in the loss
    assert squared_residual(between(A, B, HUBER), values) == pytest.approx(expected, rel=1e-12)
    assert squared_residual(between(A, B), values) == pytest.approx(expected, rel=1e-12)
    diagonal = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(np.diag(COV)))
    assert squared_residual(between(A, B, diagonal), values) == pytest.approx(expected, rel=1e-12)


def test_a_measurement_without_weight_misses_by_both_covariances():
    """Truncated: residual covariance R + H P H', so the expected square is dim + trace(R^-1 H P H')."""
    loss = gtsam.noiseModel.mEstimator.GemanMcClure.Create(1e-3)
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
    robust = gtsam.noiseModel.Robust.Create(loss, noise)
    values = gtsam.Values()
    values.insert(LANDMARK, np.array([5.0, 0.0]))
    P = np.array([[0.04, 0.01], [0.01, 0.09]])
    far = gtsam.PriorFactorPoint2(LANDMARK, np.zeros(2), robust)
    assert expected_square(far, values, lambda keys: P) == pytest.approx(2 + np.trace(P) / 0.25, rel=1e-6)
    kept = gtsam.PriorFactorPoint2(LANDMARK, np.zeros(2), noise)
    assert expected_square(kept, values, lambda keys: P) == pytest.approx(2 - np.trace(P) / 0.25, rel=1e-12)


def test_points_and_poses_keep_their_sizes_and_order():
    """Covariance of pose and landmark by hand, from the dense Jacobian of the graph."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(A, Pose2(), NOISE))
    graph.add(sightings(LANDMARK, True)[0])
    graph.add(gtsam.PriorFactorPoint2(LANDMARK, np.array([2.0, 0.1]), gtsam.noiseModel.Isotropic.Sigma(2, 0.3)))
    values.insert(A, Pose2())
    values.insert(LANDMARK, np.array([2.0, 0.2]))
    values = optimize(graph, values)
    ordering = gtsam.Ordering()
    ordering.push_back(LANDMARK)
    ordering.push_back(A)
    whitened = graph.linearize(values).jacobian(ordering)[0]
    projector = whitened @ np.linalg.inv(whitened.T @ whitened) @ whitened.T
    rows = np.cumsum([0, 3, 2, 2])
    by_hand = [n - np.trace(projector[i : i + n, i : i + n]) for i, n in zip(rows, [3, 2, 2], strict=False)]
    joint = Covariances(graph, values).joint
    assert [expected_square(graph.at(i), values, joint) for i in range(3)] == pytest.approx(by_hand)


@pytest.mark.parametrize(("belief", "honest"), [(1.0, True), (0.8, False), (1.25, False)])
def test_innovations_of_a_filter_are_judged_two_sided(belief, honest):
    """belief: the covariance that the filter believes over the true one; 600 innovations of 2 and 3 dof."""
    rng = np.random.default_rng(7)
    innovations = []
    for i in range(600):
        dof = 2 + i % 2
        S = block_diag(0.04, 0.01, 0.09)[:dof, :dof]
        miss = rng.multivariate_normal(np.zeros(dof), S)
        innovations.append(Innovation("relative pose", float(miss @ np.linalg.solve(belief * S, miss)), dof))
    found = innovation_statistics(innovations)["relative pose"]
    low, high = found.band_per_dof
    assert (low < found.mean_per_dof < high) == honest
    assert (low, high) == pytest.approx(chi2.ppf([0.025, 0.975], 1500) / 1500)
    assert (found.count, found.dof) == (600, 1500)
    if honest:
        assert found.beyond_95 == pytest.approx(0.05, abs=3 * np.sqrt(0.05 * 0.95 / 600))


def test_kinds_of_innovations_are_kept_apart():
    found = innovation_statistics([("a", 1.0, 1), ("b", 6.1, 2), ("a", 4.0, 1), ("b", 5.8, 2)])
    assert {kind: (s.count, s.dof, s.mean_per_dof) for kind, s in found.items()} == {
        "a": (2, 2, 2.5),
        "b": (2, 4, pytest.approx(2.975)),
    }
    assert (found["a"].beyond_95, found["b"].beyond_95) == (0.5, 0.5)  # tables: 3.841 and 5.991
    assert innovation_statistics([]) == {}
    for nis, dof in ((-1.0, 2), (np.nan, 2), (np.inf, 2), (1.0, 0)):
        with pytest.raises(BadInput, match="a: an innovation of nis >= 0"):
            innovation_statistics([("a", nis, dof)])


def test_landmarks_are_judged_in_the_frame_of_the_first_start():
    """The start looks along the world's y: 0.2 m too far along it is 0.2 m along x of the estimate."""
    T_world_start = Pose2(10.0, 5.0, np.pi / 2)
    truth = {"tree": np.array([10.0, 8.0]), "post": np.array([9.0, 5.0]), "unseen": np.zeros(2)}
    cov = np.diag([0.01, 0.04])
    estimated = {"tree": (np.array([3.2, 0.0]), cov), "post": (np.array([0.0, 1.2]), cov), "bush": (np.ones(2), cov)}
    found = landmark_nees(estimated, truth, T_world_start)
    assert found == {"tree": pytest.approx(4.0), "post": pytest.approx(1.0)}
    assert landmark_nees({}, truth, T_world_start) == {}


def test_robots_without_truth_are_not_judged():
    world = leapfrog(np.random.default_rng(11), legs=4)
    estimate = Batch(ROBOTS).update(world.records)
    estimated = {robot: estimate.trajectory(robot) for robot in ROBOTS}
    both = trajectory_nees(estimated, world.truth, "robot0")
    alone = trajectory_nees(estimated, {"robot0": world.truth["robot0"]}, "robot0")
    assert list(alone) == ["robot0"] and np.array_equal(alone["robot0"], both["robot0"])
    with pytest.raises(BadInput, match="no truth for robot0"):
        trajectory_nees(estimated, {"robot1": world.truth["robot1"]}, "robot0")
