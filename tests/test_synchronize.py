from pathlib import Path

import numpy as np
import pytest

from coopslam.estimation.synchronize import split, synchronized
from coopslam.estimation.timeline import Timeline
from coopslam.io.mrclam import MrclamSource
from coopslam.records import (
    BearingRangeFix,
    CornerDecision,
    CornerSighting,
    LandmarkPrior,
    LoopClosure,
    MoveNote,
    Odometry,
    PosePrior,
    RangeFix,
)
from coopslam.se2 import Pose2, chain_covariance, xytheta

MRCLAM_6 = Path(__file__).parents[2] / "shared" / "data" / "mrclam" / "MRCLAM_Dataset6"
COV = np.diag([0.03, 0.01, 0.02]) ** 2
ARC = Pose2(1.0, 0.2, 0.4)


def drive(start_s, stamp_s, robot="a", step=ARC, cov=COV):
    return Odometry(start_s, stamp_s, robot, step, cov)


def seen(stamp_s, observer="a", target="b"):
    return RangeFix(stamp_s, observer, target, 3.0, 0.1)


def spans(records, robot="a"):
    return [(r.start_s, r.stamp_s) for r in records if isinstance(r, Odometry) and r.robot == robot]


def composed(pieces):
    """By `se2.chain_covariance`, one after the other."""
    total, cov = Pose2(), np.zeros((3, 3))
    for piece in pieces:
        cov = chain_covariance(piece.T_start_now, cov, piece.cov_now)
        total = total * piece.T_start_now
    return total, cov


def random_walk(rng, step, count=400):
    """Covariance of an arc, in the axes of its end: noise of one density all along it."""
    root = rng.normal(size=(3, 3)) * [0.03, 0.01, 0.02]
    twist, density = Pose2.Logmap(step) / count, root.T @ root / count
    total, cov = Pose2(), np.zeros((3, 3))
    for _ in range(count):
        cov = chain_covariance(Pose2.Expmap(twist), cov, density)
        total = total * Pose2.Expmap(twist)
    return (cov + cov.T) / 2


def random_step(rng, turn_rad=0.5):
    return Pose2(*rng.uniform(-2, 2, 2), rng.uniform(-turn_rad, turn_rad))


KINDS = {
    "random walk": lambda rng, step: random_walk(rng, step),
    "nothing said of x and y": lambda rng, step: np.diag([0.0, 0.0, 0.02**2]),
    "only along": lambda rng, step: np.diag([0.05**2, 0.0, 0.0]),
    "any": lambda rng, step: (lambda root: root @ root.T)(rng.normal(size=(3, 3)) * 0.05),
    "exact": lambda rng, step: np.zeros((3, 3)),
    "from far away": lambda rng, step: (lambda lever: lever @ COV @ lever.T)(Pose2(30.0, 9.0, 1.0).AdjointMap()),
}


@pytest.mark.parametrize("turn_rad", [0.0, 0.5, 3.1])
@pytest.mark.parametrize("kind", KINDS)
def test_pieces_compose_to_the_record(kind, turn_rad):
    rng = np.random.default_rng(0)
    records, stamps = [], []
    for k in range(30):
        step = random_step(rng, turn_rad)
        cov = KINDS[kind](rng, step)
        records.append(drive(k, k + 1, step=step, cov=(cov + cov.T) / 2))
        stamps.append(np.sort(rng.uniform(k + 0.01, k + 0.99, rng.integers(1, 6))))
    for record, cuts, pieces in zip(records, stamps, split(records, stamps), strict=True):
        assert [piece.start_s for piece in pieces] == [record.start_s, *cuts]
        assert [piece.stamp_s for piece in pieces] == [*cuts, record.stamp_s]
        total, cov = composed(pieces)
        np.testing.assert_allclose(xytheta(record.T_start_now.between(total)), 0.0, atol=1e-12)
        np.testing.assert_allclose(cov, record.cov_now, rtol=0, atol=1e-9 * np.abs(record.cov_now).max())


def test_a_random_walk_is_split_into_the_random_walks_of_its_parts():
    """Many equal parts have the covariance with which the walk was made, not only the right sum."""
    count, step, density = 10, Pose2(1.0, 0.1, 0.3), np.array([[9.0, 1, 2], [1, 4, -1], [2, -1, 5]]) * 1e-5
    twist = Pose2.Logmap(step) / count
    total, cov = Pose2(), np.zeros((3, 3))
    for _ in range(count):
        cov = chain_covariance(Pose2.Expmap(twist), cov, density)
        total = total * Pose2.Expmap(twist)
    [pieces] = split([drive(0, count, step=total, cov=(cov + cov.T) / 2)], [np.arange(1.0, count)])
    for piece in pieces:
        np.testing.assert_allclose(piece.cov_now, density, rtol=0, atol=1e-9 * 9e-5)
        np.testing.assert_allclose(Pose2.Logmap(piece.T_start_now), twist, atol=1e-12)


@pytest.mark.parametrize("turn_rad", [np.pi, 2 * np.pi, np.pi / 2])
def test_turns_on_the_spot_are_split_although_the_axes_come_to_lie_on_each_other(turn_rad):
    [pieces] = split([drive(0, 1, step=Pose2(0, 0, turn_rad))], [np.array([0.5])])
    np.testing.assert_allclose(composed(pieces)[1], COV, atol=1e-15)


