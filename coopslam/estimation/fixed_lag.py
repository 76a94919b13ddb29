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
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from math import inf

import gtsam
import numpy as np

from coopslam.errors import BadInput, UnderDetermined, require_positive
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.factor_kinds import drop
from coopslam.estimation.factors import gaussian
from coopslam.estimation.filter_tree import seen_from
from coopslam.estimation.fixed_lag_estimate import Departed, FixedLagEstimate
from coopslam.estimation.gate import Gate, GateSettings
from coopslam.estimation.graph_check import in_words
from coopslam.estimation.keys import describe, is_landmark, is_vertex, robot_index
from coopslam.estimation.lag_window import LagWindow
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.estimation.tracks import Edge, Growth
from coopslam.records import Record
from coopslam.se2 import Pose2, chain_covariance

TOO_LATE = "older than the window"


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
        self._window = LagWindow(self.timeline.robots, self.timeline.landmarks)
        self._departed: dict[int, Departed] = {}  # the stored history; the smoother itself never reads it
        self._left: Counter[str] = Counter()  # robot -> number of its poses that have left, always its first ones
        self._estimate = FixedLagEstimate(self.timeline, self._window, self._departed, self.settings.lag_s)

    @property
    def window_size(self) -> int:
        """Number of variables that are being smoothed."""
        return self._window.values.size()

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
        values = gtsam.Values(self._window.values)
        for key, departed in self._departed.items():
            values.insert(key, departed.pose)
        return values

    # ---- what comes in ----

    def _take(self, growth: Growth) -> list[gtsam.NonlinearFactor]:
        """Bring new variables and factors into the window; the factors that come too late for it."""
        self._window.values.insert(growth.values)
        late = []
        for i in range(growth.graph.size()):
            factor = growth.graph.at(i)
            if self._departed.keys().isdisjoint(factor.keys()):
                self._window.add(factor)
            else:
                late.append(factor)
                drop(factor, self.timeline, TOO_LATE)
        return late

    # ---- the window ----

    def _smooth(self, growth: Growth, late: list[gtsam.NonlinearFactor]) -> None:
        """Find the minimum. What came too late may have been all that held a new variable: then its guess does."""
        for attempt in ("with what is left", "with ties"):
            try:
                if late and growth.values.size():
                    self._require_factors(growth)
                    self._window.require_tied_down()
                self._window.descend(self.settings.rounds, self.settings.step_threshold)
                return
            except (RuntimeError, UnderDetermined) as error:
                ties = self._ties(growth, late) if attempt == "with what is left" else []
                if not ties:
                    if isinstance(error, UnderDetermined):
                        raise
                    raise in_words(error, self.graph, self.values(), self.timeline.robots) from error
                for tie in ties:
                    self._window.add(tie)

    def _require_factors(self, growth: Growth) -> None:
        tied = self._window.tied()
        for key in growth.values.keys():  # noqa: SIM118 - Values is no dict
            if key not in tied:
                where = describe(key, self.timeline.robots, self.timeline.landmarks)
                raise UnderDetermined(f"{where} has no place: everything about it is {TOO_LATE}")

    def _ties(self, growth: Growth, late: list[gtsam.NonlinearFactor]) -> list[gtsam.NonlinearFactor]:
        """Factors for the guesses of new variables, from what was measured too late for the window.

        Two frames: the relative pose that joined them, which those measurements gave.  A vertex: the sighting.  A
        landmark: what the timeline believes its guess to be worth.  A pose that has left counts as it was then, its
        correlation with the window forgotten.
        """
        if not late:
            return []
        ties = []
        for edge in growth.tree:
            if robot_index(edge.key_a) != robot_index(edge.key_b):
                ties += self._tie_between_frames(edge)
        alignment = self.timeline.settings.alignment
        sigma_m = alignment.gate_sigmas * alignment.drift_sigma_m
        for key in {factor.keys()[-1]: None for factor in late if growth.values.exists(factor.keys()[-1])}:
            if is_landmark(key):
                noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma_m)
                ties.append(gtsam.PriorFactorPoint2(key, growth.values.atPoint2(key), noise))
        for factor in late:
            observer, key = factor.keys()[0], factor.keys()[-1]
            if is_vertex(key) and growth.values.exists(key):
                ties += self._tie_to_departed(observer, key, factor.measured(), factor.noiseModel().covariance())
        return ties

    def _tie_between_frames(self, edge: Edge) -> list[gtsam.NonlinearFactor]:
        inside = [key for key in (edge.key_a, edge.key_b) if self._window.values.exists(key)]
        if len(inside) == 2:
            return [gtsam.BetweenFactorPose2(edge.key_a, edge.key_b, edge.T_a_b, gaussian(edge.cov_b))]
        if not inside:
            return []
        gone = edge.key_a if inside == [edge.key_b] else edge.key_b
        return self._tie_to_departed(gone, *seen_from(gone, edge))

    def _tie_to_departed(self, gone: int, key: int, T_gone_key: Pose2, cov: np.ndarray) -> list[gtsam.NonlinearFactor]:
        """cov: (3, 3) of the relative pose, in the axes of what the key stands for."""
        departed = self._departed.get(gone)
        if departed is None or departed.cov is None:
            return []
        cov = chain_covariance(T_gone_key, departed.cov, cov)
        return [gtsam.PriorFactorPose2(key, departed.pose * T_gone_key, gaussian(cov))]

    # ---- what leaves ----

    def _retire(self) -> None:
        """Poses that their robots left long ago go, and leave a prior on what remains."""
        leaving = sorted(self._overdue(), key=self.timeline.stamps.get)
        departed = {key: Departed(self._window.values.atPose2(key), self._covariance_or_none(key)) for key in leaving}
        try:
            self._window.eliminate(leaving)
        except RuntimeError as error:
            raise in_words(error, self.graph, self.values(), self.timeline.robots) from error
        self._departed.update(departed)

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

    def _covariance_or_none(self, key: int) -> np.ndarray | None:
        try:
            return self._window.covariance(key)
        except UnderDetermined:
            return None
