"""pose_graph.g2o and pose_graph.keys.json: the smoothed graph for other tools, and which id is which variable."""

from collections.abc import Mapping
from pathlib import Path

import gtsam
import numpy as np

from coopslam.estimation.estimate import Estimate
from coopslam.io.g2o import BearingEdge, G2oEdge, PointEdge, PoseEdge, RangeEdge, write_g2o, write_keys

_POSITIONS = gtsam.BearingRangeFactor2D | gtsam.BearingRangeFactorPose2
_RANGES = gtsam.RangeFactor2D | gtsam.RangeFactorPose2
_BEARINGS = gtsam.BearingFactor2D | gtsam.BearingFactorPose2


def write_pose_graph(directory: Path, graph: gtsam.NonlinearFactorGraph, estimate: Estimate) -> None:
    """Ids count from 0: placed robots' poses by robot, then map vertices, then landmarks.

    Priors are left out, but the first pose is fixed. Robust losses have no place in g2o: their measurements are written
    with the noise inside.
    """
    names = _names(estimate)
    ids = {key: number for number, key in enumerate(names)}
    landmarks = {estimate.landmark_key(name) for name in estimate.landmarks}
    poses = [(number, estimate.value(key)) for key, number in ids.items() if key not in landmarks]
    points = [(number, estimate.point(key)) for key, number in ids.items() if key in landmarks]
    edges = (_edge(graph.at(k), ids) for k in range(graph.size()))
    write_g2o(directory / "pose_graph.g2o", poses, points, [edge for edge in edges if edge is not None], fixed=[0])
    write_keys(directory / "pose_graph.keys.json", {ids[key]: name for key, name in names.items()})


def _names(estimate: Estimate) -> dict[int, dict]:
    """Key of each variable -> what it is."""
    names = {}
    tracks = [estimate.timeline.tracks[robot] for robot in filter(estimate.timeline.is_placed, estimate.robots)]
    end_s = max((track.since_s[-1] for track in tracks), default=0.0)
    for track in tracks:
        stays = zip(track.keys, track.since_s, track.until_s, strict=True)
        for index, (key, since_s, until_s) in enumerate(stays):
            until_s = max(min(until_s, end_s), since_s)  # a last pose has no end
            names[key] = {"kind": "pose", "robot": track.robot, "index": index, "stamp_s": since_s, "until_s": until_s}
    for vertex in estimate.vertices:
        names[estimate.vertex_key(vertex)] = {"kind": "vertex", "vertex": vertex}
    for landmark in estimate.landmarks:
        names[estimate.landmark_key(landmark)] = {"kind": "landmark", "landmark": landmark}
    return names


def _edge(factor: gtsam.NonlinearFactor, ids: Mapping[int, int]) -> G2oEdge | None:
    """None for a prior, and for a factor between variables of which one is not estimated."""
    keys = factor.keys()
    if len(keys) != 2 or any(key not in ids for key in keys):
        return None
    ends, noise = [ids[key] for key in keys], factor.noiseModel()
    noise = noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise
    information, measured = noise.information(), factor.measured()
    if isinstance(factor, gtsam.BetweenFactorPose2):
        return PoseEdge(*ends, measured, information)
    if isinstance(factor, _BEARINGS):
        return BearingEdge(*ends, measured.theta(), float(information[0, 0]))
    if isinstance(factor, _RANGES):
        return RangeEdge(*ends, float(measured), float(information[0, 0]))
    if isinstance(factor, _POSITIONS):
        return _position(ends, measured.bearing().theta(), measured.range(), information)
    return None


def _position(ends: list[int], bearing_rad: float, range_m: float, information: np.ndarray) -> PointEdge:
    """Bearing and range as a point; the covariance to first order. information: (2, 2), order bearing, range."""
    c, s = np.cos(bearing_rad), np.sin(bearing_rad)
    inverse = np.linalg.inv(np.array([[-range_m * s, c], [range_m * c, s]]))  # of the derivative of (x, y)
    return PointEdge(*ends, range_m * np.array([c, s]), inverse.T @ information @ inverse)