def test_an_arc_is_cut_on_the_arc():
    """A quarter of a circle of radius 2: its middle is at 45 degrees."""
    [pieces] = split([drive(0, 2, step=Pose2(2.0, 2.0, np.pi / 2))], [np.array([1.0])])
    half = 2 * np.sin(np.pi / 4)
    np.testing.assert_allclose(xytheta(pieces[0].T_start_now), [half, 2 - half, np.pi / 4], atol=1e-12)


def test_odometry_is_cut_where_its_robot_is_needed_and_nowhere_else():
    sighting = CornerSighting(0.5, "a", Pose2(), COV, 1.5, 0.1)
    records = [
        drive(0, 1),
        drive(0, 1, "b"),
        drive(0, 1, "c"),
        seen(0.25),
        seen(0.25, "b", "landmark"),
        CornerDecision(0.9, sighting, 1, True),
        PosePrior(0.75, "b", Pose2(), COV),
        LoopClosure(0.6, 0.8, "a", "b", Pose2(), COV),
        LandmarkPrior(0.1, "landmark", np.zeros(2), np.eye(2)),
        MoveNote(0.2, "a", "b", "m", "e"),
    ]
    out = synchronized(records)
    assert spans(out, "a") == [(0, 0.25), (0.25, 0.5), (0.5, 0.6), (0.6, 1)]
    assert spans(out, "b") == [(0, 0.25), (0.25, 0.75), (0.75, 0.8), (0.8, 1)]
    assert spans(out, "c") == [(0, 1)]


def test_instants_at_the_ends_or_together_cut_once_or_not_at_all():
    near = 4e-7  # less than the tolerance of a millionth of a second
    fixes = [seen(t) for t in (0.0, near, 1.0 - near, 1.0, 0.5, 0.5, 0.5 + near, 0.5 - near, 2.0, -1.0)]
    assert spans(synchronized([drive(0, 1), *fixes])) == [(0, 0.5 - near), (0.5 - near, 1)]


def test_what_stands_or_takes_no_time_stays_whole():
    standing = Odometry(0, 1, "a", Pose2(), np.zeros((3, 3)))
    assert synchronized([standing, seen(0.5)])[1] is standing
    turn = Odometry(1, 1, "a", Pose2(0, 0, 1.0), COV)
    before, after = seen(1.0), seen(1.0, target="c")
    records = [standing, before, turn, after]
    assert [id(record) for record in synchronized(records)] == [id(record) for record in records]


def test_records_come_by_stamp_odometry_first_and_otherwise_as_they_were():
    fixes = [seen(1.0, target=target) for target in ("b", "c", "d")]
    early, late, gap = seen(-1.0), seen(9.0), seen(5.0)
    steps = [drive(6, 7), drive(0, 1, "b"), drive(0, 1)]
    out = synchronized([late, *fixes, gap, *steps, early])
    expected = [early, steps[1], steps[2], *fixes, gap, steps[0], late]
    assert [id(record) for record in out] == [id(record) for record in expected]
    assert synchronized([]) == []
    assert [id(r) for r in synchronized([fixes[0], steps[2]])] == [id(steps[2]), id(fixes[0])]  # stamps ascend already


def test_a_timeline_drops_nothing_of_what_was_recorded_out_of_step():
    """Two robots with clocks of 0.3 s and 0.7 s; fixes before, between and after their odometry."""
    rng = np.random.default_rng(1)
    records = [drive(k * 0.3, (k + 1) * 0.3) for k in range(100)]
    records += [drive(3 + k * 0.7, 3 + (k + 1) * 0.7, "b") for k in range(30)]
    records += [seen(stamp) for stamp in rng.uniform(-2, 35, 60)]
    timeline = Timeline(("a", "b"))
    timeline.extend(synchronized([records[k] for k in rng.permutation(len(records))]), None)
    assert not timeline.dropped and timeline.used["RangeFix"] == 60
    assert {record.stamp_s for record in records if isinstance(record, RangeFix) and 0 < record.stamp_s < 24} <= set(
        timeline.stamps.values()
    )


def test_a_long_log_of_five_robots_composes_to_the_same():
    if not MRCLAM_6.is_dir():
        pytest.skip(f"{MRCLAM_6} is not there")
    log = MrclamSource(MRCLAM_6).read()
    out = synchronized(log.records)
    whole = {r: [x for x in log.records if isinstance(x, Odometry) and x.robot == r] for r in log.header.robots}
    for robot, records in whole.items():
        ends = [record.stamp_s for record in records]
        pieces = [record for record in out if isinstance(record, Odometry) and record.robot == robot]
        assert len(pieces) > len(records) and set(ends) <= {piece.stamp_s for piece in pieces}
        expected, got = Pose2(), Pose2()
        for record in records:
            expected = expected * record.T_start_now
        for piece in pieces:
            got = got * piece.T_start_now
        np.testing.assert_allclose(xytheta(expected.between(got)), 0.0, atol=1e-8)  # 15 000 roundings of 1e-16, 100 m
    assert sum(isinstance(record, BearingRangeFix) for record in out) == 19371
