"""The loop: every end is explained, and nothing is used that was not logged."""

import re

import numpy as np
import pytest
from explorations import ROBOTS, run

from coopslam.errors import BadInput
from coopslam.estimation.incremental import Incremental
from coopslam.exploration.explorer import Explorer
from coopslam.exploration.mission import Budget, run_mission
from coopslam.exploration.moves import MoveEnd, Step
from coopslam.records import CornerDecision, MoveNote, Odometry
from coopslam.se2 import xytheta
from sim.noise import PRESETS
from sim.sensors import Sensors
from sim.team import Team
from sim.world import load_world


def team(noise="typical", seed=0, world="paper_one_obstacle") -> Team:
    return Team(load_world(world), Sensors(*PRESETS[noise], np.random.default_rng(seed)))


class Listening(Incremental):
    """An estimator that notes which records it got."""

    def __init__(self, heard: list):
        super().__init__(ROBOTS)
        self.heard = heard

    def update(self, records):
        records = list(records)
        self.heard += [("used", record) for record in records]
        return super().update(records)


def test_every_record_is_logged_before_it_is_used_and_in_order():
    story = []
    mission = run_mission(team(), Listening(story), Explorer(ROBOTS), lambda record: story.append(("logged", record)))
    assert mission.outcome == "complete"
    logged = [record for what, record in story if what == "logged"]
    used = [record for what, record in story if what == "used"]
    assert len(logged) == len(used) > 300
    assert all(a is b for a, b in zip(logged, used, strict=True))
    waiting = set()
    for what, record in story:
        if what == "logged":
            waiting.add(id(record))
        else:
            assert id(record) in waiting
    stamps = [record.stamp_s for record in logged]
    assert stamps == sorted(stamps)


def test_the_estimate_is_what_the_log_alone_gives():
    """Replaying the log through a fresh estimator tells where the robots were."""
    records = []
    mission = run_mission(team(), Incremental(ROBOTS), Explorer(ROBOTS), records.append)
    replayed = Incremental(ROBOTS).update(records)
    for robot in ROBOTS:
        ours, theirs = mission.estimate.pose(robot), replayed.pose(robot)
        assert (
            np.abs(xytheta(ours.between(theirs))).max() < 1e-3
        )  # grouping moves linearization points; sigmas are 1 cm


def test_what_is_counted_agrees_with_the_log():
    finished = run("rooms_with_doors", "typical")
    mission, notes = finished.mission, [r for r in finished.records if isinstance(r, MoveNote)]
    assert mission.moves == len(notes) == len(mission.history)
    movers = [note.robot for note in notes]
    assert mission.role_exchanges == sum(a != b for a, b in zip(movers, movers[1:], strict=False)) > 5
    for robot in ROBOTS:  # metres by odometry, which is off by 3 cm after 1 m
        driven = [r for r in finished.records if isinstance(r, Odometry) and r.robot == robot]
        assert sum(abs(r.T_start_now.x()) for r in driven) == pytest.approx(mission.travel_m[robot])
        track = np.array([xytheta(pose)[:2] for pose in finished.team.truth.tracks[robot].poses])
        true_m = np.hypot(*np.diff(track, axis=0).T).sum()
        assert mission.travel_m[robot] != true_m
        assert mission.travel_m[robot] == pytest.approx(true_m, abs=4 * 0.03 * np.sqrt(true_m))
    last = mission.history[-1]
    assert (last.triangles, last.vertices, last.open_gates) == (
        len(finished.free_map.triangles),
        finished.world.n,
        0,
    ) or (
        last.open_gates == 1  # told after the move, before what was decided of it
    )
    assert last.travel_m == pytest.approx(sum(mission.travel_m.values()))
    assert [p.stamp_s for p in mission.history] == sorted(p.stamp_s for p in mission.history)
    new = [r for r in finished.records if isinstance(r, CornerDecision) and r.is_new]
    assert len(new) == finished.world.n == mission.estimate.vertices[-1] + 1
    assert re.fullmatch(r".*44 triangles = 44 vertices \+ 2 x 1 holes - 2.*", mission.reason)


@pytest.mark.parametrize("moves", [1, 5, 12])
def test_a_budget_of_moves_ends_in_words(moves):
    finished = run("paper_one_obstacle", budget=Budget(moves=moves))
    mission = finished.mission
    assert (mission.outcome, mission.moves) == ("budget", moves)
    assert f"{moves} moves" in mission.reason
    assert f"{len(finished.free_map.gates)} gates are still open" in mission.reason and finished.free_map.gates


def test_a_budget_of_metres_ends_in_words():
    finished = run("paper_one_obstacle", budget=Budget(travel_m=20.0))
    mission = finished.mission
    spent = sum(mission.travel_m.values())
    longest = np.ptp(finished.world.points, axis=0).max() * 2
    assert mission.outcome == "budget" and 20.0 <= spent < 20.0 + longest
    assert f"{spent:.1f} m" in mission.reason and "20 m" in mission.reason


def test_a_budget_that_is_just_enough_is_enough():
    moves = run("paper_one_obstacle").mission.moves
    assert run("paper_one_obstacle", budget=Budget(moves=moves)).mission.outcome == "complete"
    assert run("paper_one_obstacle", budget=Budget(moves=moves - 1)).mission.outcome == "budget"


@pytest.mark.parametrize(
    "spent", [dict(moves=0), dict(moves=-3), dict(travel_m=0.0), dict(travel_m=-1.0), dict(travel_m=float("nan"))]
)
def test_a_budget_of_nothing_is_refused(spent):
    with pytest.raises(BadInput, match="more than zero"):
        Budget(**spent)


class Hindered:
    """A team whose moves end in a way that they should not, from a certain move on."""

    def __init__(self, ended: MoveEnd, after: int):
        self.team, self.ended, self.left = team("none"), ended, after

    def begin(self):
        return self.team.begin()

    def execute(self, move):
        step = self.team.execute(move)
        self.left -= 1
        return step if self.left >= 0 else Step(step.stamp_s, step.records, self.ended, step.travelled_m)


@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_being_stuck_is_an_outcome_with_a_reason(after):
    mission = run_mission(Hindered(MoveEnd.WALL, after), Incremental(ROBOTS), Explorer(ROBOTS), lambda record: None)
    assert mission.outcome == "stuck" and "wall" in mission.reason
    assert after < mission.moves < 100 and mission.estimate is not None and len(mission.history) == mission.moves


def test_progress_is_shown_after_every_move():
    shown = []
    mission = run_mission(
        team(), Incremental(ROBOTS), Explorer(ROBOTS), lambda record: None, Budget(moves=7), shown.append
    )
    assert shown == mission.history and len(shown) == 7
    assert all(set(p.position_sigma_m) == set(ROBOTS) for p in shown)
    assert all(0 <= sigma < 1 for p in shown for sigma in p.position_sigma_m.values())
