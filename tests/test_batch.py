import subprocess
import sys
from pathlib import Path

import gtsam
import numpy as np
import pytest
from leapfrog import ROBOTS, difference, leapfrog
from scipy.linalg import logm
from scipy.optimize import least_squares

from coopslam.errors import UnderDetermined
from coopslam.estimation.batch import Batch, BatchEstimate, solve_batch
from coopslam.estimation.factors import gauge_prior, odometry_leg
from coopslam.estimation.incremental import Incremental
from coopslam.estimation.keys import pose_key
from coopslam.records import CornerDecision, Odometry, RelativePoseFix, WallDecision
from coopslam.se2 import Pose2, rotation, xytheta


def matrix(state):
    result = np.eye(3)
    result[:2, :2], result[:2, 2] = rotation(state[2]), state[:2]
    return result


def relative(a, b):
    """State of b in the frame of a, plain numpy."""
    T = np.linalg.inv(matrix(a)) @ matrix(b)
    return np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])


def logarithm(state):
    """Exponential coordinates of a state; closed form of Eade, Lie Groups for 2D and 3D Transformations (2017)."""
    half = state[2] / 2.0
    a = half / np.tan(half) if abs(half) > 1e-9 else 1.0
    return np.array([a * state[0] + half * state[1], -half * state[0] + a * state[1], state[2]])


def test_the_oracle_s_logarithm_is_scipy_s():
    state = np.array([1.0, -2.0, 0.7])
    np.testing.assert_allclose(logm(matrix(state))[[0, 1, 1], [2, 2, 0]], logarithm(state), atol=1e-12)


def oracle(world, timeline, guess):
    """Our records as a least-squares problem for scipy; diagonal covariances only, weighed in their own axes."""
    keys = list(guess.keys())
    column = {key: 3 * i for i, key in enumerate(keys)}
    terms = []  # (key a, key b, measured state, sigmas, axes of the second pose?)
    current = {robot: 0 for robot in ROBOTS}
    for record in world.records:
        if isinstance(record, Odometry):
            index = ROBOTS.index(record.robot)
            a, b = pose_key(index, current[record.robot]), pose_key(index, current[record.robot] + 1)
            current[record.robot] += 1
            terms.append((a, b, xytheta(record.T_start_now), np.sqrt(np.diag(record.cov_now)), True))
        elif isinstance(record, RelativePoseFix):
            a, b = (pose_key(ROBOTS.index(r), current[r]) for r in (record.observer, record.target))
            terms.append((a, b, xytheta(record.T_observer_target), np.sqrt(np.diag(record.cov_observer)), False))
        elif isinstance(record, CornerDecision):
            seen = record.sighting
            a = pose_key(ROBOTS.index(seen.observer), current[seen.observer])
            b = gtsam.symbol("v", record.vertex)
            terms.append((a, b, xytheta(seen.T_observer_corner), np.sqrt(np.diag(seen.cov_observer)), False))

    def residuals(x):
        state = {key: x[i : i + 3] for key, i in column.items()}
        rows = [state[pose_key(0, 0)] / 1e-6]
        for a, b, measured, sigmas, own_axes in terms:
            predicted = relative(state[a], state[b])
            error = logarithm(relative(measured, predicted))
            if not own_axes:
                error[:2] = rotation(measured[2]) @ error[:2]
            rows.append(error / sigmas)
        for record in world.records:
            if isinstance(record, WallDecision):
                a, b = (state[gtsam.symbol("v", v)] for v in (record.start, record.end))
                along = relative(a, b)
                rows.append(np.array([np.arctan2(along[1], along[0]) / record.straightness_sigma_rad]))
        return np.concatenate(rows)

    x0 = np.concatenate([xytheta(guess.atPose2(key)) for key in keys])
    return column, least_squares(residuals, x0, jac="3-point", x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-12)


