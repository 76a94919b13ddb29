"""What plan.py does between its arguments and its table: find the paths, write them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coopslam.errors import BadInput, NotWritten
from coopslam.io.geojson import feature, write_feature_collection
from coopslam.planning.belief_paths import pareto, safest, shortest, widest
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.traversal import TraversalModel
from coopslam.report.path_figure import NamedRoute
from coopslam.report.run_directory import FILES

PATHS, PLAN, FIGURE = "paths.geojson", "plan.json", "paths.png"
ONE_PATH = {"shortest": shortest, "safest": safest, "widest": widest}
OBJECTIVES = (*ONE_PATH, "pareto")


def named_routes(
    map_graph: MapGraph, objectives: Sequence[str], start, goal, model: TraversalModel, robot_radius_m: float
) -> list[NamedRoute]:
    """One path for each objective, of a front all that are on it. Raises what the planners do."""
    found = []
    for objective in objectives:
        if objective in ONE_PATH:
            route = ONE_PATH[objective](map_graph, start, goal, model, robot_radius_m)
            found.append(NamedRoute(objective, route))
        else:
            routes = pareto(map_graph, start, goal, model, robot_radius_m)
            found += [NamedRoute(f"pareto {k}", route) for k, route in enumerate(routes, start=1)]
    return found


def prepare_plan_directory(path: Path, force: bool) -> None:
    """Make the directory. Raises BadInput when it holds a plan or a run and `force` is not given."""
    try:
        if path.exists() and not path.is_dir():
            raise BadInput(f"--out {path}: is a file; a directory expected")
        held = [name for name in (PATHS, PLAN, FIGURE, *FILES) if (path / name).exists()]
        if held and not force:
            raise BadInput(f"--out {path}: already holds {held[0]}; give another directory or --force")
        path.mkdir(parents=True, exist_ok=True)
        for name in (PATHS, PLAN, FIGURE):
            (path / name).unlink(missing_ok=True)
    except (OSError, ValueError) as error:  # ValueError: a path that no system can have
        raise cannot_write(path, error, done=False) from error


def cannot_write(path: Path, error: Exception, done: bool) -> NotWritten:
    """done: the paths have been found already."""
    return NotWritten(f"--out {str(path)[:200]}: cannot be written: {getattr(error, 'strerror', None) or error}", done)


def write_paths(path: Path, named: Sequence[NamedRoute]) -> None:
    """GeoJSON in the frame of the map: a `path` (LineString) each, and `station` points with the covariance there.

    covariance: [[xx, xy], [xy, yy]], m^2; pose_covariance: 3x3 with the heading, m, m, rad; both of the robot's pose
    relative to the map around it, in the axes of the map.
    """
    features = []
    for one in named:
        route = one.route
        line = route.bends if len(route.bends) > 1 else np.repeat(route.bends, 2, axis=0)  # GeoJSON wants two points
        features.append(feature("path", "LineString", line, name=one.name, **told(one)))
        along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route.points, axis=0).T))])
        for point, distance_m, cov in zip(route.points, along_m, route.covariances, strict=True):
            known = {"covariance": cov[:2, :2], "pose_covariance": cov}
            features.append(feature("station", "Point", point, path=one.name, distance_m=distance_m, **known))
    write_feature_collection(path, features)


def told(one: NamedRoute) -> dict:
    """The figures of a path."""
    route = one.route
    return {
        "length_m": route.length_m,
        "final_sigma_m": route.final_sigma_m,
        "final_heading_sigma_rad": float(np.sqrt(max(route.covariances[-1][2, 2], 0.0))),
        "clearance_m": route.clearance_m,
        "touching_probability": route.touching_probability,
        "triangles": list(route.triangles),
    }
