"""Records as JSON text, the same bits back: `KINDS` is the format of a run log's messages.

A pose is {x, y, theta, cos, sin}: theta is for the reader, while cosine and sine, which is what a `Pose2` holds, bring
back the same pose to the last bit; without them theta counts. Covariances are full, row by row, and their names say
the axes. JSON has no NaN and no infinity: both are refused.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from json.encoder import encode_basestring_ascii
from math import atan2, isfinite, remainder, tau

import numpy as np
from gtsam import Rot2

from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerDecision,
    CornerEvidence,
    CornerSighting,
    LandmarkPrior,
    LoopClosure,
    MoveNote,
    Odometry,
    PosePrior,
    RangeFix,
    Record,
    RelativePoseFix,
    TriangleDecision,
    WallDecision,
)
from coopslam.se2 import Pose2


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a record. `say` writes JSON text; `read` takes parsed JSON. Both raise ValueError."""

    name: str  # in the record
    key: str  # in the message
    schema: dict
    say: Callable
    read: Callable


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of record: its topic in a run log and its fields."""

    topic: str
    record: type
    fields: tuple[Field, ...]

    def say(self, record: Record) -> str:
        """JSON text. Raises ValueError when a number is not finite."""
        return "{" + ",".join([f'"{f.key}":{f.say(getattr(record, f.name))}' for f in self.fields]) + "}"

    def read(self, message) -> Record:
        """The record, from parsed JSON. Raises ValueError with the field and what was expected, or BadRecord."""
        if not isinstance(message, dict):
            raise ValueError(f"expected an object, got {message!r}")
        values = {}
        for field in self.fields:
            if field.key not in message:
                raise ValueError(f"no field {field.key!r}; expected {', '.join(f.key for f in self.fields)}")
            try:
                values[field.name] = field.read(message[field.key])
            except ValueError as error:
                raise ValueError(f"{field.key}: {error}") from error
        return self.record(**values)

    def schema(self) -> dict:
        """JSON schema of a message."""
        properties = {field.key: field.schema for field in self.fields}
        described = {"title": self.record.__name__, "description": self.record.__doc__}
        return {**described, "type": "object", "properties": properties, "required": list(properties)}


def parse_json(text: str | bytes):
    """JSON without the NaN and Infinity that Python's own reader takes. Raises ValueError."""
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def number(value) -> float:
    """A finite number of parsed JSON. Raises ValueError."""
    if type(value) is float and isfinite(value):
        return value
    if type(value) is int and abs(value) < 1 << 1023:
        return float(value)
    raise ValueError(f"expected a finite number, got {value!r}")


def integer(value) -> int:
    """A whole number of parsed JSON. Raises ValueError."""
    if type(value) is not int:
        raise ValueError(f"expected an integer, got {value!r}")
    return value


def text(value) -> str:
    """A string of parsed JSON. Raises ValueError."""
    if type(value) is not str:
        raise ValueError(f"expected text, got {value!r}")
    return value


def _boolean(value) -> bool:
    if type(value) is not bool:
        raise ValueError(f"expected true or false, got {value!r}")
    return value


def _refuse_constant(name: str):
    raise ValueError(f"expected finite numbers, got {name}")


def _say_number(value) -> str:
    value = float(value)
    if not isfinite(value):
        raise ValueError(f"{value} is not a finite number")
    return repr(value)


def _say_integer(value) -> str:
    return repr(int(value))


def _say_pose(pose: Pose2) -> str:
    turn = pose.rotation()
    return f'{{"x":{pose.x()!r},"y":{pose.y()!r},"theta":{turn.theta()!r},"cos":{turn.c()!r},"sin":{turn.s()!r}}}'


