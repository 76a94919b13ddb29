from collections import Counter

import numpy as np
import pytest

from coopslam.errors import BadInput
from coopslam.io.number_table import in_time_order, read_table

COLUMNS = ("time", "x")


def table(tmp_path, content: bytes):
    path, dropped = tmp_path / "a.dat", Counter()
    path.write_bytes(content)
    return read_table(path, COLUMNS, dropped), dropped


@pytest.mark.parametrize(
    "content",
    [
        b"1 2\n3 4\n",
        b"1 2\n3 4",
        b"# time x\n\n 1\t 2 # first\r\n3 4\r\n\r\n",
        b"\xef\xbb\xbf# with a byte order mark\n1 2\n3 4\n",
        b"1e0 +2\n3. 0.4e1\n",
    ],
)
def test_what_loggers_write(tmp_path, content):
    rows, dropped = table(tmp_path, content)
    np.testing.assert_array_equal(rows, [[1, 2], [3, 4]])
    assert not dropped


@pytest.mark.parametrize("content", [b"", b"\n\n", b"# nothing\n", b"\r\n"])
def test_a_table_without_rows(tmp_path, content):
    rows, dropped = table(tmp_path, content)
    assert rows.shape == (0, 2)
    assert not dropped


@pytest.mark.parametrize("last", [b"5", b"5 6 7", b"5 -", b"5 0."[:2]])
def test_a_last_line_that_is_cut_off_is_counted(tmp_path, last):
    rows, dropped = table(tmp_path, b"# time x\n1 2\n3 4\n" + last)
    np.testing.assert_array_equal(rows, [[1, 2], [3, 4]])
    assert dropped == {"a.dat: line 4 is cut off": 1}


@pytest.mark.parametrize(
    ("content", "line"),
    [(b"1 2\n\n3\n4 5\n", 3), (b"1 2 3\n", 1), (b"# x\n1 2\nhello world\n", 3), (b"1 2\n3 4,5\n", 2), (b"1\0 2\n", 1)],
)
def test_a_line_that_is_no_row_is_named(tmp_path, content, line):
    with pytest.raises(BadInput, match=rf"a\.dat: line {line}: expected time, x, got '[^\n]*'$"):
        table(tmp_path, content)


def test_what_is_no_text_file(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, 2000, dtype=np.uint8).tobytes()
    with pytest.raises(BadInput, match="not a text file; expected the columns time, x$"):
        table(tmp_path, noise)
    with pytest.raises(BadInput, match="not a file; expected the columns"):
        read_table(tmp_path, COLUMNS, Counter())
    with pytest.raises(BadInput, match="No such file"):
        read_table(tmp_path / "b.dat", COLUMNS, Counter())


def test_rows_are_sorted_and_those_that_are_there_twice_or_not_finite_left_out(tmp_path):
    rows = np.array([[2, 1], [1, 5], [1, 4], [3, np.nan], [1, 5], [np.pi, np.inf], [4, 0], [3.5, 0], [4, 0]])
    dropped = Counter()
    ordered = in_time_order(tmp_path / "a.dat", rows, dropped)
    np.testing.assert_array_equal(ordered, [[1, 5], [1, 4], [2, 1], [3.5, 0], [4, 0]])  # stable: 5 before 4
    assert dropped == {
        "a.dat: row with a number that is not finite": 2,
        "a.dat: row earlier than the row before it; sorted": 2,  # 1 after 2, and 3.5 after 4
        "a.dat: row that was there already": 2,
    }


def test_repeated_rows_are_those_that_a_set_has_seen(tmp_path):
    rows = np.random.default_rng(1).integers(0, 4, size=(200, 3)).astype(float)
    ordered = in_time_order(tmp_path / "a.dat", rows, dropped := Counter())
    assert {tuple(row) for row in ordered} == {tuple(row) for row in rows}
    assert len(ordered) == len({tuple(row) for row in rows})
    assert dropped["a.dat: row that was there already"] == len(rows) - len(ordered)


@pytest.mark.parametrize(("stamp", "shown"), [("nan", "nan"), ("-inf", "-inf"), ("1.2e12", "1.2e\\+12")])
def test_a_stamp_that_cannot_be_is_named_by_its_line(tmp_path, stamp, shown):
    rows, _ = table(tmp_path, f"# x\n1 2\n\n{stamp} 4\n".encode())
    with pytest.raises(BadInput, match=f"a.dat: line 4: the time stamp {shown}; expected seconds, at most 1e\\+11$"):
        in_time_order(tmp_path / "a.dat", rows, Counter())
