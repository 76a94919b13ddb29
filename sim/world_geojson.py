"""GeoJSON of a world: the file, the one polygon of it and its slippery patches; each fault said in one line."""

import json
from pathlib import Path

from coopslam.errors import BadInput
from sim.ground import Patch, is_patch, parse_patch
from sim.world_checks import short


def read_json(path: Path):
    """What a JSON file holds. Raises BadInput with the file and what is wrong."""
    try:
        return json.loads(path.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: byte {error.start} is not UTF-8 text; a GeoJSON file expected") from error
    except json.JSONDecodeError as error:
        raise BadInput(f"{path}, line {error.lineno}: not JSON ({error.msg}); a GeoJSON file expected") from error
    except RecursionError as error:
        raise BadInput(f"{path}: JSON nested too deeply; a GeoJSON polygon expected") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise BadInput(f"{path}: cannot be read ({reason}); a GeoJSON file expected") from error


def parse_world(data, where: str) -> tuple[list, dict, tuple[Patch, ...]]:
    """The coordinates of the one polygon, the properties of its feature, and the slippery patches beside it."""
    _require_object(data, where)
    numbered = [(where, data)]
    if data.get("type") == "FeatureCollection":
        numbered = [(f"{where}: feature {i}", each) for i, each in enumerate(_list(data, "features", where))]
    polygons, patches = [], []
    for place, feature in numbered:
        _require_object(feature, place)
        if is_patch(feature):
            patches.append(parse_patch(feature, f"{place} (slippery)"))
        else:
            polygons += _polygons(feature, place)
    if len(polygons) != 1:
        raise BadInput(f"{where}: {len(polygons) or 'no'} polygons found; exactly one expected")
    return *polygons[0], tuple(patches)


def parse_name(properties: dict, default: str, where: str) -> str:
    """The world's name in one line, or the default when there is none. Raises BadInput."""
    name = properties.get("name")
    if name is None:
        return default
    if not isinstance(name, str) or not name.strip():
        raise BadInput(f"{where}: properties.name is {short(name)}; text expected")
    return " ".join(name.split())


def _polygons(data, where: str) -> list[tuple[list, dict]]:
    """Every polygon's coordinates in a Feature or geometry; geometries of other types are left out."""
    properties = {}
    if data.get("type") == "Feature":
        properties = data.get("properties") or {}
        if not isinstance(properties, dict):
            raise BadInput(f"{where}: properties are {short(properties)}; an object expected")
        if properties.get("kind") is not None:
            raise BadInput(
                f'{where}: properties.kind is {short(properties["kind"])}; kind must be "slippery" or absent'
            )
        data = data.get("geometry") or {}
        _require_object(data, where)
    if data.get("type") == "Polygon":
        return [(_list(data, "coordinates", where), properties)]
    if data.get("type") == "FeatureCollection":
        raise BadInput(f"{where}: is a FeatureCollection in another; a Feature expected")
    if data.get("type") == "MultiPolygon":
        return [(coordinates, properties) for coordinates in _list(data, "coordinates", where)]
    return []


def _require_object(data, where: str) -> None:
    if not isinstance(data, dict):
        raise BadInput(f"{where}: {short(data)} found; a GeoJSON object expected")
    if data.get("crs") is not None:
        raise BadInput(f"{where}: has a crs member ({short(data['crs'])}); plain metres without a crs expected")


def _list(data: dict, key: str, where: str) -> list:
    if not isinstance(data.get(key), list):
        raise BadInput(f"{where}: {data['type']} has {key} {short(data.get(key))}; a list expected")
    return data[key]
