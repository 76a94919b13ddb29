import json
import os
import signal
import struct
import subprocess
import sys
import time
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from coopslam.errors import BadInput, BadRecord
from coopslam.io.record_json import KINDS
from coopslam.io.run_log import HEADER_NAME, PROFILE, RunLogWriter, read_run_log
from coopslam.records import (
    BearingFix,
    BearingRangeFix,
    CornerDecision,
    CornerSighting,
    Decision,
    LandmarkPrior,
    LogHeader,
    LoopClosure,
    Measurement,
    MoveNote,
    Odometry,
    PosePrior,
    RangeFix,
    RelativePoseFix,
    TriangleDecision,
    WallDecision,
)
from coopslam.se2 import Pose2

HEADER = LogHeader(
    ("anna", "bert"),
    ("landmark 6", "é"),
    seed=7,
    world='one "obstacle"',
    sensor_models={"tracker": {"range_sigma_m": 0.1 + 0.2, "axes": ["x", "y"], "limit": None}},
    provenance="line 1\nline 2 é",
)


def random_cov(rng, size):
    root = rng.normal(size=(size, size)) * 10.0 ** rng.integers(-6, 3)
    cov = root @ root.T
    return (cov + cov.T) / 2


def random_pose(rng):
    """A product, so that its cosine and sine are not those of its own angle to the last bit."""
    return Pose2(*rng.normal(size=3) * 30) * Pose2(*rng.normal(size=3))


def one_of_each(rng, stamp):
    stamp = float(stamp)
    sighting = CornerSighting(stamp, "anna", random_pose(rng), random_cov(rng, 3), rng.uniform(0.1, 6), 0.02)
    return [
        Odometry(stamp - 0.1, stamp, "bert", random_pose(rng), random_cov(rng, 3)),
        RelativePoseFix(stamp, "anna", "bert", random_pose(rng), random_cov(rng, 3)),
        BearingRangeFix(stamp, "anna", "landmark 6", rng.normal(), rng.uniform(0, 9), random_cov(rng, 2)),
        RangeFix(stamp, "anna", "bert", rng.uniform(0, 9), 0.03),
        BearingFix(stamp, "bert", "anna", rng.normal(), 1e-300),
        LoopClosure(stamp - 9.0, stamp, "bert", "anna", random_pose(rng), random_cov(rng, 3)),
        PosePrior(stamp, "anna", random_pose(rng), random_cov(rng, 3)),
        LandmarkPrior(stamp, "landmark 6", rng.normal(size=2), random_cov(rng, 2)),
        sighting,
        CornerDecision(stamp, sighting, 4, True, evidence="only candidate; é \"'\n"),
        CornerDecision(stamp, sighting, 5, False, rng.uniform(0, 9), rng.uniform(9, 99)),
        WallDecision(stamp, 4, 5),
        TriangleDecision(stamp, 0, (4, 5, 6)),
        MoveNote(stamp, "anna", "bert", "follow the wall", "corner"),
    ]


def some_records(rounds=20, seed=1):
    rng = np.random.default_rng(seed)
    stamps = np.round(rng.uniform(-5, 5, rounds), 1)  # out of order, with duplicates, some negative
    return [record for stamp in stamps for record in one_of_each(rng, stamp)]


def bits(value):
    """A record as nested tuples with every float as its eight bytes."""
    if is_dataclass(value):
        return (type(value).__name__, *(bits(getattr(value, field.name)) for field in fields(value)))
    if isinstance(value, Pose2):
        turn = value.rotation()
        return bits((value.x(), value.y(), value.theta(), turn.c(), turn.s()))
    if isinstance(value, np.ndarray):
        return (value.shape, value.tobytes())
    if isinstance(value, tuple):
        return tuple(map(bits, value))
    return struct.pack("<d", value) if isinstance(value, float) else value


def write(path, records, header=HEADER):
    with RunLogWriter(path, header) as log:
        log.extend(records)
    return path


def write_foreign(path, messages, *, profile=PROFILE, header=True, encoding="json"):
    """A log made with the mcap library alone. messages: (topic, sequence, bytes)."""
    metadata = {"format": "1", "robots": '["anna","bert"]', "frame": '""', "seed": "null", "world": '""'}
    metadata |= {"sensor_models": "{}", "provenance": '""'}
    writer = Writer(str(path))
    writer.start(profile=profile)
    if header:
        writer.add_metadata(HEADER_NAME, metadata if header is True else metadata | header)
    channels = {topic: writer.register_channel(topic, encoding, 0) for topic in dict.fromkeys(m[0] for m in messages)}
    for topic, sequence, data in messages:
        writer.add_message(channels[topic], 0, data, 0, sequence)
    writer.finish()
    return path


