"""Poses that a filter does not hold: of robots that have no place in its frame yet, and those that robots have left.

A robot that is placed late brings all that it has driven before. Its odometry, and what joined it to other robots, hang
together as a tree, along which relative poses and their covariances compose.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coopslam.estimation.tracks import Edge
from coopslam.se2 import Pose2, adjoint, chain_covariance, compose_leg, inverse_covariance


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """Poses that hang on one pose of the filter, the root, with errors of their own, as if the root were sure."""

    T_root: dict[int, Pose2]  # by key, in the axes of the root, in the order of their distance from it
    cov: dict[int, np.ndarray]  # (3, 3) in the axes of each pose
    parent: dict[int, int | None]

    def joint_covariance(self, keys: Sequence[int]) -> np.ndarray:
        """(3 N, 3 N), each pose in its own axes: two poses share the error of the last one that both descend from."""
        return np.block([[self._cross(a, b) for b in keys] for a in keys])

    def _cross(self, a: int, b: int) -> np.ndarray:
        ancestors = set(self._line(a))
        common = next((key for key in self._line(b) if key in ancestors), None)
        if common is None:
            return np.zeros((3, 3))
        carry_a = adjoint(self.T_root[a].between(self.T_root[common]))
        carry_b = adjoint(self.T_root[b].between(self.T_root[common]))
        return carry_a @ self.cov[common] @ carry_b.T

    def _line(self, key: int | None):
        while key is not None:
            yield key
            key = self.parent[key]


class Tree:
    """Odometry legs of all robots, and the relative poses that joined robots of which none is placed yet."""

    def __init__(self):
        self._legs: dict[int, Edge] = {}  # by the key at the start
        self._open: dict[int, list[Edge]] = defaultdict(list)  # by both keys: edges between poses that are not placed

    def add_leg(self, leg: Edge) -> None:
        """Odometry of a placed robot, from one of its poses to the next."""
        self._legs[leg.key_a] = leg

    def add_open(self, edge: Edge, is_leg: bool) -> None:
        """An edge between two poses that are not placed."""
        self._open[edge.key_a].append(edge)
        self._open[edge.key_b].append(edge)
        if is_leg:
            self.add_leg(edge)

    def way_back(self, key: int, latest: int) -> tuple[Pose2, np.ndarray]:
        """T_latest_key of a robot, by odometry, and its covariance (3, 3) in the axes of the earlier pose."""
        deltas, covariances = [], []
        while key != latest:
            leg = self._legs[key]
            deltas.append(leg.T_a_b)
            covariances.append(leg.cov_b)
            key = leg.key_b
        T_key_latest, cov = compose_leg(deltas, covariances)
        return T_key_latest.inverse(), inverse_covariance(T_key_latest, cov)

    def take(self, key: int, T_root_key: Pose2, cov: np.ndarray) -> Branch:
        """Everything that hangs on a pose that gets its place now. cov: (3, 3) in the axes of that pose."""
        branch = Branch({key: T_root_key}, {key: cov}, {key: None})
        reached = [key]
        for start in reached:
            for edge in self._open.pop(start, ()):
                end, T, cov_end = seen_from(start, edge)
                if end in branch.parent:
                    continue
                branch.T_root[end] = branch.T_root[start] * T
                branch.cov[end] = chain_covariance(T, branch.cov[start], cov_end)
                branch.parent[end] = start
                reached.append(end)
        return branch


def seen_from(key: int, edge: Edge) -> tuple[int, Pose2, np.ndarray]:
    """The other end of an edge, where it is as seen from this one, and the covariance in the other end's axes."""
    if key == edge.key_a:
        return edge.key_b, edge.T_a_b, edge.cov_b
    return edge.key_a, edge.T_a_b.inverse(), inverse_covariance(edge.T_a_b, edge.cov_b)
