"""Trackers other than the helix: what they report, how a team without headings starts, and that it explores."""

from math import inf, radians

import numpy as np
import pytest
from explore_script import call, summary_of
from monte_carlo import require_covariance
from scipy.stats import chi2

from coopslam.errors import BadInput, BadMove
from coopslam.exploration.moves import DriveAway, FollowWall, Side
from coopslam.io.run_log import read_run_log
from coopslam.records import BearingRangeFix, PosePrior, RelativePoseFix
from coopslam.se2 import Pose2, xytheta
from sim.noise import EXACT, NEARLY_EXACT, PRESETS, TRACKERS, PlacingNoise, TrackerLimits, TrackerNoise, preset
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import World

HALL = World("hall", (np.array([(0, 0), (6, 0), (6, 3), (0, 3)], float),))


def sensors(tracker: str, noise="typical", seed=0) -> Sensors:
    return Sensors(*preset(noise, tracker), np.random.default_rng(seed), tracker_limits=TRACKERS[tracker][1])


def test_a_retroreflector_gives_bearing_and_range_that_scatter_as_they_say():
    sensor, target = sensors("retroreflector"), Pose2(-3.0, 4.0, 2.5)
    fixes = [sensor.relative_pose(2.5, "ann", "bob", target) for _ in range(4000)]
    assert {(type(fix), fix.stamp_s, fix.observer, fix.target) for fix in fixes} == {
        (BearingRangeFix, 2.5, "ann", "bob")
    }
    errors = np.array([[fix.bearing_rad - np.arctan2(4.0, -3.0), fix.range_m - 5.0] for fix in fixes])
    by_hand = [np.hypot(0.005 / 5.0, radians(0.25)), np.hypot(0.01, 0.005)]
    squares = np.sum(np.square(errors / by_hand), axis=0)
    low, high = chi2.ppf([0.0005, 0.9995], len(fixes))
    assert ((low < squares) & (squares < high)).all()
    np.testing.assert_allclose(np.sqrt(np.diag(fixes[0].cov)), by_hand, rtol=0.01)  # at the measured range


@pytest.mark.parametrize(("tracker", "reach"), [("helix", inf), ("retroreflector", 30.0), ("laser-stripe", 4.0)])
def test_beyond_its_range_a_tracker_sees_nobody(tracker, reach):
    sensor = sensors(tracker)
    assert sensor.relative_pose(0.0, "ann", "bob", Pose2(0.0, -min(reach, 1e4) + 1e-6, 1.0)) is not None
    if reach < inf:
        assert sensor.relative_pose(0.0, "ann", "bob", Pose2(0.0, -reach - 1e-6, 1.0)) is None


def test_a_target_in_the_very_place_has_no_bearing():
    assert sensors("retroreflector", "none").relative_pose(0.0, "ann", "bob", Pose2(0, 0, 1.0)) is None


def test_a_laser_stripe_is_the_most_precise_within_its_reach():
    at_3_m = {name: np.diag(sigmas.line_covariance(3.0)) for name, (sigmas, _) in TRACKERS.items()}
    assert (at_3_m["laser-stripe"] < at_3_m["helix"]).all()
    assert (at_3_m["laser-stripe"][:2] < at_3_m["retroreflector"][:2]).all()


def test_presets_of_noise_and_tracker():
    """The helix is what the presets of noise had; without noise every tracker is exact."""
    assert {name: preset(name) for name in PRESETS} == PRESETS
    assert preset("none", "retroreflector") == (EXACT, NEARLY_EXACT)
    true, believed = preset("legged", "laser-stripe")
    assert true == believed
    assert true.odometry == PRESETS["legged"][0].odometry
    assert true.tracker == TrackerNoise(0.001, 0.001, 0.001, radians(0.05), radians(1.0))


