"""What a robot knows on its way through a map, against bare GTSAM, quadrature and worked numbers."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
import shapely
from drift_by_quadrature import straight_by_quadrature
from made_maps import LAWS, TWO_LANES, made_graph, made_map
from scipy.integrate import quad

from coopslam.errors import BadInput
from coopslam.planning.map_graph import MapGraph
from coopslam.planning.sensor_laws import OdometryLaw, SensorLaws, SightingLaw
from coopslam.planning.travel_belief import ASTRAY, FIRST_VERTEX, TravelBelief, barycentric, leg_covariance
from coopslam.planning.traversal import (
    Escorted,
    OnOdometry,
    WithCorners,
    model_named,
    start_covariance,
    travel,
)
from coopslam.planning.walk import AIM_M, Walk, left_astray, walk_along

HALL = shapely.Polygon([(0, 0), (8, 0), (8, 3), (0, 3)])
EAST = np.array([[1.0, 1.0], [7.0, 1.0]])


def trip(map_graph, points, model, start_cov=None):
    walk = walk_along(map_graph, np.array(points, float), model.stops(map_graph, np.array(points, float)))
    return travel(map_graph, walk, model, start_covariance(map_graph) if start_cov is None else start_cov)


def test_error_of_a_leg_is_the_integral_over_its_drift():
    """d metres north: along it sigma^2 d; a drift at s metres before the end is an error across of s, to the west."""
    law, d = OdometryLaw(0.05, 0.04, 0.1), 2.5
    across = quad(lambda s: 0.04**2 * s**2, 0, d)[0]
    mixed = quad(lambda s: 0.04**2 * -s, 0, d)[0]
    expected = [[across, 0, mixed], [0, 0.05**2 * d, 0], [mixed, 0, 0.04**2 * d]]
    np.testing.assert_allclose(leg_covariance(np.array([0.0, d]), law), expected, atol=1e-15)


def test_a_straight_way_in_a_certain_map_adds_up_what_was_recorded():
    """6 m east in 0.2 m stations is one leg of 6 m."""
    map_graph = made_map(HALL, sigma_m=0.0)
    done = trip(map_graph, EAST, OnOdometry(), np.zeros((3, 3)))
    expected = straight_by_quadrature(6.0, LAWS.odometry, 0.0)
    np.testing.assert_allclose(done.covariances[-1], expected, rtol=1e-9, atol=1e-12)
    assert len(done.covariances) == len(done.walk.points) >= 31


def test_slippery_triangles_count_where_they_are_crossed():
    """A hall with a triangulation whose diagonals are known: variance along the way = sum of sigma^2 times length."""
    graph = made_graph(HALL, sigma_m=0.0)
    first, second = graph.nodes
    graph.nodes[second]["odometry_sigma_per_m"] *= 5
    for triangle in graph.nodes:
        graph.nodes[triangle]["odometry_heading_sigma_per_m"] = 0.0
    map_graph = MapGraph.from_graph(graph)
    done = trip(map_graph, EAST, OnOdometry(), np.zeros((3, 3)))
    line = shapely.LineString(EAST)
    inside = [line.intersection(shapely.Polygon(map_graph.corners[t])).length for t in (first, second)]
    expected = 0.03**2 * (inside[0] + 25 * inside[1])
    assert min(inside) > 0.5 and done.covariances[-1][0, 0] == pytest.approx(expected, rel=1e-9)


def dense_least_squares(map_graph, vertices, start, legs) -> np.ndarray:
    """Joint covariance of the last pose and the vertices, axes of the map, by one dense least-squares problem.

    Every pose of the robot and every vertex is an unknown error in the axes of the map; rows are written from GTSAM's
    own Jacobians of `BetweenFactorPose2` at the planned poses.
    """
    poses = [gtsam.Pose2(*start["pose"])]
    for leg in legs:
        poses.append(poses[-1] * leg["T"])
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(k, pose)
    for v in vertices:
        values.insert(1000 + v, map_graph.vertices[v].T_map_vertex)
    graph = gtsam.NonlinearFactorGraph()
    for k, leg in enumerate(legs):
        noise = gtsam.noiseModel.Gaussian.Covariance(leg["cov"])
        graph.add(gtsam.BetweenFactorPose2(k, k + 1, leg["T"], noise))
        for vertex, law in leg["seen"]:
            measured = poses[k + 1].between(map_graph.vertices[vertex].T_map_vertex)
            line = np.arctan2(measured.y(), measured.x()) - measured.theta()
            turn = np.eye(3)
            turn[:2, :2] = [[np.cos(line), -np.sin(line)], [np.sin(line), np.cos(line)]]
            cov = turn @ law.line_covariance(float(np.hypot(measured.x(), measured.y()))) @ turn.T
            factor = gtsam.BetweenFactorPose2(k + 1, 1000 + vertex, measured, gtsam.noiseModel.Gaussian.Covariance(cov))
            graph.add(factor)
    ordering = gtsam.Ordering()
    keys = [*range(len(poses)), *(1000 + v for v in vertices)]
    for key in keys:
        ordering.push_back(key)
    rows = graph.linearize(values).jacobian(ordering)[0]
    size = 3 * len(keys)
    to_map = np.zeros((size, size))
    for k, key in enumerate(keys):
        to_map[3 * k : 3 * k + 2, 3 * k : 3 * k + 2] = values.atPose2(key).rotation().matrix()
        to_map[3 * k + 2, 3 * k + 2] = 1.0
    information = to_map @ rows.T @ rows @ to_map.T
    information[-3 * len(vertices) :, -3 * len(vertices) :] += np.linalg.inv(map_graph.joint_covariance(vertices))
    tie = np.zeros((3, size))  # the robot is put down relative to the corners of its triangle
    tie[:, :3] = np.eye(3)
    tie[:, 3 * len(poses) :] = -start["around"]
    information += tie.T @ np.linalg.solve(start["cov"], tie)
    last = 3 * (len(poses) - 1)
    pick = np.r_[last : last + 3, 3 * len(poses) : size]
    return np.linalg.inv(information)[np.ix_(pick, pick)]


def test_the_belief_is_that_of_least_squares_over_the_whole_way():
    """Turns, drives and corner sightings in an uncertain map: against one dense problem from GTSAM's Jacobians."""
    map_graph = made_map(HALL)
    vertices, law = list(map_graph.vertices), LAWS.odometry
    bends = np.array([[1.0, 1.0], [5.0, 0.5], [7.0, 2.5]])
    triangle = map_graph.triangle_at(*bends[0])
    start_cov = np.diag([0.01, 0.02, 0.015]) ** 2
    belief = TravelBelief(map_graph, vertices, bends[0], triangle, start_cov)
    around = belief.around(bends[0], triangle)[:, FIRST_VERTEX:]
    legs, heading = [], 0.0
    for k, seen in ((1, [1, 0]), (2, [2, 1, 3])):
        way = bends[k] - bends[k - 1]
        ahead, d = float(np.arctan2(way[1], way[0])), float(np.hypot(*way))
        turn = (ahead - heading) if k > 1 else 0.0
        q = law.heading_sigma_per_m**2
        cov = np.diag([law.translation_sigma_per_m**2 * d, q * d**3 / 3, q * d])
        cov[1, 2] = cov[2, 1] = q * d**2 / 2
        # GTSAM adds the turn before the drive: its heading error is carried to the end of the drive
        carried = np.outer([0.0, d, 1.0], [0.0, d, 1.0]) * law.heading_sigma_per_rad**2 * abs(turn)
        legs.append({"T": gtsam.Pose2(0, 0, turn) * gtsam.Pose2(d, 0, 0), "cov": cov + carried, "seen": []})
        belief.turn(turn, law)
        belief.drive(bends[k], law)
        for vertex in seen:
            belief.sight_corner(vertex, LAWS.finder)
            legs[-1]["seen"].append((vertex, LAWS.finder))
        heading = ahead
    first = float(np.arctan2(*(bends[1] - bends[0])[::-1]))
    start = {"pose": [*bends[0], first], "cov": start_cov, "around": around}
    expected = dense_least_squares(map_graph, vertices, start, legs)
    pick = np.r_[0:3, FIRST_VERTEX : len(belief.cov)]
    np.testing.assert_allclose(belief.cov[np.ix_(pick, pick)], expected, atol=1e-9 * expected.max(), rtol=1e-6)


