"""Who stands where and what the team knows: the memory that the parts of the explorer share."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from coopslam.exploration.account import Stuck
from coopslam.exploration.chart import SAME_PLACE_M, Chart
from coopslam.exploration.free_map import FreeMap
from coopslam.exploration.moves import FollowWall, MoveEnd, Step
from coopslam.exploration.recognition import (
    Match,
    RecognitionSettings,
    corner_distance_sq,
    corner_mismatch,
    interior_angle_agrees,
    known_corners,
)
from coopslam.records import CornerDecision, CornerSighting, Decision, WallDecision
from coopslam.se2 import largest_sigma, position

STRAIGHTNESS_RAD = 1e-4  # sigma of the direction of a long wall


@dataclass(frozen=True, slots=True)
class Decided:
    """What the explorer decided after a step: records for the log and the estimator."""

    records: tuple[Decision, ...]


@dataclass(slots=True)
class Crew:
    """The pair that explores, the robots that only watch, and the map that they have so far."""

    robots: tuple[str, ...]  # the first two explore
    free_map: FreeMap
    chart: Chart
    recognition: RecognitionSettings
    reobserve: bool  # corners passed on the way are factors
    at: dict[str, int] = field(default_factory=dict)  # robot -> vertex
    last_mover: str = ""  # of the pair
    now_s: float = 0.0  # when the last move ended
    passed: tuple[CornerDecision, ...] = ()  # known corners that were passed on the last move

    @property
    def pair(self) -> tuple[str, str]:
        """The two robots that hold and sweep gates."""
        return self.robots[0], self.robots[1]

    @property
    def followers(self) -> tuple[str, ...]:
        """The robots that only watch, and come along."""
        return self.robots[2:]

    def partner(self, robot: str) -> str:
        """The other one of the pair; for a follower the first."""
        one, other = self.pair
        return other if robot == one else one

    def go(self, move):
        """Have a move executed; corners that were passed on the way and are known become factors."""
        step = yield move
        self.now_s = step.stamp_s
        self.passed = tuple(self._known_again(step)) if self.reobserve else ()
        if self.passed:
            yield Decided(self.passed)
        return step

    def follow_to_end(self, move: FollowWall):
        """Follow a wall that is in plain view; where contact only seems lost, it goes on."""
        step = yield from self.go(move)
        while step.ended == MoveEnd.CONTACT and step.moved:
            step = yield from self.go(move)
        return step

    def new_vertex(self, sighting: CornerSighting, evidence: str = "") -> CornerDecision:
        """A vertex that the map gets, and the decision that says so."""
        vertex = len(self.free_map.fans)
        self.free_map.add_vertex(vertex, sighting.interior_angle_rad)
        self.chart.corner_angle_sigma = max(self.chart.corner_angle_sigma, sighting.interior_angle_sigma_rad)
        return CornerDecision(self.now_s, sighting, vertex, True, evidence=evidence)

    def seen_again(
        self, sighting: CornerSighting, vertex: int, evidence: str, runner_up_sq: float | None = None
    ) -> CornerDecision:
        """The robot came back to a vertex, by a way that leaves no doubt or after a test: one more factor.

        Raises Stuck when the sighting cannot be of that vertex: then a decision before was wrong.
        """
        distance_sq = corner_distance_sq(self.chart.estimate, sighting, vertex)
        limits = self.recognition
        same_shape = interior_angle_agrees(sighting, self.free_map.interior_angles[vertex], limits.angle_sigmas)
        if not same_shape or distance_sq > limits.contradiction_sq:
            raise Stuck(
                f"{sighting.observer} should stand in vertex {vertex} ({evidence}), but its finder says otherwise "
                f"(squared distance {distance_sq:.0f}, interior angle {np.degrees(sighting.interior_angle_rad):.1f} "
                f"instead of {np.degrees(self.free_map.interior_angles[vertex]):.1f} degrees)"
            )
        self.at[sighting.observer] = vertex
        return CornerDecision(self.now_s, sighting, vertex, False, distance_sq, runner_up_sq, evidence)

    def may_be(self, sighting: CornerSighting, vertex: int) -> bool:
        """Whether a sighting fits a vertex in place, direction and interior angle."""
        limits = self.recognition
        if not interior_angle_agrees(sighting, self.free_map.interior_angles[vertex], limits.angle_sigmas):
            return False
        return corner_distance_sq(self.chart.estimate, sighting, vertex) <= limits.distance_sq_max

    def wall(self, sighting: CornerSighting, start: int, end: int, seen_from: int) -> WallDecision:
        """The wall between a known corner and the sighted one at its other end.

        That a corner's direction points at the next corner is a bearing over the wall's length L. Its linearization is
        off by the square of sigma / L, with sigma what the finder leaves open of the two corners' places: the short
        walls of a rounded corner say little, and are believed little.
        """
        estimate = self.chart.estimate
        observer = estimate.value(estimate.pose_key_at(sighting.observer, sighting.stamp_s))
        here = position(observer * sighting.T_observer_corner)
        length = max(float(np.hypot(*(here - self.chart.position(seen_from)))), SAME_PLACE_M)
        bent = 2 * np.trace(sighting.cov_observer[:2, :2]) / length**2
        return WallDecision(self.now_s, start, end, float(max(STRAIGHTNESS_RAD, bent)))

    def _known_again(self, step: Step):
        """Decisions on the corners passed on the way that are known without doubt; the others are left alone."""
        for sighting in step.records:
            if not isinstance(sighting, CornerSighting) or sighting is step.corner:
                continue
            matches = known_corners(self.chart, self.recognition, sighting)
            vertex = self.surely_known(matches)
            if vertex is not None and self._stands_apart(vertex, sighting):
                best, *others = matches
                runner_up_sq = others[0].distance_sq if others else None
                yield CornerDecision(
                    self.now_s, sighting, vertex, False, best.distance_sq, runner_up_sq, "passed on the way"
                )

    def _stands_apart(self, vertex: int, sighting: CornerSighting) -> bool:
        """Whether the walls of a vertex were walked and are so long that a glance cannot mistake it for its neighbours.

        A corner seen in passing is not needed, so the least doubt leaves it alone.
        """
        neighbours = [self.free_map.wall_leaving(vertex), self.free_map.wall_arriving(vertex)]
        if None in neighbours:
            return False
        _, cov = corner_mismatch(self.chart.estimate, [(sighting, vertex)])
        here = self.chart.position(vertex)
        nearest = min(float(np.hypot(*(self.chart.position(other) - here))) for other in neighbours)
        return nearest > self.recognition.apart_sigmas * largest_sigma(cov[:2, :2])

    def surely_known(self, matches: Sequence[Match]) -> int | None:
        """The first of some matches, the likeliest first, if nothing else comes near; None: there is doubt."""
        margin = self.recognition.margin_log_odds
        if not matches or matches[0].log_odds < margin:
            return None
        if len(matches) > 1 and matches[0].log_odds - matches[1].log_odds < margin:
            return None
        return matches[0].vertex