def test_a_team_without_headings_knows_how_it_was_set_up():
    """Each robot is put a step along the wall, looking along it, and how well is said by the covariance."""
    errors = []
    for seed in range(400):
        settings = TeamSettings(("ann", "bob", "cid"), start_step_m=0.5)
        records = Team(HALL, sensors("retroreflector", seed=seed), settings).begin().records
        priors = [record for record in records if isinstance(record, PosePrior)]
        assert [prior.robot for prior in priors] == ["bob", "cid"]  # bob is the farthest from the corner
        errors += [
            xytheta(prior.T_start_robot) - (along, 0, 0) for prior, along in zip(priors, (1.0, 0.5), strict=True)
        ]
    require_covariance(np.array(errors), PlacingNoise(0.02, radians(2.0)).covariance())
    np.testing.assert_allclose(priors[0].cov_robot, np.diag([4e-4, 4e-4, radians(2.0) ** 2]))


def test_a_team_with_headings_needs_no_such_knowledge():
    records = Team(HALL, sensors("helix")).begin().records
    assert [record for record in records if isinstance(record, PosePrior)] == []
    assert sum(isinstance(record, RelativePoseFix) for record in records) == 2


@pytest.mark.parametrize(
    "move", [FollowWall("robot1", "robot0", Side.RIGHT), DriveAway("robot1", "robot0")], ids=["wall", "line"]
)
def test_contact_ends_with_the_trackers_reach(move):
    team = Team(HALL, sensors("laser-stripe"))
    team.begin()
    with pytest.raises(BadMove, match=r"because of distance: robot1 would be 6\.0 m from robot0.* reaches 4 m"):
        team.execute(move)


def test_alone_a_robot_goes_on_beyond_the_trackers_reach():
    team = Team(HALL, sensors("laser-stripe"))
    team.begin()
    step = team.execute(FollowWall("robot1", "robot0", Side.RIGHT, alone=True))
    seen = [record.stamp_s for record in step.records if isinstance(record, RelativePoseFix)]
    assert max(seen) < step.stamp_s
    assert team.truth.pose_at("robot1", max(seen)).x() <= 4.0


def test_limits_that_cannot_be():
    for reach in (0.0, -1.0, np.nan):
        with pytest.raises(BadInput, match="max_range_m: more than zero expected"):
            TrackerLimits(reach)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("more", [(), ("--outliers", "0.1")], ids=["true", "some false"])
def test_a_team_explores_without_seeing_headings(tmp_path, seed, more):
    arguments = ["--tracker-preset", "retroreflector", "--noise", "typical", "--seed", seed, "--figures", "none"]
    assert call(*arguments, *more, "--out", tmp_path / "run") == 0
    summary = summary_of(tmp_path / "run")
    assert summary["outcome"] == "complete"
    assert summary["noise"] == "typical"
    assert summary["triangles"] == 9 + 4 + 2 * 1 - 2  # n + 2 h - 2; nine corners outside and four of the obstacle
    assert summary["covered_fraction"] == pytest.approx(1.0, abs=1e-9)
    assert summary["vertex_rmse_m"] < 0.05  # odometry alone: 0.2 m and more after 50 m
    _, records = read_run_log(tmp_path / "run" / "log.mcap")
    assert sum(isinstance(record, PosePrior) for record in records) == 1
    assert sum(isinstance(record, BearingRangeFix) for record in records) > 50
    assert not any(isinstance(record, RelativePoseFix) for record in records)


def test_the_config_of_such_a_run_repeats_it(tmp_path):
    assert call("--tracker-preset", "retroreflector", "--figures", "none", "--out", tmp_path / "first") == 0
    assert call("--config", tmp_path / "first" / "config.toml", "--out", tmp_path / "again") == 0
    first, again = summary_of(tmp_path / "first"), summary_of(tmp_path / "again")
    assert {key: first[key] for key in ("outcome", "travel_m", "vertex_rmse_m")} == {
        key: again[key] for key in ("outcome", "travel_m", "vertex_rmse_m")
    }
    other = ["--config", tmp_path / "first" / "config.toml", "--tracker-preset", "helix", "--out", tmp_path / "helix"]
    assert call(*other) == 0
    _, records = read_run_log(tmp_path / "helix" / "log.mcap")
    assert not any(isinstance(record, BearingRangeFix | PosePrior) for record in records)


def test_a_short_reach_ends_the_exploration_with_a_reason(tmp_path, capsys):
    assert call("--tracker-preset", "laser-stripe", "--figures", "none", "--out", tmp_path / "run") == 3
    assert "contact lost because of distance" in capsys.readouterr().err
    assert summary_of(tmp_path / "run")["outcome"] == "stuck"
