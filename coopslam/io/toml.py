"""Settings: TOML files to and from nested frozen dataclasses; an unknown key or a wrong type is said with its place.

TOML has no null: a setting that is None is left out, which is why its default must be None. A field of a dataclass may
be `inf` when its metadata says {"infinite": True}.
"""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from math import inf, isfinite
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import tomli_w

from coopslam.errors import BadInput, CoopSlamError, shown

T = TypeVar("T")

_LARGEST_INTEGER = 2**63 - 1  # that TOML promises to carry
_SCALARS = {float: "number", int: "integer", bool: "true or false", str: "text"}


def load_toml(path: str | Path) -> dict[str, Any]:
    """What a TOML file holds. Raises BadInput with file and line."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise BadInput(f"{path}: cannot read the settings: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: not a text file; expected TOML") from error
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise BadInput(f"{path}: not valid TOML: {' '.join(str(error).split())}") from error


def dump_toml(mapping: Mapping[str, Any]) -> str:
    """TOML text of nested mappings, lists, text, numbers and booleans; what is None is left out."""
    return tomli_w.dumps(_without_none(mapping))


def from_mapping(cls: type[T], mapping: Mapping[str, Any], where: str) -> T:
    """A dataclass, nested ones included, from parsed TOML.

    where: the file, for messages. Fields may be float, int, bool, str, Enum, Literal, dataclasses, tuples, lists and
    dicts of these, or any of them | None. Raises BadInput for an unknown or missing key, a wrong type, a number that
    is not finite, and for whatever the dataclass itself refuses: one line with the file and the dotted key.
    """
    return _build(cls, mapping, where, ())


def to_mapping(settings) -> dict[str, Any]:
    """The nested mapping of a dataclass, without what is None.

    Raises ValueError when a field is None but not by default: TOML cannot say that.
    """
    mapping = {}
    for field in fields(settings):
        value = getattr(settings, field.name)
        if value is not None:
            mapping[field.name] = _plain(value)
        elif field.default is not None:
            raise ValueError(f"{type(settings).__name__}.{field.name} is None, which TOML cannot say")
    return mapping


def _build(cls, mapping, where: str, path: tuple[str, ...]):
    place = _section(where, path)
    if not isinstance(mapping, Mapping):
        raise BadInput(f"{place} expected a table, got {shown(mapping)}")
    known = {field.name: field for field in fields(cls) if field.init}
    for key in mapping:
        if key not in known:
            raise BadInput(f"{place} unknown key {shown(key)}; known keys: {', '.join(known)}")
    for name, field in known.items():
        if name not in mapping and field.default is MISSING and field.default_factory is MISSING:
            raise BadInput(f"{place} no key {name!r}; expected {', '.join(known)}")
    hints = get_type_hints(cls)
    values = {}
    for key, value in mapping.items():
        if known[key].metadata.get("infinite") and type(value) is float and value == inf:
            values[key] = value
        else:
            values[key] = _convert(hints[key], value, where, (*path, key))
    try:
        return cls(**values)
    except CoopSlamError as error:
        if re.match(r"\w*", str(error)).group() in known:
            raise BadInput(f"{where}: {''.join(f'{table}.' for table in path)}{error}") from error
        raise BadInput(f"{place} {error}") from error


def _convert(hint, value, where: str, path: tuple[str, ...]):
    """`value` as the annotation `hint` wants it."""
    origin, inner = get_origin(hint), get_args(hint)
    if is_dataclass(hint):
        return _build(hint, value, where, path)
    if hint is Any:
        return value
    if hint in _SCALARS:
        return _scalar(hint, value, where, path)
    if isinstance(hint, type) and issubclass(hint, Enum):
        choices = {member.value: member for member in hint}
        return choices[_choice(list(choices), value, where, path)]
    if origin is Literal:
        return _choice(list(inner), value, where, path)
    if origin in (Union, UnionType):
        some = [choice for choice in inner if choice is not NoneType]
        if len(some) == 1:
            return _convert(some[0], value, where, path)
    if origin is tuple and not (len(inner) == 2 and inner[1] is Ellipsis):
        if not isinstance(value, list | tuple) or len(value) != len(inner):
            raise _wrong(f"a list of {len(inner)}", value, where, path)
        return tuple(_convert(each, item, where, path) for each, item in zip(inner, value, strict=True))
    if origin in (list, tuple):
        if not isinstance(value, list | tuple):
            raise _wrong("a list", value, where, path)
        return origin(_convert(inner[0], item, where, path) for item in value)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise _wrong("a table", value, where, path)
        return {key: _convert(inner[1], item, where, (*path, key)) for key, item in value.items()}
    raise TypeError(f"settings cannot hold {hint} ({'.'.join(path)})")


def _scalar(kind: type, value, where: str, path: tuple[str, ...]):
    accepted = (float, int) if kind is float else (kind,)
    if type(value) not in accepted:
        raise _wrong(_SCALARS[kind], value, where, path)
    if kind is float and not (abs(value) < 1e308 if type(value) is int else isfinite(value)):
        raise _wrong("finite number", value, where, path)
    if kind is int and abs(value) > _LARGEST_INTEGER:
        raise _wrong("integer of 64 bits", value, where, path)
    return kind(value)


def _choice(choices: list, value, where: str, path: tuple[str, ...]):
    for choice in choices:
        if type(choice) is type(value) and choice == value:
            return choice
    raise _wrong(f"one of {', '.join(map(repr, choices))}", value, where, path)


def _wrong(expected: str, value, where: str, path: tuple[str, ...]) -> BadInput:
    return BadInput(f"{where}: {'.'.join(path)}: expected {expected}, got {shown(value)}")


def _section(where: str, path: tuple[str, ...]) -> str:
    return f"{where}: [{'.'.join(path)}]" if path else f"{where}:"


def _plain(value):
    if is_dataclass(value):
        return to_mapping(value)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def _without_none(value):
    if isinstance(value, Mapping):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value if item is not None]
    return value
