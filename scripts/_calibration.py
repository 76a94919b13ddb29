"""Calibrations for scripts: their files, the settings that a log calls for, and logs that are set right."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from coopslam.errors import BadInput
from coopslam.estimation.calibration import Calibration, Provenance
from coopslam.estimation.self_calibration import (
    CALIBRATED_CAMERA,
    SelfCalibrated,
    SelfCalibrationSettings,
    self_calibrate,
)
from coopslam.estimation.timeline import TimelineSettings
from coopslam.io.log import Log
from coopslam.io.toml import dump_toml, from_mapping, load_toml, to_mapping
from coopslam.records import Odometry, Record

FIELDS = "robots, range_is_depth, camera, odometry, provenance"


@dataclass(frozen=True, slots=True)
class CalibrateSettings:
    """How logs calibrate themselves.

    Logs of MR.CLAM do not tell the noise of their sensors: what `MrclamSettings` says is that of robots as they come,
    and calibrated ones have less. After two rounds their trajectory does not get better any more.
    """

    mrclam: SelfCalibrationSettings = field(
        default_factory=lambda: SelfCalibrationSettings(2, camera=CALIBRATED_CAMERA, reads_odometry_noise=True)
    )
    others: SelfCalibrationSettings = field(default_factory=SelfCalibrationSettings)


def read_calibration(path: Path) -> Calibration:
    """Raises BadInput, with file and key, for what is no calibration."""
    mapping = load_toml(path)
    if not mapping:
        raise BadInput(f"{path}: nothing in it; expected a calibration with {FIELDS}")
    return from_mapping(Calibration, mapping, str(path))


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Raises BadInput when it cannot be written."""
    try:
        path.write_text(dump_toml(to_mapping(calibration)), encoding="utf-8")
    except (OSError, ValueError) as error:  # ValueError: a path that no system can have
        reason = getattr(error, "strerror", None) or error
        raise BadInput(f"{str(path)[:200]}: cannot be written: {reason}; expected a file") from error


def calibrate_itself(
    log: Log,
    records: Sequence[Record],
    is_mrclam: bool,
    timeline: TimelineSettings,
    settings: CalibrateSettings,
    tell: Callable[[str], None],
    rounds: int | None = None,
    hold: tuple[str, ...] | None = None,
) -> SelfCalibrated:
    """The log's own calibration, from raw records. rounds, hold: instead of those of the settings."""
    own, header = settings.mrclam if is_mrclam else settings.others, log.header
    own = own if rounds is None else replace(own, rounds=rounds)
    own = own if hold is None else replace(own, hold=hold)
    return self_calibrate(records, header.robots, header.landmarks, timeline, own, log.name, tell)


def part_of(records: Sequence[Record], from_s: float, to_s: float | None, where: str) -> list[Record]:
    """The records from `from_s` to `to_s` after the first one began; odometry that runs over an end is left out.

    to_s: None is the end of the log.  where: the log, for messages.  Raises BadInput when nothing is left.
    """
    if from_s == 0.0 and to_s is None:
        return list(records)
    first = min((_begin(record) for record in records), default=0.0)
    last = float("inf") if to_s is None else first + to_s
    kept = [record for record in records if _begin(record) >= first + from_s and record.stamp_s <= last]
    if not kept:
        until = "its end" if to_s is None else f"{to_s:g} s"
        raise BadInput(f"{where}: no records from {from_s:g} s to {until}; expected a part of the log")
    return kept


def with_part(calibration: Calibration, from_s: float, to_s: float | None) -> Calibration:
    """The same, its provenance naming the part of the log that was used."""
    provenance: Provenance = replace(calibration.provenance, from_s=from_s, to_s=to_s)
    return replace(calibration, provenance=provenance)


def _begin(record: Record) -> float:
    return record.start_s if isinstance(record, Odometry) else record.stamp_s
