"""Ambiguous corners: the team gathers evidence, writes it down, and decides right; corners passed and followers."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from explorations import ROBOTS, Run, require_complete, run

from coopslam.estimation.incremental import Incremental
from coopslam.exploration.explorer import Explorer, ExplorerSettings
from coopslam.exploration.free_map import FreeMap
from coopslam.exploration.identification import MET, WALKED, Case, Identification
from coopslam.exploration.mission import Budget, run_mission
from coopslam.exploration.moves import MoveEnd, Step
from coopslam.exploration.navigation import Navigation
from coopslam.exploration.recognition import Match, RecognitionSettings, Walked
from coopslam.records import CornerDecision, CornerEvidence, MoveNote, RelativePoseFix
from sim.noise import PRESETS, TYPICAL, FalseSightings, TrackerNoise
from sim.sensors import Sensors
from sim.team import Team, TeamSettings
from sim.world import load_world, world_from_geojson


def never_sure(margin: float) -> ExplorerSettings:
    return ExplorerSettings(recognition=RecognitionSettings(margin_log_odds=margin))


def evidence_of(finished: Run) -> list[CornerEvidence]:
    return [record for record in finished.records if isinstance(record, CornerEvidence)]


@pytest.mark.parametrize(
    ("world", "noise", "margin"), [("paper_one_obstacle", "typical", 30.0), ("rooms_with_doors", "legged", 22.0)]
)
def test_a_team_that_wants_to_be_very_sure_goes_and_looks(world, noise, margin):
    """With a margin of e^22 to 1 and more every loop closure is ambiguous by its place alone."""
    finished = run(world, noise, seed=1, settings=never_sure(margin))
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
        assert np.hypot(*(really.poses[k].translation() - corner)) < 1e-9
        assert record.log_odds > margin


def test_evidence_precedes_the_decision_that_rests_on_it():
    finished = run("rooms_with_doors", "typical", seed=0, settings=never_sure(22.0))
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
    quick, careful = (
        run("paper_one_obstacle", "typical", 0, settings=settings) for settings in (None, never_sure(30.0))
    )
    assert not evidence_of(quick)
    assert sum(quick.mission.travel_m.values()) < sum(careful.mission.travel_m.values())


def square(x: float, y: float, side: float = 0.3) -> list:
    return [[x, y], [x + side, y], [x + side, y + side], [x, y + side], [x, y]]


def test_lookalikes_next_to_each_other_are_told_apart():
    """Three equal pillars 10 cm apart, and a tracker four to eight times as bad as usual."""
    hall = [[0, 0], [8, 0], [8, 6], [0, 6], [0, 0]]
    pillars = [square(3.0, 2.5), square(3.4, 2.5), square(3.8, 2.5)]
    world = world_from_geojson({"type": "Polygon", "coordinates": [hall, *pillars]})
    noise = replace(TYPICAL, tracker=TrackerNoise(0.04, 0.06, 0.04, np.radians(2.0), np.radians(8.0)))
    finished = run(world, true=noise, believed=noise, seed=2, settings=never_sure(15.0))
    require_complete(finished)
    assert {record.done for record in evidence_of(finished)} >= {WALKED, MET}


@pytest.mark.parametrize(("ended", "odds"), [(MoveEnd.PARTNER, 100.0), (MoveEnd.CORNER, -100.0)])
def test_at_the_end_of_a_known_wall_the_partner_is_met_or_not(ended, odds):
    """Over a known wall nobody goes astray: what happens there outweighs what the numbers said."""
    free_map = FreeMap()
    for vertex in range(3):
        free_map.add_vertex(vertex, 1.0)
    free_map.add_first_wall(0, 1)
    crew = SimpleNamespace(free_map=free_map)
    identification = Identification(crew, Navigation(crew, 0.4, 25))
    case = Case(None, None, Walked(), [Match(1, 5.0, 3.0, None), Match(2, 4.0, 5.0, None)], [])
    found = identification._odds_of_visit(case, case.matches[0], 0, Step(0.0, (), ended))
    case.weigh(found)
    assert found[1] == odds
    assert [match.vertex for match in case.matches] == ([1, 2] if ended == MoveEnd.PARTNER else [2, 1])
    assert case.verdict(7.0) == (case.matches[0] if ended == MoveEnd.PARTNER else None)  # vertex 2 is still in doubt


# corners passed on the way


def passed(finished: Run) -> list[CornerDecision]:
    decisions = [record for record in finished.records if isinstance(record, CornerDecision)]
    return [record for record in decisions if record.evidence == "passed on the way"]


def test_corners_passed_on_the_way_are_used_and_can_be_left_out():
    used, unused = (
        run("pillars", "typical", 2, budget=Budget(moves=160), settings=ExplorerSettings(reobserve=on))
        for on in (True, False)
    )
    assert len(passed(used)) > 10 and not passed(unused)
    used.corner_of()  # none was taken for another one
    both = set(used.free_map.fans) & set(unused.free_map.fans)
    with_them, without = (
        np.mean([smoothed.vertex_belief(v).position_sigma_m for v in both])
        for smoothed in (used.smoothed(), unused.smoothed())
    )
    assert with_them < without


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


# false sightings


def test_contact_that_only_seems_lost_ends_nothing():
    """A fifth of the sightings are reflections, a fifth are missed, and two in a row are believed."""
    false_alarms = 0
    for seed in range(6):
        world, records = load_world("paper_one_obstacle"), []
        sensors = Sensors(*PRESETS["typical"], np.random.default_rng(seed), false_sightings=FalseSightings(0.2, 0.2))
        team, driver = Team(world, sensors, TeamSettings(confirmations=2)), Incremental(ROBOTS)
        mission = run_mission(team, driver, Explorer(ROBOTS), records.append)
        require_complete(Run(world, team, mission, driver, records))
        false_alarms += sum(isinstance(record, MoveNote) and record.ended == "contact" for record in records)
    assert false_alarms > 30
