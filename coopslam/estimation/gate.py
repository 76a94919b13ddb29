"""Which fixes of the robot tracker can be true: a chi-square gate before they reach the graph.

Reflections come with the covariance of a good fix. Every fix is held against a prediction: where the target is in the
observer's frame by the estimate so far, the odometry since and the fixes accepted before it in its group
(Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, sections 5.4 and 7.6).
The two trackers of a pair fail independently: where odometry predicts little they are held against each other, and
where both say the same against the prediction it is the prediction that is wrong.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from math import inf, isfinite

from coopslam.errors import BadInput, UnderDetermined, require_positive
from coopslam.estimation.estimate import Estimate
from coopslam.estimation.relative import RelativeBelief, predicted, predicted_now, seen_by_tracker
from coopslam.estimation.timeline import STAMP_TOLERANCE_S, Timeline, is_motion
from coopslam.records import Odometry, Record, RelativePoseFix

FAR = "far from the prediction"
CONTRADICTED = "contradicted by another fix of the same poses"
UNDECIDED = "first fixes contradict each other"
_MOST_AT_ONCE = 16  # fixes of the same poses that are compared with each other

Pair = tuple[str, str]


@dataclass(frozen=True, slots=True)
class GateSettings:
    """When a fix is refused. Distances are squared Mahalanobis distances with 3 degrees of freedom."""

    # One good fix in a million is further from an honest prediction; inf: no gate.
    distance_sq_max: float = field(default=30.7, metadata={"infinite": True})
    margin_sq: float = 10.0  # of two that contradict each other, the nearer one is believed at odds of exp(10 / 2)
    numerical_sigma: float = 1e-4  # m and rad: how far a smoother of nearly exact sensors is off by itself

    def __post_init__(self):
        require_positive(margin_sq=self.margin_sq)
        require_positive(1e3, numerical_sigma=self.numerical_sigma)
        if not self.distance_sq_max > 0:
            raise BadInput(f"distance_sq_max: more than zero expected, got {self.distance_sq_max}")


@dataclass(slots=True, eq=False)
class Sight:
    """A fix as a measurement of robot b in the frame of robot a."""

    belief: RelativeBelief
    observer: str
    position: int | None  # in its group of records; None: of an earlier group, and refused there


@dataclass(slots=True, eq=False)
class Watch:
    """What is believed of robot b in the frame of robot a, and the fixes since either last moved."""

    pair: Pair
    belief: RelativeBelief | None  # None until first fixes agree
    sights: list[Sight] = field(default_factory=list)
    stamp_s: float = -inf  # of the last sight
    fresh: bool = True  # a fix has been accepted since either robot moved

    def carry(self, record: Odometry) -> None:
        """Everything that is believed, after odometry of one of the two."""
        if self.belief is not None:
            self.belief = self._carried(self.belief, record)
        self.sights = [replace(sight, belief=self._carried(sight.belief, record)) for sight in self.sights]
        self.fresh = False

    def learn(self, sights: Sequence[Sight]) -> None:
        """Use accepted fixes."""
        for sight in sights:
            self.belief = sight.belief if self.belief is None else self.belief.updated(sight.belief)[0]
            self.fresh = True

    def _carried(self, belief: RelativeBelief, record: Odometry) -> RelativeBelief:
        move = belief.after_a if record.robot == self.pair[0] else belief.after_b
        return move(record.T_start_now, record.cov_now)


class Gate:
    """Judges the fixes of a group of records before the timeline takes it."""

    def __init__(self, timeline: Timeline, settings: GateSettings):
        self.settings = settings
        self._timeline = timeline
        self._watches: dict[Pair, Watch] = {}
        self._refusals: dict[int, str] = {}  # of this group
        self._odometry_end_s: dict[str, float] = {}
        self._arrived_s: dict[str, float] = {}  # when each robot came to the pose at which it is now
        self._left_s: dict[str, float] = {}  # when a robot left its pose at the beginning of the group

    def refusals(self, records: Sequence[Record], estimate: Estimate) -> dict[int, str]:
        """Position in the group of each fix to refuse -> why.

        estimate: of all earlier groups. Two robots that it does not place yet are joined by the fixes that most
        others of the same poses agree with; a single first fix is taken as it is.
        """
        if not isfinite(self.settings.distance_sq_max):
            return {}
        self._begin(records, estimate)
        for position, record in enumerate(records):
            if isinstance(record, Odometry):
                self._drive(record)
            elif isinstance(record, RelativePoseFix):
                self._see(record, position, estimate)
        for watch in self._watches.values():
            self._judge(watch)
        return self._refusals

    def _begin(self, records: Sequence[Record], estimate: Estimate) -> None:
        """A watch on each pair with fixes in this group.

        One that saw its robots after they last moved goes on from group to group; otherwise the estimate, which
        knows the corners as well, predicts better.
        """
        tracks = self._timeline.tracks
        placed = {robot for robot in tracks if self._timeline.is_placed(robot)}
        for pair, watch in list(self._watches.items()):
            if placed.issuperset(pair) and (watch.belief is None or not watch.fresh):
                del self._watches[pair]
        for pair in {_pair(record): None for record in records if isinstance(record, RelativePoseFix)}:
            if pair not in self._watches and tracks.keys() >= set(pair):
                belief = predicted_now(estimate, *pair) if placed.issuperset(pair) else None
                self._watches[pair] = Watch(pair, belief)
        self._refusals = {}
        self._odometry_end_s = {robot: track.odometry_end_s for robot, track in tracks.items()}
        self._arrived_s = {robot: track.arrived_s for robot, track in tracks.items()}
        self._left_s = {}

    def _drive(self, record: Odometry) -> None:
        """Carry what is believed of a robot along its odometry; what the timeline will drop is passed over."""
        robot = record.robot
        if not record.start_s >= self._odometry_end_s.get(robot, inf) - STAMP_TOLERANCE_S:
            return
        self._odometry_end_s[robot] = record.stamp_s
        if not is_motion(record):
            return
        self._arrived_s[robot] = record.stamp_s
        self._left_s.setdefault(robot, record.start_s)
        for watch in self._watches.values():
            if robot in watch.pair:
                self._judge(watch)
                watch.carry(record)

    def _see(self, fix: RelativePoseFix, position: int, estimate: Estimate) -> None:
        """Put a fix beside the others of the same poses; a late one is judged at once."""
        watch = self._watches.get(_pair(fix))
        if watch is None:
            return  # of a robot that nobody knows
        seen = seen_by_tracker(fix, self.settings.numerical_sigma)
        sight = Sight(seen if fix.observer == watch.pair[0] else seen.inverse(), fix.observer, position)
        if any(fix.stamp_s < self._arrived_s[robot] - STAMP_TOLERANCE_S for robot in watch.pair):
            self._judge_late(sight, fix.stamp_s, watch.pair, estimate)
            return
        another_instant = watch.belief is not None and abs(fix.stamp_s - watch.stamp_s) > STAMP_TOLERANCE_S
        if another_instant or len(watch.sights) >= _MOST_AT_ONCE:
            self._judge(watch)
        watch.sights.append(sight)
        watch.stamp_s = fix.stamp_s

    def _judge(self, watch: Watch) -> None:
        """Decide on the fixes of one instant, or of first poses, and learn from those that are accepted."""
        sights, watch.sights = watch.sights, []
        if not sights:
            return
        if watch.belief is not None:
            self._judge_predicted(watch, sights)
        elif all(sight.position is None for sight in sights):
            watch.sights = sights
        else:
            kept = self._unchallenged(sights, [0.0] * len(sights))
            self._refuse((sight for sight in sights if sight not in kept), UNDECIDED)
            watch.learn(kept)
            if not kept:
                watch.sights = [replace(sight, position=None) for sight in sights[-_MOST_AT_ONCE // 2 :]]

    def _judge_predicted(self, watch: Watch, sights: list[Sight]) -> None:
        """Nearly always each fix fits the prediction and those before it; otherwise all are weighed at once."""
        belief, limit = watch.belief, self.settings.distance_sq_max
        for sight in sights:
            belief, distance = belief.updated(sight.belief)
            if distance > limit:
                break
        else:
            watch.belief, watch.fresh = belief, True
            return
        distances = [watch.belief.distance_sq(sight.belief) for sight in sights]
        credible = [k for k in range(len(sights)) if distances[k] <= limit or self._is_confirmed(sights[k], sights)]
        kept = self._unchallenged([sights[k] for k in credible], [distances[k] for k in credible])
        self._refuse((sights[k] for k in credible if sights[k] not in kept), CONTRADICTED)
        self._refuse((sights[k] for k in range(len(sights)) if k not in credible), FAR)
        if any(distances[k] > limit for k in credible if sights[k] in kept):
            watch.belief = None  # two trackers that agree refute the prediction: somebody slipped
        watch.learn(kept)

    def _is_confirmed(self, sight: Sight, others: Iterable[Sight]) -> bool:
        """Whether the other robot's tracker, which fails independently, says the same."""
        return any(
            other.observer != sight.observer and sight.belief.distance_sq(other.belief) <= self.settings.distance_sq_max
            for other in others
        )

    def _unchallenged(self, sights: list[Sight], distances: list[float]) -> list[Sight]:
        """Those that beat all that they contradict: by having fewer rivals, or by a clearly smaller distance.

        Of two that contradict each other at most one is among them.
        """
        limit, margin = self.settings.distance_sq_max, self.settings.margin_sq
        rivals = [[] for _ in sights]
        for i, j in combinations(range(len(sights)), 2):
            if sights[i].belief.distance_sq(sights[j].belief) > limit:
                rivals[i].append(j)
                rivals[j].append(i)

        def beats(i: int, j: int) -> bool:
            if len(rivals[i]) != len(rivals[j]):
                return len(rivals[i]) < len(rivals[j])
            return distances[i] + margin < distances[j]

        return [sight for i, sight in enumerate(sights) if all(beats(i, j) for j in rivals[i])]

    def _judge_late(self, sight: Sight, stamp_s: float, pair: Pair, estimate: Estimate) -> None:
        """A fix of poses that a robot has left: against their variables, if they were there before this group."""
        if any(stamp_s > self._left_s.get(robot, inf) + STAMP_TOLERANCE_S for robot in pair):
            return  # of poses of this group, which no estimate knows yet
        try:
            belief = predicted(estimate, *(estimate.pose_key_at(robot, stamp_s) for robot in pair))
        except UnderDetermined:
            return  # the timeline will drop it
        if belief.distance_sq(sight.belief) > self.settings.distance_sq_max:
            self._refuse([sight], FAR)

    def _refuse(self, sights: Iterable[Sight], reason: str) -> None:
        self._refusals |= {sight.position: reason for sight in sights if sight.position is not None}


def _pair(fix: RelativePoseFix) -> Pair:
    return min(fix.observer, fix.target), max(fix.observer, fix.target)
