"""What the resuming explorer is told: vertices by their ids, and where the new frame lies in the old one."""

from explorations import run
from surveys import same_pose
from wake_ups import ANGLE_SIGMA_RAD, stored_map

from coopslam.exploration.mission import Budget
from coopslam.planning.place_recognition import Verdict
from coopslam.planning.waking_up import WakingUp
from sim.team import TeamSettings


def test_frames_and_vertices_of_both_explorations():
    old = run("paper_one_obstacle", "typical", seed=50)
    new = run("paper_one_obstacle", "typical", seed=51, budget=Budget(moves=6), team=TeamSettings(start_corner=4))
    ask = WakingUp(stored_map(old), "robot1")
    place = ask(new.free_map, new.mission.estimate)
    true_old, true_new = old.corner_of(), new.corner_of()
    assert place.vertices == {
        v: w for v, corner in true_new.items() for w, other in true_old.items() if corner == other
    }
    true = old.team.truth.origin.between(new.team.truth.origin)
    assert same_pose(place.T_old_new, true, 0.1, 0.05)
    assert ask.answers == [(len(new.free_map.triangles), place.recognition)]
    assert ask.last_map.angle_sigma_rad == ANGLE_SIGMA_RAD


def test_an_ambiguous_place_has_neither():
    old, new = (run("symmetric_cross", "typical", seed=seed) for seed in (52, 53))
    place = WakingUp(stored_map(old), "robot0")(new.free_map, new.mission.estimate)
    assert place.vertices is None and place.T_old_new is None and place.reason.startswith("ambiguous: 4 places")
    assert place.recognition.verdict is Verdict.AMBIGUOUS
