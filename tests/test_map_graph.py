"""The map as planners load it, from its dual graph alone."""

import json
from base64 import b64encode

import gtsam
import networkx as nx
import numpy as np
import pytest
import shapely
from explorations import run
from made_maps import TWO_LANES, made_graph, made_map

from coopslam.errors import BadInput
from coopslam.planning.dual_graph import dual_graph
from coopslam.planning.graph_fields import packed, unpacked
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.recorded_odometry import RecordedOdometry
from coopslam.report.run_directory import write_dual_graph


@pytest.fixture(scope="module")
def finished():
    done = run("paper_one_obstacle", "typical", 1)
    smoothed = done.smoothed()
    odometry = RecordedOdometry(done.driver.graph, smoothed)
    return done, smoothed, dual_graph(done.free_map, smoothed, odometry)


@pytest.fixture(scope="module")
def written(finished, tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "dual_graph.json"
    write_dual_graph(path, finished[2])
    return path


def test_a_run_loads_back_from_its_dual_graph_alone(finished, written):
    done, smoothed, graph = finished
    map_graph = MapGraph.load(written)
    assert nx.utils.graphs_equal(map_graph.graph, graph)
    assert map_graph.triangles == done.free_map.triangles
    assert sorted(map_graph.walls) == sorted(done.free_map.walls()) and not map_graph.gates
    for vertex, known in map_graph.vertices.items():
        assert known.T_map_vertex.equals(smoothed.vertex(vertex), 1e-12)
        assert known.convex == (done.free_map.interior_angles[vertex] < np.pi)
    rings = [[smoothed.vertex(v).translation() for v in ring] for ring in done.free_map.rings()]
    rings.sort(key=lambda ring: -shapely.Polygon(ring).area)
    assert map_graph.polygon.equals_exact(shapely.Polygon(rings[0], rings[1:]).normalize(), 1e-12) or (
        map_graph.polygon.symmetric_difference(shapely.Polygon(rings[0], rings[1:])).area < 1e-12
    )


def test_the_joint_covariance_is_that_of_numpy(finished, written):
    """The inverse of the whole information matrix by a dense QR, its vertices turned to the axes of the map."""
    done, smoothed, graph = finished
    map_graph = MapGraph.load(written)
    values, keys = gtsam.Values(), list(done.driver.graph.keyVector())
    for key in keys:
        values.insert(key, smoothed.value(key))
    linear = done.driver.graph.linearize(values)
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    root_inverse = np.linalg.inv(np.linalg.qr(linear.jacobian(ordering)[0], mode="r"))
    some = list(map_graph.vertices)
    rows, turn = [], np.zeros((3 * len(some), 3 * len(some)))
    for k, vertex in enumerate(some):
        place = 3 * keys.index(smoothed.vertex_key(vertex))
        rows += [place, place + 1, place + 2]
        turn[3 * k : 3 * k + 2, 3 * k : 3 * k + 2] = smoothed.vertex(vertex).rotation().matrix()
        turn[3 * k + 2, 3 * k + 2] = 1.0
    part = turn @ root_inverse[rows]
    found = map_graph.joint_covariance(some)
    # relative to the largest variance: rounding where sigmas are 10^4 apart
    np.testing.assert_allclose(found, part @ part.T, atol=1e-6 * found.max())
    np.testing.assert_array_equal(map_graph.joint_covariance([3, 1])[:3, 3:], found[9:12, 3:6])
    one, other, edge = next(iter(graph.edges(data=True)))
    np.testing.assert_allclose(map_graph.position_covariance(edge["vertices"]), edge["vertex_covariance"], rtol=1e-12)
    node = graph.nodes[one]
    np.testing.assert_allclose(map_graph.position_covariance(node["vertices"]), node["vertex_covariance"], rtol=1e-12)


def test_triangles_hold_the_points_that_shapely_says():
    map_graph = made_map(TWO_LANES)
    shapes = {t: shapely.Polygon(corners) for t, corners in map_graph.corners.items()}
    points = np.random.default_rng(0).uniform([-1, -1], [17, 5], (500, 2))
    for point in points:
        expected = [t for t, shape in shapes.items() if shape.contains(shapely.Point(point))]
        assert map_graph.triangle_at(*point) == (expected[0] if expected else None)
    assert map_graph.triangle_at(0.0, 0.0) in shapes  # a corner belongs to the map
    assert map_graph.polygon.symmetric_difference(TWO_LANES).area == 0.0


def test_an_inverted_sliver_is_where_the_walls_are():
    """A vertex of a wall that noise pushed through the diagonal behind it takes that much from the free space."""
    graph = made_graph(shapely.Polygon([(0, 0), (4, 0), (4, 3), (2, 6), (0, 3)]))
    sliver = next(t for t, vertices in graph.nodes(data="vertices") if set(vertices) == {2, 3, 4})
    graph.graph["vertices"][3]["pose"][1] = 2.9
    map_graph = MapGraph.from_graph(graph)
    assert map_graph.polygon.area == pytest.approx(12 - 4 * 0.1 / 2, abs=1e-12)
    assert map_graph.triangle_at(2.0, 2.5) not in (None, sliver)


def test_an_unfinished_map_is_the_union_of_its_triangles():
    graph = made_graph(TWO_LANES)
    areas = dict(graph.nodes(data="area_m2"))
    gone = max(areas, key=areas.get)
    a, b, c = graph.nodes[gone]["vertices"]
    graph.remove_node(gone)
    wall = next(w for w in graph.graph["walls"] if set(w) <= {a, b, c})
    graph.graph["walls"].remove(wall)
    graph.graph["gates"] = [[a, b]]
    assert MapGraph.from_graph(graph).polygon.area == pytest.approx(TWO_LANES.area - areas[gone])


def test_text_of_a_matrix_by_hand():
    """Lower triangle row by row: 1; 2, 4."""
    text = b64encode(np.array([1.0, 2.0, 4.0], "<f8").tobytes()).decode()
    assert packed(np.array([[1.0, 2.0], [2.0, 4.0]])) == text
    np.testing.assert_array_equal(unpacked(text, 2), [[1, 2], [2, 4]])
    for bad, size in (("not base64", 2), (text, 3), (text[:-4], 2)):
        with pytest.raises(ValueError, match="expected|base64"):
            unpacked(bad, size)


def damages():
    """(field that the message names, what is done to the JSON)."""

    def change(*keys, to=None):
        def do(data):
            for key in keys[:-1]:
                data = data[key]
            if to is None:
                del data[keys[-1]]
            else:
                data[keys[-1]] = to

        return do

    nan = float("nan")
    yield "graph.vertices: missing", change("graph", "vertices")
    yield "graph.walls: missing", change("graph", "walls")
    yield "graph.sensors: missing", change("graph", "sensors")
    yield "graph.joint_covariance: missing", change("graph", "joint_covariance")
    yield "graph.joint_covariance", change("graph", "joint_covariance", to="AAAA")
    yield "graph.joint_covariance", change("graph", "joint_covariance", to=7)
    yield "graph.vertices[1].pose", change("graph", "vertices", 1, "pose", to=[0.0, nan, 0.0])
    yield (
        "graph.vertices[1].covariance",
        change("graph", "vertices", 1, "covariance", to=[[1, 2, 0], [2, 1, 0], [0] * 3]),
    )
    yield "graph.vertices[2].id", change("graph", "vertices", 2, "id", to=1)
    yield "graph.walls[0]", change("graph", "walls", 0, to=[0, 99])
    yield "graph.sensors.odometry", change("graph", "sensors", "odometry", to={"x": 1})
    yield "translation_sigma_per_m", change("graph", "sensors", "odometry", "translation_sigma_per_m", to=-1.0)
    yield "node 0.vertices", change("nodes", 0, "vertices", to=[0, 0, 1])
    yield "node 0.vertices", change("nodes", 0, "vertices", to=[0, 1, 77])
    yield "node 0.centroid: missing", change("nodes", 0, "centroid")
    yield "node 0.odometry_sigma_per_m", change("nodes", 0, "odometry_sigma_per_m", to=-0.1)
    yield "node 0.position_covariance", change("nodes", 0, "position_covariance", to=[[1, 0], [0, -1]])
    yield "gate", change("edges", 0, "gate", to=[0, 0])
    yield "width_m", change("edges", 0, "width_m", to=nan)
    yield "no node-link graph", change("nodes")
    yield "node 1234.vertices: missing", change("edges", 0, "target", to=1234)
    yield "undirected", change("directed", to=True)


@pytest.mark.parametrize(
    ("field", "damage"), list(damages()), ids=lambda value: value if isinstance(value, str) else ""
)
def test_damage_is_named(tmp_path, field, damage):
    data = nx.node_link_data(made_graph(TWO_LANES), edges="edges")
    damage(data)
    path = tmp_path / "dual_graph.json"
    path.write_text(json.dumps(data))
    with pytest.raises(BadInput) as caught:
        MapGraph.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and field in message and "\n" not in message


def test_a_matrix_with_a_negative_eigenvalue_is_refused():
    graph = made_graph(TWO_LANES)
    size = 3 * len(graph.graph["vertices"])
    graph.graph["joint_covariance"] = packed(np.diag([*np.ones(size - 1), -0.01]))
    with pytest.raises(BadInput, match="joint_covariance: no negative eigenvalues"):
        MapGraph.from_graph(graph)


@pytest.mark.parametrize("kept", [0, 1, 0.3, 0.9, -2])
def test_a_file_that_was_cut_off_is_no_map(tmp_path, written, kept):
    text = written.read_text()
    path = tmp_path / "dual_graph.json"
    path.write_text(text[: int(kept * len(text)) if 0 < kept < 1 else kept])
    with pytest.raises(BadInput, match="not valid JSON"):
        MapGraph.load(path)


def test_what_is_no_file_or_no_graph(tmp_path):
    with pytest.raises(BadInput, match="cannot read"):
        MapGraph.load(tmp_path / "nowhere.json")
    for text in ("[]", "{}", "null", "3", '"dual graph"'):
        path = tmp_path / "dual_graph.json"
        path.write_text(text)
        with pytest.raises(BadInput, match="no node-link graph"):
            MapGraph.load(path)


def test_without_the_joint_covariance_it_says_so():
    graph = made_graph(TWO_LANES)
    graph.graph["joint_covariance"] = None
    with pytest.raises(BadInput, match="too large to hold their joint covariance"):
        MapGraph.from_graph(graph).joint_covariance([0, 1])
    with pytest.raises(BadInput, match="vertex 99 is not in the map"):
        made_map(TWO_LANES).joint_covariance([0, 99])
