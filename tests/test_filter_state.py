"""The state's arithmetic against dense matrices and numeric derivatives."""

import numpy as np
import pytest

from coopslam.estimation.filter_state import FilterState, in_frame_axes, in_own_axes
from coopslam.se2 import Pose2, adjoint, chain_covariance, xytheta

COV = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]])
STEP = Pose2(1.2, -0.4, 0.7)


def state_of(*means):
    """Poses 0, 1, .. that are correlated with each other."""
    state, rng = FilterState(), np.random.default_rng(len(means))
    for key, mean in enumerate(means):
        state.add(key, np.asarray(mean, float), np.eye(len(mean)))
    root = rng.normal(size=(state.size, state.size)) * 0.1
    state.cov[:] = root @ root.T + 0.01 * np.eye(state.size)
    return state


def test_driving_carries_covariances_with_the_adjoint():
    state = state_of([1.0, 2.0, 0.5], [3.0, -1.0, -2.0])
    joint, pose = state.joint([0, 1]), state.pose(0)
    state.drive(0, 7, STEP, COV)
    carry = np.kron(np.diag([1, 0]), adjoint(STEP.inverse())) + np.kron(np.diag([0, 1]), np.eye(3))
    expected = carry @ joint @ carry.T
    expected[:3, :3] += COV
    assert 0 not in state and state.pose(7).equals(pose * STEP, 1e-12)
    np.testing.assert_allclose(state.joint([7, 1]), expected, atol=1e-12)
    np.testing.assert_allclose(state.covariance(7), chain_covariance(STEP, joint[:3, :3], COV), atol=1e-12)


def test_new_poses_hang_on_their_base():
    state = state_of([1.0, 2.0, 0.5], [3.0, -1.0, -2.0])
    joint, others = state.joint([0, 1]), (Pose2(0.3, 1.0, 2.0), STEP)
    own = np.kron([[1.0, 0.3], [0.3, 1.0]], COV)
    state.add_poses([5, 6], 1, others, own)
    carry = np.zeros((12, 6))
    carry[:6], carry[6:9, 3:], carry[9:, 3:] = np.eye(6), adjoint(others[0].inverse()), adjoint(others[1].inverse())
    expected = carry @ joint @ carry.T
    expected[6:, 6:] += own
    np.testing.assert_allclose(state.joint([0, 1, 5, 6]), expected, atol=1e-12)
    assert state.pose(6).equals(state.pose(1) * STEP, 1e-12)


def test_a_new_point_hangs_on_its_base():
    state, point, cov = state_of([1.0, 2.0, 0.5]), np.array([2.0, -1.0]), COV[:2, :2]
    before = state.covariance(0)
    state.add_point(9, 0, point, cov)

    def place(error):
        return (Pose2(1.0, 2.0, 0.5) * Pose2(*error)).transformFrom(point)

    steps = np.eye(3) * 1e-6
    carry = np.stack([(place(step) - place(-step)) / 2e-6 for step in steps], axis=1)
    turn = Pose2(1.0, 2.0, 0.5).rotation().matrix()
    np.testing.assert_allclose(state.mean(9), place(np.zeros(3)), atol=1e-12)
    np.testing.assert_allclose(state.covariance(9), carry @ before @ carry.T + turn @ cov @ turn.T, atol=1e-9)


def test_a_correction_is_the_kalman_update_of_dense_matrices():
    state = state_of([1.0, 2.0, 0.5], [3.0, -1.0, -2.0], [0.5, 0.5])
    rng = np.random.default_rng(2)
    H_pose, H_point, R, miss = rng.normal(size=(2, 3)), rng.normal(size=(2, 2)), np.eye(2) * 0.01, np.full(2, 1e-6)
    H = np.hstack([np.zeros((2, 3)), H_pose, H_point])
    P, mean = state.cov.copy(), np.concatenate([state.mean(key) for key in (0, 1, 2)])
    across, spread = state.spread([state.place(1), state.place(2)], [H_pose, H_point])
    S = spread + R
    state.correct(across, S, np.linalg.inv(S), miss)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    rest = np.eye(8) - gain @ H
    np.testing.assert_allclose(state.cov, rest @ P @ rest.T + gain @ R @ gain.T, atol=1e-14)  # Joseph
    np.testing.assert_allclose(np.concatenate([state.mean(key) for key in (0, 1, 2)]), mean + gain @ miss, atol=1e-14)
    np.testing.assert_array_equal(state.cov, state.cov.T)


