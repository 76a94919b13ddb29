"""What was recorded, whoever recorded it, and the truth that may lie beside it.

A format of one's own needs a class with the two methods of `LogSource`; everything else here only helps.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from coopslam.records import LogHeader, Record
from coopslam.se2 import Pose2


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """A recording, ready for an estimator once `synchronized`: records in the order in which they were written."""

    name: str
    header: LogHeader
    records: list[Record]
    dropped: Counter[str] = field(default_factory=Counter)  # what the reader left out: "what: why" -> number


@dataclass(frozen=True, slots=True, eq=False)
class TrueTrack:
    """Where a robot really was."""

    stamps_s: np.ndarray  # (N,) ascending, each once
    poses: list[Pose2]  # N, in a frame common to the whole log


def true_track(stamps_s: Sequence[float], poses: Sequence[Pose2]) -> TrueTrack:
    """A track from stamps in any order; of poses at one instant the first counts."""
    stamps, first = np.unique(np.asarray(stamps_s, dtype=float), return_index=True)
    return TrueTrack(stamps, [poses[k] for k in first.tolist()])


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What an independent, better sensor or the simulator says; for scores and figures only."""

    robots: Mapping[str, TrueTrack]
    landmarks: Mapping[str, np.ndarray] = field(default_factory=dict)  # name -> (2,), m


class LogSource(Protocol):
    """A recording in some format."""

    def read(self) -> Log:
        """Header and records. Raises BadInput, with file and line, for what cannot be used."""

    def truth(self) -> Truth | None:
        """The truth that was recorded beside it; None when there is none. Raises BadInput."""
