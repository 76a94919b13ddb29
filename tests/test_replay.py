import numpy as np
import pytest

from coopslam.estimation.replay import in_groups, replay
from coopslam.records import Odometry, RangeFix
from coopslam.se2 import Pose2


def drive(stamp_s, robot="a"):
    return Odometry(stamp_s - 1, stamp_s, robot, Pose2(1, 0, 0), np.eye(3))


def seen(stamp_s):
    return RangeFix(stamp_s, "a", "b", 1.0, 0.1)


LOG = [drive(1), seen(1), seen(1 + 5e-7), drive(2), drive(2, "b"), drive(3), seen(3), seen(3.2), drive(7), drive(8)]


def sizes(records, period_s=0.0):
    groups = list(in_groups(records, period_s))
    assert [record for group in groups for record in group] == list(records)  # all, each once, in order
    return [len(group) for group in groups]


def test_a_group_ends_with_the_fixes_of_an_instant():
    assert sizes(LOG) == [3, 4, 1, 2]


@pytest.mark.parametrize(("period_s", "expected"), [(0.1, [7, 3]), (2.0, [7, 3]), (2.1, [8, 2]), (50.0, [10])])
def test_a_group_spans_a_period_at_least(period_s, expected):
    """The first stamp is that of the first record: 1 s."""
    assert sizes(LOG, period_s) == expected


def test_odometry_alone_is_one_group_and_nothing_is_none():
    assert sizes([drive(k) for k in range(1, 9)]) == [8]
    assert list(in_groups([])) == []


class Recorder:
    """What `replay` needs of an estimator: keeps the groups, and makes two poses of each."""

    def __init__(self):
        self.timeline, self.groups, self.stamps = self, [], {}
        self.graph = "graph"

    def update(self, records):
        self.groups.append(records)
        self.stamps.update({(len(self.groups), k): 0.0 for k in range(2)})
        return f"estimate {len(self.groups)}"


def test_a_replay_feeds_group_by_group_and_keeps_what_was_when():
    estimator, told = Recorder(), []
    done = replay(estimator, in_groups(LOG), told.append)
    assert estimator.groups == list(in_groups(LOG))
    assert done.estimate == "estimate 4"
    assert told == done.stamps_s.tolist() == [1 + 5e-7, 3, 3.2, 8]
    assert done.poses.tolist() == [2, 4, 6, 8]
    assert (done.latencies_s >= 0).all() and done.seconds == pytest.approx(sum(done.latencies_s.tolist()))


def test_nothing_to_replay_is_an_error():
    with pytest.raises(ValueError, match="nothing to replay"):
        replay(Recorder(), [])
