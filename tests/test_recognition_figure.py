"""The figure shows what was answered: robots where the fits put them, as many places as there are."""

import numpy as np
import pytest
from surveys import survey

from coopslam.planning.place_recognition import PlaceRecognition, Verdict
from coopslam.report import canvas
from coopslam.report.recognition_figure import draw_recognition
from coopslam.se2 import Pose2

L_SHAPE = [[0, 0], [6, 0], [6, 4], [4, 4], [4, 5], [0, 5]]
RECTANGLE = [[0, 0], [6, 0], [6, 4], [0, 4]]


def drawn(ring):
    rng = np.random.default_rng(0)
    stored, small = survey(ring, rng, scale=0.2), survey(ring, rng, Pose2(3.0, -2.0, 2.5), [1, 2, 3], scale=0.2)
    answer = PlaceRecognition(stored).recognize(small)
    figure = draw_recognition(stored, small, answer, "a $world$")
    return answer, figure


def robots_in(axes):
    return {
        (line.get_color(), *np.round(line.get_xydata()[0], 9))
        for line in axes.lines
        if isinstance(line.get_marker(), tuple)
    }


@pytest.mark.parametrize(("ring", "places"), [(L_SHAPE, 1), (RECTANGLE, 2)])
def test_every_place_has_its_robot(ring, places):
    answer, figure = drawn(ring)
    colours = [canvas.ORANGE] + [canvas.PURPLE] * (places - 1)
    expected = [
        (c, fit.T_stored_small.x(), fit.T_stored_small.y()) for c, fit in zip(colours, answer.places, strict=True)
    ]
    assert robots_in(figure.axes[0]) == {(c, *np.round([x, y], 9)) for c, x, y in expected}
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert ("other places that fit as well: 1" in labels) is (places == 2)
    assert str(answer.verdict) in figure.get_suptitle() and r"\$world\$" in figure.get_suptitle()


def test_without_a_place_there_is_the_stored_map_alone():
    rng = np.random.default_rng(1)
    stored, small = survey(L_SHAPE, rng, scale=0.2), survey(RECTANGLE, rng, scale=0.2)
    answer = PlaceRecognition(stored).recognize(small)
    assert answer.verdict is Verdict.NONE
    assert robots_in(draw_recognition(stored, small, answer, "world").axes[0]) == set()
