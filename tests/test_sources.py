import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from mutations import damaged

from coopslam.errors import BadInput
from coopslam.io.g2o_log import G2oSource
from coopslam.io.log import Log
from coopslam.io.mrclam import MrclamSource
from coopslam.io.pyfg import PyfgSource
from coopslam.io.run_log import RunLogWriter
from coopslam.io.sources import TRUNCATED, UNDERSTOOD, RunLogSource, open_log
from coopslam.io.tum import write_tum
from coopslam.records import LogHeader, Odometry
from coopslam.se2 import Pose2

LOGS = Path(__file__).parents[1] / "datasets" / "logs"


def some_records(count: int) -> list[Odometry]:
    return [Odometry(float(k), k + 1.0, "a", Pose2(1, 0, 0.1), np.eye(3) * 0.01) for k in range(count)]


@pytest.fixture
def run(tmp_path):
    """A run directory of 20 records in two parts, with the truth of one robot."""
    directory = tmp_path / "run"
    (directory / "truth").mkdir(parents=True)
    with RunLogWriter(directory / "log.mcap", LogHeader(("a", "b"))) as writer:
        writer.extend(some_records(20)[:12])
        writer.flush()
        writer.extend(some_records(20)[12:])
    write_tum(directory / "truth" / "a.tum", [0.0, 1.0, 1.0], [Pose2(), Pose2(1, 0, 0.1), Pose2(9, 9, 0)])
    return directory


@pytest.mark.parametrize(
    ("name", "source", "robots"),
    [
        ("two_robots_mrclam", MrclamSource, ("robot1", "robot2")),
        ("two_robots.pyfg", PyfgSource, ("A", "B")),
        ("two_robots.g2o", G2oSource, ("a", "b")),
    ],
)
def test_formats_are_told_apart(name, source, robots):
    opened = open_log(LOGS / name)
    assert type(opened) is source
    assert opened.read().header.robots == robots
    assert type(open_log(str(LOGS / name))) is source


def test_a_directory_with_any_file_of_mrclam_is_one(tmp_path):
    for name in ("Barcodes.dat", "Robot2_Measurement.dat", "Robot5_Odometry.dat"):
        (tmp_path / name).write_text("")
        assert type(open_log(tmp_path)) is MrclamSource
        (tmp_path / name).unlink()


def test_a_run_by_its_directory_or_its_log(run):
    for path in (run, run / "log.mcap"):
        source = open_log(path)
        assert type(source) is RunLogSource
        log = source.read()
        assert (log.name, log.header.robots, len(log.records)) == ("run", ("a", "b"), 20)
        assert not log.dropped
        truth = source.truth()
        assert truth.robots.keys() == {"a"}
        np.testing.assert_array_equal(truth.robots["a"].stamps_s, [0, 1])  # the first of two poses at 1 s
        assert truth.robots["a"].poses[1].equals(Pose2(1, 0, 0.1), 1e-12)


def test_a_log_elsewhere_has_no_truth(run, tmp_path):
    other = tmp_path / "run" / "other.mcap"
    (run / "log.mcap").rename(other)
    assert open_log(other).truth() is None
    assert open_log(other).read().name == "other.mcap"
    (tmp_path / "plain").mkdir()
    other.rename(tmp_path / "plain" / "log.mcap")
    assert open_log(tmp_path / "plain").truth() is None


def test_of_a_log_that_breaks_off_what_precedes_the_break_is_read(run):
    path = run / "log.mcap"
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.rindex(b"coopslam.Odometry")])  # in the summary: all records are there
    log = open_log(run).read()
    assert (len(log.records), log.dropped) == (20, {TRUNCATED: 1})
    lengths = set()
    for size in range(0, len(whole), 101):
        path.write_bytes(whole[:size])
        try:
            log = open_log(run).read()
        except BadInput as error:
            assert str(error).isprintable()
        else:
            assert log.dropped == {TRUNCATED: 1}
            lengths.add(len(log.records))
    assert {12, 20} <= lengths <= {0, 12, 20}  # whole parts, each with its checksum


@settings(max_examples=60)
@given(damaged(np.random.default_rng(0).bytes(300)))
def test_noise_is_no_run_log(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "noise.mcap"
    path.write_bytes(content)
    with pytest.raises(BadInput) as caught:
        open_log(path).read()
    assert str(caught.value).isprintable()


def _run_log_bytes(folder: Path) -> bytes:
    with RunLogWriter(folder / "log.mcap", LogHeader(("a",))) as writer:
        writer.extend(some_records(3))
    return (folder / "log.mcap").read_bytes()


@pytest.fixture(scope="module")
def whole_log(tmp_path_factory):
    return _run_log_bytes(tmp_path_factory.mktemp("whole"))


def test_a_run_log_with_one_byte_changed(whole_log, tmp_path):
    """Each 41st byte inverted: a log comes back, or one line says what is wrong."""
    path = tmp_path / "a.mcap"
    for place in range(0, len(whole_log), 41):
        path.write_bytes(whole_log[:place] + bytes([whole_log[place] ^ 0xFF]) + whole_log[place + 1 :])
        try:
            log = open_log(path).read()
        except BadInput as error:
            assert str(error).isprintable()
        else:
            assert isinstance(log, Log)


def test_what_is_not_understood_is_answered_by_what_is(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.bag").write_text("hello")
    (tmp_path / "folder.pyfg").mkdir()
    for name, why in (
        ("missing.pyfg", "does not exist"),
        ("empty", "not a recording"),
        ("a.bag", "not a recording"),
        ("folder.pyfg", "not a recording"),
        ("bad\0name", "does not exist"),
        ("x" * 5000, "cannot be read"),
    ):
        with pytest.raises(BadInput) as caught:
            open_log(tmp_path / name)
        assert why in str(caught.value)
        assert str(caught.value).endswith(f"expected {UNDERSTOOD}")
        assert str(caught.value).isprintable()


def test_the_ending_of_a_name_in_capitals(tmp_path):
    (tmp_path / "A.PYFG").write_bytes((LOGS / "two_robots.pyfg").read_bytes())
    assert open_log(tmp_path / "A.PYFG").read().header.robots == ("A", "B")


def test_a_directory_that_may_not_be_read(tmp_path):
    (tmp_path / "inner").mkdir()
    tmp_path.chmod(0)
    user = os.geteuid()
    try:
        if user == 0:
            os.seteuid(65534)  # nobody; root may read everything
        with pytest.raises(BadInput, match="cannot be read: Permission denied; expected a run directory"):
            open_log(tmp_path / "inner")
    finally:
        os.seteuid(user)
        tmp_path.chmod(0o700)
