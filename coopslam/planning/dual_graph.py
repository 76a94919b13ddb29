"""The dual graph: one node a triangle, one edge a shared diagonal, each knowing how well it is known.

Covariances come from joint marginals of the smoothed estimate; positions are in the frame of the first
robot's start, covariances in its axes unless said otherwise.
"""

from collections.abc import Mapping, Sequence

import networkx as nx
import numpy as np

from coopslam.estimation.estimate import Estimate
from coopslam.exploration.free_map import FreeMap
from coopslam.planning.believed_sensors import believed_sensors
from coopslam.planning.graph_fields import packed
from coopslam.planning.recorded_odometry import RecordedOdometry, SlipByTriangle
from coopslam.planning.sensor_laws import OdometryLaw
from coopslam.se2 import largest_sigma, planar_rotation, position, rotation, xytheta

NORMAL = np.array([[0.0, -1.0], [1.0, 0.0]])  # turns a vector by +90 degrees
MOST_JOINT = 1000  # vertices; their joint covariance is 48 MB of text
NO_ODOMETRY = OdometryLaw(0.0, 0.0, 0.0)  # nobody drove


class Places:
    """Where the vertices of a map are, and how well that is known jointly."""

    def __init__(self, vertices: Sequence[int], estimate: Estimate):
        self.vertices, self._estimate = list(vertices), estimate
        self.poses = {vertex: estimate.vertex(vertex) for vertex in self.vertices}
        self.xy = {vertex: position(pose) for vertex, pose in self.poses.items()}
        self._number = {vertex: k for k, vertex in enumerate(self.vertices)}
        self.joint = pose_covariance(estimate, self.vertices) if 0 < len(self.vertices) <= MOST_JOINT else None

    def covariance(self, vertices: Sequence[int]) -> np.ndarray:
        """(3k, 3k) of k vertices' poses in the axes of the map, in the order asked."""
        if self.joint is None:
            return pose_covariance(self._estimate, vertices)
        rows = (3 * np.array([self._number[vertex] for vertex in vertices])[:, None] + np.arange(3)).ravel()
        return self.joint[np.ix_(rows, rows)]

    def position_covariance(self, vertices: Sequence[int]) -> np.ndarray:
        """(2k, 2k) of k vertices' positions in the axes of the map, in the order asked."""
        keep = np.arange(3 * len(vertices)).reshape(-1, 3)[:, :2].ravel()
        return self.covariance(vertices)[np.ix_(keep, keep)]


def dual_graph(free_map: FreeMap, estimate: Estimate, odometry: RecordedOdometry) -> nx.Graph:
    """The annotated dual graph of a map; attributes are plain numbers and lists, ready for JSON.

    Node: vertices, centroid [x, y], area_m2 (not negative), vertex_covariance (6x6, x and y of the three vertices in
    turn), position_covariance (2x2, of the centroid), position_sigma_m, odometry_sigma_per_m (odometry error recorded
    here, along the way, m per sqrt(m)), odometry_heading_sigma_per_m (rad per sqrt(m)) and
    odometry_heading_sigma_per_rad (of turns, rad per sqrt(rad)).

    Edge: gate [a, b], width_m, width_sigma_m, length_m (between centroids), relative_sigma_m (of one centroid seen from
    the other, in the axes of the gate), vertices [a, b, c, d] (gate, then the third one of the lower and of the higher
    triangle), vertex_covariance (8x8, their x and y in turn), odometry_sigma_per_m (in both triangles), odometry_legs
    (how many perfectly measured legs would tell as much of it as what was driven there and around on the same ground).

    Graph: vertices (id, pose [x, y, heading of the wall that leaves], covariance 3x3 of the pose, interior_angle_rad,
    convex), walls and open gates ([a, b]; free, or unexplored, space on the left), sensors (what was believed, see
    `SensorLaws`), joint_covariance (of the poses of all vertices in the order of `vertices`, as `graph_fields.packed`
    writes it; None for more than MOST_JOINT vertices). `MapGraph` reads it all back.
    """
    places = Places(list(free_map.fans), estimate)
    laws = believed_sensors(odometry.graph, odometry.legs)
    graph = nx.Graph(
        vertices=_vertices(free_map, places),
        walls=[list(wall) for wall in free_map.walls()],
        gates=[list(gate) for gate in sorted(free_map.gates)],
        sensors=laws.to_mapping(),
        joint_covariance=None if places.joint is None else packed(places.joint),
    )
    errors = odometry.by_triangle(free_map, places.xy)
    for triangle, vertices in free_map.triangles.items():
        slip = _slip(triangle, errors, laws.odometry or NO_ODOMETRY)
        graph.add_node(triangle, **_node(vertices, places), **slip)
    for one, other, (a, b) in sorted(free_map.adjacent_triangles()):
        attributes = _edge(free_map.triangles[one], free_map.triangles[other], (a, b), places)
        attributes["odometry_sigma_per_m"] = errors.pooled([one, other])
        attributes["odometry_legs"] = errors.legs([one, other])
        graph.add_edge(one, other, **attributes)
    return graph


