"""Which gate a robot meets that drives through a doorway: worked geometry, and what is not known of it."""

from types import SimpleNamespace

import numpy as np
import pytest

from coopslam.exploration.chart import Chart, ChartSettings
from coopslam.exploration.sweep import Sweep, gate_ahead
from coopslam.se2 import Pose2

PIVOT, CORNER, NEAR, FAR, BEYOND = range(5)  # vertices


def chart_of(places: dict[int, tuple], gates: list[tuple[int, int]], sigma_m: float | dict = 1e-6) -> Chart:
    """Vertices that err independently, by so much in x and in y; their headings are of no importance here."""
    poses = {vertex: Pose2(*place, 0.7 * vertex) for vertex, place in places.items()}
    sigmas = sigma_m if isinstance(sigma_m, dict) else dict.fromkeys(places, sigma_m)

    def joint(keys):
        return np.diag(np.concatenate([[sigmas[key] ** 2, sigmas[key] ** 2, 0.01] for key in keys]))

    free_map = SimpleNamespace(gates=dict.fromkeys(gates))
    chart = Chart(free_map, ChartSettings())
    chart.estimate = SimpleNamespace(vertex=poses.get, vertex_key=lambda v: v, joint_covariance=joint)
    return chart


def doorway(corner_is_end: bool = True) -> Sweep:
    """At the end b of a gate the robot sweeps counter-clockwise, at its start a clockwise."""
    gate = (PIVOT, CORNER) if corner_is_end else (CORNER, PIVOT)
    return Sweep(gate, "robot0", "robot1", CORNER, PIVOT, None)


LINE = {PIVOT: (0.0, 0.0), CORNER: (3.0, 0.0)}  # prolonged it runs along y = 0


def test_the_nearest_gate_across_the_line_and_its_end_on_the_unexplored_side():
    places = LINE | {NEAR: (4.0, -1.0), FAR: (6.0, 1.0), BEYOND: (9.0, 1.0), 5: (8.0, -1.0)}
    chart = chart_of(places, [(5, BEYOND), (NEAR, FAR)])
    assert gate_ahead(chart, doorway()) == (FAR, pytest.approx(2.0))
    assert gate_ahead(chart, doorway(corner_is_end=False)) == (NEAR, pytest.approx(2.0))


@pytest.mark.parametrize("aside_m", [-0.002, 0.0, 0.002])
def test_a_gate_that_ends_on_the_line_for_all_that_is_known(aside_m):
    """1 cm of doubt in each place: 2 mm aside is on the line, on whichever side."""
    chart = chart_of(LINE | {NEAR: (4.2, aside_m), FAR: (6.0, 2.0)}, [(NEAR, FAR)], sigma_m=0.01)
    assert gate_ahead(chart, doorway()) == (FAR, pytest.approx(1.2, abs=0.01))
    assert gate_ahead(chart, doorway(corner_is_end=False)) == (NEAR, pytest.approx(1.2, abs=0.01))


def test_a_gate_that_is_surely_beside_the_line_or_behind_the_mover_or_along_the_line():
    assert gate_ahead(chart_of(LINE | {NEAR: (4.2, 0.002), FAR: (6.0, 2.0)}, [(NEAR, FAR)]), doorway()) == (None, None)
    behind = chart_of(LINE | {NEAR: (1.0, 0.002), FAR: (1.0, 2.0)}, [(NEAR, FAR)], sigma_m=0.01)
    assert gate_ahead(behind, doorway()) == (None, None)
    along = chart_of(LINE | {NEAR: (4.0, 0.001), FAR: (6.0, 0.001)}, [(NEAR, FAR)], sigma_m=0.01)
    assert gate_ahead(along, doorway()) == (None, None)


@pytest.mark.parametrize("unsure", [PIVOT, CORNER, NEAR])
def test_what_is_on_the_line_follows_from_all_three_places(unsure):
    """A straight line through (0, 0) and (3, 0), at x = 6: an error of the gate's ends counts once and twice."""
    lever = {PIVOT: 1.0, CORNER: 2.0, NEAR: 1.0}[unsure]
    sigmas = dict.fromkeys(range(4), 1e-9) | {unsure: 0.01}
    for sigma_share, expected in ((2.9, FAR), (3.1, None)):
        places = LINE | {NEAR: (6.0, sigma_share * lever * 0.01), FAR: (7.0, 2.0)}
        assert gate_ahead(chart_of(places, [(NEAR, FAR)], sigmas), doorway())[0] == expected


def test_the_cave_where_the_gate_was_missed():
    """Places as estimated, to 0.1 mm: who drove away here passed the gate's end by less than that, and got through."""
    places = {PIVOT: (7.7313, 5.8898), CORNER: (4.7163, 7.1295), NEAR: (3.5518, 7.6083), FAR: (9.4825, 9.4074)}
    chart = chart_of(places, [(FAR, NEAR)], sigma_m=0.005)
    assert gate_ahead(chart, doorway(corner_is_end=False)) == (FAR, pytest.approx(1.2591, abs=1e-3))
