"""The settings of one combination of a study: a base with what each axis changes or scales."""

from collections.abc import Iterator, Mapping
from copy import deepcopy
from math import inf
from typing import Any

from _exploration import ExplorationSettings
from _study_axes import Changes, brief

from coopslam.errors import BadInput
from coopslam.io.toml import from_mapping, to_mapping
from sim.world_checks import short

NOISE_TABLES = ("true_noise", "believed_noise")
MOST_EXACT = 2**53  # integers below are floats


def effective_settings(base: Mapping, changes: list[Changes], where: str) -> ExplorationSettings:
    """The base with every change: what is not noise first, then noise with its preset spelled out, then factors."""
    mapping = deepcopy(dict(base))
    settings = {name: value for each in changes for name, value in each.settings.items()}
    noise = {name: value for name, value in settings.items() if name.split(".")[0] in NOISE_TABLES}
    for name, value in settings.items():
        if name not in noise:
            _put(mapping, name, value, where)
    mapping = to_mapping(_resolved(mapping, where))
    for name, value in noise.items():
        _put(mapping, name, value, where)
    for each in changes:
        for name, factor in each.factors.items():
            _scale(mapping, name, factor, where)
    return _resolved(mapping, where)


def _resolved(mapping: dict, where: str) -> ExplorationSettings:
    settings = from_mapping(ExplorationSettings, mapping, where)
    try:
        return settings.resolved()
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from error


def _put(mapping: dict, name: str, value: Any, where: str) -> None:
    *tables, last = name.split(".")
    for table in tables:
        mapping = mapping.setdefault(table, {})
        if not isinstance(mapping, dict):
            raise BadInput(f"{where}: {brief(name)}: {short(table)} is a setting, not a table")
    mapping[last] = deepcopy(value)


def _scale(mapping: dict, name: str, factor: float, where: str) -> None:
    """Multiply a setting, or every number of a table."""
    *tables, last = name.split(".")
    for table in [*tables, last]:
        if not isinstance(mapping, dict) or table not in mapping:
            known = ", ".join(mapping) if isinstance(mapping, dict) else "none"
            raise BadInput(f"{where}: scale: unknown key {short(table)} in {short(name)}; known keys: {known}")
        parent, mapping = mapping, mapping[table]
    scaled = dict(_scaled(mapping, last, factor, f"{where}: scale: {brief(name)}"))
    if not scaled:
        raise BadInput(
            f"{where}: scale: {brief(name)}: a number or a table with numbers expected, got {short(mapping)}"
        )
    parent.update(scaled)


def _scaled(value: Any, key: str, factor: float, place: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        inner = {k: v for name in value for k, v in _scaled(value[name], name, factor, place)}
        if inner:
            yield key, {**value, **inner}
    elif type(value) is int:
        yield key, _whole(value, key, factor, place)
    elif type(value) is float:
        yield key, value * factor


def _whole(count: int, key: str, factor: float, place: str) -> int:
    """A count times a factor; a factor like 0.29 is no binary fraction, so the product may be off by rounding."""
    scaled = float(count) * factor if abs(count) < MOST_EXACT else inf
    if not abs(scaled) < MOST_EXACT or abs(scaled - round(scaled)) > 1e-9 * abs(scaled):
        raise BadInput(f"{place}: {key} counts something, but {short(count)} times {factor:g} is no whole number")
    return round(scaled)