def test_a_watched_robot_is_known_as_a_chain_of_three_sightings():
    """Corner -> partner -> robot: with poor odometry nothing else counts; covariances of two sightings by hand."""
    laws = replace(LAWS, odometry=OdometryLaw(50.0, 50.0, 50.0))
    map_graph = made_map(HALL, sigma_m=0.0, laws=laws)
    vertex = 1  # at (8, 0): the robot ends 2 m west of it
    belief = TravelBelief(map_graph, list(map_graph.vertices), np.array([1.0, 0.0]), 0, np.zeros((3, 3)))
    belief.stand_partner(vertex, laws.finder)
    belief.drive(np.array([6.0, 0.0]), laws.odometry)
    belief.watch_robot(vertex, laws.tracker)
    near, far = laws.finder, laws.tracker
    expected = [
        near.along_sigma_m**2 + far.along_sigma_m**2 + (far.along_sigma_per_m * 2) ** 2,
        near.across_sigma_m**2 + (near.heading_sigma_rad * 2) ** 2 + far.across_sigma_m**2 + (0.004 * 2) ** 2,
        near.heading_sigma_rad**2 + far.heading_sigma_rad**2,
    ]
    np.testing.assert_allclose(np.diag(belief.cov)[:3], expected, rtol=1e-4)  # odometry still says 1e-5 of it


