"""A g2o file of several robots as a log: measurements only, since its vertices are somebody's guesses.

Which vertex is whose: the file STEM.keys.json beside it says so, as a run directory has one; otherwise the highest byte
of an id, when it is the letter of a GTSAM symbol, is the robot; otherwise all poses are those of one robot.
"""

from math import sqrt
from pathlib import Path

import numpy as np

from coopslam.errors import BadInput, shown
from coopslam.io.g2o import BearingEdge, G2oEdge, G2oGraph, PointEdge, PoseEdge, RangeEdge, read_g2o
from coopslam.io.geojson import read_json
from coopslam.io.graph_log import graph_log
from coopslam.io.log import Log, Truth
from coopslam.io.number_table import LARGEST_STAMP_S, is_there
from coopslam.io.pose_graph import Direction, Distance, Edge, Node, Point, PoseGraph, RelativePose

ONE_ROBOT = "robot"
_INDEX_BITS = 56  # of a GTSAM symbol; its letter is in the byte above


class G2oSource:
    """A pose graph. When a robot was at a pose is what the keys file says, or else the pose's number."""

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def read(self) -> Log:
        """Records of the edges. Raises BadInput, with line, edge or vertex, for what cannot be used."""
        read = read_g2o(self.path)
        graph = PoseGraph()
        _add_vertices(self.path, read, graph)
        graph.edges = [_edge(edge, f"{self.path}: edge {edge.start} -> {edge.end}") for edge in read.edges]
        log = graph_log(self.path.name, graph, f"g2o {self.path.name}")
        first = min(graph.poses, key=lambda node: (graph.poses[node].robot, graph.poses[node].index))
        others = sum(node != first for node in read.fixed)
        if others:
            log.dropped["FIX: a vertex other than the first pose of the first robot, which is the origin"] += others
        return log

    def truth(self) -> Truth | None:
        """None: a g2o file has none."""
        return None


def _add_vertices(path: Path, read: G2oGraph, graph: PoseGraph) -> None:
    keys_path = path.with_name(f"{path.stem}.keys.json")
    keys = _read_keys(keys_path) if is_there(keys_path) else None
    for node, _ in read.poses:
        where = f"{path}: vertex {node}"
        if not 0 <= node < 1 << 64:
            raise BadInput(f"{where}: expected an id of zero or more, below 2^64")
        graph.add_pose(where, node, _by_symbol(node) if keys is None else _by_key(node, keys, keys_path))
    for node, _ in read.points:
        where = f"{path}: vertex {node}"
        if not 0 <= node < 1 << 64:
            raise BadInput(f"{where}: expected an id of zero or more, below 2^64")
        name = (keys or {}).get(node, {}).get("landmark", _symbol(node, "landmark"))
        if not _is_name(name):
            raise BadInput(f"{keys_path}: id {node}: the landmark {shown(name)}; expected a name")
        graph.add_point(where, node, name)


def _by_symbol(node: int) -> Node:
    letter = _letter(node)
    index = node & ((1 << _INDEX_BITS) - 1) if letter else node
    return Node(letter or ONE_ROBOT, index, float(index))


def _symbol(node: int, otherwise: str) -> str:
    letter = _letter(node)
    return f"{letter}{node & ((1 << _INDEX_BITS) - 1)}" if letter else f"{otherwise}{node}"


def _letter(node: int) -> str:
    """The letter of a GTSAM symbol; empty when the id is none."""
    letter = chr(node >> _INDEX_BITS)
    return letter if letter.isascii() and letter.isalpha() else ""


def _by_key(node: int, keys: dict[int, dict], keys_path: Path) -> Node:
    key, where = keys.get(node), f"{keys_path}: id {node}"
    if key is None:
        raise BadInput(f"{where} is missing; expected what each vertex of the graph is")
    if "robot" not in key:
        what = "map corners and other vertices with a direction are no landmarks of a log; read the run's log.mcap"
        raise BadInput(f"{where} is {shown(key)}, not a robot's pose: {what}")
    robot, index = key["robot"], key.get("index")
    if not _is_name(robot):
        raise BadInput(f"{where}: the robot {shown(robot)}; expected a name")
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < 1 << 64:
        raise BadInput(f"{where}: the index {shown(index)}; expected a whole number, zero or more")
    stamp = _seconds(where, "stamp_s", key.get("stamp_s", index))
    until = _seconds(where, "until_s", key.get("until_s", stamp))
    if until < stamp:
        raise BadInput(f"{where}: until_s {until:g} lies before stamp_s {stamp:g}; expected a later instant")
    return Node(robot, index, stamp, until)


def _seconds(where: str, field: str, value) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= LARGEST_STAMP_S:
        raise BadInput(f"{where}: {field} {shown(value)}; expected seconds, at most {LARGEST_STAMP_S:g}")
    return float(value)


def _is_name(value) -> bool:
    return isinstance(value, str) and 0 < len(value) <= 60 and value.isprintable()


def _read_keys(path: Path) -> dict[int, dict]:
    keys = read_json(path)
    if not isinstance(keys, dict) or not all(isinstance(key, dict) for key in keys.values()):
        raise BadInput(f'{path}: expected an object such as {{"0": {{"robot": "a", "index": 0}}}}')
    try:
        return {int(node): key for node, key in keys.items()}
    except ValueError as error:
        raise BadInput(f"{path}: {error}; expected the ids of vertices as keys") from error


def _edge(edge: G2oEdge, where: str) -> Edge:
    match edge:
        case PoseEdge():
            return RelativePose(where, edge.start, edge.end, edge.T_start_end, _inverse(edge.information, where))
        case PointEdge():
            return Point(where, edge.start, edge.end, edge.xy, _inverse(edge.information, where))
        case BearingEdge():
            if edge.information <= 0:
                raise BadInput(f"{where}: the information {edge.information:g}; expected more than zero")
            return Direction(where, edge.start, edge.end, edge.bearing_rad, 1.0 / sqrt(edge.information))
        case RangeEdge():
            if edge.information <= 0:
                raise BadInput(f"{where}: the information {edge.information:g}; expected more than zero")
            return Distance(where, edge.start, edge.end, edge.range_m, 1.0 / sqrt(edge.information))


def _inverse(information: np.ndarray, where: str) -> np.ndarray:
    """The covariance. Raises BadInput for an information matrix that has no positive definite inverse."""
    try:
        np.linalg.cholesky(information)
        with np.errstate(all="ignore"):
            cov = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        cov = np.full_like(information, np.nan)
    if not np.isfinite(cov).all():
        numbers = shown(information[np.triu_indices(len(information))].tolist())
        raise BadInput(f"{where}: the information matrix {numbers} has no inverse; expected a positive definite one")
    return (cov + cov.T) / 2
