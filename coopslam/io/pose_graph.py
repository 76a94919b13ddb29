"""Other people's pose graphs: which poses exist, of which robot and when, and what was measured between them.

No guesses and no truth. The readers of formats (PyFG, g2o) make one; `graph_log` turns it into a log.
"""

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np

from coopslam.errors import BadInput
from coopslam.se2 import Pose2


@dataclass(frozen=True, slots=True)
class Node:
    """A pose of a robot."""

    robot: str
    index: int  # order of the robot's poses
    stamp_s: float
    until_s: float | None = None  # the robot stands there until then; None: it drives on at once

    @property
    def leaves_s(self) -> float:
        """When the robot drives on."""
        return self.stamp_s if self.until_s is None else self.until_s


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """A pose as another pose measures it."""

    where: str  # file and line, for messages
    start: Hashable
    end: Hashable
    T_start_end: Pose2
    cov_end: np.ndarray  # (3, 3); axes of the end pose


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """A point, or the position of a pose, as a pose sees it."""

    where: str
    start: Hashable
    end: Hashable
    xy: np.ndarray  # (2,) in the frame of the start pose, m
    cov_start: np.ndarray  # (2, 2); axes of the start pose


@dataclass(frozen=True, slots=True, eq=False)
class Distance:
    """Distance from a pose to a point or another pose."""

    where: str
    start: Hashable
    end: Hashable
    range_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Direction:
    """Direction of a point, or of the position of a pose, in the frame of the start pose."""

    where: str
    start: Hashable
    end: Hashable
    bearing_rad: float
    sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class PriorPose:
    """A pose in the frame of the file."""

    where: str
    node: Hashable
    T_file_node: Pose2
    cov_node: np.ndarray  # (3, 3); axes of the pose


@dataclass(frozen=True, slots=True, eq=False)
class PriorPoint:
    """A point in the frame of the file."""

    where: str
    node: Hashable
    xy: np.ndarray  # (2,)
    cov: np.ndarray  # (2, 2); axes of the file


Edge = RelativePose | Point | Distance | Direction


@dataclass(slots=True, eq=False)
class PoseGraph:
    """What a file holds; nodes are named as the file names them."""

    poses: dict[Hashable, Node] = field(default_factory=dict)
    points: dict[Hashable, str] = field(default_factory=dict)  # node -> name of the landmark
    edges: list[Edge] = field(default_factory=list)
    priors: list[PriorPose | PriorPoint] = field(default_factory=list)
    dropped: Counter[str] = field(default_factory=Counter)
    _taken: set = field(default_factory=set)  # (robot, index) of the poses, names of the landmarks

    def add_pose(self, where: str, node: Hashable, pose: Node) -> None:
        """A pose. Raises BadInput for a node, or a number of a pose of the robot, that is there already."""
        if node in self.poses or node in self.points or (pose.robot, pose.index) in self._taken:
            raise BadInput(f"{where}: {node} is there already; expected every vertex once")
        self._taken.add((pose.robot, pose.index))
        self.poses[node] = pose

    def add_point(self, where: str, node: Hashable, landmark: str) -> None:
        """A landmark. Raises BadInput for a node that is there already."""
        if node in self.poses or node in self.points or landmark in self._taken:
            raise BadInput(f"{where}: {node} is there already; expected every vertex once")
        self._taken.add(landmark)
        self.points[node] = landmark

    def check(self) -> None:
        """Raises BadInput for an edge or prior between vertices that do not exist or are not of its kind."""
        for edge in self.edges:
            self._require(edge.where, edge.start, self.poses, "pose")
            if isinstance(edge, RelativePose):
                self._require(edge.where, edge.end, self.poses, "pose")
            elif edge.end not in self.points:
                self._require(edge.where, edge.end, self.poses, "pose or landmark")
        for prior in self.priors:
            known, kind = (self.poses, "pose") if isinstance(prior, PriorPose) else (self.points, "landmark")
            self._require(prior.where, prior.node, known, kind)

    def _require(self, where: str, node: Hashable, known: dict, kind: str) -> None:
        if node not in known:
            raise BadInput(f"{where}: there is no vertex {node} that is a {kind}; expected vertices of the file")
