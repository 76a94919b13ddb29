"""Going on with an old map: whole second explorations, judged by shapely on the true corners."""

import numpy as np
import pytest
from explorations import ROBOTS, Run, require_complete, run
from surveys import same_pose
from wake_ups import ANGLE_SIGMA_RAD

from coopslam.estimation.batch import chi_square
from coopslam.estimation.incremental import Incremental
from coopslam.exploration.explorer import ExplorerSettings
from coopslam.exploration.mission import Budget, run_mission
from coopslam.exploration.rebuilt_map import rebuilt_map
from coopslam.exploration.resume import OldSession, Relocalizer, extend, joint_records, renamed
from coopslam.planning.corner_map import corner_map
from coopslam.planning.waking_up import WakingUp
from coopslam.records import CornerDecision, MoveNote, Odometry, PosePrior, RelativePoseFix
from coopslam.se2 import Pose2
from sim.noise import TYPICAL, TrackerLimits
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import load_world

OLD_NAMES = {robot: f"old-{robot}" for robot in ROBOTS}


class Second:
    """A second exploration of a world whose first one left a map behind."""

    def __init__(
        self, old: Run, corner: int, seed: int, robots: tuple[str, ...] = ROBOTS, limits: TrackerLimits | None = None
    ):
        ring, index = old.world.ring_index(corner)
        settings = TeamSettings(robots, start_ring=ring, start_corner=index)
        self.old, self.robots, smoothed = old, robots, old.smoothed()
        sensors = Sensors(TYPICAL, TYPICAL, np.random.default_rng(seed), tracker_limits=limits or TrackerLimits())
        self.team = Team(old.world, sensors, settings)
        records = [renamed(record, OLD_NAMES) for record in old.records]
        self.session = OldSession(tuple(OLD_NAMES.values()), records, rebuilt_map(old.records, smoothed))
        self.ask = WakingUp(corner_map(self.session.free_map, smoothed, ANGLE_SIGMA_RAD), robots[0])
        self.records = []
        explorer = Relocalizer(robots, ExplorerSettings(), self.ask)
        self.found = run_mission(self.team, Incremental(robots), explorer, self.records.append)

    def extended(self, budget: Budget | None = None) -> Run:
        joint = joint_records(self.session, self.found, self.records)
        driver, log = Incremental((*self.session.robots, *self.robots)), []
        mission = extend(self.team, driver, self.session, self.found, joint, log.append, budget)
        finished = Run(self.old.world, self.team, mission, driver, joint + log)
        corner_of = self._corner_of(finished)
        finished.corner_of = lambda: corner_of
        return finished

    def _corner_of(self, finished: Run) -> dict[int, int]:
        """Map vertex -> true corner, over both sessions. Fails when one vertex is two corners."""
        found = {}
        for record in (record for record in finished.records if isinstance(record, CornerDecision)):
            stamp, robot = record.sighting.stamp_s, record.sighting.observer
            is_old = robot in self.session.robots
            truth = self.old.team.truth if is_old else self.team.truth
            corner = truth.sighted[stamp, robot.removeprefix("old-") if is_old else robot]
            assert found.setdefault(record.vertex, corner) == corner
        return found


@pytest.mark.parametrize(
    ("world", "moves", "corner"),
    [
        ("paper_one_obstacle", 15, 9),
        ("rooms_with_doors", 40, 30),
        pytest.param("comb", 30, 21, marks=pytest.mark.slow),
        pytest.param("cave", 50, 40, marks=pytest.mark.slow),
    ],
)
def test_an_exploration_that_ended_early_is_completed(world, moves, corner):
    """n + 2h - 2 triangles, no overlap: shapely judges them on the true corners."""
    old = run(world, "typical", seed=30, budget=Budget(moves=moves))
    assert old.mission.outcome == "budget"
    second = Second(old, corner, seed=31)
    assert second.found.outcome == "complete", second.found.reason
    finished = second.extended()
    require_complete(finished)
    known = [triangle for triangle in old.free_map.triangles.items() if triangle in finished.free_map.triangles.items()]
    assert len(known) == len(old.free_map.triangles) >= 3
    squares, dof = chi_square(finished.driver.graph, finished.driver.values())
    assert 0.8 * dof < squares < 1.2 * dof  # both sessions explain each other
    assert finished.mission.moves > second.found.moves


