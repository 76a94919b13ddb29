"""The run directory: what other people's scripts read, written file by file."""

import json
import shutil
from pathlib import Path

import gtsam
import networkx as nx
import numpy as np

from coopslam.errors import BadInput
from coopslam.estimation.estimate import Estimate
from coopslam.exploration.free_map import FreeMap
from coopslam.io.g2o import BearingEdge, PoseEdge, write_g2o, write_keys
from coopslam.io.geojson import feature, write_feature_collection
from coopslam.io.tum import write_tum
from coopslam.se2 import position

FILES = (
    "config.toml",
    "log.mcap",
    "map.geojson",
    "dual_graph.json",
    "pose_graph.g2o",
    "pose_graph.keys.json",
    "summary.json",
    "report.html",
)
FOLDERS = ("trajectories", "figures", "truth")


def prepare_run_directory(path: Path, force: bool) -> None:
    """Make the directory, without an older run in it. Raises BadInput when it holds one and `force` is not given."""
    if path.exists() and not path.is_dir():
        raise BadInput(f"--out {path}: is a file; a directory expected")
    held = [name for name in (*FILES, *FOLDERS) if (path / name).exists()]
    if held and not force:
        raise BadInput(f"--out {path}: already holds a run ({held[0]}); give another directory or --force")
    try:
        path.mkdir(parents=True, exist_ok=True)
        for name in held:
            shutil.rmtree(path / name) if name in FOLDERS else (path / name).unlink()
        (path / ".writable").touch()
        (path / ".writable").unlink()
    except OSError as error:
        raise BadInput(f"--out {path}: cannot be written: {error.strerror}") from error


def fresh_directory(path: Path) -> Path:
    """The path itself, or with the first number that is not yet taken."""
    taken, number = path, 1
    while taken.exists():
        number += 1
        taken = path.with_name(f"{path.name}-{number}")
    return taken


def write_trajectories(directory: Path, estimate: Estimate, causal: Estimate) -> None:
    """trajectories/ROBOT.tum, smoothed, and ROBOT.causal.tum, as known at each moment."""
    directory.mkdir(exist_ok=True)
    for robot in estimate.robots:
        smoothed, known = estimate.trajectory(robot), causal.causal_trajectory(robot)
        write_tum(directory / f"{robot}.tum", smoothed.stamps_s, smoothed.poses)
        write_tum(directory / f"{robot}.causal.tum", known.stamps_s, known.poses)


def write_map(path: Path, free_map: FreeMap, estimate: Estimate) -> None:
    """map.geojson: vertices with covariances, triangles, walls, open gates; metres, frame of the estimate."""
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
        features.append(feature("triangle", "Polygon", [ring], id=triangle, vertices=list(vertices)))
    for kind, lines in (("wall", free_map.walls()), ("gate", sorted(free_map.gates))):
        for a, b in lines:
            features.append(feature(kind, "LineString", [places[a], places[b]], vertices=[a, b]))
    write_feature_collection(path, features)


def write_dual_graph(path: Path, graph: nx.Graph) -> None:
    """dual_graph.json: networkx node-link data."""
    write_json(path, nx.node_link_data(graph, edges="edges"))


def write_pose_graph(directory: Path, graph: gtsam.NonlinearFactorGraph, estimate: Estimate) -> None:
    """pose_graph.g2o and pose_graph.keys.json. Ids count from 0: all robots' poses by robot, then map vertices."""
    names = {}
    for robot in estimate.robots:
        for index, key in enumerate(estimate.timeline.tracks[robot].keys):
            stamp = estimate.timeline.stamps[key]
            names[key] = {"kind": "pose", "robot": robot, "index": index, "stamp_s": stamp}
    for vertex in estimate.vertices:
        names[estimate.vertex_key(vertex)] = {"kind": "vertex", "vertex": vertex}
    ids = {key: number for number, key in enumerate(names)}
    edges = []
    for k in range(graph.size()):
        factor = graph.at(k)
        if isinstance(factor, gtsam.BetweenFactorPose2):
            start, end = (ids[key] for key in factor.keys())  # noqa: SIM118 (a factor is no dict)
            edges.append(PoseEdge(start, end, factor.measured(), factor.noiseModel().information()))
        elif isinstance(factor, gtsam.BearingFactorPose2):
            start, end = (ids[key] for key in factor.keys())  # noqa: SIM118 (a factor is no dict)
            information = float(factor.noiseModel().information()[0, 0])
            edges.append(BearingEdge(start, end, factor.measured().theta(), information))
    poses = [(number, estimate.value(key)) for key, number in ids.items()]
    write_g2o(directory / "pose_graph.g2o", poses, [], edges, fixed=[0])
    write_keys(directory / "pose_graph.keys.json", {ids[key]: name for key, name in names.items()})


def write_json(path: Path, data) -> None:
    """Indented JSON; refuses what JSON cannot say (NaN, infinity)."""
    path.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
