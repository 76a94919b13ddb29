import numpy as np
import pytest
from scipy.integrate import solve_ivp

from coopslam.errors import BadInput
from coopslam.io.velocity_commands import CommandNoise, Walk, odometry_of_commands
from coopslam.se2 import Pose2, compose_leg, xytheta

NOISE = CommandNoise()
NOTHING = np.array([])


def steps_of(commands, period_s=0.1, longest_gap_s=2.0, needed_s=NOTHING, noise=NOISE):
    return odometry_of_commands("a", np.asarray(commands, float), noise, period_s, longest_gap_s, np.asarray(needed_s))


def leg(steps):
    return compose_leg([step.T_start_now for step in steps], [step.cov_now for step in steps])


def random_commands(seed, count=200):
    rng = np.random.default_rng(seed)
    stamps = 1.2e9 + np.cumsum(rng.uniform(0.005, 0.3, count))
    commands = np.round(rng.uniform([-0.2, -1.0], [0.6, 1.0], (count, 2)), 1)
    commands[rng.random(count) < 0.3] = 0.0
    return np.column_stack([stamps, np.repeat(commands[::2], 2, axis=0)])


@pytest.mark.parametrize("seed", range(3))
def test_composed_arcs_are_what_the_differential_equation_says(seed):
    commands = random_commands(seed, 60)
    pose = np.zeros(3)
    for (start, v, w), (end, _, _) in zip(commands[:-1], commands[1:], strict=True):

        def motion(_, q, v=v, w=w):
            return [v * np.cos(q[2]), v * np.sin(q[2]), w]

        pose = solve_ivp(motion, (0, end - start), pose, rtol=1e-10, atol=1e-12).y[:, -1]
    total, _ = leg(steps_of(commands)[0])
    assert total.equals(Pose2(*pose), 1e-8)


def test_steps_follow_each_other_and_are_short():
    commands = random_commands(7)
    steps, unknown = steps_of(commands)
    assert unknown == 0
    assert steps[0].start_s == commands[0, 0]
    assert steps[-1].stamp_s == commands[-1, 0]
    assert [step.start_s for step in steps[1:]] == [step.stamp_s for step in steps[:-1]]
    lengths = [step.stamp_s - step.start_s for step in steps if step.cov_now.any()]
    assert max(lengths) <= 0.1 + 1e-6  # stamps of 1e9 s are exact to 2e-7
    assert len(lengths) <= (commands[-1, 0] - commands[0, 0]) / 0.1 + len(commands)


def test_a_robot_that_stands_has_one_record_without_error():
    rows = [[0, 0.2, 0], [1, 0, 0], [1.5, 0, 0], [2.5, 0, 0], [4, 0, -0.3], [4.2, 0, 0]]
    steps, _ = steps_of(rows)
    (standing,) = [step for step in steps if not step.cov_now.any()]
    assert (standing.start_s, standing.stamp_s) == (1, 4)
    assert not xytheta(standing.T_start_now).any()
    assert len(steps) == 10 + 1 + 2


def test_covariance_of_a_straight_drive_in_closed_form():
    noise = CommandNoise(Walk(0.1, 9, 0.05), Walk(0.2, 9, 0.06), Walk(0.3, 9, 0.07))
    _, cov = leg(steps_of([[0, 0.5, 0], [4, 0.5, 0]], longest_gap_s=10, noise=noise)[0])  # 2 m in 4 s
    q = (0.3**2 * 2 + 0.07**2 * 4) / 2  # rad^2 per m
    x, y = 0.1**2 * 2 + 0.05**2 * 4, 0.2**2 * 2 + 0.06**2 * 4
    expected = [[x, 0, 0], [0, y + q * 2**3 / 3, q * 2**2 / 2], [0, q * 2**2 / 2, q * 2]]
    np.testing.assert_allclose(cov, expected, rtol=1e-9, atol=1e-15)


def test_covariance_does_not_depend_on_how_often_commands_are_logged_or_composed():
    turning = [[t, 0.4, 0.8] for t in np.arange(0, 3.01, 0.02)]
    rarely = [[0, 0.4, 0.8], [1.5, 0.4, 0.8], [3.0, 0.4, 0.8]]
    _, expected = leg(steps_of(turning, period_s=0.02)[0])
    for commands, period_s in ((rarely, 0.02), (turning, 0.1), (turning, 0.35), (rarely, 0.1)):
        _, cov = leg(steps_of(commands, period_s=period_s)[0])
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.abs((cov - expected) / scale).max() <= (0.8 * period_s) ** 2 / 8  # a chord for an arc: second order


