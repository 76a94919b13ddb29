"""Run logs: every record of a run, in order, as JSON messages with JSON schemas in an MCAP file (https://mcap.dev).

One topic per kind of record (`record_json.KINDS`). The header is the MCAP metadata record `coopslam.header`, each of
its fields as JSON. A message's log time is its stamp in nanoseconds (clamped to what MCAP can say: zero or more, below
2^64); its sequence number is its place in the log, and the only thing that orders the records.
"""

import json
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata
from mcap.records import Header as FileHeader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

from coopslam.errors import BadInput, BadRecord
from coopslam.io.record_json import KINDS, Kind, integer, parse_json, text
from coopslam.records import LogHeader, Record

PROFILE = "coopslam"
HEADER_NAME = "coopslam.header"
FORMAT_VERSION = "1"

_RECORDS_PER_CHUNK = 500  # what an abort can lose at most; 60 to 150 kB
_CHUNK_LIMIT_BYTES = 1 << 30  # chunks end where we flush, not before
_MAX_TIME_NS = 1.8e19
_BROKEN_FILE = (McapError, struct.error, ZstdError, ValueError, OverflowError, RuntimeError, MemoryError)


class RunLogWriter:
    """Writes a run log; a context manager. What was appended survives an abort, except for the last 500 records.

    Call `flush` where nothing may be lost (after each step of a mission). A file that is there is replaced.
    Raises BadInput when the file cannot be written, or the header cannot be said in JSON.
    """

    def __init__(self, path: str | Path, header: LogHeader):
        metadata = _header_to_metadata(header)
        try:
            self._stream = open(path, "wb")  # noqa: SIM115 (closed by close)
        except OSError as error:
            raise BadInput(f"{path}: cannot write a run log here: {error.strerror}") from error
        self._count = 0
        self._writer = Writer(self._stream, _CHUNK_LIMIT_BYTES, CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile=PROFILE)
        self._writer.add_metadata(HEADER_NAME, metadata)
        self._kinds = {kind.record: (kind, self._register(kind)) for kind in KINDS}
        self.flush()

    def append(self, record: Record) -> None:
        """Write one record. Raises BadRecord when a number in it is not finite."""
        kind, channel = self._kinds[type(record)]
        try:
            data = kind.say(record).encode()
        except ValueError as error:
            raise BadRecord(f"{kind.topic} at t = {record.stamp_s} s cannot be logged: {error}") from error
        time_ns = round(min(max(float(record.stamp_s) * 1e9, 0.0), _MAX_TIME_NS))
        self._writer.add_message(channel, time_ns, data, time_ns, self._count)
        self._count += 1
        if self._count % _RECORDS_PER_CHUNK == 0:
            self.flush()

    def extend(self, records: Iterable[Record]) -> None:
        """Write records in this order."""
        for record in records:
            self.append(record)

    def flush(self) -> None:
        """Hand everything so far to the operating system."""
        self._writer.flush()

    def close(self) -> None:
        """Write the index; a file without it counts as truncated. May be called again."""
        if not self._stream.closed:
            self._writer.finish()
            self._stream.close()

    def __enter__(self) -> "RunLogWriter":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def _register(self, kind: Kind) -> int:
        schema = json.dumps(kind.schema()).encode()
        schema_id = self._writer.register_schema(f"coopslam.{kind.record.__name__}", "jsonschema", schema)
        return self._writer.register_channel(kind.topic, "json", schema_id)


