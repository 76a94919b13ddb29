import gtsam
import numpy as np
import pytest

from coopslam.estimation.keys import landmark_key, pose_key
from coopslam.estimation.marginal_prior import eliminated
from coopslam.se2 import Pose2


def test_the_prior_is_the_schur_complement_and_its_derivative_the_numeric_one():
    rng = np.random.default_rng(5)
    keys = (landmark_key(0), landmark_key(1), pose_key(0, 1), pose_key(1, 2), pose_key(0, 0))
    values, linear = gtsam.Values(), gtsam.GaussianFactorGraph()
    for key in keys[:2]:
        values.insert(key, rng.normal(size=2))
    for key in keys[2:]:
        values.insert(key, Pose2(*rng.normal(size=3)))
    for a, b in zip(keys, keys[1:] + keys[:1], strict=True):
        sizes = [2 if key in keys[:2] else 3 for key in (a, b)]
        linear.add(a, rng.normal(size=(4, sizes[0])), b, rng.normal(size=(4, sizes[1])), rng.normal(size=4))
    prior = eliminated(linear, values, [keys[-1]])
    ordering, remaining = gtsam.Ordering(), gtsam.Ordering()
    for key in (keys[-1], *prior.chart.keys):
        ordering.push_back(key)
    for key in prior.chart.keys:
        remaining.push_back(key)
    information, vector = linear.hessian(ordering)
    gain = information[3:, :3] @ np.linalg.inv(information[:3, :3])
    again = gtsam.GaussianFactorGraph()
    again.push_back(prior.linearized(values))
    ours = again.hessian(remaining)
    np.testing.assert_allclose(ours[0], information[3:, 3:] - gain @ information[:3, 3:], atol=1e-9)
    np.testing.assert_allclose(ours[1], vector[3:] - gain @ vector[:3], atol=1e-9)

    moved = values.retract(_step(prior, rng.normal(size=10) * 0.5))  # far from where it was linearized
    again = gtsam.GaussianFactorGraph()
    again.push_back(prior.linearized(moved))
    _, slope = again.hessian(remaining)
    for i, direction in enumerate(np.eye(10) * 1e-5):
        ahead, behind = (prior.cost(moved.retract(_step(prior, sign * direction))) for sign in (1, -1))
        assert (ahead - behind) / 2e-5 == pytest.approx(-slope[i], rel=1e-5, abs=1e-6)


def _step(prior, vector):
    """Of all variables of a prior, in the order of its keys."""
    step, ends = gtsam.VectorValues(), np.cumsum(prior.chart.sizes)
    for key, size, end in zip(prior.chart.keys, prior.chart.sizes, ends, strict=True):
        step.insert(key, vector[end - size : end])
    return step
