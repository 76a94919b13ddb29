"""What is predicted of a traversal, against robots that are not linearized: scripts/benchmarks/_traversals.py."""

from dataclasses import replace

import numpy as np
import pytest
from made_maps import TWO_LANES, made_map
from script_calls import SCRIPTS

from coopslam.planning.touching import touching_probability
from coopslam.planning.traversal import OnOdometry, WithCorners, start_covariance, travel
from coopslam.planning.walk import walk_along

COUNT, RADIUS = 1500, 0.15


@pytest.fixture
def simulated(monkeypatch):
    """Errors at the goal, and the share that touched a wall, of robots on a way."""
    monkeypatch.syspath_prepend(SCRIPTS / "benchmarks")
    from _traversals import Traversals

    def run(map_graph, walk, model, trip):
        walk, rng = replace(walk, stops=trip.looks), np.random.default_rng(2)
        robots = Traversals(map_graph, walk, start_covariance(map_graph), COUNT, rng, RADIUS)
        return robots.run(model), robots.touched.mean()

    return run


@pytest.mark.parametrize(
    ("model", "bends"),
    [
        (OnOdometry(), [[1.0, 1.0], [6.0, 1.0], [7.0, 1.5]]),
        # 0.16 m of doubt when it sees the corner; then along the island while it still steers back
        (WithCorners(reach_m=1.2), [[1.0, 3.0], [1.0, 0.5], [3.4, 1.6], [11.0, 1.6]]),
    ],
    ids=["odometry", "corners"],
)
def test_errors_and_touches_are_those_of_simulated_robots(simulated, model, bends):
    map_graph = made_map(TWO_LANES, sigma_m=0.01)
    bends = np.array(bends)
    walk = walk_along(map_graph, bends, model.stops(map_graph, bends))
    trip = travel(map_graph, walk, model, start_covariance(map_graph))
    errors, touched = simulated(map_graph, walk, model, trip)
    assert bool(trip.looks) == isinstance(model, WithCorners)
    white = np.linalg.solve(np.linalg.cholesky(trip.covariances[-1]), errors.T).T
    products = white[:, :, None] * white[:, None, :]  # their standard errors from themselves: they are not normal
    assert (np.abs(products.mean(axis=0) - np.eye(3)) < 4.5 * products.std(axis=0) / np.sqrt(COUNT)).all()
    predicted = touching_probability(map_graph, walk, model, start_covariance(map_graph), RADIUS)
    assert 0.02 < touched < 0.98
    assert predicted == pytest.approx(touched, abs=4 * np.sqrt(touched * (1 - touched) / COUNT) + 0.03)
