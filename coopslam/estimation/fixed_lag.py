"""Fixed lag: the poses of the last seconds are smoothed, and what they say when they leave becomes a prior.

The window holds every pose that its robot left less than the lag ago, each robot's latest pose however long it has
stood there, and all landmarks and map vertices. It is linearized anew in every iteration; a pose that leaves is
eliminated, exactly where the problem is linear, and never linearized again. Factors that reach a pose that has left
come too late and are counted as dropped.

What those factors said lives on in one `MarginalPrior`. It is linearized once, at the estimate when the pose left,
while newer factors on the same variables are linearized where these are now; `marginal_prior` says why the two agree
nevertheless on what neither can know.

Why not GTSAM's smoothers: `IncrementalFixedLagSmoother` freezes the linearization of every variable next to an
eliminated one, which landmarks and standing robots are nearly at once and for ever after; `BatchFixedLagSmoother` has
no covariances in Python.
"""

import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf

import gtsam
import numpy as np

from coopslam.errors import BadInput, UnderDetermined, require_positive
from coopslam.estimation import deep_stack
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.factors import gaussian
from coopslam.estimation.gate import Gate, GateSettings
from coopslam.estimation.graph_check import in_words
from coopslam.estimation.keys import describe, is_landmark, is_vertex, robot_index, value_of
from coopslam.estimation.marginal_prior import MarginalPrior, eliminated
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.estimation.tracks import Growth
from coopslam.records import Record
from coopslam.se2 import Pose2, chain_covariance

TOO_LATE = "older than the window"
_ELIMINATED_AT_ONCE = 40  # poses; elimination is dense, and many poses leave when a robot is placed late
_HALVINGS = 8  # of a step that raises the cost


@dataclass(frozen=True, slots=True)
class FixedLagSettings:
    """How much of the past is smoothed, and how far each update goes."""

    lag_s: float = 15.0  # a pose leaves the window so long after its robot left it
    step_threshold: float = 3e-3  # m or rad: an update ends with a step smaller than this
    rounds: int = 4  # at most so many steps in one update

    def __post_init__(self):
        require_positive(lag_s=self.lag_s, step_threshold=self.step_threshold)
        if self.rounds < 1:
            raise BadInput(f"rounds: one or more expected, got {self.rounds}")


@dataclass(frozen=True, slots=True, eq=False)
class Departed:
    """A pose as it was known when it left the window."""

    pose: Pose2
    cov: np.ndarray | None  # (3, 3) axes of the pose; None where nothing told


