"""Readers that users write for formats of their own, FILE.py:CLASS; whatever goes wrong in one is said in one line."""

import runpy
import traceback
from collections.abc import Callable
from pathlib import Path

from coopslam.errors import BadInput, CoopSlamError, shown
from coopslam.io.log import Log, TrueTrack, Truth
from coopslam.records import LogHeader, Record


class OwnSource:
    """A LogSource around the class that a user named. Raises BadInput, with its name and line, for all it raises."""

    def __init__(self, name: str, path: Path):
        """name: FILE.py:CLASS; CLASS(path) makes the reader."""
        self._name = f"--source {name[:200]}"
        self._file, _, name_of_class = name.rpartition(":")
        if not self._file or not Path(self._file).is_file():
            raise BadInput(f"{self._name}: FILE.py:CLASS of a file that exists expected")
        module = self._called(runpy.run_path, self._file)
        if name_of_class not in module:
            raise BadInput(f"{self._name}: {self._file} has no {name_of_class}; expected a class")
        self._source = self._called(module[name_of_class], path)

    def read(self) -> Log:
        """What the reader reads."""
        log = self._called(lambda: self._source.read())
        self._require(isinstance(log, Log), "read() gives {}; expected a Log of coopslam.io.log", log)
        self._require(isinstance(log.header, LogHeader), "the header {}; expected a LogHeader", log.header)
        log = Log(str(log.name), log.header, self._called(list, log.records), log.dropped)
        for record in log.records:
            self._require(isinstance(record, Record), "{}; expected records of coopslam.records", record)
        return log

    def truth(self) -> Truth | None:
        """The truth that the reader has."""
        truth = self._called(lambda: self._source.truth())
        self._require(truth is None or isinstance(truth, Truth), "truth() gives {}; expected Truth or None", truth)
        for track in truth.robots.values() if truth else ():
            self._require(isinstance(track, TrueTrack), "the truth of a robot is {}; expected a TrueTrack", track)
        return truth

    def _called(self, function: Callable, *arguments):
        try:
            return function(*arguments)
        except CoopSlamError as error:
            raise BadInput(f"{self._name}: {error}") from error
        except (Exception, SystemExit) as error:
            steps = [step for step in traceback.extract_tb(error.__traceback__) if step.filename == self._file]
            line = f" in line {steps[-1].lineno}" if steps else ""
            raise BadInput(f"{self._name}: {type(error).__name__}{line}: {str(error)[:300]}") from error

    def _require(self, condition: bool, message: str, value) -> None:
        """message: with {} where the value belongs."""
        if not condition:
            raise BadInput(f"{self._name}: {message.format(shown(value))}")
