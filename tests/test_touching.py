"""The chance to touch a wall: closed forms, shapely, and a plain simulation of a robot that drifts."""

import numpy as np
import pytest
import shapely
from made_maps import LAWS, TWO_LANES, made_map
from scipy.stats import norm

from coopslam.planning.touching import DRAWN, margins, touching_probability
from coopslam.planning.traversal import OnOdometry, WithCorners, start_covariance
from coopslam.planning.walk import walk_along

CORRIDOR = shapely.Polygon([(-20, 0), (30, 0), (30, 2), (-20, 2)])


def four_standard_errors(share: float, count: int = DRAWN) -> float:
    return 4 * np.sqrt(share * (1 - share) / count)


def test_a_robot_that_stands_beside_a_wall():
    """Nothing moves: one wall 0.5 m away, another 1.5 m, radius 0.2 m, and 0.2 m of doubt."""
    map_graph = made_map(CORRIDOR, sigma_m=0.0)
    walk = walk_along(map_graph, np.array([[0.0, 0.5]]))
    found = touching_probability(map_graph, walk, OnOdometry(), np.diag([0.2, 0.2, 0.1]) ** 2, 0.2)
    both = norm.cdf(-0.3 / 0.2) + norm.cdf(-1.3 / 0.2)
    assert found == pytest.approx(both, abs=four_standard_errors(both))


def test_a_wall_may_be_elsewhere():
    """The robot knows its place exactly relative to its triangle; the walls' far ends err, more than the room there."""
    map_graph = made_map(CORRIDOR, sigma_m=0.6)
    walk = walk_along(map_graph, np.array([[0.0, 0.5]]))
    found = touching_probability(map_graph, walk, OnOdometry(), np.zeros((3, 3)), 0.4)
    # y of the robot is a mean of its triangle's corners, y of a wall's nearest point one of the wall's ends
    ids, joint = list(map_graph.vertices), map_graph.joint.reshape(4, 3, 4, 3)[:, 1, :, 1]
    triangle = map_graph.triangle_at(0.0, 0.5)
    corners = map_graph.corners[triangle]
    inside = np.zeros(4)
    inside[[ids.index(v) for v in map_graph.triangles[triangle]]] = np.linalg.solve(
        np.vstack([corners.T, np.ones(3)]), [0.0, 0.5, 1.0]
    )
    chances = []
    for wall_y, room in ((0.0, 0.1), (2.0, 1.1)):
        on_wall = np.array(
            [(0.6 if v.xy[0] < 0 else 0.4) if v.xy[1] == wall_y else 0.0 for v in map_graph.vertices.values()]
        )
        off = inside - on_wall
        chances.append(norm.cdf(-room / np.sqrt(off @ joint @ off)))
    # the two walls err together, so it is between the greater chance and the sum
    assert max(chances) > 0.05
    margin = four_standard_errors(max(chances))
    assert max(chances) - margin <= found <= sum(chances) + margin


@pytest.mark.parametrize(("length", "radius"), [(4.0, 0.7), (8.0, 0.4), (14.0, 0.2)])
def test_along_a_corridor_against_a_robot_that_drifts(length, radius):
    """A random walk of heading, integrated in steps of 2 cm, between two walls: 20 000 robots."""
    map_graph = made_map(CORRIDOR, sigma_m=0.0)
    walk = walk_along(map_graph, np.array([[0.0, 1.0], [length, 1.0]]))
    found = touching_probability(map_graph, walk, OnOdometry(), np.diag([0.01, 0.01, 0.02]) ** 2, radius)
    rng, count, step = np.random.default_rng(3), 20_000, 0.02
    aside, heading = 0.01 * rng.standard_normal(count), 0.02 * rng.standard_normal(count)
    touched = np.abs(aside) > 1.0 - radius
    for _ in range(round(length / step)):
        before = heading
        heading = heading + LAWS.odometry.heading_sigma_per_m * np.sqrt(step) * rng.standard_normal(count)
        aside = aside + step * (before + heading) / 2
        touched |= np.abs(aside) > 1.0 - radius
    share = touched.mean()
    assert 0.01 < share < 0.9  # the case says something
    # and 2 % because nothing is looked at between stations 0.2 m apart
    assert found == pytest.approx(share, abs=four_standard_errors(share) + 0.02 * share)


def test_a_path_along_a_wall_touches_at_even_odds_and_one_in_the_middle_seldom():
    map_graph = made_map(CORRIDOR, sigma_m=0.0)
    small = np.diag([1e-3, 1e-3, 1e-4]) ** 2
    beside = walk_along(map_graph, np.array([[0.0, 0.3], [0.1, 0.3]]))
    middle = walk_along(map_graph, np.array([[0.0, 1.0], [0.1, 1.0]]))
    assert touching_probability(map_graph, beside, OnOdometry(), small, 0.3) == pytest.approx(
        0.5, abs=0.1
    )  # its start alone: one half
    assert touching_probability(map_graph, middle, OnOdometry(), small, 0.3) == 0.0


def test_rooms_are_those_that_shapely_measures():
    """Between every stretch and every wall near it, wherever on the stretch they are nearest."""
    map_graph = made_map(TWO_LANES)
    points = np.array([[1.0, 1.0], [3.1, 2.2], [3.4, 2.6], [9.0, 3.0]])
    walk = walk_along(map_graph, points)
    wide = np.tile(np.eye(3), (len(walk.points), 1, 1))  # a metre of doubt: every wall is near
    found = margins(map_graph, walk, wide, 0.1)
    for k in range(1, len(walk.points)):
        stretch = shapely.LineString(walk.points[k - 1 : k + 1])
        rooms = {margin.wall: margin.room_m for margin in found[k]}
        for wall in map_graph.walls:
            line = shapely.LineString([map_graph.vertices[v].xy for v in wall])
            if wall in rooms:
                assert rooms[wall] == pytest.approx(line.distance(stretch) - 0.1, abs=1e-12)
            else:
                assert line.distance(stretch) > 5.0


def test_who_sees_corners_touches_less():
    map_graph = made_map(TWO_LANES, sigma_m=0.005)
    points = np.array([[2.0, 1.5], [14.0, 1.5]])
    chances = [
        touching_probability(
            map_graph, walk_along(map_graph, points, m.stops(map_graph, points)), m, start_covariance(map_graph), 0.3
        )
        for m in (OnOdometry(), WithCorners(reach_m=3.0))
    ]
    assert chances[0] > chances[1] + four_standard_errors(chances[0]) > 0.01