class FixedLag:
    """Causal smoothing at a cost per update that does not grow with the run."""

    def __init__(
        self,
        robots: Iterable[str],
        landmarks: Iterable[str] = (),
        settings: FixedLagSettings = FixedLagSettings(),
        gate: GateSettings | None = None,
        timeline: TimelineSettings | None = None,
    ):
        self.timeline = Timeline(robots, landmarks, timeline)
        self.settings = settings
        self.graph = gtsam.NonlinearFactorGraph()  # everything so far, for a batch solve
        self.timing = 0.0  # s spent in updates
        self._gate = Gate(self.timeline, gate or GateSettings())
        self._now_s = -inf
        self._window = gtsam.Values()
        self._factors: list[tuple[gtsam.NonlinearFactor, list[int]]] = []  # of the window, with their keys
        self._prior: MarginalPrior | None = None
        self._tree: gtsam.GaussianBayesTree | None = None  # the window eliminated, for covariances
        self._departed: dict[int, Departed] = {}  # the stored history; the smoother itself never reads it
        self._left: Counter[str] = Counter()  # robot -> number of its poses that have left, always its first ones
        self._estimate = FixedLagEstimate(self)

    @property
    def window_size(self) -> int:
        """Number of variables that are being smoothed."""
        return self._window.size()

    def update(self, records: Iterable[Record]) -> Estimate:
        """Smooth with a further group of records. Raises UnderDetermined when a variable is not tied down."""
        began = time.perf_counter()
        records = list(records)
        refusals = self._gate.refusals(records, self._estimate)
        growth = self.timeline.extend(records, self._estimate.any_value, refusals)
        self.graph.push_back(growth.graph)
        self._now_s = max([self._now_s, *(record.stamp_s for record in records)])
        late = self._take(growth)
        if growth.graph.size():
            self._smooth(growth, late)
        self._estimate.keep_causal(growth.poses)
        self._retire()
        self.timing += time.perf_counter() - began
        return self._estimate

    def values(self) -> gtsam.Values:
        """All variables as last known: those of the window now, the others as they were when they left."""
        values = gtsam.Values(self._window)
        for key, departed in self._departed.items():
            values.insert(key, departed.pose)
        return values

    # ---- what comes in ----

    def _take(self, growth: Growth) -> list[gtsam.NonlinearFactor]:
        """Bring new variables and factors into the window; the factors that come too late for it."""
        self._window.insert(growth.values)
        late = []
        for i in range(growth.graph.size()):
            factor = growth.graph.at(i)
            keys = factor.keys()
            if self._departed.keys().isdisjoint(keys):
                self._factors.append((factor, keys))
            else:
                late.append(factor)
                kind = self._record_kind(factor)
                self.timeline.dropped[f"{kind}: {TOO_LATE}"] += 1
                self.timeline.used[kind] -= 1
        return late

    def _record_kind(self, factor: gtsam.NonlinearFactor) -> str:
        """Name of the kind of record that a factor comes from."""
        keys, kind = factor.keys(), type(factor).__name__
        for start, name in (("BearingRange", "BearingRangeFix"), ("Bearing", "BearingFix"), ("Range", "RangeFix")):
            if kind.startswith(start):
                return name
        if len(keys) == 1:
            return "PosePrior"
        if is_vertex(keys[1]):
            return "CornerDecision"
        (since_a, until_a), (since_b, until_b) = map(self._stay, keys)
        return "RelativePoseFix" if max(since_a, since_b) <= min(until_a, until_b) else "LoopClosure"

    def _stay(self, key: int) -> tuple[float, float]:
        """When a robot came to a pose and when it left."""
        track = self.timeline.tracks[self.timeline.robots[robot_index(key)]]
        since_s = self.timeline.stamps[key]
        return since_s, track.until_s[bisect_left(track.since_s, since_s)]

    # ---- the window ----

    def _smooth(self, growth: Growth, late: list[gtsam.NonlinearFactor]) -> None:
        """Find the minimum. What came too late may have been all that held a new variable: then its guess does."""
        for attempt in ("with what is left", "with ties"):
            try:
                if late:
                    self._require_factors(growth)
                deep_stack.call(self._descend, variables=self.window_size)
                return
            except (RuntimeError, UnderDetermined) as error:
                self._tree = None
                ties = self._ties(growth, late) if attempt == "with what is left" else []
                if not ties:
                    if isinstance(error, UnderDetermined):
                        raise
                    raise in_words(error, self.graph, self.values(), self.timeline.robots) from error
                self._factors += [(tie, tie.keys()) for tie in ties]

    def _require_factors(self, growth: Growth) -> None:
        held = {key for _, keys in self._factors for key in keys}
        for key in growth.values.keys():  # noqa: SIM118 - Values is no dict
            if key not in held:
                where = describe(key, self.timeline.robots, self.timeline.landmarks)
                raise UnderDetermined(f"{where} has no place: everything about it is {TOO_LATE}")

    def _ties(self, growth: Growth, late: list[gtsam.NonlinearFactor]) -> list[gtsam.NonlinearFactor]:
        """Factors for the guesses of new variables, from what was measured too late for the window.

        Two frames: the relative pose that joined them, which those measurements gave.  A vertex: the sighting from a
        pose as it was when it left, its correlation with the window forgotten.  A landmark: what the timeline believes
        its guess to be worth.
        """
        if not late:
            return []
        ties = []
        for edge in growth.tree:
            apart = robot_index(edge.key_a) != robot_index(edge.key_b)
            if apart and self._window.exists(edge.key_a) and self._window.exists(edge.key_b):
                noise = gaussian(edge.cov_b)
                ties.append(gtsam.BetweenFactorPose2(edge.key_a, edge.key_b, edge.T_a_b, noise))
        alignment = self.timeline.settings.alignment
        sigma_m = alignment.gate_sigmas * alignment.drift_sigma_m
        for key in {factor.keys()[-1]: None for factor in late if growth.values.exists(factor.keys()[-1])}:
            if is_landmark(key):
                noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma_m)
                ties.append(gtsam.PriorFactorPoint2(key, growth.values.atPoint2(key), noise))
        for factor in late:
            observer, key = factor.keys()[0], factor.keys()[-1]
            departed = self._departed.get(observer)
            if is_vertex(key) and growth.values.exists(key) and departed is not None and departed.cov is not None:
                cov = chain_covariance(factor.measured(), departed.cov, factor.noiseModel().covariance())
                ties.append(gtsam.PriorFactorPose2(key, departed.pose * factor.measured(), gaussian(cov)))
        return ties

    def _descend(self) -> None:
        """Gauss-Newton; a step that raises the cost is halved until it does not."""
        graph = gtsam.NonlinearFactorGraph()
        for factor, _ in self._factors:
            graph.push_back(factor)
        cost, ordering = self._cost(graph, self._window), None
        for _ in range(self.settings.rounds):
            linear = self._linear(graph)
            # COLAMD: METIS crashes on a variable without neighbours, such as a landmark that is out of sight for long.
            ordering = ordering or gtsam.Ordering.ColamdGaussianFactorGraph(linear)
            self._tree = _elimination(linear, ordering)
            step = self._tree.optimize()
            for _ in range(_HALVINGS):
                moved = self._window.retract(step)
                cost_moved = self._cost(graph, moved)
                if cost_moved <= cost * (1 + 1e-9) + 1e-9:
                    break
                step = step.scale(0.5)
            else:
                return
            self._window, cost = moved, cost_moved
            if np.abs(step.vector()).max() < self.settings.step_threshold:
                return

    def _cost(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> float:
        return graph.error(values) + (0.0 if self._prior is None else self._prior.cost(values))

    def _linear(self, graph: gtsam.NonlinearFactorGraph) -> gtsam.GaussianFactorGraph:
        linear = graph.linearize(self._window)
        if self._prior is not None:
            linear.push_back(self._prior.linearized(self._window))
        return linear

    # ---- what leaves ----

    def _retire(self) -> None:
        """Poses that their robots left long ago go, and leave a prior on what remains."""
        leaving = sorted(self._overdue(), key=self.timeline.stamps.get)
        for key in leaving:
            self._departed[key] = Departed(self._window.atPose2(key), self._covariance_or_none(key))
        for start in range(0, len(leaving), _ELIMINATED_AT_ONCE):
            self._eliminate(leaving[start : start + _ELIMINATED_AT_ONCE])

    def _overdue(self) -> list[int]:
        """Poses for which it is time; never a robot's latest, which new factors will tie."""
        overdue = []
        for robot, track in self.timeline.tracks.items():
            if not self.timeline.is_placed(robot):
                continue
            first = end = self._left[robot]
            while end < len(track.keys) - 1 and track.until_s[end] < self._now_s - self.settings.lag_s:
                end += 1
            overdue += track.keys[first:end]
            self._left[robot] = end
        return overdue

    def _eliminate(self, leaving: list[int]) -> None:
        gone = set(leaving)
        touched = gtsam.NonlinearFactorGraph()
        kept = []
        for factor, keys in self._factors:
            if gone.isdisjoint(keys):
                kept.append((factor, keys))
            else:
                touched.push_back(factor)
        self._prior = eliminated(self._linear(touched), self._window, leaving)
        self._factors = kept
        for key in leaving:
            self._window.erase(key)

    def _covariance_or_none(self, key: int) -> np.ndarray | None:
        try:
            return self._estimate.covariance(key)
        except UnderDetermined:
            return None


class FixedLagEstimate(Estimate):
    """A view of the window, and of what is remembered of the poses that have left it.

    `trajectory` is the fixed-lag estimate: each pose as it was when it left, or as it is now.
    """

    def __init__(self, owner: FixedLag):
        super().__init__(owner.timeline)
        self._owner = owner

    def value(self, key: int) -> Pose2:
        departed = self._owner._departed.get(key)
        return self._current(key) if departed is None else departed.pose

    def point(self, key: int) -> np.ndarray:
        return self._current(key)

    def covariance(self, key: int) -> np.ndarray:
        departed = self._owner._departed.get(key)
        if departed is None:
            return self._told("marginalCovariance", key, [key])
        if departed.cov is None:
            raise UnderDetermined(f"{self._name(key)} left the window before it was tied down")
        return departed.cov

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        """As for all estimates; raises UnderDetermined when a pose has left the window: nobody remembers what it
        had in common with others."""
        for key in keys:
            if key in self._owner._departed:
                lag_s = self._owner.settings.lag_s
                raise UnderDetermined(f"{self._name(key)} left the window of {lag_s:g} s: no joint covariance is kept")
        return self._told("jointMarginalCovariance", list(keys), keys).fullMatrix()

    def _current(self, key: int) -> Pose2 | np.ndarray:
        if not self._owner._window.exists(key):
            raise UnderDetermined(f"{self._name(key)} has no estimate: the update failed")
        return value_of(self._owner._window, key)

    def _told(self, question: str, argument, keys: Sequence[int]):
        names = ", ".join(map(self._name, keys))
        if self._owner._tree is None:
            raise UnderDetermined(f"{names}: no covariance, the update failed")
        try:
            return getattr(self._owner._tree, question)(argument)
        except IndexError as error:
            raise UnderDetermined(f"{names}: no covariance, nothing ties it down") from error
        except RuntimeError as error:
            owner = self._owner
            raise in_words(error, owner.graph, owner.values(), self.robots) from error

    def _name(self, key: int) -> str:
        return describe(key, self.robots, self.timeline.landmarks)


def _elimination(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.GaussianBayesTree:
    """The Bayes tree: by Cholesky, and by QR, half as fast, where that takes a direction for an open one."""
    try:
        return linear.eliminateMultifrontal(ordering)
    except RuntimeError:
        return linear.eliminateMultifrontal(ordering, gtsam.EliminateQR)
