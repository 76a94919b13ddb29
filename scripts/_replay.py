"""Open a recording, run estimators over it, and keep what each of them made of it."""

import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from _calibration import CalibrateSettings, calibrate_itself, part_of
from _own_source import OwnSource

from coopslam.errors import BadInput, CoopSlamError, require_between, shown
from coopslam.estimation.calibration import Calibration, calibrated
from coopslam.estimation.estimators import BATCH, EstimatorSettings, run
from coopslam.estimation.rebuilt_graph import Solution
from coopslam.estimation.replay import Replay
from coopslam.estimation.self_calibration import smooth_calibrated
from coopslam.estimation.synchronize import synchronized
from coopslam.io.bounds import bounded, require_bounded_truth
from coopslam.io.log import Log, Truth
from coopslam.io.mrclam import MrclamSettings, MrclamSource
from coopslam.io.sources import open_log
from coopslam.records import LandmarkPrior, LogHeader, PointFix, Record, RelativePoseFix

_FILE_NAME = re.compile(r"[^./\\][^/\\]{0,79}")  # neither hidden nor in another directory


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """Every setting of a replay; the keys of a config file."""

    ignore: Literal["nothing", "landmarks", "robots"] = "nothing"  # sightings of these are not used
    figures: Literal["none", "static"] = "static"
    source: str = ""  # FILE.py:CLASS of a reader of one's own; empty: what the log looks like decides
    from_s: float = 0.0  # the part of the log that is used, s after its start
    to_s: float | None = None  # None: to its end
    calibrate: bool = False  # let the log calibrate its own sensors, without truth
    self_calibration: CalibrateSettings = field(default_factory=CalibrateSettings)
    calibration: Calibration | None = None  # of the sensors, from elsewhere
    estimation: EstimatorSettings = field(default_factory=EstimatorSettings)
    mrclam: MrclamSettings = field(default_factory=MrclamSettings)

    def __post_init__(self):
        require_between(0.0, 1e9, from_s=self.from_s)
        if self.to_s is not None:
            require_between(self.from_s, 1e9, to_s=self.to_s)
        if self.estimation.timeline.random_start is not None:
            require_between(0, 2**63 - 1, random_start=self.estimation.timeline.random_start)  # what TOML can carry
        if self.calibrate and self.calibration is not None:
            raise BadInput("calibrate: either that or a calibration expected, got both")
        if self.mrclam.range_is_depth and self.calibration is not None and self.calibration.range_is_depth:
            raise BadInput("calibration: it takes ranges for depths, and so does mrclam.range_is_depth; expected one")


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A log, ready for estimators, and the truth beside it, which only scores and figures read."""

    path: Path
    log: Log
    records: list[Record]  # calibrated and synchronized, without what is ignored
    truth: Truth | None
    load_seconds: float
    ignored: int = 0  # records
    calibration: Calibration | None = None  # what the records were calibrated with
    solution: Solution | None = None  # of the self-calibration
    calibration_seconds: float | None = None  # of the self-calibration, the search for a start included

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
        return {**kinds, "ignored": self.ignored, "dropped": dict(self.log.dropped)}


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one estimator made of a recording; `failure` says why it made nothing."""

    name: str
    replay: Replay | None
    failure: str = ""
    exit_code: int = 0

    @classmethod
    def failed(cls, name: str, error: Exception) -> "Outcome":
        """Came to nothing, because of what our code or a singular matrix says."""
        return cls(name, None, " ".join(str(error).split()), getattr(error, "exit_code", 3))


def open_recording(path: Path, settings: ReplaySettings, tell: Callable[[str], None] = print) -> Recording:
    """Read a log, and calibrate it when the settings say so. tell: is told what self-calibration has done.

    Raises BadInput for what cannot be used, or when nothing is in it, and what `self_calibrate` raises.
    """
    began = time.perf_counter()
    source = OwnSource(settings.source, path) if settings.source else open_log(path)
    if isinstance(source, MrclamSource):
        source = MrclamSource(path, settings.mrclam)
    log = _in_random_order(source.read(), settings.estimation.timeline.random_start)
    _require_names(log.header, path)
    log = replace(log, records=bounded(log.records, log.dropped, str(path)))
    log = replace(log, records=part_of(log.records, settings.from_s, settings.to_s, str(path)))
    raw = without_ignored(log.records, log.header, settings.ignore)
    if not raw:
        raise BadInput(f"{path}: no records to replay; expected odometry and sightings")
    active = {name for record in raw for name in _robots_of(record)}
    log.dropped.update(f"{robot}: no records of it" for robot in log.header.robots if robot not in active)
    if not active.intersection(log.header.robots):
        robots = shown(", ".join(log.header.robots))
        raise BadInput(f"{path}: no record of any robot in the header ({robots}); expected odometry and sightings")
    calibration, solution, seconds = settings.calibration, None, None
    if settings.calibrate:
        is_mrclam, timeline = isinstance(source, MrclamSource), settings.estimation.timeline
        found = calibrate_itself(log, raw, is_mrclam, timeline, settings.self_calibration, tell)
        calibration, solution, seconds = found.calibration, found.solution, found.seconds
    ignored = len(log.records) - len(raw)
    if calibration is not None:
        raw = calibrated(raw, calibration, log.dropped)
    records, truth = synchronized(raw), source.truth()
    require_bounded_truth(truth, str(path))
    load_seconds = time.perf_counter() - began - (seconds or 0.0)
    return Recording(path, log, records, truth, load_seconds, ignored, calibration, solution, seconds)


def _require_names(header: LogHeader, path: Path) -> None:
    """Raises BadInput for a robot whose name cannot be that of its trajectories' files."""
    for robot in header.robots:
        if not (_FILE_NAME.fullmatch(robot) and robot.isprintable()) or robot.endswith(".causal"):
            raise BadInput(f"{path}: the robot {shown(robot)}; expected a name that a file can have")


def _in_random_order(log: Log, seed: int | None) -> Log:
    """The log with its robots in another order: the first one's start is the origin of the estimate."""
    if seed is None:
        return log
    robots = tuple(np.random.default_rng(seed).permutation(log.header.robots).tolist())
    return replace(log, header=replace(log.header, robots=robots))


def _robots_of(record: Record) -> set[str]:
    """Names in a record, those of landmarks among them."""
    return {getattr(record, role) for role in ("robot", "observer", "target") if hasattr(record, role)}


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
    header, estimation = recording.header, settings.estimation
    arguments = (recording.records, header.robots, header.landmarks)
    try:
        if name == BATCH and recording.solution is not None:
            replay = smooth_calibrated(*arguments, estimation.timeline, estimation.smooth, recording.solution)
            return Outcome(name, replay)
        return Outcome(name, run(name, *arguments, estimation, watch))
    except (CoopSlamError, np.linalg.LinAlgError) as error:
        return Outcome.failed(name, error)
