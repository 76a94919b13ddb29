"""The run directory: what other people's scripts read, written file by file."""

import json
from pathlib import Path

import networkx as nx
import numpy as np

from coopslam.errors import BadInput
from coopslam.estimation.estimate import Estimate
from coopslam.exploration.free_map import FreeMap
from coopslam.io.geojson import feature, write_feature_collection
from coopslam.io.tum import write_tum
from coopslam.planning.dual_graph import signed_area_m2
from coopslam.se2 import position

FILES = (
    "config.toml",
    "calibration.toml",
    "log.mcap",
    "map.geojson",
    "dual_graph.json",
    "pose_graph.g2o",
    "pose_graph.keys.json",
    "summary.json",
    "report.html",
)
FOLDERS = ("trajectories", "figures", "truth", "plans", "exports")  # the last two: made from a run, stale without it
SUFFIXES = (".png", ".gif", ".mp4", ".tum", ".json", ".geojson", ".graphml", ".pgm", ".yaml")  # of what is in them


def prepare_run_directory(path: Path, force: bool) -> None:
    """Make the directory, without an older run in it. Raises BadInput when it holds one and `force` is not given.

    Only what a run writes is ever deleted; folders are left alone unless config.toml and log.mcap show that they
    belong to a run.
    """
    try:
        if path.exists() and not path.is_dir():
            raise BadInput(f"--out {path}: is a file; a directory expected")
        held = [name for name in (*FILES, *FOLDERS) if (path / name).exists()]
        if held and not force:
            raise BadInput(f"--out {path}: already holds a run ({held[0]}); give another directory or --force")
        for name in held:
            if (path / name).is_dir() != (name in FOLDERS):
                raise BadInput(f"--out {path}: {name} in it is not what a run writes; give another directory")
        path.mkdir(parents=True, exist_ok=True)
        (path / ".writable").touch()
        (path / ".writable").unlink()
        if {"config.toml", "log.mcap"} <= set(held):
            for folder in (*(path / "plans").glob("*"), *(path / name for name in FOLDERS)):
                _clear(folder)
        for name in held:
            if name in FILES:
                (path / name).unlink()
    except (OSError, ValueError) as error:  # ValueError: a path that no system can have
        reason = getattr(error, "strerror", None) or error
        raise BadInput(f"--out {str(path)[:200]}: cannot be written: {reason}") from error


def _clear(folder: Path) -> None:
    """Delete the files of a run from one of its folders, and the folder when nothing else is in it."""
    if not folder.is_dir() or folder.is_symlink():
        return
    for file in folder.iterdir():
        if file.suffix in SUFFIXES and (file.is_file() or file.is_symlink()):
            file.unlink()
    if not any(folder.iterdir()):
        folder.rmdir()


def fresh_directory(path: Path) -> Path:
    """The path itself, or with the first number that is not yet taken."""
    taken, number = path, 1
    while taken.exists():
        number += 1
        taken = path.with_name(f"{path.name}-{number}")
    return taken


def write_trajectory(directory: Path, robot: str, estimate: Estimate, causal: Estimate) -> None:
    """trajectories/ROBOT.tum, smoothed, and ROBOT.causal.tum, as known at each moment; the same instants in both."""
    known = causal.causal_trajectory(robot)
    moments, stamps = set(known.stamps_s.tolist()), estimate.timeline.stamps
    keys = [key for key in estimate.timeline.tracks[robot].keys if stamps[key] in moments]
    directory.mkdir(exist_ok=True)
    write_tum(directory / f"{robot}.tum", known.stamps_s, [estimate.value(key) for key in keys])
    write_tum(directory / f"{robot}.causal.tum", known.stamps_s, known.poses)


def write_map(path: Path, free_map: FreeMap, estimate: Estimate) -> None:
    """map.geojson: vertices with covariances, triangles, walls, open gates; metres, frame of the estimate.

    A triangle's vertices are counter-clockwise as decided; noise can turn a sliver inside out in the estimate. Only
    such a triangle has the property `inverted` (true).
    """
    places = {vertex: position(estimate.vertex(vertex)).tolist() for vertex in free_map.fans}
    features = []
    for vertex, place in places.items():
        features.append(
            feature(
                "vertex",
                "Point",
                place,
                id=vertex,
                covariance=estimate.vertex_belief(vertex).position_covariance.tolist(),
                convex=free_map.interior_angles[vertex] < np.pi,
            )
        )
    for triangle, vertices in free_map.triangles.items():
        ring = [places[vertex] for vertex in vertices]
        inverted = {"inverted": True} if signed_area_m2(ring) < 0 else {}
        features.append(feature("triangle", "Polygon", [ring], id=triangle, vertices=list(vertices), **inverted))
    for kind, lines in (("wall", free_map.walls()), ("gate", sorted(free_map.gates))):
        for a, b in lines:
            features.append(feature(kind, "LineString", [places[a], places[b]], vertices=[a, b]))
    write_feature_collection(path, features)


def write_dual_graph(path: Path, graph: nx.Graph) -> None:
    """dual_graph.json: networkx node-link data."""
    write_json(path, nx.node_link_data(graph, edges="edges"))


def write_json(path: Path, data) -> None:
    """Indented JSON; refuses what JSON cannot say (NaN, infinity)."""
    path.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
