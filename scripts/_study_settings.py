"""The settings of one combination of a study: a base with what each axis changes or scales."""

from collections.abc import Iterator, Mapping
from copy import deepcopy
from typing import Any

from _exploration import ExplorationSettings
from _study_axes import Changes

from coopslam.errors import BadInput
from coopslam.io.toml import from_mapping, to_mapping

NOISE_TABLES = ("true_noise", "believed_noise")


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
            raise BadInput(f"{where}: {name}: {table!r} is a setting, not a table")
    mapping[last] = deepcopy(value)


def _scale(mapping: dict, name: str, factor: float, where: str) -> None:
    """Multiply a setting, or every number of a table."""
    *tables, last = name.split(".")
    for table in [*tables, last]:
        if not isinstance(mapping, dict) or table not in mapping:
            known = ", ".join(mapping) if isinstance(mapping, dict) else "none"
            raise BadInput(f"{where}: scale: unknown key {table!r} in {name!r}; known keys: {known}")
        parent, mapping = mapping, mapping[table]
    scaled = dict(_scaled(mapping, last, factor))
    if not scaled:
        raise BadInput(f"{where}: scale: {name}: a number or a table with numbers expected, got {mapping!r}")
    parent.update(scaled)


def _scaled(value: Any, key: str, factor: float) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        inner = {k: v for name in value for k, v in _scaled(value[name], name, factor)}
        if inner:
            yield key, {**value, **inner}
    elif type(value) in (int, float):
        yield key, value * factor