def message_of(record, **changes):
    (kind,) = (kind for kind in KINDS if kind.record is type(record))
    return kind.topic, 0, json.dumps(json.loads(kind.say(record)) | changes).encode()


def refused(path, expected, **options):
    with pytest.raises(BadInput, match=expected) as caught:
        read_run_log(path, **options)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_every_kind_comes_back_in_order_to_the_last_bit(tmp_path):
    records = some_records(200)  # 2800 records: several chunks
    header, again = read_run_log(write(tmp_path / "log.mcap", records))
    assert header == HEADER
    assert len(again) == len(records)
    assert [bits(record) for record in again] == [bits(record) for record in records]


def test_every_record_class_has_a_topic_and_every_field_a_key():
    assert {kind.record for kind in KINDS} == {*get_args(Measurement), *get_args(Decision), MoveNote}
    assert len({kind.topic for kind in KINDS}) == len(KINDS)
    for kind in KINDS:
        assert [field.name for field in kind.fields] == [field.name for field in fields(kind.record)]


def test_the_mcap_library_reads_it_as_json_with_schemas(tmp_path):
    records = some_records()
    path = write(tmp_path / "log.mcap", records)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == PROFILE
        summary = reader.get_summary()
        assert summary.statistics.message_count == len(records)
        assert {channel.topic for channel in summary.channels.values()} == {kind.topic for kind in KINDS}
        (metadata,) = reader.iter_metadata()
        assert metadata.name == HEADER_NAME and json.loads(metadata.metadata["robots"]) == ["anna", "bert"]
        messages = list(reader.iter_messages(log_time_order=False))
    assert [message.sequence for _, _, message in messages] == list(range(len(records)))
    for (schema, channel, message), record in zip(messages, records, strict=True):
        content, described = json.loads(message.data), json.loads(schema.data)
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        assert list(content) == described["required"] == list(described["properties"])
        assert content["stamp_s"] == record.stamp_s
        assert message.log_time == max(round(record.stamp_s * 1e9), 0)
    odometry = json.loads(messages[0][2].data)
    assert odometry["robot"] == "bert"
    assert odometry["T_start_now"]["theta"] == records[0].T_start_now.theta()
    assert odometry["cov_now_x_y_theta"] == records[0].cov_now.ravel().tolist()
    assert json.loads(messages[2][2].data)["cov_bearing_range"][1] == records[2].cov[0, 1]


def test_numpy_numbers_and_extreme_stamps(tmp_path):
    records = [
        WallDecision(np.float64(1e300), np.int64(1), np.int32(2)),
        RangeFix(-1e300, "anna", "bert", np.float32(0.5), 5e-324),
        Odometry(0, 0, "anna", Pose2(), np.zeros((3, 3), dtype=int)),
    ]
    wall, distance, odometry = read_run_log(write(tmp_path / "log.mcap", records))[1]
    assert (wall.stamp_s, wall.start, wall.end) == (1e300, 1, 2)
    assert (distance.stamp_s, distance.range_m, distance.sigma_m) == (-1e300, 0.5, 5e-324)
    assert odometry.cov_now.dtype == float and type(odometry.stamp_s) is float


def test_a_log_of_before_there_were_landmarks(tmp_path):
    """Its metadata say nothing of them."""
    path = write_foreign(tmp_path / "log.mcap", [message_of(Odometry(0.0, 1.0, "anna", Pose2(), np.eye(3)))])
    header, records = read_run_log(path)
    assert (header.robots, header.landmarks, len(records)) == (("anna", "bert"), (), 1)
    again, _ = read_run_log(write_foreign(tmp_path / "new.mcap", [], header={"landmarks": '["post"]'}))
    assert again.landmarks == ("post",)
    refused(write_foreign(tmp_path / "bad.mcap", [], header={"landmarks": '["anna"]'}), "different names")
    refused(write_foreign(tmp_path / "worse.mcap", [], header={"landmarks": "3"}), "header of the run log")


def test_a_log_without_records(tmp_path):
    assert read_run_log(write(tmp_path / "log.mcap", [])) == (HEADER, [])


def test_the_sequence_number_orders_the_records(tmp_path):
    walls = [("wall_decision", i, message_of(WallDecision(0.0, i, 99))[2]) for i in (2, 0, 1)]
    _, records = read_run_log(write_foreign(tmp_path / "log.mcap", walls))
    assert [record.start for record in records] == [0, 1, 2]
    refused(write_foreign(tmp_path / "gap.mcap", walls[:2]), "record number 2 where number 1")
    refused(write_foreign(tmp_path / "twice.mcap", [walls[1], walls[1]]), "record number 0 where number 1")