def test_a_turn_of_everything_is_as_uncertain_after_a_large_correction_as_before():
    """N' P^-1 N for the turn about the origin, N = (-y, x, 1) of poses and (-y, x) of points."""
    state = FilterState()
    state.add(0, np.array([2.0, 1.0, 0.3]), np.diag([0.1, 0.2, 0.3]))
    state.add_poses([1], 0, [Pose2(3.0, -2.0, 1.0)], np.diag([0.5, 0.3, 0.2]))
    state.add_point(2, 1, np.array([4.0, 1.0]), np.diag([0.2, 0.6]))

    def turn():
        means = [state.mean(key) for key in (0, 1, 2)]
        return np.concatenate([[-mean[1], mean[0], 1.0][: len(mean)] for mean in means])

    def known():
        return turn() @ np.linalg.solve(state.cov, turn())

    before = known()
    jacobian = np.eye(3)[:2]
    rows = [state.place(1), state.place(2)]
    arm = state.mean(2) - state.mean(1)[:2]
    jacobian[:, 2] = -arm[1], arm[0]  # a turn of all leaves the point where the pose sees it
    across, spread = state.spread(rows, [jacobian, -np.eye(2)])
    S = spread + np.eye(2) * 1e-4
    state.correct(across, S, np.linalg.inv(S), np.array([0.7, -0.5]))
    assert known() == pytest.approx(before, rel=1e-9)


def test_a_copy_has_the_same_errors_until_it_drives():
    state = state_of([1.0, 2.0, 0.5], [3.0, -1.0, -2.0])
    joint = state.joint([0, 1])
    state.clone(0, 4)
    np.testing.assert_allclose(state.joint([4, 1]), joint, atol=1e-15)
    np.testing.assert_allclose(state.joint([0, 4])[:3, 3:], joint[:3, :3], atol=1e-15)
    state.drive(4, 4, STEP, COV)
    state.clone(4, 5, instead_of=0)
    assert 0 not in state and state.size == 9
    np.testing.assert_allclose(state.joint([4, 5])[3:, 3:], chain_covariance(STEP, joint[:3, :3], COV), atol=1e-12)


def test_arrays_that_double_lose_nothing():
    state, expected = FilterState(), []
    state.add(0, np.array([0.0, 0.0, 0.1]), COV)
    for key in range(1, 100):
        if key % 3:
            state.add_poses([key], key - key % 3, [Pose2(0.1 * key, 1.0, 0.2)], COV / key)
        else:
            state.add(key, np.array([1.0, 2.0, 0.01 * key]), COV)
        expected.append((key, state.mean(key).copy(), state.covariance(key)))
    assert state.size == 300
    for key, mean, cov in expected:
        np.testing.assert_array_equal(state.mean(key), mean)
        np.testing.assert_array_equal(state.covariance(key), cov)


def test_axes_there_and_back():
    mean = xytheta(STEP)
    np.testing.assert_allclose(in_own_axes(mean, in_frame_axes(mean, COV)), COV, atol=1e-15)
    turn = STEP.rotation().matrix()
    np.testing.assert_allclose(in_frame_axes(mean, COV)[:2, :2], turn @ COV[:2, :2] @ turn.T, atol=1e-15)
    np.testing.assert_array_equal(in_own_axes(mean[:2], COV[:2, :2]), COV[:2, :2])