def small_world():
    world = leapfrog(np.random.default_rng(5), legs=5, steps=2, corners=3)
    start, end = world.corners[0], world.corners[1]
    bearing = start.bearing(end.translation()).theta()
    # turn corner 0 so that its wall leads to corner 1, in truth and in what was seen of it
    world.corners[0] = start * Pose2(0, 0, bearing)
    for group in world.groups:
        for i, record in enumerate(group):
            if isinstance(record, CornerDecision) and record.vertex == 0:
                seen = record.sighting
                turned = type(seen)(
                    seen.stamp_s,
                    seen.observer,
                    seen.T_observer_corner * Pose2(0, 0, bearing),
                    seen.cov_observer,
                    1.5,
                    0.01,
                )
                group[i] = CornerDecision(record.stamp_s, turned, 0, record.is_new)
    world.groups[-1].append(WallDecision(99.0, 0, 1, 0.01))
    return world


def test_it_agrees_with_scipy_in_values_and_covariances():
    world = small_world()
    estimator = Batch(ROBOTS)
    for group in world.groups:
        estimate = estimator.update(group)
    column, solution = oracle(world, estimator.timeline, estimator.values())
    assert len(column) == 2 + 10 + 3
    assert 0.5 * solution.fun @ solution.fun == pytest.approx(estimator.graph.error(estimator.values()), rel=1e-6)
    cov = np.linalg.inv(solution.jac.T @ solution.jac)
    for key, i in column.items():
        state, pose = solution.x[i : i + 3], estimate.value(key)
        assert difference(pose, Pose2(*state)) < 1e-6
        turn = np.eye(3)
        turn[:2, :2] = rotation(-state[2])
        np.testing.assert_allclose(
            estimate.covariance(key), turn @ cov[i : i + 3, i : i + 3] @ turn.T, rtol=0.05, atol=1e-7
        )
    assert abs(estimate.vertex(0).bearing(estimate.vertex(1).translation()).theta()) < 0.02


def test_the_order_of_records_of_one_instant_does_not_matter():
    world = leapfrog(np.random.default_rng(6), legs=8)
    rng = np.random.default_rng(0)
    shuffled = []
    for group in world.groups:
        chunks = [[]]
        for record in group:
            if isinstance(record, Odometry):
                chunks.append([])
            chunks[-1].append(record)
        for chunk in chunks:
            odometry = [r for r in chunk if isinstance(r, Odometry)]
            rest = [r for r in chunk if not isinstance(r, Odometry)]
            shuffled += odometry + [rest[i] for i in rng.permutation(len(rest))]
    assert [id(r) for r in shuffled] != [id(r) for r in world.records]
    one, other = Batch(ROBOTS).update(world.records), Batch(ROBOTS).update(shuffled)
    assert one.timeline.stamps == other.timeline.stamps
    assert all(difference(one.value(key), other.value(key)) < 1e-6 for key in one.timeline.stamps)


def test_a_world_without_noise_is_found_exactly():
    world = leapfrog(np.random.default_rng(7), legs=20, scale=1e-9)
    estimate = Batch(ROBOTS).update(world.records)
    for robot in ROBOTS:
        poses = estimate.trajectory(robot).poses
        assert len(poses) == len(world.truth[robot].poses)
        assert max(difference(a, b) for a, b in zip(poses, world.truth[robot].poses, strict=True)) < 1e-6
    assert max(difference(estimate.vertex(v), corner) for v, corner in world.corners.items()) < 1e-6


def test_an_untied_variable_is_named_before_solving():
    estimator = Incremental(ROBOTS)
    estimator.update(leapfrog(np.random.default_rng(8), legs=2).records)
    values = estimator.values()
    values.insert(pose_key(1, 99), Pose2())
    with pytest.raises(UnderDetermined, match="robot1 pose 99 appear in no factor"):
        solve_batch(estimator.graph, values, ROBOTS)