def test_covariance_against_a_thousand_robots():
    """Plain numpy: every robot drives the commands with its own noise, and the spread of where it ends is compared."""
    noise = CommandNoise(Walk(0.03, 0.01, 0.01), Walk(0.02, 0.02, 0.01), Walk(0.03, 0.05, 0.02))
    commands = [[0, 0.5, 0], [1, 0.3, 1.2], [2, -0.2, -0.5], [3, 0, 0.7], [4, 0, 0]]
    rng, robots, dt = np.random.default_rng(3), 4000, 0.01
    pose, true = np.zeros((robots, 3)), np.zeros(3)
    for (start, v, w), (end, _, _) in zip(commands[:-1], commands[1:], strict=True):
        variance = np.array([0.03, 0.02, 0.03]) ** 2 * abs(v) + np.array([0.01, 0.01, 0.02]) ** 2
        variance += np.array([0.01, 0.02, 0.05]) ** 2 * abs(w)
        for _ in range(round((end - start) / dt)):
            step = [v * dt, 0, w * dt] + rng.normal(size=(robots, 3)) * np.sqrt(variance * dt)
            for q, u in ((pose, step), (true[None], np.array([[v * dt, 0, w * dt]]))):
                heading = q[:, 2] + u[:, 2] / 2
                q[:, 0] += u[:, 0] * np.cos(heading) - u[:, 1] * np.sin(heading)
                q[:, 1] += u[:, 0] * np.sin(heading) + u[:, 1] * np.cos(heading)
                q[:, 2] += u[:, 2]
    c, s = np.cos(true[2]), np.sin(true[2])
    error = (pose - true) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    sampled = np.cov(error.T)
    _, cov = leg(steps_of(commands, noise=noise)[0])
    scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
    assert np.abs((cov - sampled) / scale).max() < 0.08  # 3.5 standard deviations of a variance of 4000 samples


def test_where_nothing_was_logged_the_motion_is_unknown():
    commands = [[0, 0.2, 0.1], [0.1, 0.2, 0.1], [5.1, 0.2, 0.1], [5.2, 0, 0]]
    steps, unknown = steps_of(commands)
    assert unknown == 1
    assert [(step.start_s, step.stamp_s) for step in steps] == [(0, 0.1), (0.1, 5.1), (5.1, 5.2)]
    assert not xytheta(steps[1].T_start_now).any()
    np.testing.assert_allclose(steps[1].cov_now, 5 * 0.25 * np.eye(3), rtol=1e-12)  # 0.5 m and rad after 1 s
    assert steps_of(commands, longest_gap_s=5.5)[1] == 0


def test_unknown_motion_is_cut_where_the_robot_saw_something():
    commands = [[10, 0.2, 0], [10.05, 0.2, 0], [20, 0.2, 0], [20.05, 0, 0]]
    needed = [3, 5, 5, 12, 19.5, 20.02, 21, 30]
    steps, unknown = steps_of(commands, needed_s=needed)
    assert unknown == 3  # before the first command, between two, after the last
    ends = [step.stamp_s for step in steps]
    np.testing.assert_allclose(ends, [5, 10, 10.05, 12, 19.5, 20, 20.05, 21, 30], atol=1e-9)
    assert steps[0].start_s == 3
    _, cov = leg(steps[4:6])
    np.testing.assert_allclose(np.diag(steps[3].cov_now), 1.95 * 0.25, rtol=1e-9)
    np.testing.assert_allclose(cov, 8 * 0.25 * np.eye(3), rtol=1e-9)


def test_sightings_shortly_before_or_after_the_commands_change_nothing():
    commands = [[10, 0.2, 0], [10.05, 0.2, 0]]
    assert len(steps_of(commands, needed_s=[8.5, 12.0])[0]) == 1


@pytest.mark.parametrize("commands", [np.zeros((0, 3)), [[5, 1, 1]], [[5, 1, 1], [5, 2, 2]]])
def test_commands_that_hold_for_no_time_move_nobody(commands):
    assert steps_of(commands) == ([], 0)


def test_a_stamp_far_away_does_not_make_a_million_steps():
    steps, unknown = steps_of([[0, 0.1, 0], [0.1, 0.1, 0], [9e10, 0.1, 0]])
    assert (len(steps), unknown) == (2, 1)
    np.testing.assert_allclose(np.diag(steps[1].cov_now), 1e4 * 0.25)


def test_noise_that_cannot_be_is_refused():
    with pytest.raises(BadInput, match="after_1_rad: 0 to 1000 expected, got -1"):
        Walk(0, -1, 0)
    with pytest.raises(BadInput, match="unknown_sigma_m"):
        CommandNoise(unknown_sigma_m=float("nan"))
