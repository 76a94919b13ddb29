"""The axes of a study: what each value is called, where it stands on a picture, and which settings it changes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

from coopslam.errors import BadInput
from coopslam.io.toml import from_mapping
from sim.world_checks import short

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
        raise BadInput(
            f"{where}: axes: a table of settings with values, or tables [[axes]], expected, got {short(given)}"
        )
    axes = tuple(_axis(table, f"{where}: axis {i}") for i, table in enumerate(tables, 1))
    owner = {}
    for axis in axes:
        for name in {name for value in axis.values for name in value.changes.settings}:
            if name in ("world", "seed"):
                raise BadInput(f"{where}: axis {short(axis.name)}: a study says this with its key '{name}s'")
            if owner.setdefault(name, axis) is not axis:
                both = f"{short(owner[name].name)} and {short(axis.name)}"
                raise BadInput(f"{where}: {brief(name)} is changed by the axes {both}")
    names = [axis.name for axis in axes]
    if len(set(names)) < len(names):
        raise BadInput(f"{where}: axes: different names expected, got {', '.join(map(brief, names))}")
    return axes


def flattened(mapping: Mapping, prefix: str = "") -> dict[str, Any]:
    """Nested tables as dotted names."""
    flat = {}
    for key, value in mapping.items():
        flat |= flattened(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def brief(text: str) -> str:
    """Text of unknown origin as part of a message: one line, of at most 60 characters."""
    text = one_line(text)
    return text if len(text) <= 60 else text[:57] + "..."


def one_line(text: str) -> str:
    """Without white space around it, and with single spaces within: names are compared, and stand in tables."""
    return " ".join(text.split())


def _axis(table: Any, where: str) -> Axis:
    given = from_mapping(AxisTable, table, where)
    if given.setting and given.scale:
        raise BadInput(f"{where}: either 'setting' or 'scale' expected, got both")
    name = one_line(given.name) or one_line(given.setting)
    if not name:
        raise BadInput(f"{where}: a 'name' or a 'setting' expected")
    place = f"{where} ({brief(name)})"
    if not given.values:
        raise BadInput(f"{place}: values: at least one expected, got none")
    values = tuple(_value(value, given, place) for value in given.values)
    labels = [value.label for value in values]
    if len(set(labels)) < len(labels):
        raise BadInput(f"{place}: values: each one once expected, got {', '.join(map(brief, labels))}")
    return Axis(name, one_line(given.unit) or ("" if given.scale else _unit(given.setting)), values)


def _value(value: Any, axis: AxisTable, where: str) -> AxisValue:
    if isinstance(value, Mapping):
        return _labelled(value, where)
    at = _number(value)
    if axis.scale:
        if at is None or at <= 0:
            raise BadInput(f"{where}: a factor of more than zero expected, got {short(value)}")
        return AxisValue(f"x{value}", at, Changes(factors=dict.fromkeys(axis.scale, at)))
    if not axis.setting:
        raise BadInput(f"{where}: without 'setting' or 'scale' each value is a table with a label, got {short(value)}")
    return AxisValue(one_line(str(value)), at, Changes({axis.setting: value}))


def _labelled(table: Mapping, where: str) -> AxisValue:
    """A value that changes several settings: `label`, perhaps `at`, and the settings."""
    settings = flattened(table)
    label, at = settings.pop("label", None), settings.pop("at", None)
    place = _number(at)
    if not isinstance(label, str) or not label.strip():
        raise BadInput(f"{where}: a value that is a table needs a 'label', got {short(dict(table))}")
    label = one_line(label)
    if at is not None and place is None:
        raise BadInput(f"{where}: {brief(label)}: at: a finite number expected, got {short(at)}")
    if not settings:
        raise BadInput(f"{where}: {brief(label)}: no setting is changed; expected 'true_noise.odometry...' or the like")
    return AxisValue(label, place, Changes(settings))


def _number(value: Any) -> float | None:
    """A finite number; None for anything else."""
    try:
        return float(value) if type(value) in (int, float) and isfinite(value) else None
    except OverflowError:  # an integer that no float can be
        return None


def _unit(setting: str) -> str:
    return next((unit for ending, unit in UNITS.items() if setting.endswith(ending)), "")
