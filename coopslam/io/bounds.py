"""Numbers that no robot on Earth can have met: records and truth with such are refused before they reach an estimator.

Squares of lengths beyond these limits overflow, and what comes out of an estimator then is nobody's trajectory.
"""

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from coopslam.errors import BadInput
from coopslam.io.log import Truth
from coopslam.io.number_table import LARGEST_STAMP_S
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerSighting,
    LandmarkPrior,
    LoopClosure,
    Odometry,
    PosePrior,
    RangeFix,
    Record,
    RelativePoseFix,
)
from coopslam.se2 import Pose2

FARTHEST = 1e9  # m; rad for bearings
LARGEST_VARIANCE = 1e18  # m^2 or rad^2
SMALLEST_SIGMA = 1e-9  # m or rad; the square of its inverse must not overflow either
NEAREST_M = 1e-6  # a bearing to what is nearer says nothing

# what is measured, how well, and the stamp beside `stamp_s`
_FIELDS = {
    Odometry: ("T_start_now", "cov_now", "start_s"),
    RelativePoseFix: ("T_observer_target", "cov_observer", "stamp_s"),
    BearingRangeFix: ("range_m", "cov", "stamp_s"),
    RangeFix: ("range_m", "sigma_m", "stamp_s"),
    BearingFix: ("bearing_rad", "sigma_rad", "stamp_s"),
    LoopClosure: ("T_earlier_now", "cov_now", "earlier_s"),
    PosePrior: ("T_start_robot", "cov_robot", "stamp_s"),
    LandmarkPrior: ("xy", "cov", "stamp_s"),
    CornerSighting: ("T_observer_corner", "cov_observer", "stamp_s"),
}


def bounded(records: Sequence[Record], dropped: Counter[str], where: str) -> list[Record]:
    """The records, without sightings at range zero, which are counted. where: the log, for messages.

    Raises BadInput for a record with a stamp, a length or a covariance beyond the limits.
    """
    for kind in {type(record) for record in records}:
        _require_stamps([record for record in records if type(record) is kind], kind, where)
    for kind, fields in _FIELDS.items():
        own = [record for record in records if type(record) is kind]
        if own:
            _require_numbers(own, *fields, where)
    kept = [record for record in records if not (isinstance(record, BearingRangeFix) and record.range_m < NEAREST_M)]
    if len(kept) < len(records):
        dropped[f"bearing_range: nearer than {NEAREST_M:g} m, where there is no bearing"] += len(records) - len(kept)
    return kept


def require_bounded_truth(truth: Truth | None, where: str) -> None:
    """Raises BadInput for a true position beyond the limits, or that is not finite."""
    for robot, track in truth.robots.items() if truth else ():
        k = _first_beyond([_numbers(pose) for pose in track.poses], FARTHEST)
        if k is not None:
            place = "{:g}, {:g}".format(*_numbers(track.poses[k]))
            raise BadInput(f"{where}: truth of {robot} at t = {track.stamps_s[k]:.3f} s: {place}; {_EXPECTED}")
    for name, xy in truth.landmarks.items() if truth else ():
        if _first_beyond([xy], FARTHEST) is not None:
            raise BadInput(f"{where}: truth of {name}: {xy[0]:g}, {xy[1]:g}; {_EXPECTED}")


_EXPECTED = f"expected a position within {FARTHEST:g} m"


def _require_stamps(records: Sequence[Record], kind: type, where: str) -> None:
    k = _first_beyond([[record.stamp_s] for record in records], LARGEST_STAMP_S)
    if k is not None:
        stamp = f"the time stamp {records[k].stamp_s:g}"
        raise BadInput(f"{where}: {kind.__name__}: {stamp}; expected seconds, at most {LARGEST_STAMP_S:g}")


def _require_numbers(records: Sequence[Record], measured: str, noise: str, first_s: str, where: str) -> None:
    """Of records of one kind."""
    for field, limit in ((first_s, LARGEST_STAMP_S), (measured, FARTHEST), (noise, LARGEST_VARIANCE)):
        numbers = [_numbers(getattr(record, field)) for record in records]
        k = _first_beyond(numbers, limit)
        if k is not None:
            record = f"{type(records[k]).__name__} at t = {records[k].stamp_s:.3f} s"
            largest = float(np.abs(numbers[k]).max())
            raise BadInput(f"{where}: {record}: {field} holds {largest:g}; expected at most {limit:g}")
    for record in records if noise.startswith("sigma") else ():
        if getattr(record, noise) < SMALLEST_SIGMA:
            said = f"{type(record).__name__} at t = {record.stamp_s:.3f} s: {noise} is {getattr(record, noise):g}"
            raise BadInput(f"{where}: {said}; expected at least {SMALLEST_SIGMA:g}")


def _numbers(value) -> Iterable[float]:
    if isinstance(value, Pose2):
        return value.x(), value.y()
    return value if isinstance(value, np.ndarray) else (value,)


def _first_beyond(numbers: Sequence, limit: float) -> int | None:
    """Index of the first entry that is not within the limit."""
    table = np.abs(np.asarray(numbers, dtype=float)).reshape(len(numbers), -1)
    beyond = np.flatnonzero(~(table <= limit).all(axis=1))
    return int(beyond[0]) if len(beyond) else None
