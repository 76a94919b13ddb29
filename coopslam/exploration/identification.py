"""Which vertex is the corner in which the mover stands? When that is ambiguous, evidence is gathered first.

Evidence, the cheaper first: the mover walks the wall to its next corner and back, and both corners are compared with
the map together (how long the wall is and how its ends are shaped does not depend on how well the place is known);
then the partner goes to the vertex over the map and either meets the mover there or does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import networkx as nx
import numpy as np

from coopslam.exploration.account import Stuck
from coopslam.exploration.crew import Crew, Decided
from coopslam.exploration.free_map import Sector
from coopslam.exploration.moves import FollowWall, MoveEnd, Side, Step
from coopslam.exploration.navigation import Navigation
from coopslam.exploration.recognition import Match, Walked, corner_density, could_be, known_corners, log_odds
from coopslam.exploration.sweep import Sweep
from coopslam.records import CornerDecision, CornerEvidence, CornerSighting
from coopslam.se2 import position

CERTAIN_LOG_ODDS = 100.0  # of what was seen happen, whatever the numbers said
WALKED = "walked its wall to the next corner and back"
MET, NOT_MET = "the partner went there and met it", "the partner went there and did not meet it"
BACK = {Side.LEFT: Side.RIGHT, Side.RIGHT: Side.LEFT}


@dataclass(slots=True)
class Case:
    """A sighting behind a gate, and what is known of it so far."""

    sweep: Sweep
    sighting: CornerSighting
    walked: Walked
    matches: list[Match]  # the likeliest first
    evidence: list[str]
    visited: set[int] = field(default_factory=set)  # candidates to which the partner went

    def verdict(self, margin: float) -> Match | str | None:
        """The vertex that it is, "new", or None while that is ambiguous."""
        if not self.matches or self.matches[0].log_odds <= -margin:
            return "new"
        best, *others = self.matches
        if best.log_odds < margin or (others and best.log_odds - others[0].log_odds < margin):
            return None
        return best

    def weigh(self, odds: dict[int, float]) -> None:
        """Put new log odds in place of the old ones."""
        weighed = [replace(match, log_odds=odds.get(match.vertex, match.log_odds)) for match in self.matches]
        self.matches = sorted(weighed, key=lambda match: -match.log_odds)


class Identification:
    """Decides which vertex a sighted corner is; its `apex` is a part of the explorer's dialogue."""

    def __init__(self, crew: Crew, navigation: Navigation):
        self.crew, self.navigation = crew, navigation

    def apex(self, sweep: Sweep, sighting: CornerSighting, walked: Walked):
        """(decision, sector): a known vertex and the sector that the triangle fills there, or a new one and None.

        Raises Stuck when the sighting shows a known vertex at which the triangle does not fit: taking it for a new one
        would map a part of the world twice.
        """
        crew, margin = self.crew, self.crew.recognition.margin_log_odds
        matches = known_corners(crew.chart, crew.recognition, sighting, sweep.gate, walked)
        possible = [match for match in matches if could_be(crew.free_map, match.vertex, sweep.gate, walked)]
        ruled_out = [f"not vertex {m.vertex}, which has no room left" for m in matches if m not in possible]
        case = Case(sweep, sighting, walked, possible, ruled_out)
        if case.verdict(margin) is None:
            yield from self._walk_wall(case)
        while case.verdict(margin) is None and len(case.visited) < len(possible):
            yield from self._bring_partner(case)
        match case.verdict(margin):
            case "new":
                return crew.new_vertex(sighting, "; ".join(case.evidence)), None
            case None:
                raise Stuck(
                    f"{sweep.mover} cannot tell whether it found vertex {case.matches[0].vertex} behind gate "
                    f"{sweep.gate} (log odds {case.matches[0].log_odds:.1f})"
                )
            case best:
                return self._known(case, best)

    def _known(self, case: Case, best: Match) -> tuple[CornerDecision, int]:
        sweep, sighting = case.sweep, case.sighting
        sector: Sector | None = best.sector
        if sector is None:
            raise Stuck(f"{sighting.observer} found vertex {best.vertex} behind gate {sweep.gate}, where it cannot be")
        rivals = [match for match in case.matches[1:] if match.log_odds > -CERTAIN_LOG_ODDS]
        runner_up_sq = rivals[0].distance_sq if rivals else None
        evidence = "; ".join(case.evidence or ["end of an open gate"])
        known = CornerDecision(self.crew.now_s, sighting, best.vertex, False, best.distance_sq, runner_up_sq, evidence)
        return known, sector.index

    # evidence

    def _walk_wall(self, case: Case):
        """The mover walks a wall that both it and the likeliest candidates know, to its next corner, and comes back."""
        crew, sweep = self.crew, case.sweep
        side = self._side_to_walk(case)
        if side is None:
            return
        step = yield from crew.go(FollowWall(sweep.mover, sweep.watcher, side, alone=True))
        odds = {match.vertex: self._odds_of_wall(case, match, side, step) for match in case.matches}
        back = yield from crew.go(FollowWall(sweep.mover, sweep.watcher, BACK[side], alone=True))
        if back.ended != MoveEnd.CORNER:
            raise Stuck(f"{sweep.mover} walked a wall behind gate {sweep.gate} and did not come back ({back.ended})")
        yield from self._say(case, odds, WALKED)

    def _side_to_walk(self, case: Case) -> Side | None:
        """The hand of the wall to walk: not the one just walked, and one whose other end a candidate knows."""
        for match in case.matches:
            if not case.walked.at_start and self._neighbour(match.vertex, Side.RIGHT) is not None:
                return Side.RIGHT
            if not case.walked.at_end and self._neighbour(match.vertex, Side.LEFT) is not None:
                return Side.LEFT
        return None

    def _neighbour(self, vertex: int, side: Side) -> int | None:
        """The vertex at the other end of the wall that is followed from a vertex with a hand on it."""
        free_map = self.crew.free_map
        return free_map.wall_leaving(vertex) if side == Side.RIGHT else free_map.wall_arriving(vertex)

    def _odds_of_wall(self, case: Case, match: Match, side: Side, step: Step) -> float:
        """Log odds of a candidate once the next corner along its wall is seen too."""
        end = self._neighbour(match.vertex, side)
        if end is None:
            return match.log_odds
        met_partner, partner_there = step.ended == MoveEnd.PARTNER, end == case.sweep.pivot
        if met_partner or partner_there:  # the partner stands in a vertex that is known for certain
            return match.log_odds + (CERTAIN_LOG_ODDS if met_partner and partner_there else -CERTAIN_LOG_ODDS)
        return self._odds([(case.sighting, match.vertex), (step.corner, end)])

    def _bring_partner(self, case: Case):
        """The partner goes over the map to the likeliest candidate not yet visited: does it meet the mover there?"""
        sweep, partner = case.sweep, case.sweep.watcher
        best = next(match for match in case.matches if match.vertex not in case.visited)
        case.visited.add(best.vertex)
        route = self.route(sweep.pivot, best.vertex)
        if route is None:
            return
        been = [sweep.pivot]
        for vertex in route[1:-1]:
            if (yield from self.navigation.errand(partner, vertex, sweep.mover)) == MoveEnd.PARTNER:
                odds, met = self._only(case, vertex), True
                break
            been.append(vertex)
        else:
            step = yield from self.navigation.visit(partner, best.vertex, sweep.mover)
            odds, met = self._odds_of_visit(case, best, been[-1], step), step.ended == MoveEnd.PARTNER
            if self.navigation.is_along_wall(been[-1], best.vertex):
                self.crew.at[partner] = best.vertex
        for vertex in reversed(been):
            yield from self.navigation.errand(partner, vertex, sweep.mover)
        yield from self._say(case, odds, MET if met else NOT_MET)

    def _odds_of_visit(self, case: Case, match: Match, before: int, step: Step) -> dict[int, float]:
        """What the partner found at a candidate, coming from the vertex before.

        A known wall leads nowhere else. Over open space it may itself have found another corner that looks like the
        candidate: then its own sighting, from a pose that owes nothing to the mover's, counts beside the mover's.
        """
        met = step.ended == MoveEnd.PARTNER
        if self.navigation.is_along_wall(before, match.vertex):
            return self._only(case, match.vertex) if met else {match.vertex: -CERTAIN_LOG_ODDS}
        found = self._odds([(step.corner, match.vertex)])
        if met:
            return {match.vertex: match.log_odds + found}
        return {match.vertex: -CERTAIN_LOG_ODDS} if found >= self.crew.recognition.margin_log_odds else {}

    @staticmethod
    def _only(case: Case, vertex: int) -> dict[int, float]:
        """The mover stands in this vertex and in no other."""
        return {match.vertex: -CERTAIN_LOG_ODDS for match in case.matches} | {vertex: CERTAIN_LOG_ODDS}

    def _odds(self, pairs: Sequence[tuple[CornerSighting, int]]) -> float:
        """Log odds that sightings show certain vertices, not less than what is certain."""
        crew, (sighting, vertex) = self.crew, pairs[0]
        observer = crew.chart.estimate.pose_key_at(sighting.observer, sighting.stamp_s)
        here = position(crew.chart.estimate.value(observer) * sighting.T_observer_corner)
        density = corner_density(crew.chart, crew.recognition, here, vertex)
        return max(log_odds(crew.chart, pairs, density, crew.recognition.angle_sigmas)[0], -CERTAIN_LOG_ODDS)

    def route(self, start: int, end: int) -> list[int] | None:
        """Vertices along the shortest way over known edges."""
        free_map, place = self.crew.free_map, self.crew.chart.position
        graph = nx.Graph()
        edges = [edge for a, b, c in free_map.triangles.values() for edge in ((a, b), (b, c), (c, a))]
        for u, v in edges + free_map.walls():
            graph.add_edge(u, v, metres=float(np.hypot(*(place(u) - place(v)))))
        if start not in graph or end not in graph or not nx.has_path(graph, start, end):
            return None
        return nx.shortest_path(graph, start, end, weight="metres")

    def _say(self, case: Case, odds: dict[int, float], done: str):
        """Weigh the candidates anew, and write down what was done."""
        case.weigh(odds)
        case.evidence.append(done)
        yield Decided(
            tuple(
                CornerEvidence(self.crew.now_s, case.sighting.observer, match.vertex, done, match.log_odds)
                for match in case.matches
                if match.vertex in odds
            )
        )
