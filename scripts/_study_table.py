"""results.csv of a study: one line per run, appended and on the disk before the next, whatever interrupts it.

A line that was torn by an interruption is dropped when the table is opened again. Rows of runs that are no longer in
the study stay. One sweep at a time: a lock file with the process id, which the system frees when the process ends.
"""

import csv
import fcntl
import io
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from _exploration import DRIVERS
from _study import Study
from _study_run import SCORES

from coopslam import __version__
from coopslam.errors import BadInput

IDENTITY = ("key", "version", "world", "seed")
WORLD_SIZE = ("world_vertices", "world_holes", "world_perimeter_m", "world_area_m2")
RESULTS = (
    *("outcome", "success", "vertices", "triangles", "moves", "role_exchanges"),
    *("travel_m", "travel_over_perimeter", "covered_fraction", "vertex_rmse_m", "vertex_nees"),
    *(f"{name}.{score}" for name in dict.fromkeys(("dead-reckoning", *DRIVERS, "batch")) for score in SCORES),
    *("seconds", "outcome_reason", "error"),
)


def columns_of(study: Study) -> list[str]:
    """The columns that a study begins with. Raises BadInput for an axis named like one that is there anyway."""
    axes = [axis.name for axis in study.axes]
    taken = [name for name in axes if name in (*IDENTITY, *WORLD_SIZE, *RESULTS)]
    if taken:
        raise BadInput(f"axis {taken[0]!r}: another name expected; results.csv has a column of this name")
    return [*IDENTITY, *axes, *WORLD_SIZE, *RESULTS]


def identities(study: Study) -> dict[str, dict]:
    """What is known of each run before it is done, by its key."""
    rows = {}
    for run in study.runs:
        world = run.world.world
        size = (world.n, world.holes, world.perimeter_m, world.area_m2)
        rows[run.key] = {
            **dict(zip(IDENTITY, (run.key, __version__, run.world.name, run.seed), strict=True)),
            **{axis.name: axis.values[k].label for axis, k in zip(study.axes, run.values, strict=True)},
            **dict(zip(WORLD_SIZE, size, strict=True)),
        }
    return rows


class ResultsTable:
    """The rows by key, in memory and in the file; a file that is there is read, and mended where it is torn."""

    def __init__(self, path: Path, columns: Iterable[str], known: Mapping[str, Mapping]):
        """known: identities of the study's runs; rows of these runs get the names that the study now uses."""
        self.path = path
        self.rows: dict[str, dict[str, str]] = {}
        header, self.dropped = self._read()
        self.columns = [*columns, *(name for name in header if name not in set(columns))]
        renamed = {key: self.rows[key] | _texts(row) for key, row in known.items() if key in self.rows}
        if header != self.columns or self.dropped or any(self.rows[key] != row for key, row in renamed.items()):
            self.rows |= renamed
            self._rewrite()

    def append(self, row: Mapping) -> None:
        """One more row, on the disk when this returns. A column that is new is added to the whole table."""
        text = _texts(row)
        new = [name for name in text if name not in set(self.columns)]
        replaced = text["key"] in self.rows
        self.rows[text["key"]] = text
        if new or replaced:
            self.columns += new
            self._rewrite()
            return
        with open(self.path, "ab") as file:
            file.write(self._line(text))
            file.flush()
            os.fsync(file.fileno())

    def _read(self) -> tuple[list[str], int]:
        """Header, and how many lines were torn. Raises BadInput for a file that is something else."""
        try:
            text = self.path.read_bytes().decode("utf-8", errors="replace")
        except FileNotFoundError:
            return [], 0
        except OSError as error:
            raise BadInput(f"{self.path}: cannot read the results: {error.strerror}") from error
        whole, _, torn = text.rpartition("\n")
        header, *rows = list(csv.reader(io.StringIO(whole, newline=""))) or [[]]
        if header and header[: len(IDENTITY)] != list(IDENTITY):
            raise BadInput(f"{self.path}: not a table of results; its first columns should be {', '.join(IDENTITY)}")
        good = [row for row in rows if len(row) == len(header) and row[0]]
        self.rows = {row[0]: dict(zip(header, row, strict=True)) for row in good}
        return header, len(rows) - len(good) + bool(torn)

    def _rewrite(self) -> None:
        """The whole table anew, in one step."""
        new = self.path.with_suffix(".new")
        with open(new, "wb") as file:
            file.write(self._line({name: name for name in self.columns}))
            file.writelines(self._line(row) for row in self.rows.values())
            file.flush()
            os.fsync(file.fileno())
        new.replace(self.path)

    def _line(self, row: Mapping[str, str]) -> bytes:
        line = io.StringIO(newline="")
        csv.writer(line, lineterminator="\n").writerow([row.get(name, "") for name in self.columns])
        return line.getvalue().encode()


def _texts(row: Mapping) -> dict[str, str]:
    return {name: _text(value) for name, value in row.items()}


def _text(value) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return " ".join(str(value).split())  # a line of the file is a row


@contextmanager
def only_sweep(directory: Path) -> Iterator[Path]:
    """Holds the directory. Raises BadInput when another sweep does; the lock of a process that is gone is none."""
    with open(directory / "sweep.lock", "a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            holder = file.read().strip() or "unknown"
            raise BadInput(f"{directory}: another sweep (process {holder}) is writing here") from error
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield directory
        file.truncate(0)
