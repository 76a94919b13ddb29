"""A finished map as planners use it: the dual graph alone, as it stands in `dual_graph.json`.

Everything is in the frame of the first robot's start, covariances in its axes (order x, y, heading; m, m, rad). The
joint covariance of all vertices is part of the graph, so what is known of one place relative to any other follows
from the file alone.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import shapely

from coopslam.errors import BadInput, shown
from coopslam.planning.graph_fields import Fields, unpacked
from coopslam.planning.sensor_laws import OdometryLaw, SensorLaws
from coopslam.se2 import Pose2

ON_EDGE_M = 1e-6  # a point so near a triangle lies in it
SAME = 1e-9  # of the largest eigenvalue: what rounding leaves of a zero


@dataclass(frozen=True, slots=True, eq=False)
class MapVertex:
    """An oriented corner: its place, and the direction of the wall that leaves it (free space on the left)."""

    id: int
    pose: np.ndarray  # (3,) x, y, heading; m, m, rad
    cov: np.ndarray  # (3, 3) marginal; axes of the map
    interior_angle_rad: float  # measured

    @property
    def xy(self) -> np.ndarray:
        """(2,) m."""
        return self.pose[:2]

    @property
    def T_map_vertex(self) -> Pose2:
        """Its pose."""
        return Pose2(*self.pose)

    @property
    def convex(self) -> bool:
        """Whether less than half a turn around it is free."""
        return self.interior_angle_rad < np.pi


@dataclass(frozen=True, eq=False)
class MapGraph:
    """The annotated dual graph (see `dual_graph`) with its vertices, walls and sensor laws at hand."""

    graph: nx.Graph
    vertices: Mapping[int, MapVertex]
    walls: Sequence[tuple[int, int]]  # (start, end), free space on the left
    gates: Sequence[tuple[int, int]]  # still open: unexplored space on the left
    laws: SensorLaws
    joint: np.ndarray | None  # (3 n, 3 n), vertices in the order of `vertices`; None: the map is too large for it

    @classmethod
    def load(cls, path: str | Path) -> "MapGraph":
        """A `dual_graph.json`. Raises BadInput, with file and field, when it is damaged or of another kind."""
        try:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise BadInput(f"{path}: cannot read the file: {error.strerror}") from error
        except (ValueError, RecursionError) as error:
            raise BadInput(f"{path}: not valid JSON: {error}") from error
        try:
            graph = nx.node_link_graph(data, edges="edges")
        except Exception as error:  # networkx raises whatever the missing key leads to
            raise BadInput(f"{path}: no node-link graph: {' '.join(repr(error).split())[:80]}") from error
        return cls.from_graph(graph, str(path))

    @classmethod
    def from_graph(cls, graph: nx.Graph, where: str = "dual graph") -> "MapGraph":
        """What `dual_graph` made. Raises BadInput, which begins with `where` and the field, for anything else."""
        return _Checked(graph, where).map()

    @cached_property
    def triangles(self) -> dict[int, tuple[int, int, int]]:
        """Triangle -> its vertices, counter-clockwise as decided."""
        return {triangle: tuple(vertices) for triangle, vertices in self.graph.nodes(data="vertices")}

    @cached_property
    def corners(self) -> dict[int, np.ndarray]:
        """Triangle -> (3, 2) places of its vertices, m."""
        return {t: np.array([self.vertices[v].xy for v in vertices]) for t, vertices in self.triangles.items()}

    @cached_property
    def polygon(self) -> shapely.Polygon | shapely.MultiPolygon:
        """The mapped free space with its holes, m.

        Its boundary are the walls where they close to rings, as they do around a complete map: then a sliver that
        noise turned inside out is where it should be. Otherwise it is the union of the triangles.
        """
        by_walls = self._polygon_of_rings()
        if by_walls is not None:
            return by_walls
        return shapely.union_all([shapely.Polygon(corners) for corners in self.corners.values()])

    @cached_property
    def grown(self) -> shapely.Polygon | shapely.MultiPolygon:
        """The polygon and a hair around it, so that what runs along a wall is inside."""
        grown = self.polygon.buffer(ON_EDGE_M)
        shapely.prepare(grown)
        return grown

    @cached_property
    def wall_lines(self) -> shapely.MultiLineString:
        """What a robot may touch: the walls, and the open gates, behind which nobody has been."""
        lines = [(self.vertices[a].xy, self.vertices[b].xy) for a, b in (*self.walls, *self.gates)]
        return shapely.MultiLineString(lines)

    def triangle_at(self, x: float, y: float) -> int | None:
        """The triangle in which a point lies; None: outside the map. On a shared edge, one of them."""
        if not self.triangles:
            return None
        inside = self._inside(np.array([x, y], float))
        best = int(np.argmax(inside))
        return list(self.triangles)[best] if inside[best] >= -ON_EDGE_M else None

    def nearest_triangle(self, x: float, y: float) -> int | None:
        """As `triangle_at`, also of a point of the map's polygon that an inverted sliver keeps out of all triangles."""
        found = self.triangle_at(x, y)
        if found is not None or not self.triangles or not self.grown.covers(shapely.Point(x, y)):
            return found
        areas = shapely.polygons(list(self.corners.values()))
        return list(self.triangles)[int(np.argmin(shapely.distance(areas, shapely.Point(x, y))))]

    def gate(self, one: int, other: int) -> tuple[int, int]:
        """The vertices of the diagonal that two neighbouring triangles share."""
        return tuple(self.graph.edges[one, other]["gate"])

    def odometry_law(self, triangle: int) -> OdometryLaw:
        """Of the ground in a triangle, as it was recorded."""
        node = self.graph.nodes[triangle]
        return OdometryLaw(
            node["odometry_sigma_per_m"], node["odometry_heading_sigma_per_m"], node["odometry_heading_sigma_per_rad"]
        )

    def joint_covariance(self, vertices: Sequence[int]) -> np.ndarray:
        """(3k, 3k) of k vertices' poses in the axes of the map, in the order asked. Raises BadInput without it."""
        number = {vertex: k for k, vertex in enumerate(self.vertices)}
        unknown = [vertex for vertex in vertices if vertex not in number]
        if unknown:
            raise BadInput(f"vertex {unknown[0]} is not in the map")
        if self.joint is None:
            raise BadInput(f"the map of {len(self.vertices)} vertices is too large to hold their joint covariance")
        rows = (3 * np.array([number[vertex] for vertex in vertices], int)[:, None] + np.arange(3)).ravel()
        return self.joint[np.ix_(rows, rows)]

    def position_covariance(self, vertices: Sequence[int]) -> np.ndarray:
        """(2k, 2k) of the positions of k vertices in the axes of the map."""
        keep = np.arange(3 * len(vertices)).reshape(-1, 3)[:, :2].ravel()
        return self.joint_covariance(vertices)[np.ix_(keep, keep)]

    def _inside(self, point: np.ndarray) -> np.ndarray:
        """(t,) least distance of a point from the sides of each triangle, m; negative outside, and in inverted ones."""
        corners = np.array(list(self.corners.values()))
        along = np.roll(corners, -1, axis=1) - corners
        off = point - corners
        length = np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-12)
        left = (along[..., 0] * off[..., 1] - along[..., 1] * off[..., 0]) / length
        area = along[:, 0, 0] * along[:, 1, 1] - along[:, 0, 1] * along[:, 1, 0]
        return np.where(area > 0, left.min(axis=1), -np.inf)

    def _polygon_of_rings(self) -> shapely.Polygon | None:
        """Bounded by the walls; None when they do not close, or cross each other in the estimate."""
        after = dict(self.walls)
        if self.gates or not after or set(after) != set(self.vertices) or set(after.values()) != set(after):
            return None
        rings, left = [], set(after)
        while left:
            ring, vertex = [], next(iter(left))
            while vertex in left:
                left.remove(vertex)
                ring.append(self.vertices[vertex].xy)
                vertex = after[vertex]
            if len(ring) < 3:
                return None
            rings.append(shapely.LinearRing(ring))
        outer = [ring for ring in rings if ring.is_ccw]
        polygon = shapely.Polygon(outer[0], [ring for ring in rings if not ring.is_ccw]) if len(outer) == 1 else None
        return polygon if polygon is not None and polygon.is_valid else None


