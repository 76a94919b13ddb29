import numpy as np
import pytest
from leapfrog import ROBOTS, leapfrog

from coopslam.errors import BadInput, UnderDetermined
from coopslam.estimation.batch import Batch, solve_batch
from coopslam.estimation.covariances import Covariances
from coopslam.evaluation.bound import bound_rmse_aligned
from coopslam.evaluation.trajectory_error import vertex_rmse
from coopslam.se2 import position, rotation


def case(seed, scale=0.3):
    world = leapfrog(np.random.default_rng(seed), legs=8, steps=2, scale=scale)
    estimator = Batch(ROBOTS)
    estimator.update(world.records)
    truth = world.values(estimator.timeline, estimator.values().keys())
    keys = [key for track in estimator.timeline.tracks.values() for key in track.keys]
    return estimator, truth, keys


def dense_bound(graph, truth, keys):
    """The same from the dense joint covariance of the stacked positions and a projector by QR."""
    joint, n = Covariances(graph, truth).joint(keys), len(keys)
    poses = [truth.atPose2(key) for key in keys]
    to_world = np.zeros((2 * n, 3 * n))
    for i, pose in enumerate(poses):
        to_world[2 * i : 2 * i + 2, 3 * i : 3 * i + 2] = rotation(pose.theta())
    cov = to_world @ joint @ to_world.T
    points = np.array([position(pose) for pose in poses])
    turn = np.column_stack([-points[:, 1], points[:, 0]]).ravel()
    motions, _ = np.linalg.qr(np.column_stack([np.tile([1.0, 0.0], n), np.tile([0.0, 1.0], n), turn]))
    residual = np.eye(2 * n) - motions @ motions.T
    return np.sqrt(np.trace(residual @ cov) / n)


def test_it_is_the_dense_computation():
    estimator, truth, keys = case(0)
    for chosen in (keys, keys[5:], keys[::3]):
        assert bound_rmse_aligned(estimator.graph, truth, chosen) == pytest.approx(
            dense_bound(estimator.graph, truth, chosen), rel=1e-6
        )


def test_the_smoother_reaches_it():
    """Mean over 300 runs on one path; the mean of squared errors scatters by some 3 %."""
    ratios = []
    for seed in range(300):
        estimator, truth, keys = case(seed)
        bound = bound_rmse_aligned(estimator.graph, truth, keys)
        values = solve_batch(estimator.graph, truth)
        estimated = np.array([position(values.atPose2(key)) for key in keys])
        error = vertex_rmse(estimated, np.array([position(truth.atPose2(key)) for key in keys]))
        ratios.append((error / bound) ** 2)
    deviation = np.std(ratios) / np.sqrt(len(ratios))
    assert abs(np.mean(ratios) - 1.0) < 3.3 * deviation < 0.15


def test_what_has_no_bound_is_refused():
    estimator, truth, keys = case(1)
    with pytest.raises(BadInput, match="2 or more"):
        bound_rmse_aligned(estimator.graph, truth, keys[:1])
    free = estimator.graph.clone()
    free.remove(next(i for i in range(free.size()) if len(free.at(i).keys()) == 1))
    with pytest.raises(UnderDetermined):
        bound_rmse_aligned(free, truth, keys)
