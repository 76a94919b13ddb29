"""Pose graphs in the g2o text format, with ids of our own choosing, and the file that says which id is which.

    VERTEX_SE2 id x y theta              VERTEX_XY id x y              FIX id
    EDGE_SE2 start end x y theta I       EDGE_SE2_XY start end x y I   EDGE_BEARING_SE2_XY start end bearing I
    EDGE_RANGE_SE2_XY start end range I

I is the upper triangle of the information matrix, row by row. A bearing to a pose (a wall between two oriented corners)
has no tag in g2o, nor has the range or the position of a pose that was seen without its heading: they are written as
EDGE_BEARING_SE2, EDGE_RANGE_SE2 and EDGE_POSITION_SE2, which other readers skip instead of misunderstanding them.
`gtsam.readG2o` reads EDGE_SE2 and skips the other edges; it drops every edge that follows a FIX or a comment, so FIX
comes last and comments are not written.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from coopslam.errors import BadInput
from coopslam.se2 import Pose2, xytheta


@dataclass(frozen=True, slots=True, eq=False)
class PoseEdge:
    """A relative pose; the information is in the axes of the end pose, as in g2o's error and `BetweenFactorPose2`."""

    start: int
    end: int
    T_start_end: Pose2
    information: np.ndarray  # (3, 3); x, y, theta


@dataclass(frozen=True, slots=True, eq=False)
class PointEdge:
    """A point, or a pose's position, as the start pose sees it; the information is in the axes of the start pose."""

    start: int
    end: int
    xy: np.ndarray  # (2,) in the frame of the start pose, m
    information: np.ndarray  # (2, 2)


@dataclass(frozen=True, slots=True, eq=False)
class BearingEdge:
    """The direction of a point, or of a pose's position, in the frame of the start pose."""

    start: int
    end: int
    bearing_rad: float
    information: float  # 1 / rad^2


@dataclass(frozen=True, slots=True, eq=False)
class RangeEdge:
    """The distance of a point, or of a pose's position, from the start pose."""

    start: int
    end: int
    range_m: float
    information: float  # 1 / m^2


G2oEdge = PoseEdge | PointEdge | BearingEdge | RangeEdge


@dataclass(frozen=True, slots=True, eq=False)
class G2oGraph:
    """What a g2o file holds, each list in the order of the file."""

    poses: list[tuple[int, Pose2]]
    points: list[tuple[int, np.ndarray]]  # (2,) each, m
    edges: list[G2oEdge]
    fixed: list[int]


def write_g2o(
    path: str | Path,
    poses: Iterable[tuple[int, Pose2]],
    points: Iterable[tuple[int, np.ndarray]],
    edges: Iterable[G2oEdge],
    fixed: Iterable[int] = (),
) -> None:
    """Vertices, then edges, then what is fixed; numbers to the last bit.

    Raises ValueError for an id that occurs twice or that an edge names in vain, and for a number that is not finite.
    """
    pose_of, point_of = _by_id(poses, points)
    lines = [_line("VERTEX_SE2", [key], xytheta(pose)) for key, pose in pose_of.items()]
    lines += [_line("VERTEX_XY", [key], point) for key, point in point_of.items()]
    lines += [_edge_line(edge, pose_of, point_of) for edge in edges]
    for key in fixed:
        if key not in pose_of and key not in point_of:
            raise ValueError(f"the fixed vertex {key} does not exist")
        lines.append(_line("FIX", [key], []))
    Path(path).write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