class _Checked(Fields):
    """Reads a graph field by field."""

    def __init__(self, graph: nx.Graph, where: str):
        super().__init__(where)
        self.graph = graph

    def map(self) -> MapGraph:
        """Everything, checked."""
        if self.graph.is_directed() or self.graph.is_multigraph():
            raise self.bad("graph", "an undirected simple graph", "another kind")
        header = self.graph.graph
        vertices = self._vertices(self.field(header, "vertices", "graph"))
        walls, gates = (self._pairs(self.field(header, name, "graph"), name, vertices) for name in ("walls", "gates"))
        laws = SensorLaws.from_mapping(self.field(header, "sensors", "graph"), f"{self.where}: graph.sensors")
        joint = self._joint(self.field(header, "joint_covariance", "graph"), len(vertices))
        for triangle, node in self.graph.nodes(data=True):
            self._node(triangle, node, vertices)
        for one, other, edge in self.graph.edges(data=True):
            self._edge(one, other, edge)
        return MapGraph(self.graph, vertices, walls, gates, laws, joint)

    def _vertices(self, entries: Any) -> dict[int, MapVertex]:
        if not isinstance(entries, list):
            raise self.bad("graph.vertices", "a list", entries)
        vertices: dict[int, MapVertex] = {}
        for k, entry in enumerate(entries):
            name = f"graph.vertices[{k}]"
            vertex = self.field(entry, "id", name)
            if not isinstance(vertex, int) or vertex in vertices:
                raise self.bad(f"{name}.id", "a whole number, each once", vertex)
            pose, cov = self.numbers(entry, "pose", name, (3,)), self.covariance(entry, "covariance", name, 3)
            angle = float(self.numbers(entry, "interior_angle_rad", name, ()))
            vertices[vertex] = MapVertex(vertex, pose, cov, angle)
        return vertices

    def _pairs(self, entries: Any, name: str, vertices: Mapping[int, MapVertex]) -> list[tuple[int, int]]:
        if not isinstance(entries, list):
            raise self.bad(f"graph.{name}", "a list", entries)
        for k, entry in enumerate(entries):
            self._known(entry, 2, f"graph.{name}[{k}]", vertices)
        return [tuple(entry) for entry in entries]

    def _known(self, entry: Any, count: int, name: str, vertices: Iterable[int]) -> None:
        """`count` different ones of the known vertices."""
        if not isinstance(entry, list) or len(entry) != count or any(not isinstance(v, int) for v in entry):
            raise self.bad(name, f"{count} vertices", entry)
        unknown = [vertex for vertex in entry if vertex not in vertices]
        if unknown or len(set(entry)) < count:
            raise self.bad(name, f"{count} different ones of graph.vertices", unknown or entry)

    def _joint(self, text: Any, count: int) -> np.ndarray | None:
        name = "graph.joint_covariance"
        if text is None:
            return None
        if not isinstance(text, str):
            raise self.bad(name, "text or null", text)
        try:
            joint = unpacked(text, 3 * count)
        except ValueError as error:
            raise BadInput(f"{self.where}: {name}: {error}") from error
        if not np.isfinite(joint).all():
            raise BadInput(f"{self.where}: {name}: finite numbers expected")
        variances = np.linalg.eigvalsh(joint) if count else np.zeros(1)
        if variances[0] < -SAME * max(variances[-1], 0.0):
            raise self.bad(name, "no negative eigenvalues", float(variances[0]))
        return joint

    def _node(self, triangle: Any, node: Mapping, vertices: Mapping[int, MapVertex]) -> None:
        name = f"node {shown(triangle)}"
        if not isinstance(triangle, int):
            raise self.bad("node id", "a whole number", triangle)
        self._known(self.field(node, "vertices", name), 3, f"{name}.vertices", vertices)
        self.numbers(node, "centroid", name, (2,))
        self.covariance(node, "position_covariance", name, 2)
        self.covariance(node, "vertex_covariance", name, 6)
        for key in (
            "area_m2",
            "position_sigma_m",
            "odometry_sigma_per_m",
            "odometry_heading_sigma_per_m",
            "odometry_heading_sigma_per_rad",
        ):
            self.not_negative(node, key, name)

    def _edge(self, one: int, other: int, edge: Mapping) -> None:
        name = f"edge {one}-{other}"
        both = set(self.graph.nodes[one]["vertices"]) & set(self.graph.nodes[other]["vertices"])
        self._known(self.field(edge, "gate", name), 2, f"{name}.gate", both)
        self.covariance(edge, "vertex_covariance", name, 8)
        for key in ("width_m", "width_sigma_m", "length_m", "relative_sigma_m", "odometry_sigma_per_m"):
            self.not_negative(edge, key, name)
