"""The figure of the tracker's accuracy: what its curves show, read from the axes."""

from math import nan

import cv2
import numpy as np
import pytest
from scipy.stats import norm

from coopslam.report.tracker_figures import draw_tracker_accuracy, tracker_accuracy_figure

KEYS = [("range", "percent"), ("bearing", "deg"), ("heading", "deg")]


def table(method: str, size: str, gap=nan) -> dict:
    """Errors that grow with range; nothing was seen at 8 m."""
    lines = []
    for range_m in (1.0, 2.0, 8.0):
        line = {"range": range_m}
        for k, (quantity, unit) in enumerate(KEYS, start=1):
            line[f"{quantity}_error_{unit}_median"] = gap if range_m == 8 else 0.1 * k * range_m
            line[f"{quantity}_error_{unit}_95"] = gap if range_m == 8 else 0.3 * k * range_m
            line[f"{quantity}_bound_{unit}"] = 0.01 * k * range_m
        lines.append(line)
    return {"method": method, "size": size, "lines": lines}


@pytest.mark.parametrize("gap", [nan, None])
def test_curves_are_the_columns_of_the_tables(gap):
    sizes = ("640x480", "1280x960")
    figure = tracker_accuracy_figure([table(m, s, gap) for s in sizes for m in ("helix", "tag_cube", "aruco")])
    assert len(figure.axes) == 6
    assert [axes.get_title() for axes in figure.axes[:2]] == [f"{size} pixels" for size in sizes]
    for k, axes in enumerate(figure.axes):
        curves = [line.get_ydata() for line in axes.lines]
        assert len(curves) == 3 + 3 + 2  # the library has the cube's bound
        scale = k // 2 + 1
        np.testing.assert_allclose(curves[0], [0.1 * scale, 0.2 * scale, nan])
        np.testing.assert_allclose(curves[1], [0.3 * scale, 0.6 * scale, nan])
        np.testing.assert_allclose(curves[2], norm.ppf(0.75) * 0.01 * scale * np.array([1, 2, 8]), rtol=1e-4)
        np.testing.assert_array_equal(axes.lines[0].get_xdata(), [1, 2, 8])
    assert "(%)" in figure.axes[0].get_ylabel() and "(deg)" in figure.axes[2].get_ylabel()


def test_legend_names_what_is_there():
    figure = tracker_accuracy_figure([table("helix", "640x480")])
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["helix", "median", "95 % of errors are smaller", "median at the Cramer-Rao bound"]


def test_written_as_a_picture(tmp_path):
    path = draw_tracker_accuracy([table("helix", "640x480"), table("tag_cube", "640x480")], tmp_path / "new" / "a.png")
    assert np.ptp(cv2.imread(str(path))) == 255