def test_a_pose_without_cosine_and_sine(tmp_path):
    step = Odometry(0.0, 1.0, "anna", Pose2(), np.eye(3))
    path = write_foreign(tmp_path / "log.mcap", [message_of(step, T_start_now={"x": 1, "y": 2, "theta": 0.3})])
    assert read_run_log(path)[1][0].T_start_now.equals(Pose2(1, 2, 0.3), 1e-15)


def test_what_cannot_be_logged_is_refused(tmp_path):
    sighting = CornerSighting(0.0, "anna", Pose2(), np.eye(3), 1.0, 0.1)
    with RunLogWriter(tmp_path / "log.mcap", HEADER) as log:
        with pytest.raises(BadRecord, match="corner_decision at t = 0.0 s"):
            log.append(CornerDecision(0.0, sighting, 1, False, distance_sq=float("nan")))
        log.append(sighting)
    assert len(read_run_log(tmp_path / "log.mcap")[1]) == 1
    with pytest.raises(BadInput, match="cannot write"):
        RunLogWriter(tmp_path / "none" / "log.mcap", HEADER)
    for models in ({"a": np.eye(2)}, {"a": float("inf")}, {"a": (1, 2)}, {1: "a"}):
        with pytest.raises(BadInput, match="header"):
            RunLogWriter(tmp_path / "other.mcap", LogHeader(("anna",), sensor_models=models))


def test_an_exception_leaves_a_complete_log(tmp_path):
    records = some_records()
    with pytest.raises(ZeroDivisionError), RunLogWriter(tmp_path / "log.mcap", HEADER) as log:
        log.extend(records)
        raise ZeroDivisionError
    assert len(read_run_log(tmp_path / "log.mcap")[1]) == len(records)


KILLED = """
import sys, time
from coopslam.io.run_log import RunLogWriter
from coopslam.records import LogHeader, WallDecision
log = RunLogWriter(sys.argv[1], LogHeader(("anna", "bert")))
log.extend(WallDecision(float(i), i, -1) for i in range(1700))
print("written", flush=True)
time.sleep(60)
"""


def test_a_killed_writer_leaves_its_records(tmp_path):
    path, root = tmp_path / "log.mcap", str(Path(__file__).parent.parent)
    environment = os.environ | {"PYTHONPATH": root}
    with subprocess.Popen([sys.executable, "-c", KILLED, path], stdout=subprocess.PIPE, env=environment) as writer:
        assert writer.stdout.readline() == b"written\n"
        writer.send_signal(signal.SIGKILL)
    refused(path, "truncated or damaged")
    header, records = read_run_log(path, allow_truncated=True)
    assert header.robots == ("anna", "bert")
    assert [record.start for record in records] == list(range(1500))  # whole chunks of 500


def test_every_truncation_is_noticed_and_gives_a_prefix(tmp_path):
    records = some_records(6)
    path = tmp_path / "log.mcap"
    with RunLogWriter(path, HEADER) as log:
        for record in records:
            log.append(record)
            log.flush()
    expected, whole = [bits(record) for record in records], path.read_bytes()
    lengths = set()
    for size in range(8, len(whole), 331):
        path.write_bytes(whole[:size])
        refused(path, "expected")
        try:
            header, prefix = read_run_log(path, allow_truncated=True)
        except BadInput as error:
            assert size < 1000 and "expected" in str(error)  # the header itself is lost
            continue
        assert header == HEADER
        assert [bits(record) for record in prefix] == expected[: len(prefix)]
        lengths.add(len(prefix))
    assert {0, len(records)} < lengths and len(lengths) > 10


@pytest.fixture(scope="module")
def small_log(tmp_path_factory):
    return write(tmp_path_factory.mktemp("log") / "log.mcap", some_records(3))


@settings(max_examples=150)
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255), truncated=st.booleans())
def test_a_damaged_byte_never_passes_for_data(small_log, place, flip, truncated):
    data = bytearray(small_log.read_bytes())
    data[int(place * len(data))] ^= flip
    path = small_log.with_name("damaged.mcap")
    path.write_bytes(data)
    expected = [bits(record) for record in read_run_log(small_log)[1]]
    try:
        header, records = read_run_log(path, allow_truncated=truncated)
    except BadInput as error:
        assert str(path) in str(error) and "\n" not in str(error)
        return
    got = [bits(record) for record in records]
    assert got == (expected[: len(got)] if truncated else expected)
    assert truncated or header == HEADER