def read_run_log(path: str | Path, *, allow_truncated: bool = False) -> tuple[LogHeader, list[Record]]:
    """The header and the records of a run log, in the order in which they were recorded.

    allow_truncated: accept a log whose writer was killed or whose end was lost, and return what precedes the break.
    Raises BadInput when the file is not a complete run log, or holds what cannot be a record.
    """
    path = Path(path)
    header, numbered = None, []
    kinds = {kind.topic: kind for kind in KINDS}
    for item in _read_mcap(path, allow_truncated):
        if isinstance(item, Metadata):
            header = _header_from_metadata(item.metadata, path) if item.name == HEADER_NAME else header
            continue
        channel, message = item
        kind = kinds.get(channel.topic)
        if kind is None or channel.message_encoding != "json":
            what = f"unknown topic {channel.topic!r} with the encoding {channel.message_encoding!r}"
            raise BadInput(f"{path}: {what}; expected JSON on one of {', '.join(kinds)}")
        numbered.append((message.sequence, _read_record(kind, message, path)))
    if header is None:
        raise BadInput(f"{path}: no metadata {HEADER_NAME!r}; expected a run log written by coopslam")
    numbered.sort(key=lambda pair: pair[0])
    for expected, (sequence, _) in enumerate(numbered):
        if sequence != expected:
            raise BadInput(f"{path}: record number {sequence} where number {expected} was expected")
    return header, [record for _, record in numbered]


def _read_mcap(path: Path, allow_truncated: bool) -> Iterator[Metadata | tuple[Channel, Message]]:
    """What the file holds, in its own order. Raises BadInput."""
    ours = False
    channels: dict[int, Channel] = {}
    try:
        with path.open("rb") as stream:
            size = path.stat().st_size
            for item in StreamReader(stream, validate_crcs=True, record_size_limit=size).records:
                if isinstance(item, FileHeader):
                    ours = item.profile == PROFILE
                if not ours:
                    break
                if isinstance(item, Channel):
                    channels[item.id] = item
                elif isinstance(item, Message):
                    if item.channel_id not in channels:
                        raise McapError(f"message on the unknown channel {item.channel_id}")
                    yield channels[item.channel_id], item
                elif isinstance(item, Metadata):
                    yield item
    except OSError as error:
        raise BadInput(f"{path}: cannot read the run log: {error.strerror}") from error
    except _BROKEN_FILE as error:
        if ours and not allow_truncated:
            why = _one_line(error)
            raise BadInput(f"{path}: truncated or damaged run log; expected a complete one ({why})") from error
    if not ours:
        raise BadInput(f"{path}: not a run log; expected an MCAP file with the profile {PROFILE!r}")


def _read_record(kind: Kind, message: Message, path: Path) -> Record:
    try:
        return kind.read(parse_json(message.data))
    except (ValueError, BadRecord) as error:
        raise BadInput(f"{path}: record {message.sequence} ({kind.topic}): {_one_line(error)}") from error


def _header_to_metadata(header: LogHeader) -> dict[str, str]:
    fields = {
        "robots": list(header.robots),
        "landmarks": list(header.landmarks),
        "frame": header.frame,
        "seed": header.seed,
        "world": header.world,
        "sensor_models": header.sensor_models,
        "provenance": header.provenance,
    }
    try:
        metadata = {name: json.dumps(value, allow_nan=False) for name, value in fields.items()}
    except (TypeError, ValueError) as error:
        raise BadInput(f"the header of a run log must be finite JSON: {error}") from error
    if parse_json(metadata["sensor_models"]) != header.sensor_models:
        raise BadInput("the sensor models of a run log's header must be plain JSON: lists, and keys that are text")
    return {"format": FORMAT_VERSION, **metadata}


def _header_from_metadata(metadata: dict[str, str], path: Path) -> LogHeader:
    if metadata.get("format") != FORMAT_VERSION:
        raise BadInput(f"{path}: run log format {metadata.get('format')!r}; expected {FORMAT_VERSION!r}")
    try:
        fields = {name: parse_json(value) for name, value in metadata.items() if name != "format"}
        return LogHeader(
            robots=tuple(text(robot) for robot in fields["robots"]),
            landmarks=tuple(text(landmark) for landmark in fields.get("landmarks", [])),
            frame=text(fields["frame"]),
            seed=None if fields["seed"] is None else integer(fields["seed"]),
            world=text(fields["world"]),
            sensor_models=dict(fields["sensor_models"]),
            provenance=text(fields["provenance"]),
        )
    except KeyError as error:
        raise BadInput(f"{path}: the header of the run log has no field {error}") from error
    except (ValueError, TypeError, BadRecord) as error:
        raise BadInput(f"{path}: header of the run log: {_one_line(error)}") from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
