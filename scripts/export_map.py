"""The map of a finished run for other tools: its dual graph as GraphML, or an occupancy map for ROS (PGM and YAML).

In the occupancy map, cells that a wall runs through are occupied, mapped free space is free, and all else is unknown,
the insides of obstacles too. Its frame is the one of the map: the origin is the first robot's start.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from _cli import OneLineParser, run

from coopslam.errors import BadInput, NotWritten
from coopslam.io.graphml import write_graphml
from coopslam.io.occupancy_map import OccupancyMap, occupancy_of, write_occupancy_map
from coopslam.planning.map_graph import MapGraph

NAMES = {"graphml": ("dual_graph.graphml",), "pgm": ("map.pgm", "map.yaml")}


def main(arguments: Sequence[str] | None = None) -> int:
    """Load the map, write it in another format."""
    parser = OneLineParser(prog="export_map.py", description=__doc__)
    parser.add_argument("run", metavar="RUN_DIR", type=Path, help="directory of a finished run; its dual_graph.json")
    parser.add_argument("--format", choices=[*NAMES], required=True, help="graphml, or pgm with its yaml")
    parser.add_argument(
        "--resolution", metavar="M", type=float, default=0.05, help="side of a cell of the pgm, m; default: %(default)s"
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: RUN_DIR/exports")
    parser.add_argument("--force", action="store_true", help="overwrite what was exported before")
    options = parser.parse_args(arguments)
    map_graph = MapGraph.load(options.run / "dual_graph.json")
    out = options.out or options.run / "exports"
    grid = _occupancy(map_graph, options.resolution) if options.format == "pgm" else None
    try:
        held = [name for name in NAMES[options.format] if (out / name).exists()]
        if held and not options.force:
            raise BadInput(f"--out {out}: already holds {held[0]}; give another directory or --force")
        out.mkdir(parents=True, exist_ok=True)
        if grid is None:
            write_graphml(out / NAMES["graphml"][0], map_graph.graph)
        else:
            write_occupancy_map(out / "map", grid)
    except (OSError, ValueError) as error:  # ValueError: a path that no system can have
        reason = getattr(error, "strerror", None) or error
        raise NotWritten(f"--out {str(out)[:200]}: cannot be written: {reason}", done=False) from error
    if grid is not None:
        rows, columns = grid.pixels.shape
        print(f"{columns} x {rows} cells of {grid.resolution_m:g} m")
    print(" and ".join(str(out / name) for name in NAMES[options.format]) + " written")
    return 0


def _occupancy(map_graph: MapGraph, resolution_m: float) -> OccupancyMap:
    """Walls, not open gates, are occupied: behind a gate nothing is known."""
    walls = [(map_graph.vertices[a].xy, map_graph.vertices[b].xy) for a, b in map_graph.walls]
    return occupancy_of(map_graph.polygon, walls, resolution_m)


if __name__ == "__main__":
    sys.exit(run(main))
