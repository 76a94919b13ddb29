"""Logs of MR.CLAM with files that are missing, torn or wrong: what cannot be is counted or named in one line."""

import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mrclam_files import SMALL, append, count, fixes_of, steps_of
from mutations import damaged

from coopslam.errors import BadInput
from coopslam.io.log import Log
from coopslam.io.mrclam import MrclamSettings, MrclamSource
from coopslam.se2 import xytheta


@pytest.fixture
def small(tmp_path):
    return Path(shutil.copytree(SMALL, tmp_path / "log"))


def test_who_is_seen_without_being_part_of_the_log_is_counted(small):
    before = count(MrclamSource(small).read())
    append(small / "Barcodes.dat", "4\t33\n")
    append(small / "Robot1_Measurement.dat", "1003\t50\t2\t0.1\n1003\t5\t2\t0.1\n1003\t33\t2\t0.1\n1003.1\t50\t2\t0\n")
    log = MrclamSource(small).read()
    assert log.dropped == {
        "Robot1_Measurement.dat: row earlier than the row before it; sorted": 1,
        "bearing_range: barcode 50 belongs to nobody": 2,
        "bearing_range: robot1 sees its own barcode": 1,
        "bearing_range: robot4 has no files": 1,
    }
    assert count(log) == before


@pytest.mark.parametrize(
    ("row", "why"),
    [
        ("1008.2 63 nan 0.1", "Robot1_Measurement.dat: row with a number that is not finite"),
        ("1008.2 63 1 -inf", "Robot1_Measurement.dat: row with a number that is not finite"),
        ("1008.2 63 -2 0.1", "bearing_range: range or bearing that cannot be"),
        ("1008.2 63 0 0.1", "bearing_range: range or bearing that cannot be"),
        ("1008.2 63 1e300 0.1", "bearing_range: range or bearing that cannot be"),
        ("1008.2 63 1 2.0", "bearing_range: range or bearing that cannot be"),  # a depth behind the camera
        ("1008.2 63 1 1.57079", "bearing_range: range or bearing that cannot be"),  # or nearly beside it
        ("1008.2 63 1", "Robot1_Measurement.dat: line 44 is cut off"),
    ],
)
def test_a_sighting_that_cannot_be_is_counted(small, row, why):
    before = count(MrclamSource(small).read())
    append(small / "Robot1_Measurement.dat", row)
    log = MrclamSource(small, MrclamSettings(range_is_depth=True)).read()
    assert log.dropped == {why: 1}
    assert count(log) == before


@pytest.mark.parametrize("row", ["1008.2 nan 0", "1008.2 0 inf", "1008.2 1e3 0", "1008.2 0"])
def test_a_command_that_cannot_be_is_counted(small, row):
    path = small / "Robot2_Odometry.dat"
    append(path, row)
    log = MrclamSource(small).read()
    assert list(log.dropped.values()) == [1]
    assert count(log) == count(MrclamSource(SMALL).read())


def test_time_that_runs_backwards_and_rows_that_came_twice(small):
    path = small / "Robot1_Odometry.dat"
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *rows[20:], *rows[:21]]) + "\n")
    log, expected = MrclamSource(small).read(), MrclamSource(SMALL).read()
    assert log.dropped == {
        "Robot1_Odometry.dat: row earlier than the row before it; sorted": 1,
        "Robot1_Odometry.dat: row that was there already": 1,
    }
    assert [record.stamp_s for record in log.records] == [record.stamp_s for record in expected.records]
    for step, other in zip(steps_of(log, "robot1"), steps_of(expected, "robot1"), strict=True):
        np.testing.assert_array_equal(xytheta(step.T_start_now), xytheta(other.T_start_now))


def test_a_robot_without_odometry_moves_in_unknown_ways_and_that_is_said(small):
    (small / "Robot2_Odometry.dat").unlink()
    log = MrclamSource(small).read()
    assert log.dropped["robot2: no odometry, its motion is unknown"] == 1
    assert log.header.robots == ("robot1", "robot2")
    steps = steps_of(log, "robot2")
    span_s = steps[-1].stamp_s - steps[0].start_s
    total = sum(np.diag(step.cov_now) for step in steps)
    np.testing.assert_allclose(total, span_s * 0.25, rtol=1e-9)  # 0.5 m and 0.5 rad after 1 s
    assert len(fixes_of(log, "robot2")) == len(np.loadtxt(small / "Robot2_Measurement.dat"))


def test_a_robot_without_sightings_still_drives_and_is_seen(small):
    (small / "Robot2_Measurement.dat").unlink()
    log = MrclamSource(small).read()
    assert log.dropped == {"robot2: no measurement file": 1}
    assert len(steps_of(log, "robot2")) == len(steps_of(MrclamSource(SMALL).read(), "robot2"))
    assert any(fix.target == "robot2" for fix in fixes_of(log))


def test_odometry_with_a_gap_is_bridged_and_said(small):
    path = small / "Robot1_Odometry.dat"
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *rows[:6], *rows[24:]]) + "\n")  # 1001.0 to 1004.8
    log = MrclamSource(small).read()
    assert log.dropped == {"odometry: nothing of robot1 for more than 2 s; taken as unknown motion": 1}
    bridge = [step for step in steps_of(log, "robot1") if 1001.0 <= step.start_s < 1004.8]
    seen = {fix.stamp_s for fix in fixes_of(log) if "robot1" in (fix.observer, fix.target)}
    assert [step.stamp_s for step in bridge] == sorted({s for s in seen if 1001.0 < s < 1004.8} | {1004.8})
    total = sum(np.diag(step.cov_now) for step in bridge)
    np.testing.assert_allclose(total, 3.8 * 0.25, rtol=1e-9)  # 0.5 m and 0.5 rad after 1 s


