"""The dual graph of finished runs: its shape, its covariances against sampling, its record of slippery ground."""

import json
from dataclasses import replace
from functools import cache

import networkx as nx
import numpy as np
import pytest
import shapely
from explorations import Run, require_complete, run
from monte_carlo import require_covariance
from scipy.sparse import csr_array

from coopslam.planning.dual_graph import dual_graph, signed_area_m2
from coopslam.planning.recorded_odometry import RecordedOdometry, Squares, local_variances
from sim.noise import TYPICAL, Noise

SAMPLES = 20_000
WORLDS = ["paper_one_obstacle", "rooms_with_doors"]


@cache
def finished(name: str) -> tuple[Run, nx.Graph, object]:
    done = run(name, "typical", 1)
    require_complete(done)
    smoothed = done.smoothed()
    return done, dual_graph(done.free_map, smoothed, RecordedOdometry(done.driver.graph, smoothed)), smoothed


@cache
def sampled(name: str) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Positions of all vertices, estimated and drawn (SAMPLES, 2) from their joint covariance, as poses one by one."""
    done, _, smoothed = finished(name)
    vertices = list(done.free_map.fans)
    joint = smoothed.joint_covariance([smoothed.vertex_key(v) for v in vertices])
    errors = np.random.default_rng(1).multivariate_normal(np.zeros(len(joint)), joint, SAMPLES, method="cholesky")
    places = {v: smoothed.vertex(v).translation() for v in vertices}
    drawn = {}
    for k, v in enumerate(vertices):
        turn = smoothed.vertex(v).rotation().matrix()
        drawn[v] = places[v] + errors[:, 3 * k : 3 * k + 2] @ turn.T
    return places, drawn


@pytest.mark.parametrize("name", WORLDS)
def test_nodes_are_triangles_and_edges_are_diagonals(name):
    done, graph, smoothed = finished(name)
    triangles = done.free_map.triangles
    assert set(graph) == set(triangles)
    shared = {
        frozenset((i, j)): set(triangles[i]) & set(triangles[j])
        for i in triangles
        for j in triangles
        if i < j and len(set(triangles[i]) & set(triangles[j])) == 2
    }
    walls = {frozenset(wall) for wall in done.free_map.walls()}
    diagonals = {pair: edge for pair, edge in shared.items() if frozenset(edge) not in walls}
    assert {frozenset(edge) for edge in graph.edges} == set(diagonals)
    for i, j, gate in graph.edges(data="gate"):
        assert set(gate) == diagonals[frozenset((i, j))]
    # as many loops as obstacles
    assert graph.number_of_edges() - graph.number_of_nodes() + 1 == done.world.holes and nx.is_connected(graph)
    for triangle, attributes in graph.nodes(data=True):
        corners = shapely.Polygon([smoothed.vertex(v).translation() for v in triangles[triangle]])
        assert attributes["vertices"] == list(triangles[triangle])
        assert attributes["area_m2"] == pytest.approx(corners.area)
        assert attributes["centroid"] == pytest.approx([corners.centroid.x, corners.centroid.y])
    assert sum(area for _, area in graph.nodes(data="area_m2")) == pytest.approx(done.world.area_m2, rel=0.05)
    again = nx.node_link_graph(json.loads(json.dumps(nx.node_link_data(graph, edges="edges"))), edges="edges")
    assert nx.utils.graphs_equal(again, graph)


@pytest.mark.parametrize("name", WORLDS)
def test_covariances_of_nodes_against_sampling(name):
    _, graph, _ = finished(name)
    places, drawn = sampled(name)
    for _, node in graph.nodes(data=True):
        errors = np.hstack([drawn[v] - places[v] for v in node["vertices"]])
        cov = np.array(node["vertex_covariance"])
        assert cov.shape == (6, 6)
        for k in range(3):  # the first vertex may be the origin, whose position is nearly certain
            require_covariance(errors[:, 2 * k : 2 * k + 2], cov[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])
        require_covariance(errors, cov)
        centroid = sum(drawn[v] for v in node["vertices"]) / 3 - node["centroid"]
        require_covariance(centroid, np.array(node["position_covariance"]))
        worst = np.sqrt(np.linalg.eigvalsh(np.cov(centroid.T))[-1])
        assert node["position_sigma_m"] == pytest.approx(worst, rel=5 / np.sqrt(2 * SAMPLES))


@pytest.mark.parametrize("name", WORLDS)
def test_uncertainties_of_edges_against_sampling(name):
    done, graph, _ = finished(name)
    places, drawn = sampled(name)

    def seen(where, i, j, gate):
        """Width of the gate, and the centroid of triangle j seen from that of i, in the axes of the gate; sampled."""
        along = where[gate[1]] - where[gate[0]]
        width = np.linalg.norm(along, axis=-1, keepdims=True)
        apart = (
            sum(where[v] for v in done.free_map.triangles[j]) / 3
            - sum(where[v] for v in done.free_map.triangles[i]) / 3
        )
        ahead = along / width
        beside = np.stack([-ahead[..., 1], ahead[..., 0]], axis=-1)
        return width[..., 0], np.stack([(apart * ahead).sum(-1), (apart * beside).sum(-1)], axis=-1)

    close = 5 / np.sqrt(2 * SAMPLES)  # of a standard deviation
    for i, j, edge in graph.edges(data=True):
        width, apart = seen(places, i, j, edge["gate"])
        widths, aparts = seen(drawn, i, j, edge["gate"])
        assert edge["width_m"] == pytest.approx(width) and edge["length_m"] == pytest.approx(np.hypot(*apart))
        assert edge["width_sigma_m"] == pytest.approx(widths.std(), rel=close)
        worst = np.sqrt(np.linalg.eigvalsh(np.cov((aparts - apart).T))[-1])
        assert edge["relative_sigma_m"] == pytest.approx(worst, rel=close)
    sigmas = np.array([edge["odometry_sigma_per_m"] for _, _, edge in graph.edges(data=True)])
    assert (sigmas > 0).all()


def test_no_ground_is_without_slip():
    """Squares that by chance add up to less than zero give a quarter of the mean sigma, not zero."""
    good, lucky = 0.02, -0.01
    squares = Squares(np.repeat([good, lucky], [300, 150]), np.ones(450), np.zeros(450))  # mean 0.01; 150 legs
    shares = csr_array(np.kron([[1, 0, 0], [0, 0, 1], [0, 0, 0]], np.ones(50)))
    s2, information = local_variances(squares, shares, csr_array(np.eye(3)).tocoo())
    assert s2[0] == pytest.approx(good, rel=0.02) and s2[1] == pytest.approx(0.01 / 16)
    assert s2[2] == pytest.approx(0.01) and information[0] > 100 * information[2]


def test_a_triangle_that_runs_clockwise_has_a_negative_area():
    assert signed_area_m2([[0, 0], [2, 0], [0, 1]]) == 1.0 and signed_area_m2([[0, 0], [0, 1], [2, 0]]) == -1.0


def slip(seed: int, belief: float, true: Noise) -> tuple[float, float]:
    """Sums over the legs of one run: excess variance of the distance driven, m^2 per m, and its gain."""
    sigma = belief * true.odometry.translation_sigma_m
    believed = replace(TYPICAL, odometry=replace(TYPICAL.odometry, translation_sigma_m=sigma))
    done = run("paper_two_occluders", seed=seed, true=true, believed=believed)
    odometry = RecordedOdometry(done.driver.graph, done.smoothed())
    excess, gain = odometry.evidence(np.ones(len(odometry.legs))).ahead.sums(1.0)
    return sigma**2 * excess.sum(), gain.sum()


@pytest.mark.parametrize("belief", [0.5, 1.0, 2.0])
def test_recorded_odometry_is_unbiased_whatever_was_believed(belief):
    """Variance per metre pooled over 20 seeds, within four standard errors that the seeds' own scatter gives."""
    sigma = TYPICAL.odometry.translation_sigma_m
    excess, gain = np.array([slip(seed, belief, TYPICAL) for seed in range(20)]).T
    pooled = excess.sum() / gain.sum()
    spread = np.std(excess - pooled * gain) * np.sqrt(20) / gain.sum()
    assert spread < 0.2 * sigma**2  # sharp enough to tell the truth from half and double
    assert abs(pooled - sigma**2) < 4 * spread


def test_slippery_ground_shows_in_the_edges():
    """The same world on ground that is three times as slippery; the belief is the same and wrong."""

    def typical_edge(sigma):
        true = replace(TYPICAL, odometry=replace(TYPICAL.odometry, translation_sigma_m=sigma))
        found = []
        for seed in range(16):
            done = run("paper_two_occluders", seed=seed, true=true, believed=TYPICAL)
            smoothed = done.smoothed()
            graph = dual_graph(done.free_map, smoothed, RecordedOdometry(done.driver.graph, smoothed))
            found += [value for _, _, value in graph.edges(data="odometry_sigma_per_m")]
        return np.sqrt(np.mean(np.square(found)))

    assert typical_edge(0.03) == pytest.approx(0.03, rel=0.25) and typical_edge(0.09) == pytest.approx(0.09, rel=0.25)
