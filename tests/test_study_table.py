"""results.csv: a torn last line is dropped, whatever else is wrong with it is said with its line, nothing is lost."""

from pathlib import Path

import pytest
from _study_table import IDENTITY, RESULTS, WORLD_SIZE, ResultsTable

from coopslam.errors import BadInput

COLUMNS = [*IDENTITY, "an axis", *WORLD_SIZE, *RESULTS]
BOM = b"\xef\xbb\xbf"


def opened(path: Path, columns=COLUMNS) -> ResultsTable:
    return ResultsTable(path, columns, {})


def a_row(key: str, **more) -> dict:
    return {"key": key, "seed": 1, "success": True, "outcome": "complete", "seconds": 0.5} | more


@pytest.fixture
def path(tmp_path) -> Path:
    """A table of five rows."""
    table = opened(tmp_path / "results.csv")
    for key in "abcde":
        table.append(a_row(key, **{"an axis": f"{key}, said with a comma"}))
    return table.path


def changed(path: Path, number: int, change) -> bytes:
    """The file with another line `number`, counted from 1."""
    lines = path.read_bytes().splitlines(keepends=True)
    lines[number - 1] = change(lines[number - 1])
    path.write_bytes(b"".join(lines))
    return path.read_bytes()


def test_it_comes_back_as_it_was_written(path):
    before = path.read_bytes()
    table = opened(path)
    assert [*table.rows] == [*"abcde"] and not table.torn and path.read_bytes() == before
    assert table.rows["b"]["an axis"] == "b, said with a comma" and table.rows["b"]["success"] == "true"


WRONG = [  # line, change, what is said
    (3, lambda line: line.replace(b"0.5", b'"0.5'), "unexpected end"),
    (3, lambda line: line.replace(b"0.5", b'0.5"'), "seconds: a number expected"),
    (3, lambda line: line.replace(b"comma", b'com"ma'), "not a line of CSV"),
    (3, lambda line: line[:4] + b"\n", "fields expected, got 4"),
    (3, lambda line: b"\n", "fields expected, got 0"),
    (3, lambda line: line.replace(b"b,", b",", 1), "no key"),
    (3, lambda line: line.replace(b"true", b"TRUE"), "success: true or false expected, got 'TRUE'"),
    (3, lambda line: line.replace(b"comma", b"\xff"), "not UTF-8"),
    (3, lambda line: line.replace(b"comma", b"x" * 200_000), "field larger than field limit"),
    (6, lambda line: line.replace(b"comma", b"x" * 200_000), "field larger than field limit"),
    (4, lambda line: line.replace(b"c,", b"a,", 1), "the same run as line 2"),
    (6, lambda line: line[:-1] + b",,\n", "fields expected"),
    (1, lambda line: line.replace(b"version", b"ver"), "first columns"),
    (1, lambda line: line[: line.index(b",an axis")] + b"\n", "no column 'batch.ate_rmse_m'"),
    (1, lambda line: line.replace(b"outcome_reason", b"reason"), "no column 'outcome_reason'"),
    (1, lambda line: line[:-1] + b",an axis\n", "two columns 'an axis'"),
    (1, lambda line: b'"' + line, "not a line of CSV"),
]


@pytest.mark.parametrize(("number", "change", "words"), WRONG, ids=[f"{n}-{words}" for n, _, words in WRONG])
def test_what_is_wrong_is_said_with_its_line_and_nothing_is_deleted(path, number, change, words):
    before = changed(path, number, change)
    with pytest.raises(BadInput) as caught:
        opened(path)
    said = str(caught.value)
    assert words in said and str(path) in said, said
    assert f"line {number}:" in said or words == "first columns"
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "change",
    [
        lambda line: line[:-1],
        lambda line: line[:7],
        lambda line: line[:20] + b"\n",
        lambda line: line[: line.index(b"said")] + b"\n",  # within quotes
        lambda line: b"\n",
        lambda line: line[:9] + b"\xc3",
        lambda line: line[:9] + bytes(200_000),
    ],
)
def test_a_torn_last_line_is_dropped(path, change):
    before = path.read_bytes()
    changed(path, 6, change)
    table = opened(path)
    assert table.torn and [*table.rows] == [*"abcd"]
    table.append(a_row("e", **{"an axis": "e, said with a comma"}))
    assert path.read_bytes() == before


def test_a_file_without_a_whole_line(tmp_path):
    path = tmp_path / "results.csv"
    for begun in (b"", b"ke", b"key,version,world,seed,an"):
        path.write_bytes(begun)
        assert opened(path).rows == {}
        assert path.read_bytes().count(b"\n") == 1
    path.write_bytes(b"notes of mine, without a line feed")
    with pytest.raises(BadInput, match="first columns"):
        opened(path)
    assert path.read_bytes() == b"notes of mine, without a line feed"


def test_a_spreadsheet_may_have_saved_it(path):
    """A byte order mark, and line ends of Windows."""
    path.write_bytes(BOM + path.read_bytes().replace(b"\n", b"\r\n"))
    assert [*opened(path).rows] == [*"abcde"]
    table = opened(path, [*COLUMNS, "another axis"])
    assert [*table.rows] == [*"abcde"] and path.read_bytes().startswith(b"key,version")


def test_one_that_may_not_be_changed_is_not_replaced(path, monkeypatch):
    """Permission bits are no obstacle for root, so opening is made to fail."""
    before, really_open = path.read_bytes(), open

    def refused(file, mode="r", *more, **options):
        if Path(file) == path and mode != "rb":
            raise PermissionError(13, "Permission denied", str(file))
        return really_open(file, mode, *more, **options)

    monkeypatch.setattr("builtins.open", refused)
    table = opened(path)
    for act in (table.require_writable, lambda: table.append(a_row("f")), lambda: table.append(a_row("a"))):
        with pytest.raises(BadInput, match=r"results\.csv: cannot be written: Permission denied"):
            act()
    assert path.read_bytes() == before and not path.with_suffix(".new").exists()