@settings(max_examples=100)
@given(data=st.binary(max_size=300), magic=st.booleans(), truncated=st.booleans())
def test_random_bytes_are_refused(tmp_path_factory, data, magic, truncated):
    path = tmp_path_factory.getbasetemp() / "random.mcap"
    path.write_bytes((b"\x89MCAP0\r\n" if magic else b"") + data)
    refused(path, "not a run log; expected", allow_truncated=truncated)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "empty.mcap").write_bytes(b"")
    refused(tmp_path / "empty.mcap", "not a run log; expected an MCAP file")
    refused(tmp_path / "none.mcap", "cannot read the run log: No such file")
    refused(tmp_path, "cannot read the run log: Is a directory")
    refused(write_foreign(tmp_path / "ros.mcap", [], profile="ros2"), "not a run log")
    refused(write_foreign(tmp_path / "bare.mcap", [], header=False), "no metadata 'coopslam.header'")
    refused(write_foreign(tmp_path / "new.mcap", [], header={"format": "2"}), "format '2'; expected '1'")
    refused(write_foreign(tmp_path / "seed.mcap", [], header={"seed": "1.5"}), "expected an integer, got 1.5")
    refused(write_foreign(tmp_path / "names.mcap", [], header={"robots": '["a","a"]'}), "different robot names")
    refused(write_foreign(tmp_path / "models.mcap", [], header={"sensor_models": "3"}), "header of the run log")


STEP = Odometry(0.0, 1.0, "anna", Pose2(), np.eye(3))
FIX = RelativePoseFix(1.0, "anna", "bert", Pose2(), np.eye(3))
CORNER = CornerSighting(0.0, "anna", Pose2(), np.eye(3), 1.0, 0.1)


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (("lidar", 0, b"{}"), "unknown topic 'lidar'.*expected JSON on one of odometry, relative_pose"),
        (("odometry", 0, b"{"), r"record 0 \(odometry\)"),
        (("odometry", 0, b"\xff"), r"record 0 \(odometry\)"),
        (("odometry", 0, b"[" * 100_000), "nested too deeply"),
        (("odometry", 0, b"[]"), "expected an object"),
        (("odometry", 0, b"{}"), "no field 'start_s'; expected start_s, stamp_s"),
        (message_of(STEP, stamp_s=float("nan")), "expected finite numbers, got NaN"),
        (
            (*message_of(STEP)[:2], message_of(STEP)[2].replace(b"1.0", b"1e999", 1)),
            "stamp_s: expected a finite number",
        ),
        (message_of(STEP, stamp_s=10**400), "stamp_s: expected a finite number"),
        (message_of(STEP, stamp_s=True), "stamp_s: expected a finite number, got True"),
        (message_of(STEP, stamp_s=-1.0), "back to -1 s"),
        (message_of(STEP, robot=3), "robot: expected text, got 3"),
        (message_of(STEP, T_start_now=[0, 0, 0]), "T_start_now: expected a pose {x, y, theta}"),
        (message_of(STEP, T_start_now={"x": 0, "y": 0}), "T_start_now: expected a pose"),
        (message_of(STEP, T_start_now={"x": 0, "y": 0, "theta": 1, "cos": 1, "sin": 0}), "does not agree"),
        (message_of(STEP, cov_now_x_y_theta=[1, 2, 3]), "cov_now_x_y_theta: expected 9 numbers"),
        (message_of(STEP, cov_now_x_y_theta=["1"] * 9), "cov_now_x_y_theta: expected a finite number"),
        (message_of(STEP, cov_now_x_y_theta=[-1] * 9), "no .3, 3. covariance"),
        (message_of(FIX, target="anna"), "anna cannot observe itself"),
        (message_of(TriangleDecision(0.0, 1, (1, 2, 3)), vertices=[1, 2]), "expected three integers"),
        (message_of(CornerDecision(0.0, CORNER, 1, True), is_new=1), "is_new: expected true or false"),
        (message_of(CornerDecision(0.0, CORNER, 1, True), sighting=None), "sighting: expected an object"),
    ],
)
def test_what_cannot_be_a_record_is_refused(tmp_path, message, expected):
    refused(write_foreign(tmp_path / "log.mcap", [message]), expected)


def test_another_encoding_is_refused(tmp_path):
    path = write_foreign(tmp_path / "log.mcap", [message_of(STEP)], encoding="cbor")
    refused(path, "encoding 'cbor'; expected JSON")


@pytest.mark.slow
def test_writing_160_000_odometry_records_takes_seconds(tmp_path):
    rng = np.random.default_rng(2)
    steps = [Odometry(i, i + 1, "anna", random_pose(rng), random_cov(rng, 3)) for i in range(160_000)]
    start = time.perf_counter()
    write(tmp_path / "log.mcap", steps)
    assert time.perf_counter() - start < 160_000 * 40e-6  # 15 us each when nothing else runs