def _read_pose(value) -> Pose2:
    try:
        position = np.array([number(value["x"]), number(value["y"])])
        theta = number(value["theta"])
        if "cos" not in value and "sin" not in value:
            return Pose2(Rot2(theta), position)
        cos, sin = number(value["cos"]), number(value["sin"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"expected a pose {{x, y, theta}}, got {value!r}") from error
    if abs(remainder(atan2(sin, cos) - theta, tau)) > 1e-9 or abs(cos * cos + sin * sin - 1.0) > 1e-9:
        raise ValueError(f"theta {theta} does not agree with cos {cos}, sin {sin}")
    return Pose2(Rot2.fromCosSin(cos, sin), position)


def _float(name: str) -> Field:
    return Field(name, name, {"type": "number"}, _say_number, number)


def _optional_float(name: str) -> Field:
    return Field(
        name,
        name,
        {"type": ["number", "null"]},
        lambda value: "null" if value is None else _say_number(value),
        lambda value: None if value is None else number(value),
    )


def _int(name: str) -> Field:
    return Field(name, name, {"type": "integer"}, _say_integer, integer)


def _bool(name: str) -> Field:
    return Field(name, name, {"type": "boolean"}, lambda value: "true" if value else "false", _boolean)


def _str(name: str) -> Field:
    return Field(name, name, {"type": "string"}, encode_basestring_ascii, text)


def _pose(name: str) -> Field:
    numbers = dict.fromkeys(("x", "y", "theta", "cos", "sin"), {"type": "number"})
    schema = {"type": "object", "properties": numbers, "required": ["x", "y", "theta"]}
    return Field(name, name, schema, _say_pose, _read_pose)


def _cov(name: str, *axes: str) -> Field:
    size = len(axes)
    count = size * size

    def say(cov) -> str:
        said = repr(np.asarray(cov, dtype=float).ravel().tolist())
        if "n" in said:  # nan, inf
            raise ValueError(f"{name} is not finite: {said}")
        return said

    def read(values) -> np.ndarray:
        if not isinstance(values, list) or len(values) != count:
            raise ValueError(f"expected {count} numbers, row by row, got {values!r}")
        return np.array([number(value) for value in values]).reshape(size, size)

    schema = {"type": "array", "items": {"type": "number"}, "minItems": count, "maxItems": count}
    return Field(name, f"{name}_{'_'.join(axes)}", schema, say, read)


def _point(name: str) -> Field:
    def say(point) -> str:
        return f"[{_say_number(point[0])},{_say_number(point[1])}]"

    def read(values) -> np.ndarray:
        if not isinstance(values, list) or len(values) != 2:
            raise ValueError(f"expected x and y, got {values!r}")
        return np.array([number(value) for value in values])

    schema = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
    return Field(name, name, schema, say, read)


def _triple(name: str) -> Field:
    def say(values) -> str:
        return repr([int(value) for value in values])

    def read(values) -> tuple[int, ...]:
        if not isinstance(values, list) or len(values) != 3:
            raise ValueError(f"expected three integers, got {values!r}")
        return tuple(integer(value) for value in values)

    schema = {"type": "array", "items": {"type": "integer"}, "minItems": 3, "maxItems": 3}
    return Field(name, name, schema, say, read)


def _nested(name: str, kind: Kind) -> Field:
    return Field(name, name, kind.schema(), kind.say, kind.read)


_STAMP = _float("stamp_s")
_PAIR = (_STAMP, _str("observer"), _str("target"))
_POSE_AXES = ("x", "y", "theta")

_SIGHTING = Kind(
    "corner_sighting",
    CornerSighting,
    (
        _STAMP,
        _str("observer"),
        _pose("T_observer_corner"),
        _cov("cov_observer", *_POSE_AXES),
        _float("interior_angle_rad"),
        _float("interior_angle_sigma_rad"),
    ),
)

KINDS = (
    Kind(
        "odometry",
        Odometry,
        (_float("start_s"), _STAMP, _str("robot"), _pose("T_start_now"), _cov("cov_now", *_POSE_AXES)),
    ),
    Kind("relative_pose", RelativePoseFix, (*_PAIR, _pose("T_observer_target"), _cov("cov_observer", *_POSE_AXES))),
    Kind(
        "bearing_range",
        BearingRangeFix,
        (*_PAIR, _float("bearing_rad"), _float("range_m"), _cov("cov", "bearing", "range")),
    ),
    Kind("range", RangeFix, (*_PAIR, _float("range_m"), _float("sigma_m"))),
    Kind("bearing", BearingFix, (*_PAIR, _float("bearing_rad"), _float("sigma_rad"))),
    Kind(
        "loop_closure",
        LoopClosure,
        (
            _float("earlier_s"),
            _STAMP,
            _str("earlier_robot"),
            _str("robot"),
            _pose("T_earlier_now"),
            _cov("cov_now", *_POSE_AXES),
        ),
    ),
    Kind("pose_prior", PosePrior, (_STAMP, _str("robot"), _pose("T_start_robot"), _cov("cov_robot", *_POSE_AXES))),
    Kind("landmark_prior", LandmarkPrior, (_STAMP, _str("landmark"), _point("xy"), _cov("cov", "x", "y"))),
    _SIGHTING,
    Kind(
        "corner_decision",
        CornerDecision,
        (
            _STAMP,
            _nested("sighting", _SIGHTING),
            _int("vertex"),
            _bool("is_new"),
            _optional_float("distance_sq"),
            _optional_float("runner_up_sq"),
            _str("evidence"),
        ),
    ),
    Kind(
        "corner_evidence",
        CornerEvidence,
        (_STAMP, _str("observer"), _int("vertex"), _str("done"), _float("log_odds")),
    ),
    Kind("wall_decision", WallDecision, (_STAMP, _int("start"), _int("end"), _float("straightness_sigma_rad"))),
    Kind("triangle_decision", TriangleDecision, (_STAMP, _int("triangle"), _triple("vertices"))),
    Kind("move_note", MoveNote, (_STAMP, _str("robot"), _str("watcher"), _str("move"), _str("ended"))),
)
