"""A parameter study: what its file says, and the runs it consists of.

A study is the full product of worlds, axes and seeds. An axis changes settings of the base: by dotted name, several
at once (tables with a label), or by a factor. Axes act on what is in force: the noise preset is spelled out before
settings of noise are changed or scaled, so what an axis does not name stays as the preset has it.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

from _exploration import ExplorationSettings, prepare
from _study_axes import Axis, brief, one_line, parse_axes
from _study_settings import effective_settings

from coopslam import __version__
from coopslam.errors import BadInput
from coopslam.io.toml import dump_toml, from_mapping, load_toml, to_mapping
from sim.world import World, load_world, world_names
from sim.world_checks import short

NOT_OF_THE_KEY = ("world", "figures", "noise")  # a name, what changes no number, and what is spelled out elsewhere
MOST_RUNS = 1_000_000
GIVEN_ELSEWHERE = {"world": "worlds", "seed": "seeds"}


@dataclass(frozen=True, slots=True)
class StudyFile:
    """The keys of a study file."""

    name: str
    worlds: tuple[str, ...]  # names, or GeoJSON files relative to the study file
    seeds: Any  # a count (0 .. count - 1) or a list
    description: str = ""
    base: dict[str, Any] = field(default_factory=dict)  # settings, as in a config file
    axes: Any = ()  # a table setting -> values, or a list of tables


@dataclass(frozen=True)
class StudyWorld:
    """A world of the study under the name that its rows have."""

    name: str
    source: str  # name of a world of the repository, or absolute path
    world: World

    @cached_property
    def geojson(self) -> dict:
        """Its content, for workers that may not have the file."""
        return self.world.to_geojson()

    @cached_property
    def digest(self) -> str:
        """Of the world's content, wherever its file stands."""
        return world_digest(self.world)


@dataclass(frozen=True, slots=True)
class Run:
    """One exploration of the study, and what identifies it."""

    key: str
    world: StudyWorld
    seed: int
    values: tuple[int, ...]  # index of the value on each axis
    settings: dict  # effective, as in a config file


@dataclass(frozen=True)
class Study:
    """A study that was checked: every combination of its settings can be prepared."""

    name: str
    description: str
    seeds: Sequence[int]
    worlds: tuple[StudyWorld, ...]
    axes: tuple[Axis, ...]
    runs: tuple[Run, ...]  # seeds outermost: an interrupted study has some of every combination
    text: str  # TOML, with paths that hold from anywhere


def load_study(path: str | Path) -> Study:
    """Read and check a study. Raises BadInput that names file and key, before anything is run."""
    where = str(path)
    raw = load_toml(path)
    given = from_mapping(StudyFile, raw, where)
    for key, instead in GIVEN_ELSEWHERE.items():
        if key in given.base:
            raise BadInput(f"{where}: [base] {key}: a study says this with its key {instead!r}")
    seeds = _seeds(given.seeds, where)
    worlds = tuple(_world(text, Path(path).absolute().parent, where) for text in given.worlds)
    _require_distinct([world.name for world in worlds], f"{where}: worlds")
    _require_different_worlds(worlds, where)
    axes = parse_axes(given.axes, where)
    _require_affordable(len(seeds) * len(worlds) * prod(len(axis.values) for axis in axes), where)
    text = dump_toml({**raw, "worlds": [world.source for world in worlds]})
    name, runs = one_line(given.name), _runs(given.base, seeds, worlds, axes, where)
    return Study(name, given.description, seeds, worlds, axes, runs, text)


def world_digest(world: World) -> str:
    """Hash of a world's content."""
    return hashlib.sha256(json.dumps(world.to_geojson(), sort_keys=True).encode()).hexdigest()


def key_of(settings: ExplorationSettings, digest: str) -> str:
    """What identifies a run: a hash of its resolved settings, its world's content and the version of coopslam."""
    return _key_of_mapping(to_mapping(settings), digest)


