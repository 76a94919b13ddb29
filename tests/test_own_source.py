"""--source FILE.py:CLASS: readers that users write, and what happens when they are wrong."""

from pathlib import Path

import pytest
from replay_script import PYFG, call_replay, refused_replay, results_in
from script_calls import load, without_seconds


@pytest.fixture
def replayed(tmp_path):
    return results_in(tmp_path, call_replay)


OWN = """
from coopslam.io.log import Log, Truth, true_track
from coopslam.io.pyfg import PyfgSource

class Reader:
    def __init__(self, path):
        self.inner = PyfgSource({path!r})

    def read(self):
        {read}
        return self.inner.read()

    def truth(self):
        {truth}
        return self.inner.truth()
"""


def own(directory: Path, read: str = "pass", truth: str = "pass") -> str:
    (directory / "own.py").write_text(OWN.format(path=str(PYFG), read=read, truth=truth))
    return f"{directory / 'own.py'}:Reader"


def test_a_reader_of_ones_own_replays_like_ours(replayed, tmp_path):
    log = tmp_path / "any.thing"
    log.write_text("")
    ours = without_seconds(load(replayed(PYFG, out="ours") / "summary.json"))
    theirs = without_seconds(load(replayed(log, "--source", own(tmp_path), out="theirs") / "summary.json"))
    assert {**theirs, "log": ""} == {**ours, "log": ""}


@pytest.mark.parametrize("where", ["read", "truth"])
@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("raise KeyError('x')", ["KeyError", "line"]),
        ("raise SystemExit(0)", ["SystemExit"]),
        ("1 / 0", ["ZeroDivisionError", "line"]),
        ("raise OSError(28, 'two\\nlines')", ["OSError", "two lines"]),
        ("from coopslam.errors import BadInput; raise BadInput('my file: line 3')", ["my file: line 3"]),
        ("return 7", ["7", "expected"]),
    ],
)
def test_whatever_a_reader_raises_is_one_line_that_names_it(capsys, tmp_path, where, statement, words):
    source = own(tmp_path, **{where: statement})
    refused_replay(capsys, PYFG, "--source", source, "--out", tmp_path / "out", words=["--source", "own.py", *words])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("class Other: pass", ["no Reader"]),
        ("class Reader: pass", ["TypeError"]),
        ("class Reader:\n    def __init__(self, path): pass", ["AttributeError", "read"]),
        ("Reader = 7", ["TypeError"]),
        ("this is no Python", ["SyntaxError"]),
        ("import nowhere_at_all", ["ModuleNotFoundError"]),
        ("\0", ["own.py"]),
    ],
)
def test_files_without_a_reader(capsys, tmp_path, text, words):
    (tmp_path / "own.py").write_text(text)
    source = f"{tmp_path / 'own.py'}:Reader"
    refused_replay(capsys, PYFG, "--source", source, "--out", tmp_path / "out", words=["--source", *words])


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        (
            "log = self.inner.read(); return Log('x', log.header, [*log.records, None], log.dropped)",
            ["None", "records"],
        ),
        ("log = self.inner.read(); return Log('x', None, log.records)", ["header"]),
        ("log = self.inner.read(); return Log('x', log.header, None)", ["NoneType"]),
        ("log = self.inner.read(); return Log('x', log.header, [])", ["no records"]),
    ],
)
def test_a_log_of_other_things_is_refused(capsys, tmp_path, statement, words):
    source = own(tmp_path, read=statement)
    refused_replay(capsys, PYFG, "--source", source, "--out", tmp_path / "out", words=words)
