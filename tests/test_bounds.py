from collections import Counter

import numpy as np
import pytest

from coopslam.errors import BadInput
from coopslam.io.bounds import bounded, require_bounded_truth
from coopslam.io.log import Truth, true_track
from coopslam.records import BearingFix, BearingRangeFix, LandmarkPrior, LoopClosure, Odometry, RangeFix
from coopslam.se2 import Pose2


def test_records_within_the_limits_stay_as_they_are_and_range_zero_is_counted():
    dropped = Counter()
    fixes = [BearingRangeFix(1.0, "a", "b", 0.1, range_m, np.eye(2)) for range_m in (0.0, 1e-7, 1e-6, 1e9)]
    others = [Odometry(-1e11, 1e11, "a", Pose2(1e9, -1e9, 3), 1e18 * np.eye(3)), RangeFix(0.0, "a", "b", 0.0, 1.0)]
    assert bounded([*fixes, *others], dropped, "log") == [*fixes[2:], *others]
    assert list(dropped.values()) == [2]


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (Odometry(-2e11, 0.0, "a", Pose2(), np.eye(3)), "Odometry at t = 0.000 s: start_s holds 2e\\+11"),
        (Odometry(0.0, 2e11, "a", Pose2(), np.eye(3)), "Odometry: the time stamp 2e\\+11"),
        (Odometry(0.0, 1.0, "a", Pose2(0, -2e9, 0), np.eye(3)), "T_start_now holds 2e\\+09"),
        (LoopClosure(0.0, 1.0, "a", "a", Pose2(), 2e18 * np.eye(3)), "cov_now holds 2e\\+18"),
        (RangeFix(0.0, "a", "b", 2e9, 1.0), "range_m holds 2e\\+09"),
        (BearingFix(0.0, "a", "b", 1.0, 2e18), "sigma_rad holds 2e\\+18"),
        (RangeFix(0.0, "a", "b", 1.0, 1e-300), "sigma_m is 1e-300"),
        (LandmarkPrior(0.0, "m", np.array([0.0, -2e9]), np.eye(2)), "xy holds 2e\\+09"),
    ],
)
def test_what_is_beyond_is_named(record, words):
    with pytest.raises(BadInput, match=f"^log: .*{words}; expected"):
        bounded([BearingFix(0.0, "a", "b", 1.0, 1.0), RangeFix(0.0, "a", "b", 1.0, 1.0), record], Counter(), "log")


def test_truth_beyond_is_named():
    near, far = [Pose2(1e9, 0, 0)] * 2, [Pose2(), Pose2(0, 2e9, 0)]
    require_bounded_truth(None, "log")
    require_bounded_truth(Truth({"a": true_track([0, 1], near)}, {"m": np.zeros(2)}), "log")
    with pytest.raises(BadInput, match="log: truth of a at t = 1.000 s: 0, 2e\\+09; expected"):
        require_bounded_truth(Truth({"a": true_track([0, 1], far)}), "log")
    with pytest.raises(BadInput, match="log: truth of m: nan, 0; expected"):
        require_bounded_truth(Truth({}, {"m": np.array([np.nan, 0.0])}), "log")
