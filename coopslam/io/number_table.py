"""Text files of numbers in columns, as other people's loggers leave them: comments, rows twice or out of order."""

import warnings
from collections import Counter
from pathlib import Path

import numpy as np

from coopslam.errors import BadInput, shown

LARGEST_STAMP_S = 1e11  # the year 5138; larger stamps are in another unit, or none


def is_there(path: Path) -> bool:
    """Whether something has this name. Raises BadInput when that cannot be found out."""
    try:
        return path.exists()
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error


def read_lines(path: Path, expected: str) -> list[str]:
    """The lines of a text file; the last one is empty when the file ends with a line end.

    Raises BadInput, with what was expected, when it cannot be read or is no text.
    """
    try:
        if is_there(path) and not path.is_file():  # a directory, or a pipe that nobody may ever write to
            raise BadInput(f"{path}: not a file; expected {expected}")
        with path.open(encoding="utf-8-sig") as stream:  # takes every kind of line end
            return stream.read().split("\n")
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}; expected {expected}") from error
    except ValueError as error:  # bytes that are no text, or a path that no system can have
        raise BadInput(f"{path}: not a text file; expected {expected}") from error


def read_table(path: Path, columns: tuple[str, ...], dropped: Counter[str]) -> np.ndarray:
    """(N, len(columns)) numbers, N zero or more; # begins a comment. NaN and infinity are numbers here.

    A last line that is cut off (no line end, and not what was expected) is left out and counted. Raises BadInput,
    with the line, for another line that does not hold as many numbers as there are columns.
    """
    if not path.is_file():
        return _read_with_care(path, columns, dropped)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a table without rows is a table
            rows = np.loadtxt(path, encoding="utf-8-sig", ndmin=2)
    except (OSError, ValueError):
        return _read_with_care(path, columns, dropped)
    if rows.size and rows.shape[1] != len(columns):
        return _read_with_care(path, columns, dropped)
    return rows.reshape(-1, len(columns))


def in_time_order(path: Path, rows: np.ndarray, dropped: Counter[str]) -> np.ndarray:
    """The rows of a table by their first column (s), each once, without those that hold NaN or infinity.

    What is left out or had to be sorted is counted. Raises BadInput, with the line, for a stamp that cannot be.
    """
    stamps = rows[:, 0]
    possible = np.abs(stamps) <= LARGEST_STAMP_S
    if not possible.all():
        first = int(np.argmin(possible))
        where = f"{path}: line {_line_of_row(path, first)}"
        raise BadInput(f"{where}: the time stamp {stamps[first]:g}; expected seconds, at most {LARGEST_STAMP_S:g}")
    finite = np.isfinite(rows).all(axis=1)
    _count(dropped, f"{path.name}: row with a number that is not finite", int((~finite).sum()))
    rows = rows[finite]
    backwards = int((np.diff(rows[:, 0]) < 0).sum())
    if backwards:
        _count(dropped, f"{path.name}: row earlier than the row before it; sorted", backwards)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
    again = _repeated(rows)
    _count(dropped, f"{path.name}: row that was there already", int(again.sum()))
    return rows[~again]


def _read_with_care(path: Path, columns: tuple[str, ...], dropped: Counter[str]) -> np.ndarray:
    """The table line by line, to name the line that is wrong."""
    rows, lines = [], read_lines(path, f"the columns {', '.join(columns)}")
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != len(columns):
            if number < len(lines):
                raise BadInput(f"{path}: line {number}: expected {', '.join(columns)}, got {shown(line)}")
            rows.pop()
            dropped[f"{path.name}: line {number} is cut off"] += 1
    return np.array(rows, dtype=float).reshape(-1, len(columns))


def _line_of_row(path: Path, row: int) -> int:
    """The line, from 1, on which a row of the table stands."""
    lines = [number for number, line in enumerate(read_lines(path, "numbers"), 1) if line.partition("#")[0].strip()]
    return lines[row]


def _repeated(rows: np.ndarray) -> np.ndarray:
    """(N,) which rows, sorted by their first column, equal an earlier one."""
    again = np.zeros(len(rows), dtype=bool)
    tie = np.diff(rows[:, 0]) == 0
    tied = np.flatnonzero(np.append(tie, False) | np.insert(tie, 0, False))
    if len(tied):
        order = tied[np.lexsort(rows[tied].T[::-1])]  # stable: of equal rows, the first in the file comes first
        again[order[1:]] = (rows[order[1:]] == rows[order[:-1]]).all(axis=1)
    return again


def _count(dropped: Counter[str], what: str, number: int) -> None:
    if number:
        dropped[what] += number
