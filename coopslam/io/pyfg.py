"""Pose graphs in the text format of PyFactorGraph (github.com/MarineRoboticsGroup/PyFactorGraph), in the plane.

    VERTEX_SE2 t A0 x y theta                    true pose 0 of robot A
    VERTEX_XY L6 x y                             true position of a landmark
    VERTEX_SE2:PRIOR t A0 x y theta C            VERTEX_XY:PRIOR t L6 x y C
    EDGE_SE2 t A0 A1 x y theta C                 EDGE_SE2_XY t A0 L6 x y C
    EDGE_RANGE t A0 L6 range variance            also between two poses

C is the upper triangle of a covariance, row by row; here it is taken in the axes in which GTSAM takes it (of the end
pose for a relative pose, of the start pose for a point). A robot is the letters before the number of its pose. The
vertices' numbers are the truth and never reach a record.
"""

import re
from math import isfinite, sqrt
from pathlib import Path

import numpy as np

from coopslam.errors import BadInput, shown
from coopslam.io.graph_log import graph_log, usable_stamps
from coopslam.io.log import Log, Truth, true_track
from coopslam.io.number_table import LARGEST_STAMP_S, read_lines
from coopslam.io.pose_graph import Distance, Node, Point, PoseGraph, PriorPoint, PriorPose, RelativePose
from coopslam.se2 import Pose2

# tag -> how many stamps, names and numbers follow it
_SHAPES = {
    "VERTEX_SE2": (1, 1, 3),
    "VERTEX_XY": (0, 1, 2),
    "VERTEX_SE2:PRIOR": (1, 1, 9),
    "VERTEX_XY:PRIOR": (1, 1, 5),
    "EDGE_SE2": (1, 2, 9),
    "EDGE_SE2_XY": (1, 2, 5),
    "EDGE_RANGE": (1, 2, 2),
}
_SPATIAL = {f"{tag}{prior}" for tag in ("VERTEX_SE3:QUAT", "VERTEX_XYZ") for prior in ("", ":PRIOR")}
_SPATIAL |= {"EDGE_SE3:QUAT", "EDGE_SE3_XYZ"}
_LONGEST_NAME = 60
_POSE_NAME = re.compile(r"([A-Za-z]+)([0-9]{1,15})")


class PyfgSource:
    """A file of PyFactorGraph. Robots are named by the letters of their poses: A, B, ..."""

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def read(self) -> Log:
        """Records of the edges and priors. Raises BadInput, with the line, for what is not in the format."""
        graph, _ = _read(self.path)
        return graph_log(self.path.name, graph, f"PyFG {self.path.name}")

    def truth(self) -> Truth | None:
        """Poses and points of the vertices, by the same stamps as the records."""
        graph, values = _read(self.path)
        usable_stamps(graph)
        tracks: dict[str, list] = {}
        for name, node in graph.poses.items():
            tracks.setdefault(node.robot, []).append((node.stamp_s, Pose2(*values[name])))
        robots = {robot: true_track(*zip(*tracks[robot], strict=True)) for robot in sorted(tracks)}
        landmarks = {landmark: np.array(values[name]) for name, landmark in graph.points.items()}
        return Truth(robots, landmarks) if robots or landmarks else None


def _read(path: Path) -> tuple[PoseGraph, dict[str, list[float]]]:
    """The graph, and the numbers of its vertices. A last line that is cut off is left out and counted."""
    lines = read_lines(path, "a pose graph of PyFactorGraph")
    graph, values = PoseGraph(), {}
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            _read_line(words, graph, values, f"{path}: line {number}", number)
        except BadInput:
            if number < len(lines):
                raise
            graph.dropped[f"line {number} is cut off"] += 1
    return graph, values


def _read_line(words: list[str], graph: PoseGraph, values: dict[str, list[float]], where: str, number: int) -> None:
    tag = words[0]
    if tag in _SPATIAL:
        raise BadInput(f"{where}: 3-D graph ({tag}, line {number}); 2-D expected")
    if tag not in _SHAPES:
        raise BadInput(f"{where}: unknown tag {shown(tag)}; expected one of {', '.join(_SHAPES)}")
    stamps, names, numbers = _SHAPES[tag]
    named = words[1 + stamps : 1 + stamps + names]
    try:
        stamp = float(words[1]) if stamps else 0.0
        found = [float(word) for word in words[1 + stamps + names :]]
    except (ValueError, IndexError):
        found = []
    if len(found) != numbers or not all(map(isfinite, found)):
        what = f"{'a stamp, ' if stamps else ''}{names} name(s) and {numbers} finite numbers"
        raise BadInput(f"{where}: {tag} takes {what}, got {shown(' '.join(words))}")
    if not abs(stamp) <= LARGEST_STAMP_S:
        raise BadInput(f"{where}: the time stamp {stamp:g}; expected seconds, at most {LARGEST_STAMP_S:g}")
    for name in named:
        if not name.isprintable() or len(name) > _LONGEST_NAME:
            raise BadInput(f"{where}: the name {shown(name)}; expected up to {_LONGEST_NAME} printable characters")
    _take(tag, stamp, named, found, graph, values, where)


def _take(tag: str, stamp: float, names: list[str], numbers: list[float], graph: PoseGraph, values, where: str) -> None:
    match tag:
        case "VERTEX_SE2":
            robot, index = _robot_and_index(names[0], where)
            graph.add_pose(where, names[0], Node(robot, index, stamp))
            values[names[0]] = numbers
        case "VERTEX_XY":
            graph.add_point(where, names[0], names[0])
            values[names[0]] = numbers
        case "VERTEX_SE2:PRIOR":
            graph.priors.append(PriorPose(where, names[0], Pose2(*numbers[:3]), _covariance(numbers[3:], where)))
        case "VERTEX_XY:PRIOR":
            graph.priors.append(PriorPoint(where, names[0], np.array(numbers[:2]), _covariance(numbers[2:], where)))
        case "EDGE_SE2":
            graph.edges.append(RelativePose(where, *names, Pose2(*numbers[:3]), _covariance(numbers[3:], where)))
        case "EDGE_SE2_XY":
            graph.edges.append(Point(where, *names, np.array(numbers[:2]), _covariance(numbers[2:], where)))
        case "EDGE_RANGE":
            range_m, variance = numbers
            if variance <= 0:
                raise BadInput(f"{where}: the variance {variance:g} of a range; expected more than zero")
            graph.edges.append(Distance(where, *names, range_m, sqrt(variance)))


def _robot_and_index(name: str, where: str) -> tuple[str, int]:
    found = _POSE_NAME.fullmatch(name)
    if found is None:
        raise BadInput(f"{where}: the pose {shown(name)}; expected letters and a number, such as A0")
    return found[1], int(found[2])


def _covariance(upper: list[float], where: str) -> np.ndarray:
    """(2, 2) or (3, 3) from its upper triangle, row by row. Raises BadInput when it is not positive definite."""
    if len(upper) == 3:
        xx, xy, yy = upper
        cov = np.array([[xx, xy], [xy, yy]])
    else:
        xx, xy, xt, yy, yt, tt = upper
        cov = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError as error:
        raise BadInput(f"{where}: the covariance {shown(upper)}; expected a positive definite one") from error
    return cov
