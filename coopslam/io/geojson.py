"""GeoJSON feature collections in metres, and JSON files in general."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from coopslam.errors import BadInput


def feature(kind: str, geometry_type: str, coordinates, **properties) -> dict:
    """A feature whose `properties.kind` is `kind`.

    coordinates: as GeoJSON nests them for `geometry_type`, sequences or arrays, metres; the rings of a Polygon are
    closed here when they are not.
    """
    plain = _plain(coordinates)
    if geometry_type == "Polygon":
        plain = [ring if ring[0] == ring[-1] else [*ring, ring[0]] for ring in plain]
    geometry = {"type": geometry_type, "coordinates": plain}
    return {"type": "Feature", "properties": {"kind": kind, **_plain(properties)}, "geometry": geometry}


def write_feature_collection(path: str | Path, features: Iterable[dict]) -> None:
    """One feature on each line. Raises ValueError when a number is not finite."""
    lines = ",\n".join(json.dumps(item, allow_nan=False) for item in features)
    Path(path).write_text(f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n', encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """What a JSON file holds. Raises BadInput with file, line and what is wrong; NaN and Infinity are not JSON."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except OSError as error:
        raise BadInput(f"{path}: cannot read the file: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: not a text file; expected JSON") from error
    except json.JSONDecodeError as error:
        raise BadInput(f"{path}: line {error.lineno}, column {error.colno}: not valid JSON: {error.msg}") from error
    except _NotFinite as error:
        raise BadInput(f"{path}: not valid JSON: {error} where a finite number is expected") from error
    except (RecursionError, ValueError) as error:
        raise BadInput(f"{path}: not usable JSON: {error}") from error


class _NotFinite(Exception):
    pass


def _refuse_constant(name: str):
    raise _NotFinite(name)


def _plain(value):
    """Arrays, tuples and numpy scalars as the lists and numbers of JSON."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
