"""results.csv of a study: one line per run, appended and on the disk before the next, whatever interrupts it.

A last line that was torn by an interruption is dropped when the table is opened again. Rows of runs that are no longer
in the study stay.
"""

import csv
import io
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from _exploration import DRIVERS
from _study import Study
from _study_csv import Columns, read_results
from _study_files import require_writable, write_anew, writing
from _study_run import SCORES

from coopslam import __version__
from coopslam.errors import BadInput
from sim.world_checks import short

IDENTITY = ("key", "version", "world", "seed")
WORLD_SIZE = ("world_vertices", "world_holes", "world_perimeter_m", "world_area_m2")
RESULTS = (
    *("outcome", "success", "vertices", "triangles", "moves", "role_exchanges"),
    *("travel_m", "travel_over_perimeter", "covered_fraction", "vertex_rmse_m", "vertex_nees"),
    *(f"{name}.{score}" for name in dict.fromkeys(("dead-reckoning", *DRIVERS, "batch")) for score in SCORES),
    *("seconds", "outcome_reason", "error"),
)
TEXTS = frozenset(("outcome", "outcome_reason", "error"))
TRUTHS = frozenset(("success",))
REQUIRED = Columns(IDENTITY, frozenset((*WORLD_SIZE, *RESULTS)) - TEXTS - TRUTHS, TRUTHS, TEXTS)


def columns_of(study: Study, where: str) -> list[str]:
    """The columns that a study begins with; where: its file.

    Raises BadInput for an axis named like a column that is there anyway.
    """
    axes = [axis.name for axis in study.axes]
    taken = [name for name in axes if name in (*IDENTITY, *WORLD_SIZE, *RESULTS)]
    if taken:
        raise BadInput(f"{where}: axis {short(taken[0])}: another name expected; results.csv has a column of this name")
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
        found = read_results(path, REQUIRED)
        self.rows, self.torn = found.rows, found.torn
        self.columns = [*columns, *(name for name in found.header if name not in set(columns))]
        renamed = {key: self.rows[key] | _texts(row) for key, row in known.items() if key in self.rows}
        if found.header != self.columns or self.torn or any(self.rows[key] != row for key, row in renamed.items()):
            self.rows |= renamed
            self._rewrite()

    def require_writable(self) -> None:
        """Before the first run, not after it. Raises BadInput."""
        require_writable(self.path)

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
        with writing(self.path), open(self.path, "ab") as file:
            file.write(self._line(text))
            file.flush()
            os.fsync(file.fileno())

    def _rewrite(self) -> None:
        """The whole table anew, in one step."""
        header = self._line({name: name for name in self.columns})
        write_anew(self.path, header + b"".join(self._line(row) for row in self.rows.values()))

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
