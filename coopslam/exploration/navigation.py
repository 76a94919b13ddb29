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
        """Bring a robot along a known edge to the vertex at its other end, watched by its partner."""
        yield from self._cross(mover, target, self.crew.partner(mover), alone=False)

    def errand(self, mover: str, target: int, watcher: str):
        """As `cross`, whether the watcher sees it or not; returns how the last move ended."""
        return (yield from self._cross(mover, target, watcher, alone=True))

    def _cross(self, mover: str, target: int, watcher: str, alone: bool):
        crew, free_map = self.crew, self.crew.free_map
        start = crew.at[mover]
        if free_map.wall_leaving(start) == target:
            side = Side.RIGHT
        elif free_map.wall_arriving(start) == target:
            side = Side.LEFT
        else:
            return (yield from self._go_to(mover, target, watcher, alone))
        step = yield from crew.go(FollowWall(mover, watcher, side, alone=alone))
        if step.ended not in (MoveEnd.CORNER, MoveEnd.PARTNER):
            raise Stuck(f"{mover} followed the wall from vertex {start} to {target} and ended with {step.ended}")
        yield Decided((crew.seen_again(step.corner, target, "end of a known wall"),))
        return step.ended

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
        """Drive to a known vertex in the open, search for it if need be, and make sure that it is the one."""
        crew = self.crew
        places, search = 0, iter([NOWHERE_ELSE])
        while (offset := next(search, None)) is not None:
            step = yield from crew.go(self.aim(mover, target, watcher, None, offset, True, alone))
            for _ in range(MAX_HALVINGS):
                if step.ended != MoveEnd.DISTANCE:
                    break  # else: watched on the way, it aims again
                step = yield from crew.go(self.aim(mover, target, watcher, None, offset, True, alone))
            if step.corner is not None:
                if crew.may_be(step.corner, target):
                    yield Decided((crew.seen_again(step.corner, target, "found where it should be"),))
                    return step.ended
                yield from self._take_bearings(step, watcher)
            if places == 0:
                search = iter(self.places_to_search(mover, target))
            places += 1
        raise Stuck(f"{mover} looked for vertex {target} in {places} places and did not find it ({step.ended})")

    def _take_bearings(self, step: Step, watcher: str):
        """Another corner than the one looked for: if it is known without doubt, the next way is aimed from there."""
        crew = self.crew
        if step.ended == MoveEnd.PARTNER:
            vertex = crew.at.get(watcher)
        else:
            vertex = crew.surely_known(known_corners(crew.chart, crew.recognition, step.corner))
        if vertex is not None and crew.may_be(step.corner, vertex):
            yield Decided((crew.seen_again(step.corner, vertex, "found on a search"),))
