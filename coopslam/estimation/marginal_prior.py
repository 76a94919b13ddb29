"""What eliminated variables say about those that remain: a Gaussian in coordinates that turn with the map.

It is linearized once. Were it a Gaussian in x, y and theta of the frame, it would remember how the map lay in the frame
then; factors that are linearized where the map lies now would disagree with it, and their sum would know the heading
of the whole map, which no relative measurement tells: the estimate grows overconfident (Huang, Mourikis, Roumeliotis
2010, Observability-based rules for designing consistent EKF SLAM estimators). So all but one variable, the anchor, is
told relative to the anchor. Turn and shift the map as one piece, and only the anchor's part of the cost changes: the
other measurements are as blind to that as they were when they were made.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from coopslam.estimation.keys import is_landmark
from coopslam.se2 import wrap


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """Coordinates (K, 3) of K variables: x, y, theta of a pose; x, y and zero of a landmark.

    Of the anchor, a pose, in the frame of the estimate; of all others in the frame of the anchor.
    """

    keys: tuple[int, ...]
    sizes: tuple[int, ...]  # 3 of a pose, 2 of a landmark
    anchor: int  # its place among the keys

    def coordinates(self, values: gtsam.Values) -> np.ndarray:
        """(K, 3)"""
        return self._relative(self._absolute(values))

    def derivatives(self, values: gtsam.Values) -> tuple[np.ndarray, np.ndarray]:
        """(K, 3, 3) of each variable's coordinates by its own perturbation, and (K, 3, 3) by that of the anchor.

        Perturbations are GTSAM's: of a pose in its own axes, from the right; of a landmark in those of the frame.
        What is at y in the anchor's frame moves by -(I, J y) (anchor's perturbation), where J turns by 90 degrees.
        """
        absolute = self._absolute(values)
        relative = self._relative(absolute)
        angles = absolute[:, 2] - absolute[self.anchor, 2]
        angles[self.anchor] = absolute[self.anchor, 2]
        own, by_anchor = np.zeros((2, len(self.keys), 3, 3))
        own[:, 0, 0] = own[:, 1, 1] = np.cos(angles)
        own[:, 1, 0] = np.sin(angles)
        own[:, 0, 1] = -own[:, 1, 0]
        own[:, 2, 2] = 1.0
        by_anchor[:, (0, 1, 2), (0, 1, 2)] = -1.0
        by_anchor[:, 0, 2], by_anchor[:, 1, 2] = relative[:, 1], -relative[:, 0]
        by_anchor[self.anchor] = 0.0
        return own, by_anchor

    def _absolute(self, values: gtsam.Values) -> np.ndarray:
        """(K, 3) in the frame of the estimate."""
        rows = []
        for key, size in zip(self.keys, self.sizes, strict=True):
            if size == 3:
                pose = values.atPose2(key)
                rows.append((pose.x(), pose.y(), pose.theta()))
            else:
                rows.append((*values.atPoint2(key).tolist(), 0.0))
        return np.array(rows)

    def _relative(self, absolute: np.ndarray) -> np.ndarray:
        """(K, 3) in the frame of the anchor, but for the anchor itself."""
        here = absolute[self.anchor]
        relative = absolute - here
        c, s = np.cos(here[2]), np.sin(here[2])
        relative[:, :2] = relative[:, :2] @ np.array([[c, -s], [s, c]])
        relative[np.array(self.sizes) == 2, 2] = 0.0
        relative[self.anchor] = here
        return relative


@dataclass(frozen=True, slots=True, eq=False)
class MarginalPrior:
    """The cost |root (z - at) - rest|^2 / 2, where z are the coordinates of a chart."""

    chart: Chart
    root: np.ndarray  # (K, m, 3): square root of the information, by variable; zero in the third column of landmarks
    rest: np.ndarray  # (m,)
    at: np.ndarray  # (K, 3) where it was linearized

    def linearized(self, values: gtsam.Values) -> gtsam.GaussianConditional:
        """As a linear factor. Of those that Python can make only a conditional takes any number of keys."""
        chart = self.chart
        own, by_anchor = chart.derivatives(values)
        blocks = self.root @ own
        blocks[chart.anchor] += (self.root @ by_anchor).sum(axis=0)
        terms = [(chart.keys[k], blocks[k, :, : chart.sizes[k]]) for k in range(len(chart.keys))]
        return gtsam.GaussianConditional(
            terms, 1, -self._residual(values), gtsam.noiseModel.Unit.Create(len(self.rest))
        )

    def cost(self, values: gtsam.Values) -> float:
        """Half the squared residual."""
        return float((self._residual(values) ** 2).sum()) / 2

    def _residual(self, values: gtsam.Values) -> np.ndarray:
        """(m,)"""
        apart = self.chart.coordinates(values) - self.at
        apart[:, 2] = wrap(apart[:, 2])
        return np.einsum("kmi,ki->m", self.root, apart) - self.rest


def eliminated(linear: gtsam.GaussianFactorGraph, values: gtsam.Values, leaving: Sequence[int]) -> MarginalPrior | None:
    """What a linear graph says of its other variables, of which one is a pose, once the leaving poses are eliminated.

    None when it says nothing.  values: where it was linearized.  By a dense QR decomposition, in which nothing is
    squared; GTSAM's, because that of numpy starts threads, which are slow where other processes want the cores.
    Raises RuntimeError when a leaving pose is not tied down.
    """
    ordering = gtsam.Ordering()
    for key in leaving:
        ordering.push_back(key)
    _, remains = gtsam.EliminateQR(linear, ordering)
    if not remains.rows():
        return None
    keys = tuple(remains.keys())
    sizes = tuple(2 if is_landmark(key) else 3 for key in keys)
    chart = Chart(keys, sizes, sizes.index(3))
    matrix, rest = remains.jacobian()
    blocks, end = np.zeros((len(keys), len(rest), 3)), 0
    for k, size in enumerate(sizes):
        blocks[k, :, :size] = matrix[:, end : end + size]
        end += size
    own, by_anchor = chart.derivatives(values)
    root = blocks @ own.transpose(0, 2, 1)
    root[chart.anchor] = (blocks[chart.anchor] - (root @ by_anchor).sum(axis=0)) @ own[chart.anchor].T
    return MarginalPrior(chart, root, rest, chart.coordinates(values))
