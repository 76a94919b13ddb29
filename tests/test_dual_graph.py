"""The dual graph of finished runs: its shape, its covariances against sampling, its record of slippery ground."""

import json
from dataclasses import replace
from functools import cache

import networkx as nx
import numpy as np
import pytest
import shapely
from explorations import ROBOTS, Run, require_complete, run
from monte_carlo import require_covariance
from scipy.sparse import csr_array

from coopslam.estimation.incremental import Incremental
from coopslam.exploration.explorer import Explorer
from coopslam.exploration.mission import run_mission
from coopslam.planning.believed_sensors import believed_sensors
from coopslam.planning.dual_graph import dual_graph, signed_area_m2
from coopslam.planning.recorded_odometry import RecordedOdometry, Squares, local_variances
from coopslam.records import RelativePoseFix
from sim.noise import TRACKERS, TYPICAL, Noise
from sim.sensors import Sensors
from sim.team import Team
from sim.world import load_world

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


@pytest.mark.parametrize("name", WORLDS)
def test_four_vertices_of_an_edge_against_sampling(name):
    """Gate first, then the third corners; their joint covariance is that of samples drawn with all vertices at once."""
    _, graph, _ = finished(name)
    places, drawn = sampled(name)
    for i, j, edge in graph.edges(data=True):
        corners = [set(graph.nodes[t]["vertices"]) for t in sorted((i, j))]
        gate, thirds = edge["vertices"][:2], edge["vertices"][2:]
        assert gate == edge["gate"] and [corners[0] - corners[1], corners[1] - corners[0]] == [{v} for v in thirds]
        errors = np.hstack([drawn[v] - places[v] for v in edge["vertices"]])
        require_covariance(errors, np.array(edge["vertex_covariance"]))


@pytest.mark.parametrize("name", WORLDS)
def test_the_graph_tells_what_was_believed_of_the_sensors(name):
    """Read off the covariances of the factors: the settings of the run, to 1 % where they were used at all ranges."""
    _, graph, _ = finished(name)
    found, noise = graph.graph["sensors"], TYPICAL
    drift = noise.odometry.drift_sigma_rad
    per_rad = noise.odometry.rotation_sigma_rad / np.sqrt(2 * np.pi)
    assert found["odometry"]["translation_sigma_per_m"] == pytest.approx(noise.odometry.translation_sigma_m, rel=0.02)
    assert found["odometry"]["heading_sigma_per_m"] == pytest.approx(drift, rel=0.02)  # legs of several turns differ
    assert found["odometry"]["heading_sigma_per_rad"] == pytest.approx(per_rad, rel=0.02)
    tracker, finder = found["tracker"], found["finder"]
    assert tracker["along_sigma_m"] == pytest.approx(noise.tracker.range_sigma_m, rel=0.01)
    assert tracker["along_sigma_per_m"] == pytest.approx(noise.tracker.range_sigma_per_m, rel=0.01)
    assert tracker["across_sigma_m"] == pytest.approx(noise.tracker.lateral_sigma_m, rel=0.01)
    assert tracker["across_sigma_rad"] == pytest.approx(noise.tracker.bearing_sigma_rad, rel=0.01)
    assert tracker["heading_sigma_rad"] == pytest.approx(noise.tracker.heading_sigma_rad, rel=0.01)
    assert finder["along_sigma_m"] == pytest.approx(noise.finder.position_sigma_m, rel=0.01)
    assert finder["heading_sigma_rad"] == pytest.approx(noise.finder.direction_sigma_rad, rel=0.01)
    done, _, _ = finished(name)
    ranges = [r.T_observer_target.range(np.zeros(2)) for r in done.records if isinstance(r, RelativePoseFix)]
    assert tracker["reach_m"] == pytest.approx(max(ranges), rel=1e-9)


def test_a_tracker_without_heading_is_told_so():
    world_noise = replace(TYPICAL, tracker=TRACKERS["retroreflector"][0])
    sensors = Sensors(world_noise, world_noise, np.random.default_rng(1), tracker_limits=TRACKERS["retroreflector"][1])
    world = load_world("paper_two_occluders")
    driver = Incremental(ROBOTS)
    mission = run_mission(Team(world, sensors), driver, Explorer(ROBOTS), lambda record: None)
    assert mission.outcome == "complete"
    estimate = driver.update([])
    laws = believed_sensors(driver.graph, RecordedOdometry(driver.graph, estimate).legs)
    sigmas = TRACKERS["retroreflector"][0]
    assert laws.tracker.heading_sigma_rad is None
    assert laws.tracker.along_sigma_m == pytest.approx(sigmas.range_sigma_m, rel=0.01)
    assert laws.tracker.across_sigma_rad == pytest.approx(sigmas.bearing_sigma_rad, rel=0.01)


def test_triangles_tell_the_slip_of_heading_too():
    """Ground three times as slippery in all it does: the drift recorded in the triangles is, too."""

    def typical_drift(factor):
        sigmas = replace(
            TYPICAL.odometry,
            translation_sigma_m=factor * TYPICAL.odometry.translation_sigma_m,
            drift_sigma_rad=factor * TYPICAL.odometry.drift_sigma_rad,
            rotation_sigma_rad=factor * TYPICAL.odometry.rotation_sigma_rad,
        )
        found = []
        for seed in range(12):
            done = run("paper_two_occluders", seed=seed, true=replace(TYPICAL, odometry=sigmas), believed=TYPICAL)
            smoothed = done.smoothed()
            graph = dual_graph(done.free_map, smoothed, RecordedOdometry(done.driver.graph, smoothed))
            found += [value for _, value in graph.nodes(data="odometry_heading_sigma_per_m")]
        return np.sqrt(np.mean(np.square(found)))

    drift = TYPICAL.odometry.drift_sigma_rad
    assert typical_drift(1.0) == pytest.approx(drift, rel=0.25)
    assert typical_drift(3.0) == pytest.approx(3 * drift, rel=0.25)


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
