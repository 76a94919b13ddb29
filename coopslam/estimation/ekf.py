"""Joint extended Kalman filter: all robots' latest poses, all map vertices and landmarks, and all they have in common.

The filter of Roumeliotis and Bekey (Distributed multirobot localization, 2002), kept in one place, with the map in it
(Smith, Self and Cheeseman 1990). Odometry carries a robot's pose to the next and the last one leaves the state; every
other measurement corrects everything that is correlated with what it measured, once, linearized at the estimate of that
moment. What concerns a pose that has left comes too late, and is counted as dropped. Poses from which corners were
sighted stay for a while, as copies: the team decides later which vertex it was, and asks for joint covariances.
"""

import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from coopslam.errors import UnderDetermined, require_between
from coopslam.estimation.ekf_estimate import Departed, EkfEstimate
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.factor_kinds import drop
from coopslam.estimation.factors import floored
from coopslam.estimation.filter_models import (
    Linearized,
    Sighting,
    is_prior,
    linearized,
    noise_covariance,
    prior_mean,
    sighting,
)
from coopslam.estimation.filter_state import FilterState, in_frame_axes
from coopslam.estimation.filter_tree import Tree, seen_from
from coopslam.estimation.gate import Gate, GateSettings
from coopslam.estimation.innovation_gate import InnovationGate
from coopslam.estimation.keys import is_landmark, pose_key, robot_index
from coopslam.estimation.timeline import Timeline, TimelineSettings
from coopslam.estimation.tracks import Edge, Growth
from coopslam.records import CornerSighting, Record
from coopslam.se2 import Pose2, chain_covariance, xytheta

TOO_LATE = "older than the filter's state"
SINGULAR = "observer and target coincide"
_ORIGIN = pose_key(0, 0)


@dataclass(frozen=True, slots=True)
class EkfSettings:
    """Which measurements a filter refuses, and how much of the past it holds."""

    # Probability that a good measurement is refused for its innovation; zero: no gate. Relative pose fixes have the
    # gate of all estimators instead (`gate`); that a corner is a known vertex the team has decided on better grounds.
    gate_probability: float = 1e-4
    sightings_kept: int = 30  # so many of the last poses from which corners were sighted stay in the state

    def __post_init__(self):
        require_between(0.0, 1.0, gate_probability=self.gate_probability)
        require_between(0, 10_000, sightings_kept=self.sightings_kept)


