"""Maps for tests of planners, made from polygons: as `dual_graph` writes them, with covariances that are set."""

from collections.abc import Callable

import networkx as nx
import numpy as np
import shapely

from coopslam.planning.graph_fields import packed
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.sensor_laws import OdometryLaw, SensorLaws, SightingLaw

LAWS = SensorLaws(
    OdometryLaw(0.03, 0.03, 0.02),
    SightingLaw(0.005, 0.0, 0.005, 0.01, 0.01, 0.5),
    SightingLaw(0.005, 0.01, 0.005, 0.004, 0.03, 10.0),
)
TWO_LANES = shapely.Polygon(
    [(0, 0), (16, 0), (16, 4), (0, 4)], [[(3.5, 2.0), (3.5, 2.4), (12.5, 2.4), (12.5, 2.0)]]
)  # south lane 2 m wide, north lane 1.6 m


def made_graph(
    polygon: shapely.Polygon,
    sigma_m: float = 0.02,
    slip: Callable[[np.ndarray], float] = lambda centroid: 1.0,
    laws: SensorLaws = LAWS,
) -> nx.Graph:
    """The dual graph of a Delaunay triangulation; vertices err together where they are near (5 m) each other."""
    rings = [np.array(ring.coords)[:-1] for ring in (shapely.orient_polygons(polygon).exterior, *polygon.interiors)]
    rings = [ring[::-1] if k > 0 and shapely.LinearRing(ring).is_ccw else ring for k, ring in enumerate(rings)]
    walls, first = [], 0
    for ring in rings:
        walls += [[first + k, first + (k + 1) % len(ring)] for k in range(len(ring))]
        first += len(ring)
    xy = np.vstack(rings)
    joint = joint_of(xy, sigma_m)
    number = {tuple(place): k for k, place in enumerate(xy.tolist())}
    leaving, arriving = dict(map(tuple, walls)), {b: a for a, b in walls}
    vertices = []
    for k, place in enumerate(xy):
        out, back = xy[leaving[k]] - place, xy[arriving[k]] - place
        angle = (np.arctan2(back[1], back[0]) - np.arctan2(out[1], out[0])) % (2 * np.pi)
        block = joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3].tolist()
        pose = [*place.tolist(), float(np.arctan2(out[1], out[0]))]
        vertices.append(
            {
                "id": k,
                "pose": pose,
                "covariance": block,
                "interior_angle_rad": float(angle),
                "convex": bool(angle < np.pi),
            }
        )
    graph = nx.Graph(
        vertices=vertices, walls=walls, gates=[], sensors=laws.to_mapping(), joint_covariance=packed(joint)
    )
    cut = shapely.orient_polygons(shapely.get_parts(shapely.constrained_delaunay_triangles(polygon)))
    by_edge: dict[frozenset, list[int]] = {}
    for triangle, shape in enumerate(cut):
        corners = [number[place] for place in list(shape.exterior.coords)[:3]]
        graph.add_node(triangle, **_node(corners, xy, joint, slip, laws.odometry or OdometryLaw(0.0, 0.0, 0.0)))
        for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
            by_edge.setdefault(frozenset((a, b)), []).append(triangle)
    for ends, pair in by_edge.items():
        if len(pair) == 2:
            graph.add_edge(*pair, **_edge(graph, pair, sorted(ends), xy, joint))
    return graph


def made_map(*arguments, **settings) -> MapGraph:
    """The same, loaded."""
    return MapGraph.from_graph(made_graph(*arguments, **settings))


def joint_of(xy: np.ndarray, sigma_m: float) -> np.ndarray:
    """(3n, 3n) with correlation exp(-distance / 5 m), headings 0.3 rad per m of sigma and independent."""
    apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    joint = np.zeros((len(xy), 3, len(xy), 3))
    joint[:, 0, :, 0] = joint[:, 1, :, 1] = sigma_m**2 * np.exp(-apart / 5)
    joint[:, 2, :, 2] = (0.3 * sigma_m) ** 2 * np.eye(len(xy))
    return joint.reshape(3 * len(xy), 3 * len(xy))


def _node(corners, xy, joint, slip, law: OdometryLaw) -> dict:
    centroid, cov = xy[corners].mean(axis=0), _positions(joint, corners)
    third = np.hstack([np.eye(2) / 3] * 3)
    law = law.slipping(slip(centroid))
    return {
        "vertices": corners,
        "centroid": centroid.tolist(),
        "area_m2": shapely.Polygon(xy[corners]).area,
        "vertex_covariance": cov.tolist(),
        "position_covariance": (third @ cov @ third.T).tolist(),
        "position_sigma_m": float(np.sqrt(np.linalg.eigvalsh(third @ cov @ third.T)[-1])),
        "odometry_sigma_per_m": law.translation_sigma_per_m,
        "odometry_heading_sigma_per_m": law.heading_sigma_per_m,
        "odometry_heading_sigma_per_rad": law.heading_sigma_per_rad,
    }


def _edge(graph, pair, gate, xy, joint) -> dict:
    others = [v for t in pair for v in graph.nodes[t]["vertices"] if v not in gate]
    centroids = [np.array(graph.nodes[t]["centroid"]) for t in pair]
    return {
        "gate": gate,
        "width_m": float(np.hypot(*(xy[gate[1]] - xy[gate[0]]))),
        "width_sigma_m": 0.01,
        "length_m": float(np.hypot(*(centroids[1] - centroids[0]))),
        "relative_sigma_m": 0.01,
        "vertices": [*gate, *others],
        "vertex_covariance": _positions(joint, [*gate, *others]).tolist(),
        "odometry_sigma_per_m": graph.nodes[pair[0]]["odometry_sigma_per_m"],
        "odometry_legs": 1.0,
    }


def _positions(joint: np.ndarray, vertices) -> np.ndarray:
    rows = (3 * np.array(vertices)[:, None] + np.arange(2)).ravel()
    return joint[np.ix_(rows, rows)]