def _vertices(free_map: FreeMap, places: Places) -> list[dict]:
    return [
        {
            "id": vertex,
            "pose": xytheta(places.poses[vertex]).tolist(),
            "covariance": places.covariance([vertex]).tolist(),
            "interior_angle_rad": float(free_map.interior_angles[vertex]),
            "convex": bool(free_map.interior_angles[vertex] < np.pi),
        }
        for vertex in places.vertices
    ]


def _slip(triangle: int, errors: SlipByTriangle, believed: OdometryLaw) -> dict[str, float]:
    """The odometry error of a triangle: of the way as it was recorded, of heading as believed times what was found."""
    heading = float(np.sqrt(errors.heading[triangle]))
    return {
        "odometry_sigma_per_m": float(np.sqrt(errors.variance_per_m[triangle])),
        "odometry_heading_sigma_per_m": heading * believed.heading_sigma_per_m,
        "odometry_heading_sigma_per_rad": heading * believed.heading_sigma_per_rad,
    }


def _node(vertices: tuple[int, int, int], places: Places) -> dict:
    corners = np.array([places.xy[vertex] for vertex in vertices])
    cov = places.position_covariance(vertices)
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


def _edge(one, other, gate: tuple[int, int], places: Places) -> dict:
    vertices = [*gate, *(vertex for triangle in (one, other) for vertex in triangle if vertex not in gate)]
    cov = places.position_covariance(vertices)
    pick: Mapping[int, np.ndarray] = {vertex: np.eye(8)[2 * k : 2 * k + 2] for k, vertex in enumerate(vertices)}
    along = places.xy[gate[1]] - places.xy[gate[0]]
    width = float(np.hypot(*along))
    d_along = pick[gate[1]] - pick[gate[0]]
    d_width = along @ d_along / max(width, 1e-12)
    d_turn = (NORMAL @ along) @ d_along / max(width, 1e-12) ** 2  # of the gate's direction

    apart = sum(places.xy[v] for v in other) / 3 - sum(places.xy[v] for v in one) / 3
    d_apart = sum(pick[v] for v in other) / 3 - sum(pick[v] for v in one) / 3
    to_gate_axes = rotation(-np.arctan2(along[1], along[0]))
    d_seen = to_gate_axes @ (d_apart - np.outer(NORMAL @ apart, d_turn))
    return {
        "gate": list(gate),
        "width_m": width,
        "width_sigma_m": float(np.sqrt(d_width @ cov @ d_width)),
        "length_m": float(np.hypot(*apart)),
        "relative_sigma_m": largest_sigma(d_seen @ cov @ d_seen.T),
        "vertices": vertices,
        "vertex_covariance": cov.tolist(),
    }


def pose_covariance(estimate: Estimate, vertices: Sequence[int]) -> np.ndarray:
    """(3k, 3k) joint covariance of k vertices' poses in the axes of the map."""
    joint = estimate.joint_covariance([estimate.vertex_key(vertex) for vertex in vertices])
    turn = np.zeros_like(joint)
    for k, vertex in enumerate(vertices):
        turn[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = planar_rotation(estimate.vertex(vertex).theta())
    return turn @ joint @ turn.T
