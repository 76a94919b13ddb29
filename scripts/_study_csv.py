"""results.csv as it is read: an interruption may tear its last line; whatever else is wrong is said, not mended."""

import csv
from dataclasses import dataclass, field
from pathlib import Path

from coopslam.errors import BadInput
from sim.world_checks import short

BOM = b"\xef\xbb\xbf"


@dataclass(frozen=True, slots=True)
class Columns:
    """What a table of results has to have."""

    first: tuple[str, ...]  # in this order; the first one is the key
    numbers: frozenset[str]  # anywhere, as are the others
    truths: frozenset[str]
    texts: frozenset[str]

    @property
    def required(self) -> list[str]:
        """All of them."""
        return [*self.first, *sorted(self.numbers | self.truths | self.texts)]


@dataclass(slots=True)
class ResultsFile:
    """Its header, its rows by key, and whether its last line was torn."""

    header: list[str] = field(default_factory=list)
    rows: dict[str, dict[str, str]] = field(default_factory=dict)
    torn: bool = False


def read_results(path: Path, columns: Columns) -> ResultsFile:
    """Rows of a file, one per line; no rows when there is no file. Raises BadInput with file and line."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return ResultsFile()
    except OSError as error:
        raise BadInput(f"{path}: cannot read the results: {error.strerror}") from error
    *lines, unfinished = content.removeprefix(BOM).split(b"\n")
    if not lines:
        return _torn_header(path, unfinished, columns)
    found = ResultsFile(_fields(lines[0], f"{path}: line 1"), torn=bool(unfinished))
    _check_header(found.header, columns, path)
    line_of = {}
    for number, line in enumerate(lines[1:], 2):
        place = f"{path}: line {number}"
        if number == len(lines) and not unfinished and _is_short(line, len(found.header)):
            found.torn = True
            break
        row = _row(line, found.header, columns, place)
        key = row[columns.first[0]]
        if key in line_of:
            raise BadInput(f"{place}: the same run as line {line_of[key]}; one row for each expected")
        line_of[key], found.rows[key] = number, row
    return found


def _torn_header(path: Path, text: bytes, columns: Columns) -> ResultsFile:
    """A file without a whole line: nothing is lost with the beginning of a header."""
    begins = ",".join(columns.first).encode()
    if not (text.startswith(begins) or begins.startswith(text)):
        raise _another_file(path, columns)
    return ResultsFile(torn=bool(text))


def _check_header(header: list[str], columns: Columns, path: Path) -> None:
    if header[: len(columns.first)] != list(columns.first):
        raise _another_file(path, columns)
    missing = [name for name in columns.required if name not in header]
    if missing:
        raise BadInput(f"{path}: line 1: no column {missing[0]!r}; a table that sweep.py wrote expected")
    twice = [name for name in header if header.count(name) > 1]
    if twice:
        raise BadInput(f"{path}: line 1: two columns {short(twice[0])}; different ones expected")


def _another_file(path: Path, columns: Columns) -> BadInput:
    return BadInput(f"{path}: not a table of results; its first columns should be {', '.join(columns.first)}")


def _is_short(line: bytes, fields: int) -> bool:
    """Whether the line ends too early: within quotes, or with fields missing."""
    try:
        return len(next(csv.reader([line.decode(errors="replace")], strict=True), [])) < fields
    except csv.Error as error:
        return "unexpected end" in str(error)


def _fields(line: bytes, place: str) -> list[str]:
    try:
        return next(csv.reader([line.decode()], strict=True), [])
    except (csv.Error, UnicodeDecodeError) as error:
        reason = "not UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)
        raise BadInput(f"{place}: not a line of CSV ({reason}); mend it or remove it") from error


def _row(line: bytes, header: list[str], columns: Columns, place: str) -> dict[str, str]:
    values = _fields(line, place)
    if len(values) != len(header):
        raise BadInput(f"{place}: {len(header)} fields expected, got {len(values)}; mend it or remove it")
    row = dict(zip(header, values, strict=True))
    if not row[columns.first[0]]:
        raise BadInput(f"{place}: no {columns.first[0]}; mend it or remove it")
    for name in columns.numbers:
        if row[name] and not _is_number(row[name]):
            raise BadInput(f"{place}: {name}: a number expected, got {short(row[name])}")
    for name in columns.truths:
        if row[name] not in ("true", "false"):
            raise BadInput(f"{place}: {name}: true or false expected, got {short(row[name])}")
    return row


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
