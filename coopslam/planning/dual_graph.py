"""The dual graph: one node a triangle, one edge a shared diagonal, each knowing how well it is known.

Covariances come from joint marginals of the smoothed estimate; positions are in the frame of the first
robot's start, covariances in its axes unless said otherwise.
"""

from collections.abc import Mapping

import networkx as nx
import numpy as np

from coopslam.estimation.estimate import Estimate
from coopslam.exploration.free_map import FreeMap
from coopslam.planning.recorded_odometry import RecordedOdometry
from coopslam.se2 import largest_sigma, position, rotation

NORMAL = np.array([[0.0, -1.0], [1.0, 0.0]])  # turns a vector by +90 degrees


def dual_graph(free_map: FreeMap, estimate: Estimate, odometry: RecordedOdometry) -> nx.Graph:
    """The annotated dual graph of a map; attributes are plain numbers and lists, ready for JSON.

    Node: vertices, centroid [x, y], area_m2 (not negative), vertex_covariance (6x6, x and y of the three vertices in
    turn), position_covariance (2x2, of the centroid), position_sigma_m. Edge: gate [a, b], width_m, width_sigma_m,
    length_m (between centroids), relative_sigma_m (of one centroid seen from the other, in the axes of the gate),
    odometry_sigma_per_m (odometry error recorded in both triangles, m per sqrt(m)), odometry_legs (how many perfectly
    measured legs would tell as much of it as what was driven there and around on the same ground).
    """
    graph = nx.Graph()
    places = {vertex: position(estimate.vertex(vertex)) for vertex in free_map.fans}
    for triangle, vertices in free_map.triangles.items():
        graph.add_node(triangle, **_node(vertices, places, estimate))
    errors = odometry.by_triangle(free_map, places)
    for one, other, (a, b) in sorted(free_map.adjacent_triangles()):
        attributes = _edge(free_map.triangles[one], free_map.triangles[other], (a, b), places, estimate)
        attributes["odometry_sigma_per_m"] = errors.pooled([one, other])
        attributes["odometry_legs"] = errors.legs([one, other])
        graph.add_edge(one, other, **attributes)
    return graph


def _node(vertices: tuple[int, int, int], places: Mapping[int, np.ndarray], estimate: Estimate) -> dict:
    corners = np.array([places[vertex] for vertex in vertices])
    cov = position_covariance(estimate, vertices)
    third = np.hstack([np.eye(2) / 3] * 3)
    cov_centroid = third @ cov @ third.T
    return {
        "vertices": list(vertices),
        "centroid": corners.mean(axis=0).tolist(),
        "area_m2": abs(signed_area_m2(corners)),
        "vertex_covariance": cov.tolist(),
        "position_covariance": cov_centroid.tolist(),
        "position_sigma_m": largest_sigma(cov_centroid),
    }


def signed_area_m2(corners) -> float:
    """Of a triangle, (3, 2); negative when its corners run clockwise: a sliver that noise turned inside out."""
    a, b, c = np.asarray(corners, float)
    (ux, uy), (vx, vy) = b - a, c - a
    return float(ux * vy - uy * vx) / 2


def _edge(one, other, gate: tuple[int, int], places: Mapping[int, np.ndarray], estimate: Estimate) -> dict:
    vertices = sorted(set(one) | set(other))
    cov = position_covariance(estimate, vertices)
    pick = {vertex: np.eye(2 * len(vertices))[2 * k : 2 * k + 2] for k, vertex in enumerate(vertices)}
    along = places[gate[1]] - places[gate[0]]
    width = float(np.hypot(*along))
    d_along = pick[gate[1]] - pick[gate[0]]
    d_width = along @ d_along / max(width, 1e-12)
    d_turn = (NORMAL @ along) @ d_along / max(width, 1e-12) ** 2  # of the gate's direction

    apart = sum(places[v] for v in other) / 3 - sum(places[v] for v in one) / 3
    d_apart = sum(pick[v] for v in other) / 3 - sum(pick[v] for v in one) / 3
    to_gate_axes = rotation(-np.arctan2(along[1], along[0]))
    d_seen = to_gate_axes @ (d_apart - np.outer(NORMAL @ apart, d_turn))
    return {
        "gate": list(gate),
        "width_m": width,
        "width_sigma_m": float(np.sqrt(d_width @ cov @ d_width)),
        "length_m": float(np.hypot(*apart)),
        "relative_sigma_m": largest_sigma(d_seen @ cov @ d_seen.T),
    }


def position_covariance(estimate: Estimate, vertices) -> np.ndarray:
    """(2k, 2k) joint covariance of k vertices' positions in the axes of the map."""
    joint = estimate.joint_covariance([estimate.vertex_key(vertex) for vertex in vertices])
    turn = np.zeros((2 * len(vertices), 3 * len(vertices)))
    for k, vertex in enumerate(vertices):
        turn[2 * k : 2 * k + 2, 3 * k : 3 * k + 2] = rotation(estimate.vertex(vertex).theta())
    return turn @ joint @ turn.T
