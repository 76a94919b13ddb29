"""Ambiguous corners: the team gathers evidence, writes it down, and decides right; corners passed and followers."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from explorations import ROBOTS, Run, require_complete, run

from coopslam.estimation.incremental import Incremental
from coopslam.exploration.explorer import Explorer, ExplorerSettings
from coopslam.exploration.identification import CERTAIN_LOG_ODDS
from coopslam.exploration.mission import run_mission
from coopslam.exploration.moves import Step
from coopslam.exploration.recognition import RecognitionSettings
from coopslam.records import CornerDecision, CornerEvidence, CornerSighting, MoveNote, RelativePoseFix
from coopslam.se2 import Pose2
from sim.noise import PRESETS
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import load_world

NEVER_SURE = ExplorerSettings(recognition=RecognitionSettings(margin_log_odds=60.0))
WALKED, MET = "walked its wall to the next corner and back", "the partner went there and met it"


def evidence_of(finished: Run) -> list[CornerEvidence]:
    return [record for record in finished.records if isinstance(record, CornerEvidence)]


@pytest.mark.parametrize(("world", "noise"), [("paper_one_obstacle", "typical"), ("rooms_with_doors", "legged")])
def test_a_team_that_wants_to_be_very_sure_goes_and_looks(world, noise):
    """With a margin of e^60 to 1 every loop closure is ambiguous by its place alone."""
    finished = run(world, noise, seed=1, settings=NEVER_SURE)
    require_complete(finished)
    evidence = evidence_of(finished)
    done = Counter(record.done for record in evidence)
    assert done[WALKED] >= 1 and done[MET] >= 1
    true_corner = finished.corner_of()
    at_end = {record.stamp_s: record for record in evidence if record.done == MET}
    for stamp_s, record in at_end.items():  # who was met stands in the vertex that the evidence names
        really = finished.team.truth.tracks[record.observer]
        k = int(np.searchsorted(really.stamps_s, stamp_s + 1e-6)) - 1
        corner = finished.world.points[true_corner[record.vertex]]
        assert np.hypot(*(really.poses[k].translation() - corner)) < 1e-9 and record.log_odds == CERTAIN_LOG_ODDS


def test_evidence_precedes_the_decision_that_rests_on_it():
    finished = run("rooms_with_doors", "typical", seed=0, settings=NEVER_SURE)
    asked: dict[str, list[str]] = {}
    rested = 0
    for record in finished.records:
        if isinstance(record, CornerEvidence):
            asked.setdefault(record.observer, []).append(record.done)
        elif isinstance(record, CornerDecision) and WALKED in record.evidence:
            assert WALKED in asked[record.sighting.observer]
            assert record.stamp_s > record.sighting.stamp_s  # decided after what was done in between
            rested += 1
    assert rested >= 1


def test_a_sure_team_does_not_waste_metres():
    quick, careful = (run("paper_one_obstacle", seed=0, settings=settings) for settings in (None, NEVER_SURE))
    assert not evidence_of(quick)
    assert sum(quick.mission.travel_m.values()) < sum(careful.mission.travel_m.values())


class Elsewhere(Team):
    """Its finder shows a false place whenever the first robot closes the loop around the obstacle."""

    def execute(self, move) -> Step:
        step = super().execute(move)
        shifted = [self._shift(record) for record in step.records]
        return replace(step, records=tuple(shifted))

    def _shift(self, record):
        if not isinstance(record, CornerSighting):
            return record
        known = self.truth.sighted[record.stamp_s, record.observer]
        if known != 2 or record.observer != "robot0":
            return record
        seen = record.T_observer_corner
        return replace(record, T_observer_corner=Pose2(seen.x() + 0.05, seen.y(), seen.theta()))


def test_a_wall_and_a_partner_outweigh_a_doubtful_place():
    """A sighting off by 5 cm, ten sigmas of the finder, leaves doubt; what is done about it does not."""
    world, records = load_world("paper_one_obstacle"), []
    team = Elsewhere(world, Sensors(*PRESETS["typical"], np.random.default_rng(0)))
    driver = Incremental(ROBOTS)
    mission = run_mission(team, driver, Explorer(ROBOTS), records.append)
    finished = Run(world, team, mission, driver, records)
    assert mission.outcome == "complete", mission.reason
    assert evidence_of(finished) and finished.corner_of()


# corners passed on the way


def passed(finished: Run) -> list[CornerDecision]:
    decisions = [record for record in finished.records if isinstance(record, CornerDecision)]
    return [record for record in decisions if record.evidence == "passed on the way"]


def test_corners_passed_on_the_way_are_used_and_can_be_left_out():
    used, unused = (run("pillars", "typical", 2, settings=ExplorerSettings(reobserve=on)) for on in (True, False))
    require_complete(used)
    require_complete(unused)
    assert len(passed(used)) > 20 and not passed(unused)
    used.corner_of()  # none was taken for another one
    sigmas = [
        np.mean([finished.smoothed().vertex_belief(v).position_sigma_m for v in finished.free_map.fans])
        for finished in (used, unused)
    ]
    assert sigmas[0] < sigmas[1]


# followers


@pytest.mark.parametrize("count", [3, 4])
@pytest.mark.parametrize("noise", ["none", "legged"])
def test_followers_come_along_and_see_every_leg(count, noise):
    robots = tuple(f"robot{k}" for k in range(count))
    world, records = load_world("rooms_with_doors"), []
    team = Team(world, Sensors(*PRESETS[noise], np.random.default_rng(5)), TeamSettings(robots=robots))
    driver = Incremental(robots)
    mission = run_mission(team, driver, Explorer(robots), records.append)
    require_complete(Run(world, team, mission, driver, records))
    moves = [record for record in records if isinstance(record, MoveNote)]
    by_pair = [move for move in moves if move.robot in robots[:2]]
    assert len(by_pair) > len(moves) / 2
    for follower in robots[2:]:
        seen = {
            record.target for record in records if isinstance(record, RelativePoseFix) and record.observer == follower
        }
        assert set(robots[:2]) <= seen
    assert mission.role_exchanges == sum(a.robot != b.robot for a, b in zip(by_pair, by_pair[1:], strict=False))
