"""The end of an exploration: is the finished map a triangulation of one polygon with holes?"""

import numpy as np

from coopslam.errors import CoopSlamError
from coopslam.exploration.free_map import FreeMap


class Stuck(CoopSlamError):
    """Exploration cannot go on, or must not be called complete; the message says where and why."""

    exit_code = 3


def account(free_map: FreeMap, angle_sigma_rad: float, sigmas: float) -> str:
    """The numbers of a finished map, in words.

    Raises Stuck when a vertex is not surrounded by triangles and walls, when the corners of a ring of walls do not
    add up to one full turn, when there is not one outer ring, or when the counts do not agree.
    """
    unfinished = [vertex for vertex, fan in free_map.fans.items() if not fan.complete]
    if unfinished:
        raise Stuck(f"no gate is open, but vertices {unfinished[:5]} have unexplored space or unknown walls")
    rings = free_map.rings()
    for ring in rings:
        doubt = sigmas * angle_sigma_rad * np.sqrt(len(ring)) + 1e-6
        if abs(abs(free_map.turning(ring)) - 2 * np.pi) > doubt:
            degrees = np.degrees(free_map.turning(ring))
            raise Stuck(f"the corners of the walls {ring[:5]}... turn by {degrees:.1f} degrees, not by 360")
    n, holes, triangles = len(free_map.fans), free_map.holes, len(free_map.triangles)
    if len(rings) != holes + 1 or triangles != n + 2 * holes - 2:
        raise Stuck(f"{triangles} triangles do not fit {n} vertices, {len(rings)} rings of walls and {holes} holes")
    return f"no gate is open; {triangles} triangles = {n} vertices + 2 x {holes} holes - 2"
