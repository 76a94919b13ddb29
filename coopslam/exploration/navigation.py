"""How a robot gets to a known vertex: along a known wall, or over mapped free space and a search where it should be."""

import numpy as np

from coopslam.errors import require_positive
from coopslam.exploration.account import Stuck
from coopslam.exploration.crew import Crew, Decided
from coopslam.exploration.moves import FollowWall, GoToCorner, MoveEnd, Side, Step
from coopslam.exploration.recognition import known_corners
from coopslam.se2 import Pose2

NOWHERE_ELSE = np.zeros(2)
MAX_HALVINGS = 16  # of a way that is aimed anew half way


class Navigation:
    """Brings robots to known vertices; its methods are parts of the explorer's dialogue."""

    def __init__(self, crew: Crew, sure_reach_m: float, search_places: int):
        """sure_reach_m: a corner this near to where it should be is found.  search_places: looked at, at most."""
        require_positive(sure_reach_m=sure_reach_m, search_places=search_places)
        self.crew, self.sure_reach_m, self.search_places = crew, sure_reach_m, search_places

    def cross(self, mover: str, target: int):
        """Bring a robot over mapped free space to a vertex that its partner sees."""
        step, evidence = yield from self._way(mover, target, self.crew.partner(mover), alone=False)
        yield Decided((self.crew.seen_again(step.corner, target, evidence),))

    def errand(self, mover: str, target: int, watcher: str):
        """As `cross`, whether the watcher sees it or not; returns how the last move ended."""
        step, evidence = yield from self._way(mover, target, watcher, alone=True)
        yield Decided((self.crew.seen_again(step.corner, target, evidence),))
        return step.ended

    def visit(self, mover: str, target: int, watcher: str):
        """As `errand`, but nothing is decided of the corner in which it ends: returns the step."""
        step, _ = yield from self._way(mover, target, watcher, alone=True)
        return step

    def is_along_wall(self, start: int, end: int) -> bool:
        """Whether the way between two vertices is a known wall, on which nobody can go astray."""
        return end in (self.crew.free_map.wall_leaving(start), self.crew.free_map.wall_arriving(start))

    def _way(self, mover: str, target: int, watcher: str, alone: bool):
        """(the step that ended in the vertex, by which evidence it did)."""
        start = self.crew.at[mover]
        if not self.is_along_wall(start, target):
            return (yield from self._go_to(mover, target, watcher, alone)), "found where it should be"
        side = Side.RIGHT if self.crew.free_map.wall_leaving(start) == target else Side.LEFT
        step = yield from self.crew.follow_to_end(FollowWall(mover, watcher, side, alone=alone))
        if step.ended == MoveEnd.CONTACT:  # the map is a little off; along a known wall nobody goes astray
            step = yield from self.crew.go(FollowWall(mover, watcher, side, alone=True))
        if step.corner is None:
            raise Stuck(f"{mover} followed the wall from vertex {start} to {target} and ended with {step.ended}")
        return step, "end of a known wall"

    def aim(
        self,
        mover: str,
        target: int,
        watcher: str,
        watch_for_rad: float | None = None,
        offset: np.ndarray = NOWHERE_ELSE,
        keep_contact: bool = False,
        alone: bool = False,
    ) -> GoToCorner:
        """The move to a known vertex.  offset: (2,) from where the vertex should be, axes of the map, m."""
        chart = self.crew.chart
        vertex = chart.vertex(target)
        there = chart.robot(mover).between(Pose2(vertex.x() + offset[0], vertex.y() + offset[1], vertex.theta()))
        metres = float(np.hypot(there.x(), there.y()))
        far_off = metres > 2 * self.sure_reach_m and 3 * chart.relative_sigma(mover, target) > self.sure_reach_m
        return GoToCorner(
            mover,
            watcher,
            (there.x(), there.y(), there.theta()),
            self.crew.free_map.interior_angles[target],
            watch_for_rad,
            metres / 2 if far_off and not offset.any() else None,
            keep_contact,
            alone,
        )

    def places_to_search(self, mover: str, target: int) -> list[np.ndarray]:
        """Offsets (2,) from where a vertex should be, on a grid that the finder covers, the likeliest first, m.

        The place itself comes first again: seen from near, the robot aims better.
        """
        variances, axes = np.linalg.eigh(self.crew.chart.relative_covariance(mover, target))
        sigmas = np.sqrt(np.maximum(variances, 1e-12))
        spacing = 1.4 * self.sure_reach_m  # squares whose corners the finder just reaches
        counts = np.minimum(np.ceil(np.maximum(3 * sigmas - self.sure_reach_m, 0) / spacing), 10).astype(int)
        steps = [spacing * np.arange(-count, count + 1) for count in counts]
        grid = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
        likely = np.argsort(np.sum((grid / sigmas) ** 2, axis=1), kind="stable")[: self.search_places]
        return [axes @ grid[k] for k in likely]

    def _go_to(self, mover: str, target: int, watcher: str, alone: bool):
        """Drive to a known vertex in the open and search for it if need be; the step that ended in it."""
        crew = self.crew
        places, search = 0, iter([NOWHERE_ELSE])
        while (offset := next(search, None)) is not None:
            step = yield from crew.go(self.aim(mover, target, watcher, None, offset, True, alone))
            for _ in range(MAX_HALVINGS):
                if step.ended != MoveEnd.DISTANCE:
                    break  # else: watched on the way, it aims again
                step = yield from crew.go(self.aim(mover, target, watcher, None, offset, True, alone))
            if step.corner is not None:
                if self._is_likeliest(step, target):
                    return step
                yield from self._take_bearings(step, target, watcher, alone)
            passed_target = any(record.vertex == target for record in crew.passed)
            if places == 0 or passed_target:  # from now on it is aimed much better
                search = iter(self.places_to_search(mover, target))
            places += 1
            if places > self.search_places:
                break
        raise Stuck(f"{mover} looked for vertex {target} in {places} places and did not find it ({step.ended})")

    def _is_likeliest(self, step: Step, target: int) -> bool:
        """Whether the corner found fits the target, and no other known vertex better."""
        crew = self.crew
        if not crew.may_be(step.corner, target):
            return False
        matches = known_corners(crew.chart, crew.recognition, step.corner)
        return not matches or matches[0].vertex == target

    def _take_bearings(self, step: Step, target: int, watcher: str, alone: bool):
        """Another corner than the one looked for: if it is known without doubt, the next way is aimed from there."""
        crew = self.crew
        if step.ended == MoveEnd.PARTNER and not alone:
            vertex = crew.at[watcher]
        else:
            vertex = crew.surely_known(known_corners(crew.chart, crew.recognition, step.corner))
        if vertex not in (None, target) and crew.may_be(step.corner, vertex):
            yield Decided((crew.seen_again(step.corner, vertex, "found on a search"),))
