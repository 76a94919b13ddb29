"""Lines of sight among polygons: when contact breaks, what a straight drive meets, who sees whom.

A line of sight is a closed segment in closed free space: touching a wall or a corner does not break it.
One tolerance, `TOLERANCE_M`, says what counts as touching. All queries look at every vertex at once.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from sim.world import World

TOLERANCE_M = 1e-9
ROUNDING_M = 1e-6  # by less than this nothing is hidden, or away from its wall, beyond the doubt of rounding
PROBE_M = 1e-4  # so far ahead is looked whether a robot at a wall heads into it


@dataclass(frozen=True, slots=True)
class Obstacle:
    """What a straight drive meets first: a corner (vertex index) or a wall (index of its first vertex).

    Neither, at distance zero: the drive leads straight into a wall at which it starts.
    """

    distance_m: float
    corner: int | None = None
    wall: int | None = None


class Sight:
    """Visibility queries in one world. Points are (2,) in metres, vertices are flat indices."""

    def __init__(self, world: World):
        self.world = world
        self.points = world.points
        self._edge = world.points[world.next_index] - world.points

    @cached_property
    def _drawn_out(self) -> shapely.Polygon:
        polygon = self.world.polygon.buffer(ROUNDING_M, join_style="mitre")
        shapely.prepare(polygon)
        return polygon

    def contact_break(self, watcher, start, end, start_corner: int | None = None) -> float | None:
        """Fraction of the straight drive start -> end after which the watcher loses sight of the robot.

        Contact must hold at the start. `start_corner` is the vertex in which the drive starts, if any.
        None: contact holds all the way. While the line of contact turns about the watcher it can only be
        cut by a vertex inside the triangle that it sweeps, by one that it touches when it starts to turn, or
        by the corner in which the drive starts.
        """
        line = start - watcher
        drive = end - start
        length = np.hypot(*line)
        if length < TOLERANCE_M or abs(cross(line, drive)) < TOLERANCE_M * length:
            return None  # the robot drives along the line of contact
        turn = np.sign(cross(line, drive))  # +1: the line of contact turns counter-clockwise
        if start_corner is not None and not self._leaves_freely(start_corner, -line, drive, turn):
            return 0.0
        arm = self.points - watcher
        last = end - watcher
        ahead = turn * cross(line, arm) / length  # metres ahead of the first line of contact
        passed = -turn * cross(last, arm) / np.hypot(*last)  # metres behind the last one
        inside = turn * cross(drive, self.points - start) > TOLERANCE_M * np.hypot(*drive)

        along = arm @ line / length
        touching = inside & (np.abs(ahead) <= TOLERANCE_M) & (along > TOLERANCE_M) & (along < length - TOLERANCE_M)
        if touching.any():
            which = np.flatnonzero(touching)
            neighbours = np.maximum(ahead[self.world.next_index[which]], ahead[self.world.prev_index[which]])
            if (neighbours > TOLERANCE_M).any():
                return 0.0
        swept = inside & (ahead > TOLERANCE_M) & (passed > TOLERANCE_M)
        breaks = [float(np.min(-cross(line, arm[swept]) / cross(drive, arm[swept])))] if swept.any() else []
        return min(breaks + self._hidden_behind_touched(watcher, start, drive, turn), default=None)

    def first_obstacle(self, origin, direction) -> Obstacle | None:
        """What a drive from `origin` along the unit vector `direction` meets first; touching a corner counts."""
        if not self._is_free(origin + PROBE_M * direction):
            return Obstacle(0.0)
        arm = self.points - origin
        along, beside = arm @ direction, cross(direction, arm)
        best = None
        on_line = np.flatnonzero((np.abs(beside) <= TOLERANCE_M) & (along > TOLERANCE_M))
        if on_line.size:
            corner = int(on_line[np.argmin(along[on_line])])
            best = Obstacle(float(along[corner]), corner=corner)
        walls, at = self._walls_across(along, beside)
        walls, at = walls[at > TOLERANCE_M], at[at > TOLERANCE_M]
        if walls.size and (best is None or at.min() < best.distance_m):
            nearest = int(np.argmin(at))
            best = Obstacle(float(at[nearest]), wall=int(walls[nearest]))
        return best

    def first_corner_between(self, origin, end) -> int | None:
        """The first corner that a drive origin -> end touches on its way, ends excluded."""
        direction = end - origin
        length = np.hypot(*direction)
        if length <= TOLERANCE_M:
            return None
        direction = direction / length
        arm = self.points - origin
        along = arm @ direction
        hits = np.flatnonzero(
            (np.abs(cross(direction, arm)) <= TOLERANCE_M) & (along > TOLERANCE_M) & (along < length - TOLERANCE_M)
        )
        return int(hits[np.argmin(along[hits])]) if hits.size else None

    def sees(self, a, b) -> bool:
        """Whether the closed segment a - b lies in closed free space."""
        direction = b - a
        length = np.hypot(*direction)
        if length <= TOLERANCE_M:
            return True
        direction = direction / length
        arm = self.points - a
        along, beside = arm @ direction, cross(direction, arm)
        _, at = self._walls_across(along, beside)
        if ((at > TOLERANCE_M) & (at < length - TOLERANCE_M)).any():
            return False
        touched = along[(np.abs(beside) <= TOLERANCE_M) & (along > TOLERANCE_M) & (along < length - TOLERANCE_M)]
        stops = np.concatenate([[0.0], np.sort(touched), [length]])
        middles = a + np.outer((stops[:-1] + stops[1:]) / 2, direction)
        return bool(all(self._is_free(point) for point in middles))

    def _walls_across(self, along: np.ndarray, beside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Walls that cross a line clear of their corners, and where on the line, m.

        along, beside: (n,) coordinates of all corners from the line's origin, m.
        """
        beyond = self.world.next_index
        clear = (np.abs(beside) > TOLERANCE_M) & (np.abs(beside[beyond]) > TOLERANCE_M)
        walls = np.flatnonzero(clear & (beside * beside[beyond] < 0))
        ends = beyond[walls]
        share = beside[walls] / (beside[walls] - beside[ends])
        return walls, along[walls] + (along[ends] - along[walls]) * share

    def is_hidden(self, a, b) -> bool:
        """Whether a does not see b, beyond any doubt of rounding: an obstacle lies between them, deeper than 1 um."""
        return not self.sees(a, b) and not self._drawn_out.covers(shapely.LineString([a, b]))

    def is_at_wall(self, point, wall: int) -> bool:
        """Whether a point lies on a wall, but for rounding."""
        arm, edge = point - self.points[wall], self._edge[wall]
        fraction = min(max(float(arm @ edge / (edge @ edge)), 0.0), 1.0)
        return bool(np.hypot(*(arm - fraction * edge)) <= ROUNDING_M)

    def corners_near(self, point, reach_m: float) -> np.ndarray:
        """Flat indices of the corners within reach, nearest first."""
        distance = np.hypot(*(self.points - point).T)
        near = np.flatnonzero(distance <= reach_m)
        return near[np.argsort(distance[near])]

    def _is_free(self, point) -> bool:
        """Whether a point lies in closed free space: even-odd rule, with the boundary counted in."""
        arm = self.points - point
        edge = self._edge
        fraction = np.clip(-np.sum(arm * edge, axis=1) / np.sum(edge * edge, axis=1), 0.0, 1.0)
        if np.min(np.hypot(*(arm + fraction[:, None] * edge).T)) <= TOLERANCE_M:
            return True
        tip = arm[self.world.next_index]
        straddles = (arm[:, 1] > 0) != (tip[:, 1] > 0)
        left = cross(arm[straddles], tip[straddles]) * np.sign(tip[straddles, 1] - arm[straddles, 1]) > 0
        return bool(np.count_nonzero(left) % 2)

    def _hidden_behind_touched(self, watcher, start, drive, turn: float) -> list[float]:
        """Fractions of a drive at which it passes a corner that hides the robot from then on."""
        length = np.hypot(*drive)
        arm = self.points - start
        along = arm @ drive / length
        touched = (np.abs(cross(drive, arm)) <= TOLERANCE_M * length) & (along > TOLERANCE_M)
        return [
            float(along[corner] / length)
            for corner in np.flatnonzero(touched & (along < length - TOLERANCE_M))
            if not self._leaves_freely(corner, watcher - self.points[corner], drive, turn)
        ]

    def _leaves_freely(self, corner: int, to_watcher, drive, turn: float) -> bool:
        """Whether the wedge that the line of contact sweeps next to a corner is free of the corner's own obstacle."""
        leaving = self._edge[corner]
        first, last = (drive, to_watcher) if turn > 0 else (to_watcher, drive)
        opening = angle_between(leaving, first)
        if opening > 2 * np.pi - 1e-9:
            opening -= 2 * np.pi
        return opening + angle_between(first, last) <= self.world.interior_angle(corner) + 1e-9


def cross(a, b):
    """z component of the cross product of (..., 2) vectors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def angle_between(a, b) -> float:
    """Angle from a counter-clockwise to b, in [0, 2 pi)."""
    return float(np.arctan2(cross(a, b), a @ b) % (2 * np.pi))
