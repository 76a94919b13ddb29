"""How few metres any team could have driven: lower bounds that only the shape of the free space decides.

Both count the metres of all robots together, and hold whatever the team senses, knows beforehand, or decides.

Corners: a team that brings a robot into every corner drives at least the weight of the minimum spanning tree of the
corners, measured by shortest paths inside the free space. Proof: join the corners that each robot visits one after
the other, and the one in which all start; this graph connects all corners, and each of its edges is no longer than the
stretch of path that it stands for.

Walls: a team that follows every wall drives at least the perimeter and the minimum spanning tree of the rings of
walls, measured by the distance between rings. Proof: the paths connect all rings, and the stretches away from walls,
each ring drawn together into a point, still do.
"""

import numpy as np
import shapely
from scipy.cluster.hierarchy import DisjointSet
from scipy.spatial.distance import pdist

SLACK = 1e-9  # of the extent of the world; a line that leaves the free space by less counts as inside


def corners_bound_m(polygon: shapely.Polygon, starts_apart_m: float = 0.0) -> float:
    """Metres of any team that comes to all corners, and starts in one of them.

    starts_apart_m: how far apart, all together, the robots stand at first; each such metre is saved at most once.
    """
    return spanning_tree_m(polygon) - starts_apart_m


def walls_bound_m(polygon: shapely.Polygon, starts_apart_m: float = 0.0) -> float:
    """Metres of any team that follows all walls, and starts at one of them; starts_apart_m as above."""
    return float(polygon.length) + ring_tree_m(polygon) - starts_apart_m


def spanning_tree_m(polygon: shapely.Polygon) -> float:
    """Weight of the minimum spanning tree of a polygon's corners under the metric of shortest paths inside, m.

    Equals that of the graph of corners which see each other: a shortest path is a chain of such edges (Lozano-Perez
    and Wesley 1979), and in a tree an edge of the metric can be exchanged for an edge of its chain that joins the same
    two parts and is no longer. Kruskal's algorithm asks only for the lines of sight that could join parts.
    """
    corners = _corners(polygon)
    free = polygon.buffer(SLACK * float(np.hypot(*np.ptp(corners, axis=0))), join_style="mitre")
    shapely.prepare(free)
    walls = _walls(polygon)

    def seen(u: int, v: int) -> bool:
        return (u, v) in walls or bool(shapely.covers(free, shapely.linestrings(corners[[u, v]])))

    return _kruskal(len(corners), pdist(corners), seen)


def ring_tree_m(polygon: shapely.Polygon) -> float:
    """Weight of the minimum spanning tree of a polygon's rings under their Euclidean distance, m; 0 without holes.

    A shortest line between two rings that meets a third one on its way is not in the tree.
    """
    rings = [polygon.exterior, *polygon.interiors]
    apart = [shapely.distance(rings[i], rings[j]) for i in range(len(rings)) for j in range(i + 1, len(rings))]
    return _kruskal(len(rings), np.array(apart), lambda u, v: True)


def _kruskal(nodes: int, lengths: np.ndarray, is_edge) -> float:
    """lengths: (nodes (nodes - 1) / 2,) of the pairs (u, v), u < v, in the order of `numpy.triu_indices`."""
    parts, total = DisjointSet(range(nodes)), 0.0
    one, other = np.triu_indices(nodes, 1)
    for k in np.argsort(lengths, kind="stable"):
        u, v = int(one[k]), int(other[k])
        if not parts.connected(u, v) and is_edge(u, v):
            parts.merge(u, v)
            total += float(lengths[k])
            if parts.n_subsets == 1:
                break
    return total


def _rings(polygon: shapely.Polygon) -> list[np.ndarray]:
    """(n_i, 2) corners of each ring, not closed."""
    return [shapely.get_coordinates(ring)[:-1] for ring in (polygon.exterior, *polygon.interiors)]


def _corners(polygon: shapely.Polygon) -> np.ndarray:
    """(n, 2), ring after ring."""
    return np.vstack(_rings(polygon))


def _walls(polygon: shapely.Polygon) -> set[tuple[int, int]]:
    """Pairs of corners, the smaller index first, that a wall joins."""
    walls, first = set(), 0
    for ring in _rings(polygon):
        ends = first + np.roll(np.arange(len(ring)), -1)
        walls |= {(min(u, int(v)), max(u, int(v))) for u, v in enumerate(ends, start=first)}
        first += len(ring)
    return walls