def test_a_file_of_two_lines_and_an_empty_one(small):
    (small / "Robot1_Odometry.dat").write_text("1000 0.4 0\n1000.2 0 0\n")
    (small / "Robot2_Odometry.dat").write_text("")
    log = MrclamSource(small, MrclamSettings(longest_gap_s=100)).read()
    assert len(steps_of(log, "robot1")) == 2
    assert log.dropped == {"robot2: no odometry, its motion is unknown": 1}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("Robot1_Odometry.dat", b"1000 0.4 0\nhello\n1001 0 0\n", "line 2: expected time, forward velocity, angular"),
        ("Robot1_Odometry.dat", b"1000 0.4 0\n1e12 0.4 0\n", "line 2: the time stamp 1e\\+12; expected seconds"),
        ("Robot1_Measurement.dat", b"# x\nnan 63 1 0\n", "line 2: the time stamp nan; expected seconds"),
        ("Robot1_Measurement.dat", bytes(range(256)) * 9, "not a text file; expected the columns time, barcode, range"),
        ("Barcodes.dat", b"1 5\n2 5\n", "barcode 5 belongs to robot1 and robot2; expected one owner"),
        ("Barcodes.dat", b"1.5 5\n", "subject 1.5; expected a whole number"),
        ("Barcodes.dat", b"nan 5\n", "subject nan; expected a whole number"),
    ],
)
def test_what_is_not_in_the_format_is_named(small, name, content, message):
    (small / name).write_bytes(content)
    with pytest.raises(BadInput, match=f"{name}: {message}") as caught:
        MrclamSource(small).read()
    assert "\n" not in str(caught.value)


def test_barcodes_are_needed_where_something_was_seen(small):
    (small / "Barcodes.dat").unlink()
    with pytest.raises(BadInput, match="Barcodes.dat: cannot be read: No such file"):
        MrclamSource(small).read()
    for path in small.glob("*_Measurement.dat"):
        path.unlink()
    assert count(MrclamSource(small).read()).keys() == {"Odometry"}


def test_truth_that_is_not_in_the_format_is_named(small):
    append(small / "Landmark_Groundtruth.dat", "9 nan 0 0 0\n")
    with pytest.raises(BadInput, match="Landmark_Groundtruth.dat: NaN or infinity"):
        MrclamSource(small).truth()
    (small / "Robot1_Groundtruth.dat").write_text("1 2 3\n4 5 6\n")
    with pytest.raises(BadInput, match="Robot1_Groundtruth.dat: line 1: expected time, x, y, orientation"):
        MrclamSource(small).truth()


def test_what_is_no_directory_of_mrclam(small, tmp_path):
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "empty", tmp_path / "missing", small / "Barcodes.dat"):
        with pytest.raises(BadInput, match="no Robot1_Odometry.dat or the like; expected a directory of MR.CLAM"):
            MrclamSource(path).read()
    (tmp_path / "empty" / "Robot3_Odometry.dat").write_text("# nothing\n")
    with pytest.raises(BadInput, match="neither motion nor a sighting"):
        MrclamSource(tmp_path / "empty").read()


def test_a_directory_where_a_file_should_be(small):
    (small / "Robot1_Odometry.dat").unlink()
    (small / "Robot1_Odometry.dat").mkdir()
    with pytest.raises(BadInput, match="Robot1_Odometry.dat: not a file; expected the columns"):
        MrclamSource(small).read()


def test_what_may_not_be_read():
    folder = Path(tempfile.mkdtemp())
    user = os.geteuid()
    try:
        small = Path(shutil.copytree(SMALL, folder / "log"))
        (small / "Robot1_Odometry.dat").chmod(0)
        folder.chmod(0o755)
        if user == 0:
            os.seteuid(65534)  # nobody; root may read everything
        with pytest.raises(BadInput, match="Robot1_Odometry.dat: cannot be read: Permission denied"):
            MrclamSource(small).read()
        os.seteuid(user)
        small.chmod(0)
        if user == 0:
            os.seteuid(65534)
        with pytest.raises(BadInput, match="cannot be read: Permission denied"):
            MrclamSource(small).read()
    finally:
        os.seteuid(user)
        (folder / "log").chmod(0o700)
        shutil.rmtree(folder)


FILES = {path.name: path.read_bytes() for path in sorted(SMALL.iterdir())}


@settings(max_examples=150)
@given(st.sampled_from(sorted(FILES)), st.data())
def test_damage_is_read_over_or_named_in_one_line(name, data):
    content = data.draw(damaged(FILES[name]))
    with tempfile.TemporaryDirectory() as folder:
        for other, bytes_of in FILES.items():
            (Path(folder) / other).write_bytes(content if other == name else bytes_of)
        for read in (MrclamSource(folder).read, MrclamSource(folder).truth):
            try:
                result = read()
            except BadInput as error:
                assert str(error).isprintable()
            else:
                assert isinstance(result, Log) or result.robots