def test_covariances_of_a_range_only_pose_are_refused_in_words():
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(gauge_prior(pose_key(0, 0)))
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    for _ in range(3):  # enough equations to count, but all alike
        graph.push_back(gtsam.RangeFactorPose2(pose_key(0, 0), pose_key(1, 0), 1.0, noise))
    values.insert(pose_key(0, 0), Pose2())
    values.insert(pose_key(1, 0), Pose2(1.0, 0.0, 0.3))
    timeline = Incremental(ROBOTS).timeline
    with pytest.raises(UnderDetermined, match="numerically singular around robot. pose 0"):
        BatchEstimate(timeline, graph, values).covariance(pose_key(1, 0))


def long_chain(poses):
    graph, values, cov = gtsam.NonlinearFactorGraph(), gtsam.Values(), np.diag([0.01, 0.01, 0.001]) ** 2
    graph.push_back(gauge_prior(pose_key(0, 0)))
    pose = Pose2()
    for i in range(poses):
        values.insert(pose_key(0, i), pose)
        if i + 1 < poses:
            graph.push_back(odometry_leg(pose_key(0, i), pose_key(0, i + 1), Pose2(0.1, 0.0, 0.01), cov))
            pose = pose * Pose2(0.1, 0.001, 0.01)
    return graph, values


@pytest.mark.parametrize("poses", [3_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_a_long_chain_is_solved_with_covariances(poses):
    graph, values = long_chain(poses)
    solution = solve_batch(graph, values)
    assert graph.error(solution) < 1e-6
    timeline = Incremental(("robot0",)).timeline
    estimate = BatchEstimate(timeline, graph, solution)
    heading_variance = estimate.covariance(pose_key(0, poses - 1))[2, 2]
    assert heading_variance == pytest.approx((poses - 1) * 1e-6, rel=1e-3)  # a random walk


def straight_and_turn(poses, rng):
    """Legs whose sigmas are 10^6 apart, a guess half a metre off, and loops: bare Cholesky never leaves the guess."""
    graph, values, pose = gtsam.NonlinearFactorGraph(), gtsam.Values(), Pose2()
    graph.push_back(gauge_prior(pose_key(0, 0)))
    truth = [pose]
    for i in range(1, poses):
        turns = i % 2 == 0
        delta = Pose2(0, 0, rng.normal()) if turns else Pose2(1 + rng.random(), 0, 0)
        sigmas = np.array([1e-6, 1e-6, 0.1] if turns else [1.0, 0.5, 1e-6])
        truth.append(truth[-1] * delta)
        measured = delta * Pose2(*(rng.standard_normal(3) * sigmas))
        graph.push_back(odometry_leg(pose_key(0, i - 1), pose_key(0, i), measured, np.diag(sigmas) ** 2))
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.05)
    for i in range(0, poses - 9, 7):
        a, b = truth[i], truth[i + 9]
        measured = a.between(b) * Pose2(*(rng.standard_normal(3) * 0.05))
        graph.push_back(gtsam.BetweenFactorPose2(pose_key(0, i), pose_key(0, i + 9), measured, noise))
    for i, pose in enumerate(truth):
        values.insert(pose_key(0, i), pose * Pose2(*(0.5 * rng.standard_normal(3) * (i > 0))))
    return graph, values


def newton_step_in_sigmas(graph, values):
    """sqrt(g' H^-1 g), which no variable's way to the minimum exceeds in its sigmas; numpy's QR of the Jacobian."""
    ordering = gtsam.Ordering()
    for key in values.keys():  # noqa: SIM118 - Values is no dict
        ordering.push_back(key)
    jacobian, rest = graph.linearize(values).jacobian(ordering)
    return np.linalg.norm(np.linalg.qr(jacobian)[0].T @ rest)


def bare(graph, initial, solver="MULTIFRONTAL_CHOLESKY", tolerance=1e-9):
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType(solver)
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(tolerance)
    return gtsam.LevenbergMarquardtOptimizer(graph, initial, parameters).optimize()


@pytest.mark.parametrize("large", [60, 0])  # variables from which the faster Cholesky is tried first
def test_sigmas_far_apart_are_solved_where_cholesky_gives_up(large, monkeypatch):
    monkeypatch.setattr("coopslam.estimation.batch._LARGE", large)
    graph, initial = straight_and_turn(60, np.random.default_rng(3))
    assert graph.error(bare(graph, initial)) > 1e6
    solution = solve_batch(graph, initial)
    # a relative change of the cost of 1e-9, as between the last two iterations, is 4e-5 sigma for a cost of 1
    assert newton_step_in_sigmas(graph, solution) < 1e-3
    expected = bare(graph, initial, "MULTIFRONTAL_QR", 1e-12)
    assert max(difference(solution.atPose2(key), expected.atPose2(key)) for key in expected.keys()) < 1e-4  # noqa: SIM118


@pytest.mark.parametrize("large", [1000, 0])
def test_robust_losses_stop_within_the_promised_part_of_a_sigma(large, monkeypatch):
    monkeypatch.setattr("coopslam.estimation.batch._LARGE", large)
    rng = np.random.default_rng(1)
    graph, initial, truth = gtsam.NonlinearFactorGraph(), gtsam.Values(), Pose2()
    graph.push_back(gauge_prior(pose_key(0, 0)))
    beacons = rng.uniform(-10, 10, size=(4, 2))
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(1.0)
    noise = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05, 0.15])))
    step = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.1, 0.1]))
    for i in range(100):
        if i:
            delta = Pose2(0.3, 0, 0.05)
            truth = truth * delta
            measured = delta * Pose2(*(rng.standard_normal(3) * 0.1))
            graph.push_back(gtsam.BetweenFactorPose2(pose_key(0, i - 1), pose_key(0, i), measured, step))
        initial.insert(pose_key(0, i), truth * Pose2(*(0.1 * rng.standard_normal(3))))
        for number, beacon in enumerate(beacons):
            factor = (truth.bearing(beacon), truth.range(beacon))
            wrong = rng.standard_normal(2) * (1.0 if rng.random() < 0.3 else 0.1)  # a third is false
            bearing = gtsam.Rot2(factor[0].theta() + wrong[0])
            key = gtsam.symbol("l", number)
            graph.push_back(gtsam.BearingRangeFactor2D(pose_key(0, i), key, bearing, factor[1] + wrong[1], noise))
    for number, beacon in enumerate(beacons):
        initial.insert(gtsam.symbol("l", number), beacon + 0.1 * rng.standard_normal(2))
    solution = solve_batch(graph, initial)
    best = bare(graph, solution, "MULTIFRONTAL_QR", 1e-14)
    way = solution.localCoordinates(best)
    marginals = gtsam.Marginals(graph, best)
    # GTSAM's marginals: of the losses linearized at the minimum
    far = [way.at(key) @ marginals.marginalInformation(key) @ way.at(key) for key in best.keys()]  # noqa: SIM118
    assert 0 < np.sqrt(max(far)) < 0.05


