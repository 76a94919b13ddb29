"""What benchmarks write: a directory, lines of one dataclass as CSV, tables as JSON."""

import csv
from collections.abc import Sequence
from dataclasses import asdict, fields
from math import isfinite
from pathlib import Path

from coopslam.errors import NotWritten


def make_directory(path: Path) -> None:
    """Raises NotWritten when there can be none."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NotWritten(f"{path}: a directory expected to write to ({error.strerror})", done=False) from error


def write_csv(path: Path, rows: Sequence) -> None:
    """A line for each of one or more instances of a dataclass."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(rows[0])])
        writer.writeheader()
        writer.writerows(map(asdict, rows))


def without_nan(data):
    """The same with None for what is not finite, which JSON does not have."""
    if isinstance(data, dict):
        return {key: without_nan(value) for key, value in data.items()}
    if isinstance(data, list):
        return list(map(without_nan, data))
    return None if isinstance(data, float) and not isfinite(data) else data
