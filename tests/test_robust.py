import gtsam
import numpy as np
import pytest
from false_sightings import Sightings
from leapfrog import FIX_COV, ROBOTS, difference

from coopslam.errors import BadInput
from coopslam.estimation.batch import BatchEstimate, solve_batch
from coopslam.estimation.gate import GateSettings
from coopslam.estimation.incremental import Incremental
from coopslam.estimation.keys import pose_key, robot_index, vertex_key
from coopslam.estimation.robust import RobustSettings, is_tracker_fix, solve_robust, truncated_weights
from coopslam.evaluation.consistency import chi_square_band, pose_nees
from coopslam.records import RelativePoseFix
from coopslam.se2 import Pose2, position

OFF = GateSettings(distance_sq_max=np.inf)
LIMIT = RobustSettings().distance_sq_max


def run(groups, gate=None):
    estimator = Incremental(ROBOTS, gate=gate)
    for group in groups:
        estimator.update(group)
    return estimator


def smoothed(estimator):
    return solve_robust(estimator.graph, estimator.timeline.refused, estimator.values(), ROBOTS)


def without_false(log, estimator):
    """Values of least cost with exactly the good fixes: what somebody who knows would do."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in [*factors_of(estimator.graph), *estimator.timeline.refused]:
        if not is_false(log, factor):
            graph.push_back(factor)
    return solve_batch(graph, estimator.values())


def factors_of(graph):
    return [graph.at(i) for i in range(graph.size())]


def is_false(log, factor):
    return is_tracker_fix(factor) and any(
        log.is_false(record) and factor.measured().equals(record.T_observer_target, 1e-12)
        for record in log.world.records
        if isinstance(record, RelativePoseFix)
    )


def position_errors(log, timeline, values):
    """(N,) m, of all pose variables."""
    truth = log.world.values(timeline, timeline.stamps)
    return np.array([np.hypot(*(position(values.atPose2(k)) - position(truth.atPose2(k)))) for k in timeline.stamps])


def farthest(one, other):
    """Largest difference of all poses, m or rad."""
    assert one.size() == other.size()
    return max(difference(one.atPose2(key), other.atPose2(key)) for key in list(other.keys()))


def rms(errors):
    return np.sqrt(np.mean(np.square(errors)))


@pytest.mark.parametrize("odometry_factor", [1.0, 10.0])
def test_without_reflections_it_is_the_plain_solution(odometry_factor):
    estimator = run(Sightings(np.random.default_rng(1), 20, odometry_factor=odometry_factor).clean.groups)
    solution, plain = smoothed(estimator), solve_batch(estimator.graph, estimator.values())
    assert (solution.outliers, solution.thrown_out, solution.taken_back, solution.steps) == ([], 0, 0, 0)
    assert solution.graph is estimator.graph
    assert farthest(solution.values, plain) == 0.0


@pytest.mark.parametrize(("odometry_factor", "share"), [(1.0, 0.1), (1.0, 0.2), (10.0, 0.1), (10.0, 0.2)])
def test_errors_are_those_of_somebody_who_knows_which_fixes_are_false(odometry_factor, share):
    ours, best, clean = [], [], []
    for seed in range(10):
        log = Sightings(np.random.default_rng(seed), 15, share, 0.2, odometry_factor)
        estimator = run(log.world.groups)
        ours.append(rms(position_errors(log, estimator.timeline, smoothed(estimator).values)))
        best.append(rms(position_errors(log, estimator.timeline, without_false(log, estimator))))
        undisturbed = run(log.clean.groups, OFF)
        clean.append(rms(position_errors(log, undisturbed.timeline, undisturbed.values())))
    assert rms(ours) < 1.05 * rms(best)
    if odometry_factor == 1.0:  # a pose that only nearly absent odometry ties is bad whatever one does with reflections
        assert rms(ours) < 1.5 * rms(clean)


@pytest.mark.parametrize("odometry_factor", [1.0, 3.0])
def test_covariances_are_honest_with_reflections_about(odometry_factor):
    """One pose of each run: a 99.9 % band."""
    scores = []
    for seed in range(80):
        log = Sightings(np.random.default_rng(700 + seed), 6, 0.2, 0.2, odometry_factor)
        estimator = run(log.world.groups)
        solution = smoothed(estimator)
        belief = BatchEstimate(estimator.timeline, solution.graph, solution.values).belief("robot1")
        scores += list(pose_nees([belief.T_world_body], belief.cov_body[None], [log.truth["robot1"].poses[-1]]))
    low, high = chi_square_band(3, len(scores), confidence=0.999)
    assert low < np.mean(scores) < high


def test_good_fixes_that_were_refused_come_back():
    """A gate that is far too tight refuses many; the final smoothing is the one of all."""
    log = Sightings(np.random.default_rng(2), 12)
    narrow, ungated = run(log.clean.groups, GateSettings(distance_sq_max=4.0)), run(log.clean.groups, OFF)
    refused = len(narrow.timeline.refused)
    assert refused > 10
    solution, expected = smoothed(narrow), solve_batch(ungated.graph, ungated.values())
    assert (solution.taken_back, solution.thrown_out, solution.outliers) == (refused, 0, [])
    assert farthest(solution.values, expected) < 1e-5


def test_false_fixes_that_passed_are_thrown_out():
    """No gate at all: the start is what reflections made of it."""
    log = Sightings(np.random.default_rng(3), 12, 0.2)
    estimator = run(log.world.groups, OFF)
    false = [factor for factor in factors_of(estimator.graph) if is_false(log, factor)]
    solution, expected = smoothed(estimator), without_false(log, estimator)
    assert solution.thrown_out == len(solution.outliers) == len(false) > 10
    assert all(is_false(log, factor) for factor in solution.outliers)
    assert not any(is_false(log, factor) for factor in factors_of(solution.graph))
    assert farthest(solution.values, expected) < 1e-5


@pytest.mark.parametrize("odometry_factor", [1.0, 10.0])
def test_a_robot_that_a_reflection_placed_is_found(odometry_factor):
    """The very first fix is false and alone, so it is taken as it is."""
    for seed in range(5):
        log = Sightings(np.random.default_rng(seed), 12, 0.1, 0.2, odometry_factor)
        ghost = log.reflection(log.clean.groups[0][0], np.random.default_rng(seed))
        log.world.groups[0] = [ghost]
        estimator = run(log.world.groups)
        solution, expected = smoothed(estimator), without_false(log, estimator)
        assert solution.thrown_out >= 1
        assert not any(is_false(log, factor) for factor in factors_of(solution.graph))
        assert farthest(solution.values, expected) < 1e-5


def test_it_decides_as_gtsam_s_own_optimizer_does():
    log = Sightings(np.random.default_rng(4), 8, 0.2, 0.2, 10.0)
    estimator = run(log.world.groups)
    factors = factors_of(estimator.graph)
    known = [factor for factor in factors if not is_tracker_fix(factor)]
    fixes = [factor for factor in factors if is_tracker_fix(factor)] + estimator.timeline.refused
    graph = gtsam.NonlinearFactorGraph()
    for factor in known + fixes:
        graph.push_back(factor)
    base = gtsam.LevenbergMarquardtParams()
    base.setLinearSolverType("MULTIFRONTAL_QR")
    parameters = gtsam.GncLMParams(base)
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(range(len(known))))
    optimizer = gtsam.GncLMOptimizer(graph, solve_batch(estimator.graph, estimator.values()), parameters)
    optimizer.setInlierCostThresholds(LIMIT / 2)  # of half the square
    theirs = optimizer.optimize()
    outliers = [
        factor for factor, weight in zip(fixes, optimizer.getWeights()[len(known) :], strict=True) if weight < 1
    ]
    solution = smoothed(estimator)
    assert len(solution.outliers) > 5
    assert sorted(map(measured, solution.outliers)) == sorted(map(measured, outliers))
    assert farthest(solution.values, theirs) < 1e-4


def measured(factor):
    return factor.measured().x(), factor.measured().y()


def test_a_refused_fix_of_a_robot_that_was_never_placed_stays_out():
    estimator = Incremental(ROBOTS)
    contradictory = [RelativePoseFix(0.0, *ROBOTS, Pose2(x, 0.0, 0.0), FIX_COV) for x in (1.0, 3.0)]
    estimator.update(contradictory)
    solution = smoothed(estimator)
    assert len(solution.outliers) == 2 and solution.values.size() == 1


def test_weights_are_those_of_the_paper():
    """Zero or one beyond two borders, where they are continuous; for a large mu the step of the truncated square."""
    mu = 0.5
    low, high = LIMIT * mu / (mu + 1), LIMIT * (mu + 1) / mu
    weights = truncated_weights(np.array([0.0, low, low * (1 + 1e-9), high * (1 - 1e-9), high, 1e9]), LIMIT, mu)
    np.testing.assert_allclose(weights, [1.0, 1.0, 1.0, 0.0, 0.0, 0.0], atol=1e-8)
    np.testing.assert_array_equal(truncated_weights(LIMIT * np.array([0.999, 1.001]), LIMIT, 1e6), [1.0, 0.0])
    # Black and Rangarajan (1996): the weight minimizes w r^2 + mu (1 - w) / (mu + w) c^2
    square = 0.5 * (low + high)
    candidates = np.linspace(0.0, 1.0, 100_001)
    cost = candidates * square + mu * (1 - candidates) / (mu + candidates) * LIMIT
    assert truncated_weights(np.array([square]), LIMIT, mu)[0] == pytest.approx(candidates[np.argmin(cost)], abs=2e-5)


def test_only_full_poses_between_robots_are_in_question():
    noise = gtsam.noiseModel.Unit.Create(3)
    a, b, v = pose_key(0, 3), pose_key(1, 2), vertex_key(5)
    assert (robot_index(a), robot_index(b), robot_index(v)) == (0, 1, None)
    assert is_tracker_fix(gtsam.BetweenFactorPose2(a, b, Pose2(), noise))
    assert not is_tracker_fix(gtsam.BetweenFactorPose2(a, pose_key(0, 4), Pose2(), noise))
    assert not is_tracker_fix(gtsam.BetweenFactorPose2(a, v, Pose2(), noise))
    assert not is_tracker_fix(gtsam.RangeFactorPose2(a, b, 1.0, gtsam.noiseModel.Unit.Create(1)))


def test_nonsense_settings_are_refused():
    for nonsense in (
        {"distance_sq_max": 0.0},
        {"mu_factor": 1.0},
        {"mu_factor": 1e3},
        {"iterations": 0},
        {"iterations": 10**4},
    ):
        with pytest.raises(BadInput, match=next(iter(nonsense))):
            RobustSettings(**nonsense)


@pytest.mark.parametrize("by_bearing", [False, True])
def test_where_no_fix_would_be_left_those_of_the_graph_stay(by_bearing):
    """Two fixes of the same poses, metres apart: at most one is true, at their mean neither fits.

    by_bearing: a bearing and range, too little to hold the other robot, though its equations are enough to count.
    """
    a, b = pose_key(0, 0), pose_key(1, 0)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(gtsam.PriorFactorPose2(a, Pose2(), noise))
    for x in (1.0, 3.0):
        graph.push_back(gtsam.BetweenFactorPose2(a, b, Pose2(x, 0, 0), noise))
    if by_bearing:
        for _ in range(2):
            weak = gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
            graph.push_back(gtsam.BearingRangeFactorPose2(a, b, gtsam.Rot2(0.0), 2.0, weak))
    initial.insert(a, Pose2())
    initial.insert(b, Pose2(2, 0, 0))
    solution = solve_robust(graph, [], initial)
    assert solution.thrown_out == 0 and solution.graph.size() == graph.size()
    assert solution.values.atPose2(b).equals(Pose2(2, 0, 0), 1e-6)
