"""Every record refuses nonsense when it is made, and says so with the numbers."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from coopslam.errors import BadRecord
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerSighting,
    LogHeader,
    Odometry,
    RangeFix,
    RelativePoseFix,
    TriangleDecision,
    WallDecision,
)
from coopslam.se2 import Pose2

NAN, INF = float("nan"), float("inf")
COV = np.diag([0.01, 0.02, 0.03]) ** 2
GOOD = {
    Odometry: dict(start_s=1.0, stamp_s=2.0, robot="ann", T_start_now=Pose2(1, 0, 0.1), cov_now=COV),
    RelativePoseFix: dict(
        stamp_s=2.0, observer="ann", target="bob", T_observer_target=Pose2(1, 2, 3), cov_observer=COV
    ),
    BearingRangeFix: dict(stamp_s=2.0, observer="ann", target="bob", bearing_rad=0.5, range_m=3.0, cov=COV[:2, :2]),
    RangeFix: dict(stamp_s=2.0, observer="ann", target="bob", range_m=3.0, sigma_m=0.1),
    BearingFix: dict(stamp_s=2.0, observer="ann", target="bob", bearing_rad=0.5, sigma_rad=0.1),
    CornerSighting: dict(
        stamp_s=2.0,
        observer="ann",
        T_observer_corner=Pose2(0.1, 0, 1),
        cov_observer=COV,
        interior_angle_rad=1.5,
        interior_angle_sigma_rad=0.01,
    ),
    WallDecision: dict(stamp_s=2.0, start=3, end=4),
    TriangleDecision: dict(stamp_s=2.0, triangle=7, vertices=(3, 4, 5)),
    LogHeader: dict(robots=("ann", "bob")),
}
NO_COVARIANCE = [COV[:2, :2], -COV, np.full((3, 3), NAN), COV + np.triu(np.ones((3, 3)), 1), np.diag([1, INF, 1])]

NONSENSE = [
    (Odometry, dict(start_s=2.5), ["ann", "2.5", "2 s"]),
    (Odometry, dict(start_s=NAN), ["ann", "nan"]),
    (Odometry, dict(start_s=-INF), ["ann", "inf"]),
    (Odometry, dict(T_start_now=Pose2(NAN, 0, 0)), ["ann", "nan", "2.000"]),
    (Odometry, dict(T_start_now=Pose2(0, INF, 0)), ["ann", "inf", "2.000"]),
    (RelativePoseFix, dict(T_observer_target=Pose2(1, NAN, 0)), ["ann", "bob", "nan", "2.000"]),
    (CornerSighting, dict(T_observer_corner=Pose2(INF, 0, 0)), ["ann", "inf", "2.000"]),
    *[(Odometry, dict(cov_now=cov), ["ann", "(3, 3)", "2.000"]) for cov in NO_COVARIANCE],
    *[(RelativePoseFix, dict(cov_observer=cov), ["ann", "bob", "(3, 3)", "2.000"]) for cov in NO_COVARIANCE],
    *[(CornerSighting, dict(cov_observer=cov), ["ann", "(3, 3)", "2.000"]) for cov in NO_COVARIANCE],
    (BearingRangeFix, dict(cov=COV), ["ann", "bob", "(2, 2)", "2.000"]),
    (BearingRangeFix, dict(cov=-COV[:2, :2]), ["ann", "bob", "-0.0001"]),
    *[
        (kind, {stamp: value}, [str(value)])
        for kind in (Odometry, RelativePoseFix, BearingRangeFix, RangeFix, BearingFix, CornerSighting)
        for stamp, value in (("stamp_s", NAN), ("stamp_s", INF))
    ],
    *[
        (kind, dict(target="ann"), ["ann", "itself", "2.000"])
        for kind in (RelativePoseFix, BearingRangeFix, RangeFix, BearingFix)
    ],
    *[(kind, dict(bearing_rad=v), ["ann", str(v)]) for kind in (BearingFix, BearingRangeFix) for v in (NAN, INF)],
    *[
        (kind, dict(range_m=v), ["ann", str(v), "2.000"])
        for kind in (RangeFix, BearingRangeFix)
        for v in (NAN, INF, -0.5)
    ],
    *[(RangeFix, dict(sigma_m=v), ["ann", str(v), "2.000"]) for v in (0.0, -0.25, NAN, INF)],
    *[(BearingFix, dict(sigma_rad=v), ["ann", str(v), "2.000"]) for v in (0.0, -0.25, NAN, INF)],
    *[(CornerSighting, dict(interior_angle_sigma_rad=v), ["ann", str(v)]) for v in (0.0, -0.25, NAN, INF)],
    *[(CornerSighting, dict(interior_angle_rad=v), ["ann", f"{v:g}", "2.000"]) for v in (0.0, -1.25, 6.5, NAN, INF)],
    (WallDecision, dict(end=3), ["3", "2.000"]),
    (TriangleDecision, dict(vertices=(3, 4, 3)), ["7", "3, 4, 3"]),
    (TriangleDecision, dict(vertices=(3, 4)), ["7", "3, 4"]),
    (LogHeader, dict(robots=()), ["()"]),
    (LogHeader, dict(robots=("ann", "ann")), ["ann"]),
]


@pytest.mark.parametrize("kind", GOOD, ids=lambda kind: kind.__name__)
def test_what_makes_sense_is_taken_and_stays(kind):
    record = kind(**GOOD[kind])
    for name, value in GOOD[kind].items():
        assert getattr(record, name) is value
        with pytest.raises(FrozenInstanceError):
            setattr(record, name, value)


@pytest.mark.parametrize(("kind", "change", "words"), NONSENSE)
def test_nonsense_is_refused_in_words(kind, change, words):
    with pytest.raises(BadRecord) as error:
        kind(**{**GOOD[kind], **change})
    message = str(error.value)
    assert [word for word in words if word not in message] == [], message


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (Odometry, dict(start_s=2.0)),
        (Odometry, dict(cov_now=np.zeros((3, 3)))),
        (RangeFix, dict(range_m=0.0)),
        (CornerSighting, dict(interior_angle_rad=np.pi)),
        (CornerSighting, dict(interior_angle_rad=2 * np.pi - 1e-6)),
    ],
)
def test_the_edge_of_sense_is_taken(kind, change):
    kind(**{**GOOD[kind], **change})
