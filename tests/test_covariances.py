import gtsam
import numpy as np
import pytest

from coopslam.errors import UnderDetermined
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.factors import gauge_prior, odometry_leg
from coopslam.estimation.keys import landmark_key, pose_key
from coopslam.se2 import Pose2

POSES, LANDMARKS = 40, 4


def driven(strong, weak=1.0, seed=3):
    """A robot that turns on the spot and drives straight in turns, knowing one of the two `strong`ly, with loops."""
    rng = np.random.default_rng(seed)
    graph, values, pose = gtsam.NonlinearFactorGraph(), gtsam.Values(), Pose2()
    graph.push_back(gauge_prior(pose_key(0, 0)))
    values.insert(pose_key(0, 0), pose)
    for i in range(1, POSES):
        turns = i % 2 == 0
        delta = Pose2(0, 0, rng.normal()) if turns else Pose2(1 + rng.random(), 0, 0)
        sigmas = [strong, strong, 0.1 * weak] if turns else [weak, weak / 2, strong]
        graph.push_back(odometry_leg(pose_key(0, i - 1), pose_key(0, i), delta, np.diag(sigmas) ** 2))
        pose = pose * delta
        values.insert(pose_key(0, i), pose)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, weak)
    for i in range(0, POSES - 9, 7):
        a, b = pose_key(0, i), pose_key(0, i + 9)
        graph.push_back(gtsam.BetweenFactorPose2(a, b, values.atPose2(a).between(values.atPose2(b)), noise))
    for number in range(LANDMARKS):
        point = rng.normal(size=2) * 5
        values.insert(landmark_key(number), point)
        for i in range(number, POSES, 5):
            seen = values.atPose2(pose_key(0, i))
            sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05, 0.2]))
            graph.push_back(
                gtsam.BearingRangeFactor2D(
                    pose_key(0, i), landmark_key(number), seen.bearing(point), seen.range(point), sigmas
                )
            )
    return graph, values


def dense(graph, values):
    """Key -> columns, and the inverse of the whole information matrix by numpy's QR of the whitened Jacobian."""
    ordering, columns, end = gtsam.Ordering(), {}, 0
    for key in values.keys():  # noqa: SIM118 - Values is no dict
        ordering.push_back(key)
        dim = 2 if key in map(landmark_key, range(LANDMARKS)) else 3
        columns[key] = list(range(end, end + dim))
        end += dim
    jacobian, _ = graph.linearize(values).jacobian(ordering)
    inverse = np.linalg.inv(np.linalg.qr(jacobian, mode="r"))
    return columns, inverse @ inverse.T


def in_sigmas(found, expected):
    """Largest error of a covariance as a correlation coefficient."""
    sigmas = np.sqrt(np.diag(expected))
    return np.abs((found - expected) / np.outer(sigmas, sigmas)).max()


# QR keeps about 16 digits less those of the ratio of sigmas, which Cholesky would lose twice.
@pytest.mark.parametrize(("strong", "tolerance"), [(0.1, 1e-10), (1e-3, 1e-9), (1e-6, 1e-6)])
def test_marginals_and_joints_are_those_of_the_dense_inverse(strong, tolerance):
    graph, values = driven(strong)
    columns, expected = dense(graph, values)
    covariances, keys = Covariances(graph, values), list(columns)
    assert len(keys) == POSES + LANDMARKS
    for key, found in zip(keys, covariances.marginals(keys), strict=True):
        assert in_sigmas(found, expected[np.ix_(columns[key], columns[key])]) < tolerance
    rng = np.random.default_rng(0)
    for _ in range(20):
        asked = [keys[i] for i in rng.permutation(len(keys))[: rng.integers(1, 6)]]
        within = sum((columns[key] for key in asked), [])
        assert in_sigmas(covariances.joint(asked), expected[np.ix_(within, within)]) < tolerance


def test_what_was_asked_before_does_not_matter():
    graph, values = driven(0.1)
    keys = list(values.keys())
    fresh = Covariances(graph, values).marginal(keys[7])
    asked = Covariances(graph, values)
    for key in reversed(keys):
        asked.marginal(key)[:] = np.nan  # what was handed out is the caller's
    assert np.array_equal(asked.marginal(keys[7]), fresh)


def test_a_variable_that_is_not_in_the_graph_is_refused():
    covariances = Covariances(*driven(0.1))
    with pytest.raises(UnderDetermined, match="no estimate"):
        covariances.marginal(pose_key(0, POSES))
    with pytest.raises(UnderDetermined, match="no estimate"):
        covariances.joint([pose_key(0, 1), pose_key(1, 0)])


def test_a_heading_that_nothing_tells_is_refused():
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(gauge_prior(pose_key(0, 0)))
    values.insert(pose_key(0, 0), Pose2())
    values.insert(pose_key(0, 1), Pose2(1.0, 2.0, 0.3))
    for point in ([4.0, 0.0], [0.0, 5.0], [3.0, 3.0]):  # ranges to three landmarks place it, and do not turn it
        key = landmark_key(len(values.keys()))
        values.insert(key, np.array(point))
        graph.push_back(gtsam.PriorFactorPoint2(key, np.array(point), gtsam.noiseModel.Isotropic.Sigma(2, 0.1)))
        distance = values.atPose2(pose_key(0, 1)).range(np.array(point))
        noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
        graph.push_back(gtsam.RangeFactor2D(pose_key(0, 1), key, distance, noise))
    graph.push_back(
        gtsam.RangeFactorPose2(pose_key(0, 0), pose_key(0, 1), np.sqrt(5), gtsam.noiseModel.Isotropic.Sigma(1, 0.1))
    )
    with pytest.raises(UnderDetermined, match="numerically singular around robot0 pose 1"):
        Covariances(graph, values, ("robot0",)).marginal(pose_key(0, 1))
