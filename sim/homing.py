"""The way of a robot to where a known corner should be: straight, along walls that are in the way, then to the corner.

The robot knows only where the corner should be and what its short-range finder shows within reach; the course
itself is held without error, as if the partner corrected it all the time; so it is on the few errands that no partner
watches, which flatters them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from coopslam.se2 import Pose2, wrap
from sim.sight import TOLERANCE_M, Sight

MAX_STRETCHES = 12  # straight ones, on one way


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A place on the way, and the corner (vertex) or wall (first vertex) that it touches."""

    position: np.ndarray  # (2,) m, world frame
    corner: int | None = None
    wall: int | None = None


def way_to_corner(sight: Sight, start: Waypoint, aim: np.ndarray, reach_m: float) -> list[Waypoint]:
    """Waypoints from the start towards (2,) `aim`: until it is reached, or nothing but a corner is left to look for.

    A robot that meets a wall follows it in the sense that leads nearer, to the foot of the aim or to its corner.
    """
    way, here = [], start
    for _ in range(MAX_STRETCHES):
        left = aim - here.position
        length = float(np.hypot(*left))
        if length <= TOLERANCE_M or (way and here.corner is not None and length <= reach_m):
            break
        obstacle = sight.first_obstacle(here.position, left / length)
        if obstacle is None or obstacle.distance_m > length:
            way.append(Waypoint(aim))
            break
        if obstacle.distance_m > 0.0:
            if obstacle.corner is not None:
                here = Waypoint(sight.points[obstacle.corner], corner=obstacle.corner)
            else:
                here = Waypoint(here.position + obstacle.distance_m / length * left, wall=obstacle.wall)
            way.append(here)
            continue
        after = _along_wall(sight, here, left)
        if after is None:
            break
        here = after
        way.append(here)
        if here.corner is None:
            break  # the foot of the aim: no place on this wall is nearer
    return way


def best_corner(
    sight: Sight, here: np.ndarray, expected: Pose2, angle_rad: float, reach_m: float, look: Callable
) -> int | None:
    """The visible corner within reach of (2,) `here` and of the expected place that looks most like the expected one.

    expected: the oriented corner in the world, where the robot believes it.  angle_rad: its interior angle.
    look: corner -> (oriented corner in the world, interior angle) as the finder measures them.
    """
    best, best_score = None, np.inf
    for corner in sight.corners_near(here, reach_m):
        if not sight.sees(here, sight.points[corner]):
            continue
        seen, seen_angle = look(int(corner))
        offset = seen.range(expected.translation()) / reach_m
        if offset > 1:
            continue
        turned = wrap(seen.theta() - expected.theta())
        score = offset**2 + turned**2 + (seen_angle - angle_rad) ** 2
        if score < best_score:
            best, best_score = int(corner), score
    return best


def cut_off(start: np.ndarray, way: list[Waypoint], limit_m: float) -> tuple[list[Waypoint], bool]:
    """The first `limit_m` of a way, and whether anything was cut off."""
    kept, here, left = [], start, limit_m
    for waypoint in way:
        stretch = waypoint.position - here
        length = float(np.hypot(*stretch))
        if length > left:
            return [*kept, Waypoint(here + left / length * stretch, wall=waypoint.wall)], True
        kept.append(waypoint)
        here, left = waypoint.position, left - length
    return kept, False


def _along_wall(sight: Sight, here: Waypoint, left: np.ndarray) -> Waypoint | None:
    """Where following the wall in the way leads; None: no wall here leads nearer to the aim."""
    world = sight.world
    if here.corner is not None:
        ends = [(int(world.next_index[here.corner]), here.corner), (int(world.prev_index[here.corner]),) * 2]
    elif here.wall is not None:
        ends = [(int(world.next_index[here.wall]), here.wall), (here.wall, here.wall)]
    else:
        return None
    nearer = []
    for end, wall in ends:
        along = sight.points[end] - here.position
        length = float(np.hypot(*along))
        if length > TOLERANCE_M and (progress := float(left @ along) / length) > TOLERANCE_M:
            nearer.append((progress, length, end, wall, along / length))
    if not nearer:
        return None
    progress, length, end, wall, direction = max(nearer, key=lambda option: option[0])
    if progress < length:
        return Waypoint(here.position + progress * direction, wall=wall)
    return Waypoint(sight.points[end], corner=end, wall=wall)
