"""Which measurements a filter believes: a chi-square gate on innovations, and all innovations for statistics."""

from functools import cache
from math import inf
from typing import NamedTuple

import gtsam
from scipy.stats import chi2

from coopslam.estimation.factor_kinds import drop, kind_of, record_kind
from coopslam.estimation.timeline import Timeline

REFUSED = "beyond the gate"
_JUDGED_BEFORE = frozenset({"RelativePoseFix", "CornerDecision", "WallDecision"})  # by `gate`; the team that decided


class Innovation(NamedTuple):
    """How far a measurement was from its prediction."""

    kind: str  # in words
    nis: float  # squared, normalized with its covariance; chi-square distributed when that is honest
    dof: int


class InnovationGate:
    """Judges measurements of a timeline by their innovations, and keeps these."""

    def __init__(self, timeline: Timeline, probability: float):
        """probability: that a good measurement is refused; zero: no gate."""
        self.innovations: list[Innovation] = []  # of all measurements that were tested, those refused included
        self.refused: list[Innovation] = []
        self._timeline, self._probability = timeline, probability

    def is_credible(self, factor: gtsam.NoiseModelFactor, nis: float, dof: int) -> bool:
        """Judge an innovation, and keep it; one that is refused is counted, and may be looked at again."""
        innovation = Innovation(kind_of(factor), nis, dof)
        self.innovations.append(innovation)
        if nis <= _limit(self._probability, dof) or record_kind(factor, self._timeline) in _JUDGED_BEFORE:
            return True
        self.refused.append(innovation)
        self._timeline.refused.append(factor)
        drop(factor, self._timeline, REFUSED)
        return False


@cache
def _limit(probability: float, dof: int) -> float:
    """Squared innovation that a good measurement goes beyond with this probability."""
    return inf if probability == 0.0 else float(chi2.isf(probability, dof))