def write_keys(path: str | Path, mapping: Mapping[int, Mapping]) -> None:
    """JSON that says what each id in a g2o file is, e.g. {0: {"robot": "a", "index": 0}, 1: {"vertex": 3}}.

    Raises ValueError for a number that is not finite.
    """
    lines = ",\n".join(f'"{key}": {json.dumps(dict(what), allow_nan=False)}' for key, what in mapping.items())
    Path(path).write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def read_g2o(path: str | Path) -> G2oGraph:
    """Reads what `write_g2o` writes. Raises BadInput, with the line, for another tag or numbers that do not fit."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise BadInput(f"{path}: cannot read the pose graph: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: not a text file; expected g2o") from error
    graph = G2oGraph([], [], [], [])
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            _read_line(line.split(), graph, f"{path}: line {number}")
    return graph


# tag -> how many ids and how many numbers follow it
_SHAPES = {
    "VERTEX_SE2": (1, 3),
    "VERTEX_XY": (1, 2),
    "FIX": (1, 0),
    "EDGE_SE2": (2, 9),
    "EDGE_SE2_XY": (2, 5),
    "EDGE_BEARING_SE2_XY": (2, 2),
    "EDGE_BEARING_SE2": (2, 2),
    "EDGE_RANGE_SE2_XY": (2, 2),
    "EDGE_RANGE_SE2": (2, 2),
    "EDGE_POSITION_SE2": (2, 5),
}


def _read_line(words: list[str], graph: G2oGraph, where: str) -> None:
    tag = words[0]
    if tag not in _SHAPES:
        raise BadInput(f"{where}: unknown tag {tag!r}; expected one of {', '.join(_SHAPES)}")
    id_count, number_count = _SHAPES[tag]
    try:
        ids = [int(word) for word in words[1 : 1 + id_count]]
        values = [float(word) for word in words[1 + id_count :]]
    except ValueError as error:
        raise BadInput(f"{where}: {tag}: {error}") from error
    if len(ids) != id_count or len(values) != number_count or not all(map(isfinite, values)):
        raise BadInput(f"{where}: {tag} takes {id_count} id(s) and {number_count} finite numbers")
    if tag == "VERTEX_SE2":
        graph.poses.append((*ids, Pose2(*values)))
    elif tag == "VERTEX_XY":
        graph.points.append((*ids, np.array(values)))
    elif tag == "FIX":
        graph.fixed.extend(ids)
    elif tag == "EDGE_SE2":
        graph.edges.append(PoseEdge(*ids, Pose2(*values[:3]), _symmetric(values[3:], 3)))
    elif tag in ("EDGE_SE2_XY", "EDGE_POSITION_SE2"):
        graph.edges.append(PointEdge(*ids, np.array(values[:2]), _symmetric(values[2:], 2)))
    elif "BEARING" in tag:
        graph.edges.append(BearingEdge(*ids, *values))
    else:
        graph.edges.append(RangeEdge(*ids, *values))


def _by_id(poses, points) -> tuple[dict[int, Pose2], dict[int, np.ndarray]]:
    poses, points = list(poses), list(points)
    pose_of, point_of = dict(poses), dict(points)
    if len(pose_of.keys() | point_of.keys()) != len(poses) + len(points):
        raise ValueError("two vertices of a pose graph have the same id")
    return pose_of, point_of


def _edge_line(edge: G2oEdge, poses: Mapping, points: Mapping) -> str:
    ids = [edge.start, edge.end]
    if edge.start in poses:
        match edge:
            case PoseEdge() if edge.end in poses:
                return _line("EDGE_SE2", ids, [*xytheta(edge.T_start_end), *_upper_triangle(edge.information, 3)])
            case PointEdge() if edge.end in points:
                return _line("EDGE_SE2_XY", ids, [*edge.xy, *_upper_triangle(edge.information, 2)])
            case PointEdge() if edge.end in poses:
                return _line("EDGE_POSITION_SE2", ids, [*edge.xy, *_upper_triangle(edge.information, 2)])
            case RangeEdge() if edge.end in points:
                return _line("EDGE_RANGE_SE2_XY", ids, [edge.range_m, edge.information])
            case RangeEdge() if edge.end in poses:
                return _line("EDGE_RANGE_SE2", ids, [edge.range_m, edge.information])
            case BearingEdge() if edge.end in points:
                return _line("EDGE_BEARING_SE2_XY", ids, [edge.bearing_rad, edge.information])
            case BearingEdge() if edge.end in poses:
                return _line("EDGE_BEARING_SE2", ids, [edge.bearing_rad, edge.information])
    raise ValueError(f"{type(edge).__name__} {edge.start} -> {edge.end} joins vertices that do not exist")


def _line(tag: str, ids, numbers) -> str:
    numbers = [float(number) for number in numbers]
    if not all(map(isfinite, numbers)):
        raise ValueError(f"{tag} {ids} is not finite: {numbers}")
    return " ".join([tag, *(str(int(key)) for key in ids), *map(repr, numbers)])


def _upper_triangle(matrix: np.ndarray, size: int) -> np.ndarray:
    matrix = np.asarray(matrix, dtype=float)
    if matrix.shape != (size, size):
        raise ValueError(f"a ({size}, {size}) information matrix is expected, not {matrix.shape}")
    return matrix[np.triu_indices(size)]


def _symmetric(upper: list[float], size: int) -> np.ndarray:
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = upper
    return matrix + np.triu(matrix, 1).T
