"""Open a recording, run estimators over it, and keep what each of them made of it."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from coopslam.errors import BadInput, CoopSlamError
from coopslam.estimation.estimators import EstimatorSettings, run
from coopslam.estimation.replay import Replay
from coopslam.estimation.synchronize import synchronized
from coopslam.io.log import Log, Truth
from coopslam.io.mrclam import MrclamSettings, MrclamSource
from coopslam.io.sources import open_log
from coopslam.records import LandmarkPrior, LogHeader, PointFix, Record, RelativePoseFix


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """Every setting of a replay; the keys of a config file."""

    ignore: Literal["nothing", "landmarks", "robots"] = "nothing"  # sightings of these are not used
    figures: Literal["none", "static"] = "static"
    estimation: EstimatorSettings = field(default_factory=EstimatorSettings)
    mrclam: MrclamSettings = field(default_factory=MrclamSettings)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A log, ready for estimators, and the truth beside it, which only scores and figures read."""

    path: Path
    log: Log
    records: list[Record]  # synchronized, without what is ignored
    truth: Truth | None
    load_seconds: float

    @property
    def header(self) -> LogHeader:
        return self.log.header

    @property
    def start_s(self) -> float:
        """Stamp of the first record."""
        return self.records[0].stamp_s

    def counts(self) -> dict:
        """Number of records of each kind, and what was dropped by the reader, and why."""
        kinds = Counter(type(record).__name__ for record in self.log.records)
        ignored = len(self.log.records) - len(without_ignored(self.log.records, self.header, self.ignore))
        return {**kinds, "ignored": ignored, "dropped": dict(self.log.dropped)}

    ignore: str = "nothing"


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one estimator made of a recording; `failure` says why it made nothing."""

    name: str
    replay: Replay | None
    failure: str = ""
    exit_code: int = 0


def open_recording(path: Path, settings: ReplaySettings) -> Recording:
    """Read a log. Raises BadInput for what cannot be used, or when nothing is in it."""
    began = time.perf_counter()
    source = open_log(path)
    if isinstance(source, MrclamSource):
        source = MrclamSource(path, settings.mrclam)
    log = source.read()
    records = synchronized(without_ignored(log.records, log.header, settings.ignore))
    if not records:
        raise BadInput(f"{path}: no records to replay; expected odometry and sightings")
    return Recording(path, log, records, source.truth(), time.perf_counter() - began, settings.ignore)


def without_ignored(records: Sequence[Record], header: LogHeader, ignore: str) -> list[Record]:
    """The records without sightings of landmarks, or of robots."""
    names = {"nothing": (), "landmarks": header.landmarks, "robots": header.robots}[ignore]
    sightings = PointFix | RelativePoseFix

    def is_ignored(record: Record) -> bool:
        if isinstance(record, LandmarkPrior):
            return record.landmark in names
        return isinstance(record, sightings) and record.target in names

    return [record for record in records if not is_ignored(record)] if names else list(records)


def run_estimator(
    name: str, recording: Recording, settings: ReplaySettings, watch: Callable[[float], None] = lambda stamp_s: None
) -> Outcome:
    """One estimator over a recording; what it cannot do is an outcome, not an error."""
    header = recording.header
    try:
        return Outcome(name, run(name, recording.records, header.robots, header.landmarks, settings.estimation, watch))
    except CoopSlamError as error:
        return Outcome(name, None, " ".join(str(error).split()), error.exit_code)