def test_the_map_around_a_point_moves_as_its_corners_do():
    """A rigid motion of all corners moves the point and turns it by just that motion, to first order."""
    map_graph = made_map(HALL)
    point, angle, shift = np.array([2.0, 1.0]), 1e-6, np.array([3e-6, -1e-6])
    triangle = map_graph.triangle_at(*point)
    belief = TravelBelief(map_graph, list(map_graph.vertices), point, triangle, np.zeros((3, 3)))
    errors = np.zeros(len(belief.cov))
    for k, vertex in map_graph.vertices.items():
        errors[belief.place(k)] = [shift[0] - angle * vertex.xy[1], shift[1] + angle * vertex.xy[0], angle]
    expected = [shift[0] - angle * point[1], shift[1] + angle * point[0], angle]
    np.testing.assert_allclose(belief.around(point, triangle) @ errors, expected, atol=1e-18)


def test_weights_of_a_flat_triangle_are_those_of_its_nearest_corner():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    np.testing.assert_array_equal(barycentric(np.array([1.9, 0.0]), corners), [0, 0, 1])
    solid = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])
    np.testing.assert_allclose(barycentric(np.array([0.5, 0.5]), solid), [0.5, 0.25, 0.25])


def test_a_robot_that_moves_nowhere_knows_what_it_knew():
    """However uncertain the map is in its own frame: relative to the map around it, it is as it was put down."""
    map_graph = made_map(HALL, sigma_m=0.5)
    cov = np.diag([0.01, 0.02, 0.03]) ** 2
    np.testing.assert_allclose(trip(map_graph, [[1.0, 1.0]], OnOdometry(), cov).covariances, [cov], atol=1e-12)


def test_a_walk_is_cut_where_shapely_says():
    map_graph = made_map(TWO_LANES)
    points = np.array([[1.0, 1.0], [3.2, 2.2], [3.4, 3.0], [14.0, 2.7], [14.0, 1.0]])
    walk = walk_along(map_graph, points)
    shapes = {t: shapely.Polygon(corners) for t, corners in map_graph.corners.items()}
    assert walk.points[0].tolist() == [1, 1] and walk.points[-1].tolist() == [14, 1]
    length = {t: 0.0 for t in shapes}
    for a, b, triangle in zip(walk.points[:-1], walk.points[1:], walk.triangles, strict=True):
        line = shapely.LineString([a, b])
        assert line.difference(shapes[triangle].buffer(1e-9)).length < 1e-9 and line.length <= 0.2 + 1e-12
        length[triangle] += line.length
    whole = shapely.LineString(points)
    for triangle, shape in shapes.items():
        assert length[triangle] == pytest.approx(whole.intersection(shape).length, abs=1e-5)  # of cuts left out


