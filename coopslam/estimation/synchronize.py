"""Records of robots that are not synchronous, made ready for a timeline: in order of time, odometry split where needed.

A fix at some instant needs the poses of observer and target then, and odometry that runs over that instant is cut in
two there. Within one record the robot is taken to move along an arc at constant speed.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from coopslam.estimation.timeline import STAMP_TOLERANCE_S, is_motion
from coopslam.records import CornerDecision, CornerEvidence, LoopClosure, MoveNote, Odometry, PosePrior, Record
from coopslam.se2 import Pose2

_SHARP_TURN_RAD = 1.0  # from pi / 2 on, axes that have turned may make the equations for the variance singular
_TIMELESS = Odometry | MoveNote | CornerEvidence  # these need no pose at an instant


def synchronized(records: Iterable[Record]) -> list[Record]:
    """The same records by stamp, odometry before what was measured at its end.

    Odometry is split at the instants of all fixes that name its robot; the pieces compose to the record, its pose and
    its covariance (`split`). Records of one instant and kind keep their order, and so does a motion in no time at all
    among the fixes of its instant.
    """
    records = list(records)
    pieces, end = [], 0
    cuts = _cuts(records)
    for position, parts in zip(cuts, split([records[k] for k in cuts], list(cuts.values())), strict=True):
        pieces += records[end:position]
        pieces += parts
        end = position + 1
    pieces += records[end:]
    return sorted(pieces, key=_order)


def split(records: Sequence[Odometry], stamps_s: Sequence[np.ndarray]) -> list[list[Odometry]]:
    """Records of odometry, each cut at its ascending stamps inside it.

    The pieces share the record's twist in proportion to time. Noise is a random walk: all pieces of a record have one
    variance per time in their own axes, which is such that they compose to the record's covariance. That is linear in
    the variance, close to proportional to it, and solved exactly. Where there is no such variance (a record that is
    better known than its parts could be), or several (one that turns far), each piece adds its share of the record's
    covariance at the record's end.
    """
    if not records:
        return []
    counts = np.array([len(stamps) + 1 for stamps in stamps_s])
    first, parent = np.cumsum(counts) - counts, np.repeat(np.arange(len(counts)), counts)
    starts = np.concatenate([[record.start_s, *stamps] for record, stamps in zip(records, stamps_s, strict=True)])
    ends = np.append(starts[1:], 0.0)
    ends[first + counts - 1] = last_s = np.array([record.stamp_s for record in records])
    duration = (last_s - starts[first])[parent]
    shares, rests = (ends - starts) / duration, (last_s[parent] - ends) / duration
    twists = np.array([Pose2.Logmap(record.T_start_now) for record in records])
    steps = map(Pose2.Expmap, shares[:, None] * twists[parent])
    cov_end = np.array([record.cov_now for record in records], dtype=float)
    cov = _shared(cov_end, first, parent, shares, rests[:, None] * twists[parent])
    rows = zip(parent.tolist(), starts.tolist(), ends.tolist(), steps, cov, strict=True)
    pieces = [Odometry(start, end, records[k].robot, step, cov_piece) for k, start, end, step, cov_piece in rows]
    return [pieces[a : a + count] for a, count in zip(first.tolist(), counts.tolist(), strict=True)]


def _shared(
    cov_end: np.ndarray, first: np.ndarray, parent: np.ndarray, shares: np.ndarray, rests: np.ndarray
) -> np.ndarray:
    """(M, 3, 3) covariances of pieces, in their own axes, that add up to their records' (N, 3, 3).

    first: (N,) index of each record's first piece.  parent: (M,) index of each piece's record.  shares: (M,) of the
    record's time.  rests: (M, 3) twist from the end of each piece to the end of its record.
    """
    carry = _adjoints(-rests)
    products = np.einsum("m,mij,mkl->mikjl", shares, carry, carry).reshape(-1, 9, 9)
    added = np.add.reduceat(products, first)  # density -> the record's covariance
    sharp = np.abs(rests[first, 2]) > _SHARP_TURN_RAD
    added[sharp] = np.eye(9)
    density = np.linalg.solve(added, cov_end.reshape(-1, 9, 1)).reshape(-1, 3, 3)
    density = (density + density.transpose(0, 2, 1)) / 2
    smallest = np.linalg.eigvalsh(density)[:, 0]
    cov = shares[:, None, None] * density[parent]
    other = (sharp | (smallest < 0))[parent]
    back, shared = _adjoints(rests[other]), shares[other, None, None] * cov_end[parent[other]]
    cov[other] = back @ shared @ back.transpose(0, 2, 1)
    return (cov + cov.transpose(0, 2, 1)) / 2


def _adjoints(twists: np.ndarray) -> np.ndarray:
    """(M, 3, 3) adjoint matrices of the poses to which (M, 3) twists lead: `se2.adjoint` for many arcs at once."""
    half = twists[:, 2] / 2
    chord = np.sinc(half / np.pi)  # over the arc: sin(half) / half
    c, s = np.cos(half), np.sin(half)
    x = chord * (c * twists[:, 0] - s * twists[:, 1])
    y = chord * (s * twists[:, 0] + c * twists[:, 1])
    adjoints = np.zeros((len(twists), 3, 3))
    adjoints[:, 0, 0] = adjoints[:, 1, 1] = np.cos(twists[:, 2])
    adjoints[:, 1, 0] = np.sin(twists[:, 2])
    adjoints[:, 0, 1] = -adjoints[:, 1, 0]
    adjoints[:, 0, 2], adjoints[:, 1, 2], adjoints[:, 2, 2] = y, -x, 1.0
    return adjoints


def _cuts(records: Sequence[Record]) -> dict[int, np.ndarray]:
    """Position of each record of motion that must be split -> ascending stamps inside it, each instant once."""
    needed = _instants(records)
    odometry: dict[str, list[int]] = {}
    for position, record in enumerate(records):
        if isinstance(record, Odometry) and record.robot in needed:
            odometry.setdefault(record.robot, []).append(position)
    cuts = {}
    for robot, positions in odometry.items():
        stamps = needed[robot]
        start, end = np.array([(records[k].start_s, records[k].stamp_s) for k in positions]).T
        first = np.searchsorted(stamps, start + STAMP_TOLERANCE_S, side="right")
        last = np.searchsorted(stamps, end - STAMP_TOLERANCE_S, side="left")
        for i in np.flatnonzero(last > first).tolist():
            if is_motion(records[positions[i]]):
                cuts[positions[i]] = stamps[first[i] : last[i]]
    return dict(sorted(cuts.items()))


def _instants(records: Sequence[Record]) -> dict[str, np.ndarray]:
    """Robot -> ascending instants, further apart than the tolerance, at which some record needs its pose."""
    needed: dict[str, list[float]] = {}
    for record in records:
        if isinstance(record, _TIMELESS):
            continue
        for robot, stamp_s in _poses_of(record):
            needed.setdefault(robot, []).append(stamp_s)
    return {robot: _apart(np.unique(stamps)) for robot, stamps in needed.items()}


def _poses_of(record: Record) -> list[tuple[str, float]]:
    """Whose pose at which stamp a record needs."""
    if isinstance(record, CornerDecision):
        record = record.sighting
    if isinstance(record, LoopClosure):
        return [(record.earlier_robot, record.earlier_s), (record.robot, record.stamp_s)]
    roles = ("robot",) if isinstance(record, PosePrior) else ("observer", "target")
    return [(getattr(record, role), record.stamp_s) for role in roles if hasattr(record, role)]


def _apart(stamps_s: np.ndarray) -> np.ndarray:
    """Ascending stamps without those that are the same instant as the last one that stays."""
    if len(stamps_s) < 2 or np.diff(stamps_s).min() > STAMP_TOLERANCE_S:
        return stamps_s
    kept = [stamps_s[0]]
    for stamp in stamps_s[1:]:
        if stamp - kept[-1] > STAMP_TOLERANCE_S:
            kept.append(stamp)
    return np.array(kept)


def _order(record: Record) -> tuple[float, bool]:
    return record.stamp_s, not (isinstance(record, Odometry) and record.start_s < record.stamp_s)
