"""How long a shortest path takes against the number of corners: process time of one query, preprocessing apart.

Every world is triangulated as it is; queries join random points of its free space. Prints a line for each world and
the exponent of time against n: the slope of a straight line through the logarithms, by least squares.
"""

import sys
import time
from argparse import ArgumentParser
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2])]

import numpy as np
import shapely
from rich.console import Console
from rich.table import Table

from coopslam.planning.shortest import ShortestPaths
from sim.world import load_world, world_names


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument(
        "worlds", metavar="W", nargs="*", help="names or GeoJSON files; default: all in datasets/worlds"
    )
    parser.add_argument("--queries", metavar="N", type=int, default=200, help="in each world; default: %(default)s")
    parser.add_argument("--radius", metavar="M", type=float, default=0.0, help="of the robot, m; default: %(default)s")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = []
    for world in map(load_world, options.worlds or world_names()):
        rng = np.random.default_rng(options.seed)
        rows.append((world.name, *_measured(world.polygon, options.radius, options.queries, rng)))
    rows.sort(key=lambda row: row[1])
    _show(rows, options)
    return 0


def _measured(polygon: shapely.Polygon, radius_m: float, queries: int, rng: np.random.Generator) -> tuple:
    """Corners of the polygon, corners of the mesh, pairs joined, ms to prepare, ms of a query: (queries,)."""
    began = time.process_time()
    paths = ShortestPaths(polygon, radius_m)
    joined = paths.prepare()
    prepared_ms = 1e3 * (time.process_time() - began)
    room = max(shapely.get_parts(paths.free_space), key=shapely.area)
    points = _points_inside(room, 2 * queries, rng).tolist()
    took_ms = []
    for start, goal in zip(points[::2], points[1::2], strict=True):
        began = time.process_time()
        paths.path(start, goal)
        took_ms.append(1e3 * (time.process_time() - began))
    corners = len(np.unique(shapely.get_coordinates(polygon), axis=0))
    return corners, len(paths.mesh.points), joined, prepared_ms, np.array(took_ms)


def _show(rows: list[tuple], options) -> None:
    table = Table(title=f"{options.queries} queries in each world, robot of {options.radius:g} m radius, process time")
    table.add_column("world", no_wrap=True)
    for column in ("corners n", "of the mesh", "tangents", "prepare ms", "median ms", "p99 ms"):
        table.add_column(column, justify="right")
    for name, n, points, joined, prepared_ms, took in rows:
        cells = (f"{prepared_ms:.1f}", f"{np.median(took):.2f}", f"{np.quantile(took, 0.99):.2f}")
        table.add_row(name, str(n), str(points), str(joined), *cells)
    Console(width=110).print(table)
    n = np.array([row[2] for row in rows], float)
    if len(set(n.tolist())) > 1:
        for name, ms in (("query", [np.median(row[5]) for row in rows]), ("preparation", [row[4] for row in rows])):
            slope, offset = np.polyfit(np.log(n), np.log(ms), 1)
            print(f"{name}: time grows as n^{slope:.2f}, {np.exp(offset + slope * np.log(200)):.2f} ms at n = 200")


def _points_inside(polygon: shapely.Polygon, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 2) points drawn evenly over the polygon."""
    low, high = np.reshape(polygon.bounds, (2, 2))
    points = np.empty((0, 2))
    while len(points) < count:
        drawn = rng.uniform(low, high, (4 * count, 2))
        points = np.vstack([points, drawn[shapely.contains_xy(polygon, drawn)]])
    return points[:count]


if __name__ == "__main__":
    sys.exit(main())