def test_a_complete_map_needs_nothing_more():
    old = run("paper_two_occluders", "typical", seed=32)
    second = Second(old, 7, seed=33)
    finished = second.extended()
    assert finished.mission.outcome == "complete" and finished.mission.moves == second.found.moves < 20
    require_complete(finished)


def test_a_symmetric_world_is_not_resumed():
    second = Second(run("symmetric_cross", "typical", seed=34), 5, seed=35)
    assert second.found.outcome == "stuck" and "4 places explain" in second.found.reason
    assert second.ask.answers[-1][0] == load_world("symmetric_cross").triangles_expected


def test_three_robots_resume_what_two_began():
    old = run("paper_one_obstacle", "typical", seed=36, budget=Budget(moves=15))
    second = Second(old, 5, seed=37, robots=("robot0", "robot1", "robot2"))
    finished = second.extended()
    require_complete(finished)
    at = finished.mission.explorer.at
    assert set(at) == {"robot0", "robot1", "robot2"}


def test_how_the_second_team_was_set_up_is_relative_to_its_own_start():
    """A tracker without heading: a record says where the second robot was put, as seen from the first."""
    old = run("paper_one_obstacle", "typical", seed=42, budget=Budget(moves=15))
    second = Second(old, 9, seed=43, limits=TrackerLimits(has_heading=False))
    finished = second.extended()
    require_complete(finished)
    squares, dof = chi_square(finished.driver.graph, finished.driver.values())
    assert squares < 1.3 * dof
    estimate, truth = finished.mission.estimate, second.team.truth
    true = old.team.truth.origin.between(truth.pose_at("robot1", truth.tracks["robot1"].stamps_s[0]))
    assert same_pose(estimate.trajectory("robot1").poses[0], true, 0.15, 0.1)


def test_the_budget_counts_from_the_wake_up():
    old = run("paper_one_obstacle", "typical", seed=38, budget=Budget(moves=15))
    second = Second(old, 9, seed=39)
    moves = second.found.moves + 3
    finished = second.extended(Budget(moves=moves))
    assert finished.mission.outcome == "budget" and finished.mission.moves == moves
    assert [p.stamp_s for p in finished.mission.history] == sorted(p.stamp_s for p in finished.mission.history)


def test_records_of_renamed_robots():
    one = Pose2(1, 2, 3)
    fix = renamed(RelativePoseFix(1.0, "robot0", "robot1", one, np.eye(3)), OLD_NAMES)
    assert (fix.observer, fix.target) == ("old-robot0", "old-robot1") and fix.T_observer_target is one
    odometry = renamed(Odometry(0.0, 1.0, "robot1", one, np.eye(3)), {"robot1": "x"})
    assert odometry.robot == "x"
    note = MoveNote(1.0, "robot0", "robot1", "a move", "corner")
    assert renamed(note, {"robot1": "x"}).watcher == "x" and renamed(note, {}) is note
    decision = next(r for r in run("comb", budget=Budget(moves=1)).records if isinstance(r, CornerDecision))
    assert renamed(decision, OLD_NAMES).sighting.observer == "old-robot0"


def test_where_the_team_began_is_said_so_loosely_that_it_tells_nothing():
    """The solution is the same to a thousandth of its sigmas when that record is a metre off."""
    old = run("paper_one_obstacle", "typical", seed=40)
    second = Second(old, 4, seed=41)
    joint = joint_records(second.session, second.found, second.records)
    where = next(k for k, record in enumerate(joint) if isinstance(record, PosePrior))
    moved = joint[where].T_start_robot * Pose2(1.0, 0.0, 0.1)
    shifted = [*joint[:where], PosePrior(joint[where].stamp_s, "robot0", moved, joint[where].cov_robot)]
    estimates = []
    for records in (joint, [*shifted, *joint[where + 1 :]]):
        driver = Incremental((*second.session.robots, *ROBOTS))
        driver.update(records)
        for _ in range(5):
            estimate = driver.update(())
        belief = estimate.belief("robot0")
        estimates.append(belief)
    apart = estimates[0].T_world_body.between(estimates[1].T_world_body)
    assert np.hypot(apart.x(), apart.y()) < 1e-3 * estimates[0].position_sigma_m + 1e-4