def _key_of_mapping(mapping: Mapping, digest: str) -> str:
    effective = {key: value for key, value in mapping.items() if key not in NOT_OF_THE_KEY}
    content = json.dumps([__version__, digest, effective], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def is_success(summary: Mapping) -> bool:
    """A complete exploration whose map is a triangulation of the true world."""
    return bool(
        summary["outcome"] == "complete"
        and summary.get("true_triangulation")
        and summary["triangles"] == summary["triangles_expected"]
        and summary["covered_fraction"] >= 1 - 1e-6
        and summary["overlap_fraction"] <= 1e-6
    )


def _seeds(given: Any, where: str) -> Sequence[int]:
    if type(given) is int and given > 0:
        _require_affordable(given, where)
        return range(given)
    if not isinstance(given, list) or not given or any(type(seed) is not int or seed < 0 for seed in given):
        raise BadInput(
            f"{where}: seeds: a count of 1 or more, or a list of integers from 0 on, expected, got {short(given)}"
        )
    _require_distinct(given, f"{where}: seeds")
    return tuple(given)


def _world(text: str, folder: Path, where: str) -> StudyWorld:
    source = text if text in world_names() or "." not in text and "/" not in text else str(folder / text)
    try:
        return StudyWorld(one_line(Path(text).stem), source, load_world(source))
    except BadInput as error:
        raise BadInput(f"{where}: worlds: {error}") from error


def _require_distinct(items: list, what: str) -> None:
    twice = sorted(brief(str(item)) for item, count in Counter(items).items() if count > 1)
    if twice or not items:
        raise BadInput(
            f"{what}: {'each one once' if twice else 'at least one'} expected, got {', '.join(twice[:5]) or items}"
        )


def _require_different_worlds(worlds: tuple[StudyWorld, ...], where: str) -> None:
    """Their rows would have the same keys."""
    named = {}
    for world in worlds:
        first = named.setdefault(world.digest, world)
        if first is not world:
            both = f"{short(first.name)} and {short(world.name)}"
            raise BadInput(f"{where}: worlds {both} are the same: one of them is too many")


def _require_affordable(count: int, where: str) -> None:
    """Before anything is multiplied out."""
    if count > MOST_RUNS:
        raise BadInput(f"{where}: at most {MOST_RUNS} runs expected (worlds x values x seeds), got {short(count)}")


def _runs(base: dict, seeds: Sequence[int], worlds: tuple, axes: tuple, where: str) -> tuple[Run, ...]:
    """The full product. Raises BadInput for a combination that cannot be prepared or is the same run as another."""
    prepared, said_of = [], {}
    for values in product(*(range(len(axis.values)) for axis in axes)):
        chosen = [axis.values[k] for axis, k in zip(axes, values, strict=True)]
        said = ", ".join(f"{brief(axis.name)} = {brief(value.label)}" for axis, value in zip(axes, chosen, strict=True))
        place = f"{where} ({said})" if said else f"{where}: [base]"
        settings = effective_settings(base, [value.changes for value in chosen], place)
        for world in worlds:
            try:
                ready = prepare(replace(settings, world=world.source)).settings
            except BadInput as error:
                raise BadInput(f"{place}: {world.name}: {error}") from error
            first, said_first = said_of.setdefault(key_of(replace(ready, seed=0), world.digest), (values, said))
            if first != values:
                raise BadInput(f"{where}: '{said_first}' and '{said}' are the same run: one of them is too many")
            prepared.append((to_mapping(replace(ready, figures="none")), world, values))
    return tuple(_seeded(*each, seed) for seed in seeds for each in prepared)


def _seeded(mapping: dict, world: StudyWorld, values: tuple[int, ...], seed: int) -> Run:
    """All seeds of a combination share its tables: there may be a million runs."""
    settings = {**mapping, "seed": seed}
    return Run(_key_of_mapping(settings, world.digest), world, seed, values, settings)
