"""How slippery the ground is: the odometry error that was recorded while each part of a map was explored.

The ground multiplies every odometry sigma by one factor, which the belief does not know. Let s^2 be true over assumed
variance of a leg of odometry. The smoothed leg has the whitened residual y and, of its assumed covariance, the part
P = A Sigma A' that is left (A: whitened Jacobian, Sigma: joint covariance of the leg's ends). In the eigenvectors of P
the three components are independent: with p an eigenvalue and r = 1 - p the redundancy (1: all that odometry could
get wrong was measured by others, 0: nothing else speaks of this component) the smoother leaves of the leg's own error
the share r, and of the others' error, whose variance is p / r, also r. Hence

    E y^2 = s^2 r^2 + p r,    var y^2 = 2 (s^2 r^2 + p r)^2.

The likelihood of the same s^2 in many components, differentiated, says: s^2 = sum(w r^2 (y^2 - p r)) / sum(w r^4) with
w = (s^2 r^2 + p r)^-2, unbiased for any fixed w; its variance is 2 s^4 / I with the information I = sum(w s^4 r^4),
which is 1 for a component that is measured perfectly.

What others say of a leg contains its neighbours' odometry, so everything is done twice: the second pass smooths again
with the covariances that the first one found, which makes the sums those of restricted maximum likelihood (Patterson
and Thompson, 1971; the variance components of geodesy, Foerstner, 1979).

Where to take s^2 from is the adaptive smoothing of Polzehl and Spokoiny (Propagation-Separation Approach for Local
Likelihood Estimation, 2006): each triangle gathers legs from ever farther around in the dual graph, from triangles
whose ground does not differ significantly from its own, so a patch keeps its border. Belief may be wrong of distance
and of heading by different factors; this is found from the whole map, and what is reported is the error in distance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import shapely
from scipy.sparse import coo_array, csr_array, eye_array

from coopslam.estimation.estimate import Estimate
from coopslam.estimation.graph_check import in_words
from coopslam.estimation.ordering import nested_dissection
from coopslam.exploration.free_map import FreeMap
from coopslam.se2 import Pose2, planar_rotation, position, xytheta

REACH = 4  # steps in the dual graph, from how far a triangle takes legs at most
DIFFERENT = 5.0  # squared normal deviation from which on two triangles share nothing; 2.5 % by chance
PRIOR_INFORMATION = 0.2  # of the average over the map, in every part of it; a leg measured perfectly has 3
LEAST_OF_MEAN = 0.25  # of the map's mean sigma: y^2 - p r of a few legs can add up to less than zero
NEAR_M = 0.02  # a leg so near a triangle was driven in it
LEAST_PART = 0.01  # of a leg: one that lies less in the map is taken for an average one
PASSES = 2
ROUNDS = 8  # of an estimate whose weights depend on it
MOVED_M = 1e-3  # a shorter leg was a turn
TINY = 1e-6  # least s^2, for logarithms


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """One odometry factor of a graph."""

    factor: int  # its index
    line: np.ndarray  # (2, 2) m; from where to where, in the frame of the estimate
    distance_m: float
    axes: np.ndarray  # (3, 3) turns the axes of the leg's end to (ahead, aside, heading)
    cov: np.ndarray  # (3, 3) believed; axes of the end; m, m, rad


@dataclass(frozen=True, slots=True, eq=False)
class Squares:
    """Squared residuals of k legs or components; `excess` has mean s^2 * gain and variance 2 (s^2 gain + noise)^2."""

    excess: np.ndarray  # (k,) y^2 - p r
    gain: np.ndarray  # (k,) r^2 / variance assumed, relative to belief
    noise: np.ndarray  # (k,) p r

    def relative_to(self, s2: np.ndarray) -> "Squares":
        """The same for the variance over s2."""
        return Squares(self.excess, self.gain * s2, self.noise)

    def sums(self, s2: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Terms of numerator and denominator of the estimate that is best near s2."""
        weight = self.gain / np.maximum(s2 * self.gain + self.noise, 1e-12) ** 2
        return weight * self.excess, weight * self.gain


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a pass says of n legs."""

    all: Squares  # 3 n: the independent components, leg by leg
    ahead: Squares  # n: the error in the direction of travel alone
    heading: Squares  # n


@dataclass(frozen=True, slots=True)
class SlipByTriangle:
    """Odometry error by triangle."""

    variance_per_m: Mapping[int, float]  # m^2 per m
    information: Mapping[int, float]
    heading: Mapping[int, float]  # variance of heading over the believed one

    def pooled(self, triangles: Sequence[int]) -> float:
        """Odometry error in some triangles, m per sqrt(m)."""
        weights = [self.information[t] for t in triangles]
        return float(np.sqrt(np.average([self.variance_per_m[t] for t in triangles], weights=weights)))

    def legs(self, triangles: Sequence[int]) -> float:
        """How many perfectly measured legs would tell as much as what stands behind it, on average."""
        return float(np.mean([self.information[t] for t in triangles]) / 3)


class RecordedOdometry:
    """The legs of a run, compared with an estimate that smoothed them."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, estimate: Estimate):
        """graph: the factors that the estimate smoothed."""
        self.graph, self._values, self._robots = graph, gtsam.Values(), estimate.robots
        for key in graph.keyVector():
            self._values.insert(key, estimate.value(key))
        chains = {
            key: (robot, k) for robot in estimate.robots for k, key in enumerate(estimate.timeline.tracks[robot].keys)
        }
        self.legs = []
        for i in range(graph.size()):
            factor = graph.at(i)
            if not isinstance(factor, gtsam.BetweenFactorPose2):
                continue
            start, end = factor.keys()
            if start in chains and end in chains and chains[end] == (chains[start][0], chains[start][1] + 1):
                line = np.array([position(estimate.value(start)), position(estimate.value(end))])
                self.legs.append(_leg(i, line, factor.measured(), factor.noiseModel().covariance()))

    def evidence(self, s2: np.ndarray, split: float = 1.0) -> Evidence:
        """Smooth with other covariances, one step of Gauss and Newton, and look at what is left.

        s2: (n,) assumed variance of each leg over the believed one. split: ratio of the sigmas ahead to those of
        heading, in addition to the belief's.
        """
        graph = self._assumed(s2, split)
        linear = graph.linearize(self._values)
        residuals, left, unwhiten = (np.empty((len(self.legs), *shape)) for shape in ((3,), (3, 3), (3, 3)))
        try:
            ordering = nested_dissection(linear)
            tree = linear.eliminateMultifrontal(ordering, gtsam.EliminateQR)
            step = tree.optimize()
            for k, leg in enumerate(self.legs):
                factor, keys = graph.at(leg.factor), graph.at(leg.factor).keys()
                jacobian, rest = linear.at(leg.factor).jacobian()
                residuals[k] = jacobian @ np.concatenate([step.at(key) for key in keys]) - rest
                left[k] = jacobian @ tree.jointMarginalCovariance(keys).fullMatrix() @ jacobian.T
                unwhiten[k] = leg.axes @ np.linalg.inv(factor.noiseModel().R())
        except RuntimeError as error:
            raise in_words(error, graph, self._values, self._robots) from error
        moved = np.array([leg.distance_m > MOVED_M for leg in self.legs])
        return _evidence(residuals, left, unwhiten, s2, moved)

    def _assumed(self, s2: np.ndarray, split: float) -> gtsam.NonlinearFactorGraph:
        """The graph with other covariances of its legs."""
        part = np.diag([np.sqrt(split), 1 / np.sqrt(split), 1 / np.sqrt(split)])
        graph = gtsam.NonlinearFactorGraph(self.graph)
        for leg, scale in zip(self.legs, s2, strict=True):
            factor, stretch = graph.at(leg.factor), leg.axes.T @ part @ leg.axes
            model = gtsam.noiseModel.Gaussian.Covariance(scale * stretch @ leg.cov @ stretch.T)
            graph.replace(leg.factor, gtsam.BetweenFactorPose2(*factor.keys(), factor.measured(), model))
        return graph

    def by_triangle(self, free_map: FreeMap, places: Mapping[int, np.ndarray]) -> SlipByTriangle:
        """The odometry error in each triangle, from its own legs and from those around it on the same ground.

        places: vertex -> (2,) in the frame of the estimate.
        """
        if not free_map.triangles:
            return SlipByTriangle({}, {}, {})
        areas = shapely.polygons([[places[v] for v in corners] for corners in free_map.triangles.values()])
        number = {triangle: k for k, triangle in enumerate(free_map.triangles)}
        pairs = [(number[one], number[other]) for one, other, _ in free_map.adjacent_triangles()]
        found = self._variances(_shares(self.legs, areas), _hops(len(areas), pairs))
        return SlipByTriangle(*(dict(zip(number, values.tolist(), strict=True)) for values in found))

    def _variances(self, shares: csr_array, hops: coo_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(t,) variances of the distance driven, m^2 per m, their (t,) information, and (t,) of heading over belief."""
        moves = [leg for leg in self.legs if leg.distance_m > MOVED_M]
        local, information = np.ones(shares.shape[0]), np.full(shares.shape[0], PRIOR_INFORMATION)
        if not moves:
            return 0.0 * local, information, local
        s2, split, next_split, ahead, heading = np.ones(len(self.legs)), 1.0, 1.0, 1.0, 1.0
        for _ in range(PASSES):
            split = next_split
            evidence = self.evidence(s2, split)
            local, information = local_variances(evidence.all, shares, hops)
            parts = shares.sum(axis=0)
            s2 = np.where(parts > LEAST_PART, shares.T @ local / np.maximum(parts, LEAST_PART), variance(evidence.all))
            # a common factor of both components is in s2 already
            ahead = variance(evidence.ahead.relative_to(s2), 1.0)
            heading = variance(evidence.heading.relative_to(s2), 1.0)
            next_split = split * np.sqrt(ahead / heading)
        believed = sum(leg.axes[0] @ leg.cov @ leg.axes[0] for leg in moves) / sum(leg.distance_m for leg in moves)
        return local * ahead * split * believed, information, local * heading / split


def variance(squares: Squares, prior: float | None = None) -> float:
    """The s^2 that squares have in common; prior: what it is without them, with PRIOR_INFORMATION."""
    s2 = 1.0
    for _ in range(ROUNDS):
        excess, gain = (float(terms.sum()) for terms in squares.sums(s2))
        if prior is not None:
            excess, gain = excess + PRIOR_INFORMATION / prior, gain + PRIOR_INFORMATION / prior**2
        s2 = excess / gain if gain > 0 else 1.0
        s2 = max(s2, TINY)
    return s2


def local_variances(squares: Squares, shares: csr_array, hops: coo_array) -> tuple[np.ndarray, np.ndarray]:
    """(t,) s^2 of each triangle and their (t,) information.

    squares: 3 for each of n legs.  shares: (t, n), of each leg in each triangle.  hops: (t, t), 1 + steps between
    triangles that are at most REACH steps apart.
    """
    mean = variance(squares)
    s2, information = np.full(shares.shape[0], mean), np.full(shares.shape[0], PRIOR_INFORMATION)
    near, far = hops.coords
    for reach in range(REACH + 1):
        weights = np.clip(1 - ((hops.data - 1) / (reach + 1)) ** 2, 0, 1)
        if reach:
            apart = np.log(s2[near] / s2[far]) ** 2 / (2 / information[near] + 2 / information[far])
            weights *= np.clip(1 - apart / DIFFERENT, 0, 1)
        gathered = coo_array((weights, (near, far)), shape=hops.shape).tocsr() @ shares
        s2, information = _gathered(squares, gathered.tocoo(), mean, s2)
    return s2, information


def _gathered(squares: Squares, weights: coo_array, mean: float, s2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(t,) s^2 and information of each triangle from the legs that it gathered, near a first guess s2."""
    triangle, leg = weights.coords
    columns = 3 * leg[:, None] + np.arange(3)
    taken = Squares(squares.excess[columns], squares.gain[columns], squares.noise[columns])
    weight = np.minimum(weights.data, 1.0)
    for _ in range(ROUNDS):
        excess, gain = (
            np.bincount(triangle, weight * terms.sum(axis=1), len(s2)) for terms in taken.sums(s2[triangle, None])
        )
        prior = PRIOR_INFORMATION / s2**2
        s2 = np.maximum((excess + prior * mean) / (gain + prior), LEAST_OF_MEAN**2 * mean)
    return s2, (gain + prior) * s2**2


def _leg(factor: int, line: np.ndarray, measured: Pose2, cov: np.ndarray) -> Leg:
    x, y, turn = xytheta(measured)
    ahead = np.arctan2(y, x) - turn  # in the axes of the end
    return Leg(factor, line, float(np.hypot(x, y)), planar_rotation(-ahead), cov)


def _evidence(
    residuals: np.ndarray, left: np.ndarray, unwhiten: np.ndarray, s2: np.ndarray, moved: np.ndarray
) -> Evidence:
    """What (n, 3) residuals y and (n, 3, 3) covariances P of the module's docstring say of the ground.

    unwhiten: (n, 3, 3) to (ahead, aside, heading).  s2: (n,) that was assumed.  moved: (n,) legs that were not turns.
    A row a that is not an eigenvector has E (a y)^2 = s^2 |(I - P) a|^2 + a' P (I - P) a.
    """
    p, directions = np.linalg.eigh(left)
    p = np.clip(p, 0.0, 1.0)  # of what rounding left
    y = np.einsum("nij,ni->nj", directions, residuals)
    named = unwhiten[:, [0, 2]] @ directions
    rows = np.concatenate([np.broadcast_to(np.eye(3), left.shape), named], axis=1)
    rows /= np.linalg.norm(rows, axis=2, keepdims=True)
    noise = np.einsum("nki,ni->nk", rows**2, p * (1 - p))
    gain = np.einsum("nki,ni->nk", rows**2, (1 - p) ** 2) / s2[:, None]
    excess = np.einsum("nki,ni->nk", rows, y) ** 2 - noise
    return Evidence(
        Squares(excess[:, :3].ravel(), gain[:, :3].ravel(), noise[:, :3].ravel()),
        Squares(excess[:, 3], gain[:, 3] * moved, noise[:, 3]),
        Squares(excess[:, 4], gain[:, 4], noise[:, 4]),
    )


def _shares(legs: Sequence[Leg], areas: np.ndarray) -> csr_array:
    """(t, n) part of each leg that was driven in each triangle; along an edge it counts for both sides."""
    lines = shapely.linestrings(np.array([leg.line for leg in legs]).reshape(-1, 2, 2))
    length = shapely.length(lines)
    near = shapely.buffer(areas, NEAR_M)
    triangle, leg = shapely.STRtree(lines).query(near, predicate="intersects")
    inside = shapely.length(shapely.intersection(lines[leg], near[triangle]))
    share = np.where(length[leg] > MOVED_M, inside / np.maximum(length[leg], MOVED_M), 1.0)
    return coo_array((share, (triangle, leg)), shape=(len(areas), len(legs))).tocsr()


def _hops(triangles: int, pairs: Sequence[tuple[int, int]]) -> coo_array:
    """(t, t) 1 + steps between triangles that are at most REACH steps apart in the dual graph."""
    one, other = np.array(pairs, int).reshape(-1, 2).T
    ones = np.ones(2 * len(pairs))
    step = coo_array((ones, (np.r_[one, other], np.r_[other, one])), shape=(triangles, triangles)).tocsr()
    reached = hops = eye_array(triangles, format="csr")
    for distance in range(1, REACH + 1):
        new = ((reached @ step) > 0).astype(float)
        new = new - new.multiply(hops > 0)
        hops, reached = hops + (distance + 1) * new, new
    hops.eliminate_zeros()
    return hops.tocoo()
