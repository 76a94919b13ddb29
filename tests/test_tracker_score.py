"""Errors of fixes against numbers worked by hand."""

from math import pi, sqrt

import numpy as np
import pytest

from coopslam.estimation.estimate import Trajectory
from coopslam.evaluation.tracker_score import score_fixes
from coopslam.records import BearingRangeFix, RelativePoseFix
from coopslam.se2 import Pose2

TRUTH = {  # bob stands to the left of ann, 4 m away, until he drives at 2 s
    "ann": Trajectory(np.array([0.0]), [Pose2(1.0, 1.0, pi / 2)]),
    "bob": Trajectory(np.array([0.0, 2.0, 3.0]), [Pose2(-3.0, 1.0, 0.0), Pose2(-3.0, 1.0, 0.0), Pose2(-3.0, 2.0, 0.0)]),
}
COV = np.diag([0.01, 0.04, 0.09])


def test_a_pose_and_a_bearing_with_range():
    """True: bob at (0, 4) m in ann's frame, heading -90 degrees; bearing 90 degrees."""
    pose = RelativePoseFix(1.0, "ann", "bob", Pose2(0.0, 4.2, -pi / 2 + 0.3), COV)
    point = BearingRangeFix(2.0, "ann", "bob", pi / 2 + 0.02, 4.1, np.diag([0.0001, 0.0025]))
    scores = score_fixes([pose, point], TRUTH)
    assert scores["fixes"] == 2 and scores["with_heading"] == 1
    assert scores["pose_nees_mean"] == pytest.approx(0.2**2 / 0.04 + 0.3**2 / 0.09)
    assert scores["pose_nees_median"] == scores["pose_nees_mean"]
    assert scores["point_nees_mean"] == pytest.approx(0.02**2 / 0.0001 + 0.1**2 / 0.0025)
    assert scores["range_error_rms_m"] == pytest.approx(sqrt((0.2**2 + 0.1**2) / 2))
    assert scores["bearing_error_rms_rad"] == pytest.approx(sqrt(0.02**2 / 2))
    assert scores["heading_error_rms_rad"] == pytest.approx(0.3)
    assert scores["headings_beyond_5_sigma"] == 0


def test_where_a_robot_drove_later_does_not_count():
    seen = [RelativePoseFix(t, "ann", "bob", Pose2(x, 4.0, -pi / 2), COV) for t, x in ((1.9, 0.0), (3.0, 1.0))]
    assert score_fixes(seen, TRUTH)["pose_nees_mean"] == pytest.approx(0.0, abs=1e-18)


def test_angles_come_round():
    """Behind ann, a bearing just beyond 180 degrees is near one just before it."""
    truth = {"ann": Trajectory(np.array([0.0]), [Pose2()]), "bob": Trajectory(np.array([0.0]), [Pose2(-2.0, 0.0, pi)])}
    cov = np.diag([1e-4, 1e-4])
    scores = score_fixes([BearingRangeFix(0.0, "ann", "bob", -pi + 0.01, 2.0, cov)], truth)
    assert scores["point_nees_mean"] == pytest.approx(0.01**2 / 1e-4)
    turned = RelativePoseFix(0.0, "ann", "bob", Pose2(-2.0, 0.0, -pi + 1.6), COV)
    assert score_fixes([turned], truth)["heading_error_rms_rad"] == pytest.approx(1.6)
    assert score_fixes([turned], truth)["headings_beyond_5_sigma"] == 1  # 1.6 rad at a sigma of 0.3


def test_nothing_seen_is_no_number():
    scores = score_fixes([], TRUTH)
    assert scores["fixes"] == 0 and scores["pose_nees_mean"] is None and scores["range_error_rms_m"] is None
