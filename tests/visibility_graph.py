"""Shortest paths by brute force: every pair of corners is joined when shapely says that the polygon covers the line."""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import networkx as nx
import numpy as np
import shapely

from sim.world import load_world

ROOT = Path(__file__).parents[1]
SHARED_WORLDS = sorted((Path(__file__).parents[2] / "shared" / "data" / "worlds").glob("*.geojson"))
OWN_WORLDS = sorted((ROOT / "datasets" / "worlds").glob("*.geojson"))


def load_polygon(path: Path) -> shapely.Polygon:
    """The free space of a world."""
    return load_world(str(path)).polygon


class VisibilityGraph:
    """All corners of a polygon, joined where they see each other."""

    def __init__(self, polygon: shapely.Polygon):
        shapely.prepare(polygon)
        self.polygon = polygon
        self.corners = np.unique(shapely.get_coordinates(polygon), axis=0)
        self.graph = nx.Graph()
        pairs = np.array(list(combinations(range(len(self.corners)), 2)))
        self._join(self.graph, self.corners[pairs], pairs.tolist())

    def length_m(self, start: Sequence[float], goal: Sequence[float]) -> float:
        """Of the shortest path; infinite without one."""
        graph = self.graph.copy()
        graph.add_nodes_from(("start", "goal"))
        for name, point in (("start", start), ("goal", goal)):
            lines = np.stack([np.broadcast_to(point, self.corners.shape), self.corners], axis=1)
            self._join(graph, lines, [(name, k) for k in range(len(self.corners))])
        self._join(graph, np.array([[start, goal]], float), [("start", "goal")])
        try:
            return nx.dijkstra_path_length(graph, "start", "goal")
        except nx.NetworkXNoPath:
            return np.inf

    def _join(self, graph: nx.Graph, lines: np.ndarray, names: list) -> None:
        for k in np.flatnonzero(shapely.covers(self.polygon, shapely.linestrings(lines))):
            graph.add_edge(*names[k], weight=float(np.hypot(*(lines[k, 1] - lines[k, 0]))))


def points_inside(polygon: shapely.Polygon, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 2) points drawn evenly over the polygon."""
    low, high = np.reshape(polygon.bounds, (2, 2))
    points = np.empty((0, 2))
    while len(points) < count:
        drawn = rng.uniform(low, high, (4 * count, 2))
        points = np.vstack([points, drawn[shapely.contains_xy(polygon, drawn)]])
    return points[:count]


def length_m(path: np.ndarray) -> float:
    """Of an open line of (k, 2) points."""
    return float(np.hypot(*np.diff(path, axis=0).T).sum())
