"""Where in a stored map has a team woken up? From the few triangles that it has explored since.

The small map is laid onto the stored one in every way that its corners and walls allow (`association`), and the free
space must agree. A place is recognized when one pose explains the small map and every other is out of the question.

Why a recognized place is the right one. Let the stored map be complete. The true pairs of corners are among those
that are searched, and the search drops them only if one of these tests fails by chance: an interior angle (two sided,
`rejection` each), a place relative to a neighbour (`rejection`), the joint chi-square (`rejection`, once a corner).
As long as they are kept, the true pose is one of the fits, and a wrong one is never alone. So with m corners a false
recognition has at most the probability 3 m `rejection`, 1e-7 for m = 40, whatever the world looks like, if the
covariances are right: a symmetric world makes the answer ambiguous, not wrong. That needs no luck with the wrong
fits; `acceptance` only keeps back an answer that is itself improbable.

A stored map that ended early is searched for in the small one, once that is complete, with the same certainty.

Else, of an incomplete map, the place may lie outside, and then nothing true protects from a wrong fit: it must be
beyond chance. The expected number of accidental fits is (pairs with like angles) x product over further pairs of the
share of stored corners from which the same step leads to a like corner (`Association.accidental`); repeated rooms
count as often as the stored map shows them. It has to be below `accidental`. Another fit counts as an alternative,
though it be no better than chance, if it pairs more than `least_corners`: so does the true one where the small map
reaches over the border of the stored one. No number protects from a room beyond the map that is the double of one
inside.
"""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from coopslam.errors import require_positive
from coopslam.planning.association import Association, AssociationSettings, TooMany
from coopslam.planning.corner_map import CornerMap
from coopslam.planning.free_agreement import FreeSpace
from coopslam.planning.map_fit import Fit
from coopslam.se2 import Pose2, PoseBelief


class Verdict(StrEnum):
    """What can be said of the place."""

    RECOGNIZED = "recognized"
    AMBIGUOUS = "ambiguous"  # several places explain what was seen
    NOT_YET = "not enough yet"  # too little was seen to tell
    NONE = "none"  # no place in the stored map explains what was seen


@dataclass(frozen=True, slots=True)
class PlaceSettings:
    """How sure an answer has to be."""

    acceptance: float = 1e-3  # a fit less probable than this is not accepted
    least_corners: int = 3  # that are paired without doubt
    accidental: float = 1e-4  # expected accidental fits in an incomplete map, at most
    same_place_m: float = 0.3  # fits whose poses differ by less mean one place
    same_heading_rad: float = 0.1
    association: AssociationSettings = field(default_factory=AssociationSettings)

    def __post_init__(self):
        require_positive(1.0, acceptance=self.acceptance, accidental=self.accidental)
        require_positive(
            1e6,
            least_corners=self.least_corners,
            same_place_m=self.same_place_m,
            same_heading_rad=self.same_heading_rad,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """The answer after some triangles."""

    verdict: Verdict
    reason: str
    places: tuple[Fit, ...] = ()  # the best fit of each place that explains what was seen, the most probable first
    pairs: tuple[tuple[int, int], ...] = ()  # (small, stored) indices that hold in all fits of the first place

    @property
    def alternatives(self) -> int:
        """Places that explain what was seen as well, beside the first."""
        return max(len(self.places) - 1, 0)

    @property
    def belief(self) -> PoseBelief | None:
        """The frame of the small map (a robot's, if it was made so) in the stored map; None unless recognized.

        The covariance holds all that both maps leave open, also how the stored one drifted from its start to here.
        """
        if self.verdict is not Verdict.RECOGNIZED:
            return None
        return PoseBelief(self.places[0].T_stored_small, self.places[0].cov_small)


class _ByAccident(Exception):
    """No fit to an incomplete map is beyond chance."""

    def __init__(self, expected: float):
        super().__init__()
        self.expected = expected


class PlaceRecognition:
    """Answers for one stored map."""

    def __init__(self, stored: CornerMap, settings: PlaceSettings | None = None):
        self.stored, self.settings = stored, settings or PlaceSettings()
        self._free_space = FreeSpace(stored)

    def recognize(self, small: CornerMap) -> Recognition:
        """Where the small map lies in the stored one; its frame should be that of a robot."""
        if len(small.triangles) == 0:
            return Recognition(Verdict.NOT_YET, "no triangle is explored")
        try:
            return self._answer(self._places(self._fits(small)), small)
        except TooMany:
            return Recognition(Verdict.AMBIGUOUS, f"more than {self.settings.association.most_fits} fits")
        except _ByAccident as accident:
            return Recognition(Verdict.NOT_YET, f"{accident.expected:.1e} such fits are expected by accident")

    def _fits(self, small: CornerMap) -> list[Fit]:
        """Those that nothing speaks against. Raises TooMany or _ByAccident."""
        limits = self.settings
        if small.is_complete and not self.stored.is_complete:  # all of the stored map must be found in the small one
            fits = Association(small, self.stored, limits.association).fits()
            found_in = FreeSpace(small)
            return [one.inverted() for one in fits if not found_in.contradiction(self.stored, one)]
        association = Association(self.stored, small, limits.association)
        fits = [one for one in association.fits() if not self._free_space.contradiction(small, one)]
        if self.stored.is_complete or not fits:
            return fits
        expected = {one: association.accidental(one.pairs) for one in fits}
        least = min(expected.values())
        if least > limits.accidental:
            raise _ByAccident(least)
        rivals = limits.least_corners + 1
        return [one for one in fits if expected[one] <= limits.accidental or len(one.pairs) >= rivals]

    def _answer(self, places: list[list[Fit]], small: CornerMap) -> Recognition:
        best_of = tuple(place[0] for place in places)
        if not places:
            beyond = "" if self.stored.is_complete or small.is_complete else "; it may lie outside"
            return Recognition(Verdict.NONE, f"no place in the stored map explains what was seen{beyond}")
        pairs = tuple(sorted(set.intersection(*(set(one.pairs) for one in places[0]))))
        if len(places) > 1:
            return Recognition(Verdict.AMBIGUOUS, f"{len(places)} places explain what was seen", best_of, pairs)
        best, needed = best_of[0], self.settings.least_corners
        if len(pairs) < needed:
            reason = f"{len(pairs)} corners are paired without doubt, {needed} are needed"
            return Recognition(Verdict.NOT_YET, reason, best_of, pairs)
        if best.probability < self.settings.acceptance:
            reason = f"the only place that is left has the probability {best.probability:.1e}"
            return Recognition(Verdict.NOT_YET, reason, best_of, pairs)
        reason = f"one place explains what was seen (probability {best.probability:.2g})"
        return Recognition(Verdict.RECOGNIZED, reason, best_of, pairs)

    def _places(self, fits: list[Fit]) -> list[list[Fit]]:
        """Fits in groups that mean one place, the most probable first in each."""
        places: list[list[Fit]] = []
        for one in sorted(fits, key=lambda one: -one.probability):
            for place in places:
                if self._is_same(place[0].T_stored_small, one.T_stored_small):
                    place.append(one)
                    break
            else:
                places.append([one])
        return places

    def _is_same(self, one: Pose2, other: Pose2) -> bool:
        apart = one.between(other)
        near = np.hypot(apart.x(), apart.y()) < self.settings.same_place_m
        return bool(near and abs(apart.theta()) < self.settings.same_heading_rad)
