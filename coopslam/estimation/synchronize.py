"""Records of robots that are not synchronous, made ready for a timeline: in order of time, odometry split where needed.

A fix at some instant needs the poses of observer and target then, and odometry that runs over that instant is cut in
two there. Within one record the robot is taken to move along an arc at constant speed.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from operator import attrgetter

import numpy as np

from coopslam.estimation.timeline import STAMP_TOLERANCE_S, is_motion
from coopslam.records import CornerDecision, CornerEvidence, LoopClosure, MoveNote, Odometry, PosePrior, Record
from coopslam.se2 import Pose2, adjoint

_TIMELESS = MoveNote | CornerEvidence


def synchronized(records: Iterable[Record]) -> list[Record]:
    """The same records by stamp, odometry before what was measured at its end.

    Odometry is split at the instants of all fixes that name its robot; twist and variance are shared in proportion to
    time (noise is a random walk), so that the pieces compose to the record: its pose exactly, its covariance too.
    Records of one instant and kind keep their order.
    """
    records = list(records)
    instants = _instants(records)
    pieces = []
    for record in records:
        if isinstance(record, Odometry) and is_motion(record):
            pieces += split(record, _inside(instants.get(record.robot, []), record))
        else:
            pieces.append(record)
    if all(a.stamp_s <= b.stamp_s for a, b in zip(pieces, pieces[1:], strict=False)):
        return pieces
    return sorted(pieces, key=lambda record: (record.stamp_s, not isinstance(record, Odometry)))


def split(record: Odometry, stamps_s: Iterable[float]) -> list[Odometry]:
    """A record of odometry cut at ascending stamps inside it."""
    cuts = [record.start_s, *stamps_s, record.stamp_s]
    if len(cuts) == 2:
        return [record]
    twist, duration = Pose2.Logmap(record.T_start_now), record.stamp_s - record.start_s
    shares = np.diff(cuts) / duration
    steps = [Pose2.Expmap(share * twist) for share in shares]
    density = _density(record, shares, steps)
    return [Odometry(cuts[i], cuts[i + 1], record.robot, steps[i], shares[i] * density) for i in range(len(steps))]


def _density(record: Odometry, shares: np.ndarray, steps: list[Pose2]) -> np.ndarray:
    """(3, 3) variance of a piece for each share of the time, the same for all pieces in their own axes.

    Carried to the end of the record and added, the pieces' covariances must give the record's; that is linear in the
    density, nearly proportional to it, and solved exactly. A density that is no covariance (a record that is better
    known than its parts could be) is replaced by the proportional one.
    """
    to_end, carry_all = Pose2(), np.zeros((9, 9))
    for share, step in zip(shares[::-1], steps[::-1], strict=True):
        carry = adjoint(to_end.inverse())
        carry_all += share * np.kron(carry, carry)
        to_end = step * to_end
    density = np.linalg.solve(carry_all, np.asarray(record.cov_now, float).ravel()).reshape(3, 3)
    density = (density + density.T) / 2
    return density if np.linalg.eigvalsh(density)[0] >= 0 else np.asarray(record.cov_now, float)


def _instants(records: list[Record]) -> dict[str, list[float]]:
    """Robot -> ascending instants at which some record needs its pose."""
    needed: dict[str, set[float]] = {}
    for record in records:
        if isinstance(record, Odometry | _TIMELESS):
            continue
        if isinstance(record, LoopClosure):
            needed.setdefault(record.earlier_robot, set()).add(record.earlier_s)
            needed.setdefault(record.robot, set()).add(record.stamp_s)
        elif isinstance(record, PosePrior):
            needed.setdefault(record.robot, set()).add(record.stamp_s)
        elif isinstance(record, CornerDecision):
            needed.setdefault(record.sighting.observer, set()).add(record.sighting.stamp_s)
        else:
            for role in ("observer", "target"):
                if hasattr(record, role):
                    needed.setdefault(attrgetter(role)(record), set()).add(record.stamp_s)
    return {robot: sorted(stamps) for robot, stamps in needed.items()}


def _inside(stamps_s: list[float], record: Odometry) -> list[float]:
    """Those of ascending stamps that lie within a record and not at its ends, each instant once."""
    first = bisect_right(stamps_s, record.start_s + STAMP_TOLERANCE_S)
    last = bisect_left(stamps_s, record.stamp_s - STAMP_TOLERANCE_S)
    inside = stamps_s[first:last]
    return [stamp for i, stamp in enumerate(inside) if i == 0 or stamp - inside[i - 1] > STAMP_TOLERANCE_S]