class Ekf:
    """Causal filtering: each factor is used once, when it comes."""

    def __init__(
        self,
        robots: Iterable[str],
        landmarks: Iterable[str] = (),
        settings: EkfSettings = EkfSettings(),
        gate: GateSettings | None = None,
        timeline: TimelineSettings | None = None,
    ):
        self.timeline = Timeline(robots, landmarks, timeline)
        self.settings = settings
        self.graph = gtsam.NonlinearFactorGraph()  # all that was not refused, for a batch solve
        self.timing = 0.0  # s spent in updates
        self._innovations = InnovationGate(self.timeline, settings.gate_probability)
        self.innovations = self._innovations.innovations  # of all measurements that were tested, those refused included
        self.refused_innovations = self._innovations.refused
        self._state = FilterState()
        self._departed: dict[int, Departed] = {}
        self._gate = Gate(self.timeline, gate or GateSettings())
        self._tree = Tree()
        self._ahead: deque[Edge] = deque()  # edges of this update that are not yet used
        self._spent: dict[tuple[int, int], Edge] = {}  # edges that were used, until their factors come
        self._latest: dict[int, int] = {}  # index of a robot -> its pose in the state
        self._sighters: set[int] = set()  # poses from which corners were sighted
        self._kept: deque[int] = deque()  # those of them that robots have left and the state holds
        self._estimate = EkfEstimate(self.timeline, self._state, self._departed, self.innovations)

    def update(self, records: Iterable[Record]) -> Estimate:
        """Filter a further group of records."""
        began = time.perf_counter()
        records = list(records)
        refusals = self._gate.refusals(records, self._estimate)
        growth = self.timeline.extend(records, self._estimate.any_value, refusals)
        self._sighters.update(self._poses_of_sightings(records))
        self._take(growth)
        self._estimate.keep_causal(growth.poses)
        self.timing += time.perf_counter() - began
        return self._estimate

    def values(self) -> gtsam.Values:
        """All variables as last known: those of the state now, earlier poses as they were when they left it."""
        values = gtsam.Values()
        for key in (*self._state.keys(), *self._departed):
            values.insert(key, self._estimate.any_value(key))
        return values

    # ---- what comes in ----

    def _poses_of_sightings(self, records: Iterable[Record]) -> Iterator[int]:
        for record in records:
            if isinstance(record, CornerSighting) and record.observer in self.timeline.tracks:
                with suppress(UnderDetermined):  # a robot without a place, or a sighting that was dropped
                    yield self._estimate.pose_key_at(record.observer, record.stamp_s)

    def _take(self, growth: Growth) -> None:
        """Use new factors in their order; last those on variables that only poses of the past have seen."""
        self._ahead = deque(growth.tree)
        late = []
        for factor in map(growth.graph.at, range(growth.graph.size())):
            keys = factor.keys()
            believed = self._use(factor, keys, growth.values)
            if believed is None:
                late.append((factor, keys))
            if believed is not False:
                self.graph.push_back(factor)
        while self._ahead:
            self._follow(self._ahead.popleft())
        self._use_late(late, growth.values)

    def _use(self, factor: gtsam.NoiseModelFactor, keys: Sequence[int], guesses: gtsam.Values) -> bool | None:
        """Place what is new in a factor, or measure with it; False when refused, None when it cannot be used yet."""
        for key in keys:
            while self._ahead and robot_index(key) is not None and key != _ORIGIN and not self._is_known(key):
                self._follow(self._ahead.popleft())
        if self._is_spent(factor, keys):
            return True
        if all(key in self._state for key in keys):
            return self._measure(factor, keys)
        new = [key for key in keys if not self._is_known(key)]
        if not new:
            drop(factor, self.timeline, TOO_LATE)
            return True
        if new != keys[-1:] or not (len(keys) == 1 or keys[0] in self._state):
            return None
        if is_prior(factor):
            mean = prior_mean(factor)
            self._state.add(new[0], mean, in_frame_axes(mean, noise_covariance(factor)))
            return True
        seen = self._sighting(factor, self._state.pose(keys[0]), new[0], guesses)
        if seen is None:
            return None
        self._place(new[0], keys[0], seen)
        return True

    def _use_late(self, late: list[tuple], guesses: gtsam.Values) -> None:
        """What was only seen from poses that have left gets its place from the last of them, by odometry since."""
        rest = []
        for factor, keys in reversed(late):
            if len(keys) == 2 and keys[0] in self._departed and not self._is_known(keys[1]):
                seen = self._sighting(factor, Pose2(*self._departed[keys[0]].mean), keys[1], guesses)
                if seen is not None:
                    latest = self._latest[robot_index(keys[0])]
                    self._place(keys[1], latest, seen.carried(*self._tree.way_back(keys[0], latest)))
                    continue
            rest.append((factor, keys))
        for factor, keys in reversed(rest):
            if self._use(factor, keys, guesses) is None:
                drop(factor, self.timeline, TOO_LATE)

    def _sighting(self, factor, observer: Pose2, key: int, guesses: gtsam.Values) -> Sighting | None:
        guess = guesses.atPoint2(key) if is_landmark(key) else None
        return sighting(factor, observer, guess, self.timeline.settings.alignment)

    def _place(self, key: int, observer: int, seen: Sighting) -> None:
        """A new vertex or landmark, with what it has in common with everything through its observer."""
        if isinstance(seen.relative, Pose2):
            self._state.add_poses([key], observer, [seen.relative], seen.cov)
        else:
            self._state.add_point(key, observer, seen.relative, seen.cov)
        self._placed([key])

    def _placed(self, keys: Sequence[int]) -> None:
        """For filters that keep less."""

    # ---- odometry, and robots that get their place ----

    def _follow(self, edge: Edge) -> None:
        """Carry a robot along its odometry, or place robots that an edge ties to those in the state."""
        edge = replace(edge, cov_b=floored(edge.cov_b))
        self._spent[edge.key_a, edge.key_b] = edge
        is_leg = robot_index(edge.key_a) == robot_index(edge.key_b)
        known = [key for key in (edge.key_a, edge.key_b) if self._is_known(key)]
        if is_leg and known:
            self._tree.add_leg(edge)
            self._drive(edge)
        elif known:
            self._join(known[0], edge)
        else:
            self._tree.add_open(edge, is_leg)

    def _drive(self, leg: Edge) -> None:
        """The pose at the start leaves the state, or a copy of it drives."""
        start, end = leg.key_a, leg.key_b
        if start in self._sighters and self.settings.sightings_kept:
            oldest = self._kept.popleft() if len(self._kept) == self.settings.sightings_kept else None
            if oldest is not None:
                self._leave(oldest)
                self._sighters.discard(oldest)
            self._kept.append(start)
            self._state.clone(start, end, oldest)
            self._state.drive(end, end, leg.T_a_b, leg.cov_b)
            self._placed([end])
        else:
            self._leave(start)
            self._state.drive(start, end, leg.T_a_b, leg.cov_b)
        self._latest[robot_index(end)] = end

    def _join(self, known: int, edge: Edge) -> None:
        """Robots come in by a relative pose between one of them and one of the state, then or now.

        Their latest poses enter the state, those before are remembered. A pose of the state's robots that has left is
        found by odometry back from the latest; the first pose of all is the frame itself.
        """
        key, T, cov = seen_from(known, edge)
        base = known
        if known not in self._state:
            base = None if known == _ORIGIN else self._latest[robot_index(known)]
        if base is not None and base != known:
            T_base_known, cov_known = self._tree.way_back(known, base)
            T, cov = T_base_known * T, chain_covariance(T, cov_known, cov)
        branch = self._tree.take(key, T, cov)
        latest = {robot_index(key): key for key in sorted(branch.T_root)}
        newest = list(latest.values())
        for past in branch.T_root.keys() - latest.values():
            T_frame_base, cov_base = self._belief(base)
            mean = xytheta(T_frame_base * branch.T_root[past])
            own = chain_covariance(branch.T_root[past], cov_base, branch.cov[past])
            self._departed[past] = Departed(mean, in_frame_axes(mean, own))
        T_base_newest = [branch.T_root[key] for key in newest]
        self._state.add_poses(newest, base, T_base_newest, branch.joint_covariance(newest))
        self._latest |= latest
        self._placed(newest)

    def _belief(self, key: int | None) -> tuple[Pose2, np.ndarray]:
        """A pose of the state, or the frame itself, with its covariance in its own axes."""
        return (Pose2(), np.zeros((3, 3))) if key is None else (self._state.pose(key), self._state.covariance(key))

    def _leave(self, key: int) -> None:
        self._departed[key] = Departed(self._state.mean(key).copy(), self._state.block(key).copy())

    def _is_known(self, key: int) -> bool:
        return key in self._state or key in self._departed

    def _is_spent(self, factor: gtsam.NoiseModelFactor, keys: Sequence[int]) -> bool:
        """Whether it is the measurement of an edge that has been used."""
        if isinstance(factor, gtsam.BetweenFactorPose2):
            ends, measured = (keys[0], keys[1]), factor.measured
        elif isinstance(factor, gtsam.PriorFactorPose2):
            ends, measured = (_ORIGIN, keys[0]), factor.prior
        else:
            return False
        edge = self._spent.get(ends)
        if edge is None or not measured().equals(edge.T_a_b, 1e-12):
            return False
        del self._spent[ends]
        return True

    # ---- measurements ----

    def _measure(self, factor: gtsam.NoiseModelFactor, keys: Sequence[int]) -> bool:
        """Correct the state; False when the measurement is refused."""
        model = linearized(factor, [self._state.mean(key) for key in keys])
        if model is None:
            drop(factor, self.timeline, SINGULAR)
            return False
        return self._fuse(factor, keys, model)

    def _fuse(self, factor: gtsam.NoiseModelFactor, keys: Sequence[int], model: Linearized) -> bool:
        """The Kalman update of everything."""
        rows = [self._state.place(key) for key in keys]
        across, spread = self._state.spread(rows, model.jacobians)
        S = spread + noise_covariance(factor)
        S_inverse = np.linalg.inv(S)
        if not self._innovations.is_credible(factor, float(model.miss @ S_inverse @ model.miss), len(model.miss)):
            return False
        self._state.correct(across, S, S_inverse, model.miss)
        return True