def test_a_walk_out_of_the_map_is_refused():
    with pytest.raises(BadInput, match=r"leaves the map at \(8.000, 1.000\)"):
        walk_along(made_map(HALL), np.array([[1.0, 1.0], [9.0, 1.0]]))
    with pytest.raises(BadInput, match=r"leaves the map at \(5.000, 2.000\)"):
        walk_along(made_map(TWO_LANES), np.array([[5.0, 1.0], [5.0, 3.0]]))  # through the island
    with pytest.raises(BadInput, match=r"leaves the map at \(5.000, 2.000\)"):  # through it twice, and out
        walk_along(made_map(TWO_LANES), np.array([[5.0, 1.0], [5.0, 3.0], [6.0, 3.0], [6.0, -1.0]]))
    with pytest.raises(BadInput, match=r"leaves the map at \(9.000, 1.000\)"):
        walk_along(made_map(HALL), np.array([[9.0, 1.0]]))


def test_corners_are_seen_once_in_passing_and_not_through_walls():
    """Past the island's south side at 0.3 m: its two southern corners, once each; a northern one stands behind it."""
    map_graph = made_map(TWO_LANES)
    places = {v: tuple(vertex.xy.tolist()) for v, vertex in map_graph.vertices.items()}
    points = np.array([[2.0, 1.7], [8.0, 1.7], [14.0, 1.7]])
    stops = WithCorners(reach_m=0.6).stops(map_graph, points)
    found = [(stop.leg, places[stop.vertex], round(points[stop.leg][0] + 6 * stop.along, 9)) for stop in stops]
    assert sorted(found) == [(0, (3.5, 2.0), 3.5), (1, (12.5, 2.0), 12.5)]
    hidden = WithCorners(reach_m=1.3).stops(map_graph, np.array([[4.5, 1.7], [8.0, 1.7]]))
    assert [places[stop.vertex] for stop in hidden] == [(3.5, 2.0)]  # (3.5, 2.4) is 1.22 m away, behind the island
    around = WithCorners(reach_m=0.6).stops(map_graph, np.array([[3.2, 1.0], [3.2, 2.2], [3.2, 3.5]]))
    assert sorted((stop.leg, places[stop.vertex], stop.along) for stop in around) == [
        (0, (3.5, 2.0), pytest.approx(1.0 / 1.2)),
        (1, (3.5, 2.4), pytest.approx(0.2 / 1.3)),
    ]
    angles = np.linspace(-np.pi / 2, np.pi / 2, 60)  # around the west end in chords, as paths around corners are
    round_it = np.column_stack([3.5 - 0.3 * np.cos(angles), 2.2 + 0.5 * np.sin(angles)])
    assert sorted(places[stop.vertex] for stop in WithCorners().stops(map_graph, round_it)) == [(3.5, 2.0), (3.5, 2.4)]
    there_and_back = np.array([[2.0, 1.7], [4.0, 1.7], [2.0, 1.6]])
    again = WithCorners(reach_m=0.45).stops(map_graph, there_and_back)
    assert [(stop.leg, places[stop.vertex]) for stop in again] == [(0, (3.5, 2.0)), (1, (3.5, 2.0))]


def test_only_what_is_surely_within_reach_is_seen():
    """A corner 0.3 m aside after 1.5 and after 11 m on odometry, with a reach of 0.5 m."""
    map_graph = made_map(TWO_LANES, sigma_m=0.001)
    points = np.array([[2.0, 1.7], [14.0, 1.7]])
    model = WithCorners(reach_m=0.5)
    done = trip(map_graph, points, model)
    seen = [map_graph.vertices[v].xy.tolist() for vertices in done.looks.values() for v in vertices]
    assert seen == [[3.5, 2.0]]
    assert len(model.stops(map_graph, points)) == 2
    # after 9 m more the robot is off by 0.03 * sqrt(9^3 / 3) = 0.47 m across: it may be elsewhere
    wide = trip(map_graph, points, WithCorners(reach_m=3.0))
    assert [3.5, 2.0] in [map_graph.vertices[v].xy.tolist() for some in wide.looks.values() for v in some]
    assert len(wide.looks) > 1