CHAIN_ON_A_SMALL_STACK = """
import resource, sys
resource.setrlimit(resource.RLIMIT_STACK, (1 << 20, resource.getrlimit(resource.RLIMIT_STACK)[1]))
sys.path[:0] = [{benchmarks!r}]
import numpy as np
from long_chain import pose_key, two_robots
from coopslam.estimation.batch import solve_batch
from coopslam.estimation.covariances import Covariances
graph, initial = two_robots(30_000, 5, np.random.default_rng(0))
values = solve_batch(graph, initial)
covariances = Covariances(graph, values)
covariances.marginals([pose_key(1, i) for i in range(0, 15_000, 150)])
covariances.joint([pose_key(0, 14_999), pose_key(1, 14_999)])
print(2 * graph.error(values))
del covariances, values, initial, graph
"""


def test_a_long_run_of_two_robots_needs_no_more_than_a_small_stack():
    benchmarks = str(Path(__file__).parents[1] / "scripts" / "benchmarks")
    script = CHAIN_ON_A_SMALL_STACK.format(benchmarks=benchmarks)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    dof = 3 * 3000 - 3  # of the fixes, less the other robot's first pose
    assert float(done.stdout) == pytest.approx(dof, abs=4 * np.sqrt(2 * dof))  # four sigmas of a chi-square
