"""The axes of a study: what each value is called, where it stands on a picture, and which settings it changes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

from coopslam.errors import BadInput
from coopslam.io.toml import from_mapping

UNITS = {  # last part of a setting's name -> unit; longest first
    "_m_per_s": "m/s",
    "_rad_per_s": "rad/s",
    "_per_m": "per m",
    "_rad": "rad",
    "_s": "s",
    "_m": "m",
}


@dataclass(frozen=True, slots=True)
class Changes:
    """What a value does to the settings, by dotted name."""

    settings: dict[str, Any] = field(default_factory=dict)
    factors: dict[str, float] = field(default_factory=dict)  # of a setting, or of every number in a table


@dataclass(frozen=True, slots=True)
class AxisValue:
    """A value under the name that it has in the table of results."""

    label: str
    at: float | None  # its place on a numeric axis
    changes: Changes


@dataclass(frozen=True, slots=True)
class Axis:
    """A quantity that the study varies."""

    name: str  # of its column
    unit: str
    values: tuple[AxisValue, ...]


@dataclass(frozen=True, slots=True)
class AxisTable:
    """The keys of an [[axes]] table: `setting` is varied, or what `scale` names is multiplied, or values are tables."""

    values: tuple[Any, ...]
    name: str = ""
    setting: str = ""
    scale: tuple[str, ...] = ()
    unit: str = ""


def parse_axes(given: Any, where: str) -> tuple[Axis, ...]:
    """Axes from `[axes]` (setting -> values) or `[[axes]]` (tables). Raises BadInput."""
    if isinstance(given, Mapping):
        tables = [{"setting": name, "values": values} for name, values in flattened(given).items()]
    else:
        tables = given
    if not isinstance(tables, list | tuple):
        raise BadInput(f"{where}: axes: a table of settings with values, or tables [[axes]], expected, got {given!r}")
    axes = tuple(_axis(table, f"{where}: axis {i}") for i, table in enumerate(tables, 1))
    owner = {}
    for axis in axes:
        for name in {name for value in axis.values for name in value.changes.settings}:
            if name in ("world", "seed"):
                raise BadInput(f"{where}: axis {axis.name!r}: a study says this with its key '{name}s'")
            if owner.setdefault(name, axis) is not axis:
                raise BadInput(f"{where}: {name} is changed by the axes {owner[name].name!r} and {axis.name!r}")
    names = [axis.name for axis in axes]
    if len(set(names)) < len(names):
        raise BadInput(f"{where}: axes: different names expected, got {', '.join(names)}")
    return axes


def flattened(mapping: Mapping, prefix: str = "") -> dict[str, Any]:
    """Nested tables as dotted names."""
    flat = {}
    for key, value in mapping.items():
        flat |= flattened(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def _axis(table: Any, where: str) -> Axis:
    given = from_mapping(AxisTable, table, where)
    if given.setting and given.scale:
        raise BadInput(f"{where}: either 'setting' or 'scale' expected, got both")
    name = given.name or given.setting
    if not name:
        raise BadInput(f"{where}: a 'name' or a 'setting' expected")
    if not given.values:
        raise BadInput(f"{where} ({name}): values: at least one expected, got none")
    values = tuple(_value(value, given, f"{where} ({name})") for value in given.values)
    labels = [value.label for value in values]
    if len(set(labels)) < len(labels):
        raise BadInput(f"{where} ({name}): values: each one once expected, got {', '.join(labels)}")
    return Axis(name, given.unit or ("" if given.scale else _unit(given.setting)), values)


def _value(value: Any, axis: AxisTable, where: str) -> AxisValue:
    if isinstance(value, Mapping):
        return _labelled(value, where)
    at = float(value) if type(value) in (int, float) else None
    if axis.scale:
        if at is None or not (isfinite(at) and at > 0):
            raise BadInput(f"{where}: a factor of more than zero expected, got {value!r}")
        return AxisValue(f"x{value}", at, Changes(factors=dict.fromkeys(axis.scale, at)))
    if not axis.setting:
        raise BadInput(f"{where}: without 'setting' or 'scale' each value is a table with a label, got {value!r}")
    return AxisValue(str(value), at, Changes({axis.setting: value}))


def _labelled(table: Mapping, where: str) -> AxisValue:
    """A value that changes several settings: `label`, perhaps `at`, and the settings."""
    settings = flattened(table)
    label, at = settings.pop("label", None), settings.pop("at", None)
    if not isinstance(label, str) or not label.strip():
        raise BadInput(f"{where}: a value that is a table needs a 'label', got {dict(table)!r}")
    if at is not None and (type(at) not in (int, float) or not isfinite(at)):
        raise BadInput(f"{where}: {label}: at: a finite number expected, got {at!r}")
    if not settings:
        raise BadInput(f"{where}: {label}: no setting is changed; expected 'true_noise.odometry...' or the like")
    return AxisValue(label, None if at is None else float(at), Changes(settings))


def _unit(setting: str) -> str:
    return next((unit for ending, unit in UNITS.items() if setting.endswith(ending)), "")
