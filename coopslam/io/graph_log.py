"""A pose graph as a log: every edge as the record that says the same."""

from collections.abc import Hashable, Mapping
from itertools import pairwise

import numpy as np

from coopslam.errors import BadInput, BadRecord
from coopslam.io.log import Log
from coopslam.io.pose_graph import (
    Direction,
    Distance,
    Edge,
    Node,
    Point,
    PoseGraph,
    PriorPoint,
    PriorPose,
    RelativePose,
)
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    LandmarkPrior,
    LogHeader,
    LoopClosure,
    Odometry,
    PosePrior,
    RangeFix,
    Record,
    RelativePoseFix,
)
from coopslam.se2 import Pose2, chain_covariance, inverse_covariance, observer_to_target_axes, position, rotation

UNKNOWN_SIGMAS = (1e3, 1e3, np.pi)  # m, m, rad; of a motion that no edge measures


def graph_log(name: str, graph: PoseGraph, provenance: str) -> Log:
    """The log of a graph: robots by name, records by stamp. Adds to `graph.dropped`.

    Consecutive poses of a robot are odometry; where no edge joins them the motion is unknown, and counted. The first
    pose of the first robot is the origin: a prior on it is where that is in the file's frame, not a record.
    Raises BadInput, with the edge, when a number in it cannot be.
    """
    if not graph.poses or not graph.edges:
        raise BadInput(f"{name}: no {'edges' if graph.poses else 'poses'} in it; expected a pose graph")
    graph.check()
    usable_stamps(graph)
    walks = _walks(graph.poses)
    records = _Records(graph, walks).all()
    landmarks = set(graph.points.values()) & {_landmark(record) for record in records}
    try:
        header = LogHeader(
            tuple(walks), tuple(sorted(landmarks, key=lambda mark: (len(mark), mark))), provenance=provenance
        )
    except BadRecord as error:
        raise BadInput(f"{name}: {error}") from error
    return Log(name, header, records, graph.dropped)


def usable_stamps(graph: PoseGraph) -> None:
    """Give every pose its index as stamp when the stamps of some robot don't ascend, and count that."""
    for nodes in _walks(graph.poses).values():
        stays = [graph.poses[node] for node in nodes]
        if any(later.stamp_s <= earlier.leaves_s for earlier, later in pairwise(stays)):
            graph.dropped["stamps: those of a robot do not ascend; the numbers of the poses are taken instead"] += 1
            for node, pose in graph.poses.items():
                graph.poses[node] = Node(pose.robot, pose.index, float(pose.index))
            return


def _walks(poses: Mapping[Hashable, Node]) -> dict[str, list[Hashable]]:
    """Robot, by name -> its nodes in the order of their indices."""
    walks: dict[str, list[Hashable]] = {robot: [] for robot in sorted({node.robot for node in poses.values()})}
    for key, node in sorted(poses.items(), key=lambda item: item[1].index):
        walks[node.robot].append(key)
    return walks