def test_a_measurement_moves_the_belief_and_not_the_robot():
    """Its true place less its way: the same before and after, then back to the leg's end but for what is not known."""
    map_graph = made_map(HALL, sigma_m=0.02)
    belief = TravelBelief(map_graph, list(map_graph.vertices), np.array([1.0, 1.0]), 0, np.diag([0.1, 0.2, 0.1]) ** 2)
    belief.drive(np.array([3.0, 1.0]), LAWS.odometry)
    nothing = np.zeros((3, len(belief.cov)))
    before = belief.true_place_covariance(nothing)
    belief.sight_corner(0, LAWS.finder)
    np.testing.assert_allclose(belief.true_place_covariance(nothing), before, rtol=1e-9)
    known = belief.cov[:2, :2]
    assert known[1, 1] < 0.2 * before[1, 1]
    # a known correction is uncorrelated with what is still wrong (orthogonality of the least squares estimate)
    np.testing.assert_allclose(belief.cov[ASTRAY, :3], 0.0, atol=1e-9 * before.max())
    belief.steer_back(0.5)
    np.testing.assert_allclose(belief.true_place_covariance(nothing), known + (before - known) / 4, rtol=1e-9)


def test_what_is_left_of_being_astray():
    """Legs of 2 and 1 m, the first with a needless point in it: straight to their ends, until 0.3 m before them."""
    stations = np.array([[1.0, 1.0], [1.5, 1.0], [2.0, 1.0], [2.9, 1.0], [3.0, 1.0], [3.0, 1.5], [3.0, 2.0]])
    found = np.cumprod(left_astray(Walk(stations, [0] * 6, 0)))
    assert AIM_M == 0.3
    np.testing.assert_allclose(found, [1.5 / 2, 1.0 / 2, 0.3 / 2, 0.15, 0.15 * 0.5, 0.15 * 0.3])


def test_who_sees_corners_knows_more_and_who_is_escorted_most():
    map_graph = made_map(TWO_LANES)
    points = [[2.0, 1.7], [14.0, 1.7]]
    models = OnOdometry(), WithCorners(reach_m=2.5), Escorted()
    alone, corners, escorted = (trip(map_graph, points, model).covariances for model in models)
    sigmas = [float(np.sqrt(np.trace(covs[-1][:2, :2]))) for covs in (alone, corners, escorted)]
    assert sigmas[0] > 2 * sigmas[1] > 4 * sigmas[2]
    # a look at the last corner, 1.5 m before the end, leaves what 1.5 m of odometry and of its heading's doubt bring
    q = LAWS.odometry.heading_sigma_per_m**2
    least = np.sqrt(0.03**2 * 1.5 + q * 1.5**3 / 3)
    assert least < sigmas[1] < 1.5 * least


def test_a_map_that_does_not_say_how_robots_see_is_refused():
    blind = made_map(HALL, laws=SensorLaws(LAWS.odometry, None, None))
    OnOdometry().require(blind)
    np.testing.assert_array_equal(start_covariance(blind), np.zeros((3, 3)))
    for model in (WithCorners(), Escorted()):
        with pytest.raises(BadInput, match=r"graph\.sensors\.finder"):
            model.require(blind)
    with pytest.raises(BadInput, match=r"graph\.sensors\.tracker"):
        Escorted().require(made_map(HALL, laws=replace(LAWS, tracker=None)))
    with pytest.raises(BadInput, match=r"graph\.sensors\.odometry"):
        OnOdometry().require(made_map(HALL, laws=replace(LAWS, odometry=None)))
    with pytest.raises(BadInput, match="model: one of odometry, corners, escorted expected, got flying"):
        model_named("flying")


def test_a_tracker_without_heading_still_tells_the_place():
    laws = replace(LAWS, tracker=SightingLaw(0.01, 0.001, 0.005, 0.004, None, 30.0))
    map_graph = made_map(TWO_LANES, laws=laws)
    alone, escorted = (
        trip(map_graph, EAST + [1.0, 0.0], model_named(n)).covariances[-1] for n in ("odometry", "escorted")
    )
    assert np.trace(escorted[:2, :2]) < 0.05 * np.trace(alone[:2, :2])
