"""Every way to lay a small map onto a stored one that the corners allow.

A pair of corners alone makes a hypothesis: a corner is oriented, so it fixes the pose. From there on the pairs follow:
along walls that both maps know there is no choice, and from corner to corner over open space only a few stored ones
are compatible. Each further pair has to fit all pairs before it together (joint compatibility: Neira and Tardos, Data
Association in Stochastic Mapping Using the Joint Compatibility Test, 2001).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from coopslam.errors import require_positive
from coopslam.planning.corner_map import UNKNOWN, CornerMap, relative_poses, rotations, turned
from coopslam.planning.map_fit import FLOOR_SIGMAS, Fit, fit
from coopslam.se2 import wrap

CLEAR_TURN_RAD = 0.35  # beyond all doubt of headings and angles
Pairs = dict[int, int]  # small -> stored index


@dataclass(frozen=True, slots=True)
class AssociationSettings:
    """When corners may be the same."""

    rejection: float = 1e-9  # a fit less probable than this is none
    most_fits: int = 500  # of a search; beyond, it is given up and the answer is open

    def __post_init__(self):
        require_positive(0.1, rejection=self.rejection)
        require_positive(1e6, most_fits=self.most_fits)

    @property
    def angle_sigmas(self) -> float:
        """How far apart two interior angles may be measured."""
        return float(np.sqrt(chi2.isf(self.rejection, 1)))

    @property
    def distance_sq(self) -> float:
        """How far a corner may lie from where another one, and the way between them, tells it to be (3 dof)."""
        return float(chi2.isf(self.rejection, 3))


class TooMany(Exception):
    """More fits than `most_fits`."""


class Association:
    """The search for fits of one small map."""

    def __init__(self, stored: CornerMap, small: CornerMap, settings: AssociationSettings | None = None):
        self.stored, self.small, self.settings = stored, small, settings or AssociationSettings()
        sigma = np.hypot(stored.angle_sigma_rad, small.angle_sigma_rad)
        apart = np.abs(small.interior_angles[:, None] - stored.interior_angles[None])
        self._distance_sq = self.settings.distance_sq
        self.alike = apart <= self.settings.angle_sigmas * sigma  # (small, stored) interior angles agree
        self._leads_on: dict[tuple[int, int], np.ndarray] = {}  # small step -> stored corners from which it leads on
        self._relative: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def fits(self) -> list[Fit]:
        """All that are jointly compatible, each set of pairs once, the most probable first. Raises TooMany.

        Of a complete stored map every corner of the small one must be found; else those that lie beyond it may be left.
        """
        found: dict[frozenset, Fit] = {}
        for anchor in self._anchors():
            for candidate in self._grown(anchor):
                found.setdefault(frozenset(candidate.pairs), candidate)
                if len(found) > self.settings.most_fits:
                    raise TooMany
        return sorted(found.values(), key=lambda one: (-len(one.pairs), -one.probability, one.squares))

    def _anchors(self) -> Iterator[Pairs]:
        """Sets of pairs that one pair leads to along walls, each set once."""
        seen = set()
        for i in self._first_corners():
            for j in np.flatnonzero(self.alike[i]).tolist():
                pairs = self.walked({}, i, j)
                key = frozenset(pairs.items()) if pairs else None
                if pairs and key not in seen:
                    seen.add(key)
                    yield pairs

    def _first_corners(self) -> list[int]:
        """Where to begin: at any corner of the longest run of walls, or of an incomplete stored map at every corner."""
        if not self.stored.is_complete:
            return list(range(len(self.small.ids)))
        return [max(range(len(self.small.ids)), key=self._run_length)]

    def _run_length(self, i: int) -> int:
        length, at = 0, i
        while at != UNKNOWN and length <= len(self.small.ids):
            length, at = length + 1, self.small.leaving[at]
        return length

    def walked(self, pairs: Pairs, i: int, j: int) -> Pairs | None:
        """The pairs with (i, j) and all that walls known in both maps add; None: they contradict each other."""
        pairs, taken, queue = dict(pairs), set(pairs.values()), [(i, j)]
        while queue:
            i, j = queue.pop()
            if i in pairs or j in taken:
                if pairs.get(i) != j:
                    return None
                continue
            if not self.alike[i, j]:
                return None
            pairs[i] = j
            taken.add(j)
            for small_ends, stored_ends in (
                (self.small.leaving, self.stored.leaving),
                (self.small.arriving, self.stored.arriving),
            ):
                if small_ends[i] != UNKNOWN and stored_ends[j] != UNKNOWN:
                    queue.append((int(small_ends[i]), int(stored_ends[j])))
        return pairs

    def _grown(self, anchor: Pairs) -> Iterator[Fit]:
        """The compatible sets of pairs that contain the anchor's, as large as they can be. Raises TooMany."""
        stack, steps = [(anchor, frozenset())], 0
        while stack:
            pairs, left = stack.pop()
            steps += 1
            if steps > self.settings.most_fits:
                raise TooMany
            candidate = fit(self.stored, self.small, sorted(pairs.items()))
            if candidate.probability < self.settings.rejection:
                continue
            nearest = self._nearest_open(pairs, left)
            if nearest is None:
                yield candidate
                continue
            i, known = nearest
            options = self.compatible(i, known, pairs)
            if not self.stored.is_complete and (len(options) != 1 or not self._stands_apart(options[0])):
                stack.append((pairs, left | {i}))
                continue
            grown = (self.walked(pairs, i, j) for j in options)
            stack.extend((more, left) for more in grown if more is not None)

    def _nearest_open(self, pairs: Pairs, left: frozenset[int]) -> tuple[int, int] | None:
        """The unpaired small corner that is nearest to a paired one, and that one."""
        waiting = [i for i in range(len(self.small.ids)) if i not in pairs and i not in left]
        if not waiting:
            return None
        known = list(pairs)
        apart = self.small.places[waiting][:, None] - self.small.places[known][None]
        row, column = np.unravel_index(np.argmin((apart**2).sum(axis=2)), (len(waiting), len(known)))
        return waiting[row], known[column]

    def compatible(self, i: int, known: int, pairs: Pairs) -> list[int]:
        """Stored corners that lie where the small corner i must be, seen from its paired neighbour, the nearest first.

        Place and heading relative to the neighbour are compared, with what both maps leave open of them.
        """
        distances, taken = self._step_distances_sq(known, i, pairs[known]), set(pairs.values())
        order = np.argsort(distances, kind="stable")
        order = order[distances[order] <= self._distance_sq]
        return [j for j in order.tolist() if self.alike[i, j] and j not in taken]

    def accidental(self, pairs: Iterable[tuple[int, int]]) -> float:
        """How many sets of so many pairs are to be expected if the small map has nothing to do with the stored one.

        The pairs with like angles, times for each further pair the share of stored corners from which the same step
        leads to a like corner too; the true one is not counted, and one more than were found.
        """
        (first, *others), expected = pairs, float(self.alike.sum())
        known = dict([first])
        for i, j in others:
            start = min(known, key=lambda k: float(np.hypot(*(self.small.places[k] - self.small.places[i]))))
            expected *= self._share_of_like_steps(start, i, known[start])
            known[i] = j
        return expected

    def _share_of_like_steps(self, start: int, end: int, stored_start: int) -> float:
        if (start, end) not in self._leads_on:
            steps = (self._step_distances_sq(start, end, u) for u in range(len(self.stored.ids)))
            near = [(step <= self._distance_sq) & self.alike[end] for step in steps]
            self._leads_on[start, end] = np.array([ends.any() for ends in near])
        leads_on = self._leads_on[start, end]
        return (np.count_nonzero(leads_on) - int(leads_on[stored_start]) + 1) / len(leads_on)

    def _step_distances_sq(self, start: int, end: int, stored_start: int) -> np.ndarray:
        """(n,) how far each stored corner is from where the step between two small corners leads from a stored one."""
        T_here, cov_here = relative_poses(self.small, start, np.array([end]))
        if stored_start not in self._relative:
            everyone = np.arange(len(self.stored.ids))
            self._relative[stored_start] = relative_poses(self.stored, stored_start, everyone)
        return _distances_sq(T_here[0], cov_here[0], *self._relative[stored_start])

    def _stands_apart(self, j: int) -> bool:
        """Whether no unseen corner next to a stored one can be taken for it.

        The next corner along a wall not yet walked may be near, but its heading differs by the turn at one of the two:
        in a corner that is far from straight it is no candidate, if it is open by the same angle.
        """
        if UNKNOWN not in (self.stored.leaving[j], self.stored.arriving[j]):
            return True
        return bool(abs(self.stored.interior_angles[j] - np.pi) > CLEAR_TURN_RAD)


def _distances_sq(T: np.ndarray, cov: np.ndarray, others: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """(k,) squared Mahalanobis distances between one pose and k others, in the axes of the others."""
    apart = turned(-others[:, 2], T[:2] - others[:, :2])
    differences = np.column_stack([apart, wrap(T[2] - others[:, 2])])
    own = rotations(differences[:, 2])
    total = own @ cov @ own.transpose(0, 2, 1) + covs + np.diag(FLOOR_SIGMAS**2)
    return np.einsum("ki,ki->k", differences, np.linalg.solve(total, differences[:, :, None])[:, :, 0])