class _Records:
    """The records of one graph."""

    def __init__(self, graph: PoseGraph, walks: dict[str, list[Hashable]]):
        self.graph, self.walks = graph, walks
        self.next = {node: after for nodes in walks.values() for node, after in pairwise(nodes)}
        self.driven: set[Hashable] = set()  # nodes from which odometry leads on

    def all(self) -> list[Record]:
        """By stamp; of those at one instant odometry first, since it leads to the pose that the others concern."""
        records = []
        for edge in self.graph.edges:
            records.append(self._told(edge, self._of_edge))
        origin = self._origin()
        for prior in self.graph.priors:
            if prior is not origin:
                records.append(self._told(prior, lambda prior: self._of_prior(prior, origin)))
        records += self._bridges()
        used = [record for record in records if record is not None]
        return sorted(used, key=lambda record: (record.stamp_s, not isinstance(record, Odometry)))

    def _told(self, item, make) -> Record | None:
        """What `make` makes of an edge or prior. Raises BadInput where the record itself would be refused."""
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # what overflows is no record either
                return make(item)
        except BadRecord as error:
            raise BadInput(f"{item.where}: {error}") from error

    def _of_edge(self, edge: Edge) -> Record | None:
        if edge.start == edge.end:
            return self._drop("edge: joins a pose to itself")
        if isinstance(edge, RelativePose):
            return self._relative_pose(edge)
        observer, stamp = self.graph.poses[edge.start].robot, self.graph.poses[edge.start].stamp_s
        target = self.graph.points.get(edge.end)
        if target is None:
            seen, stamp = self.graph.poses[edge.end], self._both_there_s(edge)
            if seen.robot == observer or stamp is None:
                return self._drop("edge: a sighting between poses at different times")
            target = seen.robot
        if isinstance(edge, Distance):
            return RangeFix(stamp, observer, target, edge.range_m, edge.sigma_m)
        if isinstance(edge, Direction):
            return BearingFix(stamp, observer, target, edge.bearing_rad, edge.sigma_rad)
        return self._bearing_range(edge, stamp, observer, target)

    def _bearing_range(self, edge: Point, stamp: float, observer: str, target: str) -> BearingRangeFix | None:
        """A point in polar coordinates; to first order its covariance is J cov J', J the derivative of the change."""
        (x, y), range_m = edge.xy.tolist(), float(np.hypot(*edge.xy))
        if range_m == 0.0:
            return self._drop("bearing_range: range zero")
        jacobian = np.array([[-y / range_m / range_m, x / range_m / range_m], [x / range_m, y / range_m]])
        cov = jacobian @ edge.cov_start @ jacobian.T
        return BearingRangeFix(stamp, observer, target, float(np.arctan2(y, x)), range_m, cov)

    def _relative_pose(self, edge: RelativePose) -> Odometry | RelativePoseFix | LoopClosure:
        if self._is_later(edge.start, edge.end):
            T_end_start, cov_start = edge.T_start_end.inverse(), inverse_covariance(edge.T_start_end, edge.cov_end)
            edge = RelativePose(edge.where, edge.end, edge.start, T_end_start, cov_start)
        start, end = self.graph.poses[edge.start], self.graph.poses[edge.end]
        if self.next.get(edge.start) == edge.end and edge.start not in self.driven:
            self.driven.add(edge.start)
            return Odometry(start.leaves_s, end.stamp_s, start.robot, edge.T_start_end, edge.cov_end)
        both_there_s = self._both_there_s(edge)
        if both_there_s is not None and start.robot != end.robot:
            cov_observer = observer_to_target_axes(edge.T_start_end.inverse(), edge.cov_end)  # and back again
            return RelativePoseFix(both_there_s, start.robot, end.robot, edge.T_start_end, cov_observer)
        return LoopClosure(start.stamp_s, end.stamp_s, start.robot, end.robot, edge.T_start_end, edge.cov_end)

    def _both_there_s(self, edge: Edge) -> float | None:
        """The first instant at which robots are at both ends of an edge; None when there is none."""
        start, end = self.graph.poses[edge.start], self.graph.poses[edge.end]
        stamp_s = max(start.stamp_s, end.stamp_s)
        return stamp_s if stamp_s <= min(start.leaves_s, end.leaves_s) else None

    def _is_later(self, start: Hashable, end: Hashable) -> bool:
        return self.graph.poses[start].stamp_s > self.graph.poses[end].stamp_s

    def _bridges(self) -> list[Odometry]:
        """Unknown motion between consecutive poses of a robot that no edge joins."""
        cov = np.diag(np.square(UNKNOWN_SIGMAS))
        bridges = []
        for node, after in self.next.items():
            if node not in self.driven:
                start, end = self.graph.poses[node], self.graph.poses[after]
                bridges.append(Odometry(start.leaves_s, end.stamp_s, start.robot, Pose2(), cov))
                self._drop("odometry: none between consecutive poses; taken as unknown motion")
        return bridges

    def _origin(self) -> PriorPose | None:
        """The prior on the first pose of the first robot."""
        first = next(iter(self.walks.values()))[0]
        found = (prior for prior in self.graph.priors if isinstance(prior, PriorPose) and prior.node == first)
        return next(found, None)

    def _of_prior(self, prior: PriorPose | PriorPoint, origin: PriorPose | None) -> Record | None:
        """A prior in the frame of the first robot's start; how well that start is known adds to its covariance."""
        if origin is None:
            return self._drop("prior: none on the first pose of the first robot, which is the origin")
        if isinstance(prior, PriorPose):
            node = self.graph.poses[prior.node]
            T_start_robot = origin.T_file_node.between(prior.T_file_node)
            cov = chain_covariance(T_start_robot, origin.cov_node, prior.cov_node)
            return PosePrior(node.stamp_s, node.robot, T_start_robot, cov)
        first = self.graph.poses[origin.node]
        turn = rotation(-origin.T_file_node.theta())
        xy = turn @ (prior.xy - position(origin.T_file_node))
        lever = np.array([[1.0, 0.0, -xy[1]], [0.0, 1.0, xy[0]]])
        cov = turn @ prior.cov @ turn.T + lever @ origin.cov_node @ lever.T
        return LandmarkPrior(first.stamp_s, self.graph.points[prior.node], xy, cov)

    def _drop(self, what: str) -> None:
        self.graph.dropped[what] += 1


def _landmark(record: Record) -> str | None:
    return getattr(record, "landmark", getattr(record, "target", None))
