"""Logs as the world damages them, through the whole of replay.py: used as far as they go, or refused in one line."""

import io
import json
import os
import shutil
import subprocess
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutations import damaged, mistaken
from replay_script import G2O, MRCLAM, PYFG, call_replay
from script_calls import SCRIPTS

from coopslam.errors import CoopSlamError
from coopslam.io.run_log import RunLogWriter
from coopslam.io.sources import open_log
from coopslam.records import BearingRangeFix, LogHeader, Odometry
from coopslam.se2 import Pose2

ESTIMATORS = ("batch", "ekf", "incremental", "fixed-lag", "weighted", "dead-reckoning")


def replayed(log: Path, estimator: str = "batch", *options) -> tuple[int, str, dict | None]:
    """Exit code, what was said on standard error, and the summary; a warning of numpy is an error.

    The log is in a directory of its own, and the results go beside it.
    """
    out, said = log.parent / f"out-{estimator}", io.StringIO()
    arguments = (log, "--estimator", estimator, "--figures", "none", "--out", out, "--force", *options)
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(said):
        warnings.simplefilter("error")
        code = call_replay(*arguments)
    said = said.getvalue()
    assert code in (0, 2, 3)
    assert len(said.splitlines()) == (code != 0) and len(said) < 1500, said
    summary = out / "summary.json"
    return code, said, json.loads(summary.read_text()) if summary.exists() else None


@pytest.fixture
def mrclam(tmp_path):
    return Path(shutil.copytree(MRCLAM, tmp_path / "log"))


def edit(path: Path, change):
    """Replace the lines of a text file, without the comment on top, by what `change` makes of their words."""
    top, *lines = path.read_text().splitlines()
    path.write_text("\n".join([top, *(" ".join(words) for words in change([line.split() for line in lines]))]) + "\n")


# ---- any damage ----


@st.composite
def run_logs(draw, directory: Path) -> Path:
    """A complete run log of records that nobody could have recorded."""
    log = open_log(draw(st.sampled_from([PYFG, MRCLAM, G2O]))).read()
    records, header = list(log.records), log.header
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(records) - 1))
        try:
            match draw(st.sampled_from(["lose", "double", "move", "now", "name", "team", "far", "loose"])):
                case "lose" if len(records) > 40:
                    del records[at : at + draw(st.sampled_from([1, 3, 10, 30]))]
                case "double":
                    records.insert(draw(st.integers(0, len(records))), records[at])
                case "move":
                    records.append(records.pop(at))
                case "now":
                    stamp_s = draw(st.sampled_from([0.0, -1.0, 1e9, 1e12, 1e300, records[-1].stamp_s]))
                    records[at] = replace(records[at], stamp_s=stamp_s)
                case "name" if hasattr(records[at], "observer"):
                    target = draw(st.sampled_from([*header.robots, *header.landmarks, "nobody", ""]))
                    records[at] = replace(records[at], target=target)
                case "team":
                    robots = log.header.robots
                    team = st.sampled_from([robots[:1], robots[::-1], (*robots, "extra"), ("extra", *robots), ("?",)])
                    header = replace(header, robots=draw(team))
                case "far" if hasattr(records[at], "range_m"):
                    range_m = draw(st.sampled_from([0.0, 1e-300, 1e-7, 1e5, 1e9, 1e300]))
                    records[at] = replace(records[at], range_m=range_m)
                case "loose" if isinstance(records[at], Odometry):
                    share = draw(st.sampled_from([0.0, 1e-300, 1e-12, 1e12, 1e300]))
                    records[at] = replace(records[at], cov_now=share * records[at].cov_now)
        except CoopSlamError:  # the record itself refused
            continue
    path = directory / "log.mcap"
    with RunLogWriter(path, header) as writer:
        writer.extend(records)
    return path


@st.composite
def hostile(draw, directory: Path) -> Path:
    kind = draw(st.sampled_from(["mrclam", "pyfg", "g2o", "damaged mcap", "mcap"]))
    if kind == "mcap":
        return draw(run_logs(directory))
    damage = draw(st.sampled_from([damaged, mistaken]))
    if kind == "mrclam":
        log = Path(shutil.copytree(MRCLAM, directory / "log"))
        names = st.sampled_from(sorted(path.name for path in MRCLAM.iterdir()))
        files = [log / name for name in draw(st.lists(names, min_size=1, max_size=2, unique=True))]
    elif kind == "damaged mcap":
        files = [log] = [directory / "log.mcap"]
        recorded = open_log(PYFG).read()
        with RunLogWriter(log, recorded.header) as writer:
            writer.extend(recorded.records)
        damage = damaged
    else:
        files = [log] = [Path(shutil.copy(PYFG if kind == "pyfg" else G2O, directory))]
    for file in files:
        file.write_bytes(draw(damage(file.read_bytes())))
    return log


def check_any_damage(data, estimator):
    with TemporaryDirectory() as directory:
        log = data.draw(hostile(Path(directory)))
        for name in ("batch", estimator):
            code, _, summary = replayed(log, name)
            if code != 2:
                assert "dropped" in summary["records"]
                assert ("failed" in summary["estimators"][name]) == (code == 3)


@settings(max_examples=90, suppress_health_check=list(HealthCheck))
@given(st.data(), st.sampled_from(ESTIMATORS[1:]))
def test_any_damage_ends_with_results_or_in_one_line(data, estimator):
    check_any_damage(data, estimator)


@pytest.mark.slow
@settings(max_examples=3000, suppress_health_check=list(HealthCheck))
@given(st.data(), st.sampled_from(ESTIMATORS[1:]))
def test_much_damage_ends_with_results_or_in_one_line(data, estimator):
    check_any_damage(data, estimator)


# ---- what is used, with a count of what is not ----

# file, words of a line -> words of lines, what is counted
COUNTED = {
    "NaN": ("Robot1_Measurement.dat", lambda rows: [[*rows[0][:2], "nan", "0.1"], *rows[1:]], "not finite"),
    "infinite": ("Robot2_Odometry.dat", lambda rows: [[rows[0][0], "inf", "0"], *rows[1:]], "not finite"),
    "negative range": ("Robot1_Measurement.dat", lambda rows: [[*rows[0][:2], "-1", "0.1"], *rows[1:]], "cannot be"),
    "range zero": ("Robot1_Measurement.dat", lambda rows: [[*rows[0][:2], "0", "0.1"], *rows[1:]], "cannot be"),
    "nearly zero": ("Robot1_Measurement.dat", lambda rows: [[*rows[0][:2], "1e-300", "0"], *rows[1:]], "nearer than"),
    "time backwards": ("Robot1_Odometry.dat", lambda rows: rows[::-1], "earlier than the row before"),
    "rows twice": ("Robot2_Measurement.dat", lambda rows: [row for row in rows for _ in "ab"], "was there already"),
    "barcode of nobody": ("Robot1_Measurement.dat", lambda rows: [*rows, ["1001", "99", "1", "0"]], "to nobody"),
    "its own barcode": ("Robot1_Measurement.dat", lambda rows: [*rows, ["1001", "5", "1", "0"]], "own barcode"),
    "no rows": ("Robot2_Odometry.dat", lambda rows: [], "no odometry"),
    "a command out of reach": ("Robot1_Odometry.dat", lambda rows: [["1000", "1e300", "0"], *rows[1:]], "beyond 100"),
}


@pytest.mark.parametrize("name", COUNTED)
@pytest.mark.parametrize("estimator", ["batch", "ekf"])
def test_what_is_left_out_of_a_log_is_counted(mrclam, name, estimator):
    file, change, why = COUNTED[name]
    edit(mrclam / file, change)
    code, said, summary = replayed(mrclam, estimator)
    assert code == 0, said
    assert [number for what, number in summary["records"]["dropped"].items() if why in what and number > 0]
    assert summary["estimators"][estimator]["ate_rmse_m"] < 1.0  # the whole log spans 3 m


def test_a_file_that_is_cut_in_the_middle_of_a_line(mrclam):
    path = mrclam / "Robot1_Measurement.dat"
    path.write_bytes(path.read_bytes()[:-9])
    code, _, summary = replayed(mrclam)
    assert code == 0 and [what for what in summary["records"]["dropped"] if "cut off" in what]


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_truncated_run_log_is_used_up_to_the_break(tmp_path, estimator):
    recorded, path = open_log(PYFG).read(), tmp_path / "log.mcap"
    writer = RunLogWriter(path, recorded.header)
    writer.extend(recorded.records)
    writer.flush()
    kept = path.stat().st_size
    writer.append(recorded.records[-1])
    writer.close()
    path.write_bytes(path.read_bytes()[: kept + 20])
    code, said, summary = replayed(path, estimator)
    assert code == 0, said
    assert summary["records"]["dropped"] == {"truncated: what precedes the break was read": 1}
    assert sum(summary["records"][type_] for type_ in {type(r).__name__ for r in recorded.records}) == len(
        recorded.records
    )


def test_windows_line_ends_make_no_difference(mrclam):
    _, _, before = replayed(mrclam)
    for path in mrclam.iterdir():
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    code, _, after = replayed(mrclam)
    assert code == 0 and after["records"] == before["records"]
    assert after["estimators"]["batch"]["ate_rmse_m"] == before["estimators"]["batch"]["ate_rmse_m"]


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_one_robot_and_what_it_sees(mrclam, estimator):
    for path in mrclam.glob("Robot2_*.dat"):
        path.unlink()
    code, said, summary = replayed(mrclam, estimator)
    assert code == 0 and summary["robots"] == ["robot1"], said
    assert summary["records"]["dropped"]["bearing_range: robot2 has no files"] > 0
    assert summary["estimators"][estimator]["ate_rmse_m"] < 1.0


# ---- what cannot be used, or not to the end ----


@pytest.mark.parametrize("name", ["log.mcap", "log.pyfg", "log.g2o", "log/Robot1_Odometry.dat", "log/Barcodes.dat"])
def test_noise_is_no_log(tmp_path, name):
    path = tmp_path / name
    if path.parent != tmp_path:
        shutil.copytree(MRCLAM, path.parent)
    path.write_bytes(np.random.default_rng(0).bytes(4000))
    code, said, _ = replayed(path if path.parent == tmp_path else path.parent)
    assert code == 2 and path.name in said and "expected" in said


@pytest.mark.parametrize("name", ["log.mcap", "log.pyfg", "log.g2o", "log"])
def test_nothing_is_no_log(tmp_path, name):
    (tmp_path / name).mkdir() if name == "log" else (tmp_path / name).touch()
    code, said, _ = replayed(tmp_path / name)
    assert code == 2 and name in said and "expected" in said


@pytest.mark.parametrize(
    ("file", "row", "words"),
    [
        ("Robot1_Odometry.dat", ["1e300", "0", "0"], ["line 2", "1e+300", "seconds"]),
        ("Robot1_Odometry.dat", ["1000000000000000000", "0", "0"], ["line 2", "1e+18", "seconds"]),
        ("Robot1_Odometry.dat", ["nan", "0", "0"], ["line 2", "nan", "seconds"]),
        ("Robot1_Odometry.dat", ["1000", "0"], ["line 2", "forward velocity"]),
        ("Robot2_Measurement.dat", ["1000", "5", "1,5", "0"], ["line 2", "range"]),
        ("Robot1_Groundtruth.dat", ["1000", "1e300", "0", "0"], ["robot1", "1e+300", "position"]),
        ("Landmark_Groundtruth.dat", ["6", "1e300", "0", "0", "0"], ["landmark6", "1e+300", "position"]),
    ],
)
def test_a_wrong_number_is_named(mrclam, file, row, words):
    edit(mrclam / file, lambda rows: [row, *rows[1:]])
    code, said, _ = replayed(mrclam)
    assert code == 2 and [word for word in words if word not in said] == [], said


@pytest.mark.parametrize("path", [PYFG, G2O, MRCLAM])
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_all_stamps_equal(tmp_path, path, estimator):
    """Poses of a graph are numbered instead; commands that hold for no time drive nowhere."""
    log = tmp_path / path.name
    if path.is_dir():
        shutil.copytree(path, log)
        for file in log.glob("Robot*.dat"):
            edit(file, lambda rows: [["1000", *row[1:]] for row in rows])
    else:
        log.write_text("".join(_stamped(line) for line in path.read_text().splitlines(keepends=True)))
    code, said, summary = replayed(log, estimator)
    assert code in (0, 3) and summary["log"] == str(log), said


def _stamped(line: str) -> str:
    words = line.split()
    return line.replace(words[1], "7.0", 1) if "." in words[1] else line


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_two_lines(mrclam, estimator):
    """One command and one sighting say nothing of where the second robot is, but that it was seen."""
    for file in mrclam.glob("Robot*.dat"):
        edit(file, lambda rows: rows[:1])
    code, said, summary = replayed(mrclam, estimator)
    assert code in (0, 3) and summary["robots"] == ["robot1", "robot2"], said


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_robot_that_nobody_sees_is_named(mrclam, estimator):
    edit(mrclam / "Robot1_Measurement.dat", lambda rows: [])
    edit(mrclam / "Robot2_Measurement.dat", lambda rows: [])
    code, said, summary = replayed(mrclam, estimator)
    assert code == 3 and "robot2" in said
    assert summary["estimators"][estimator]["failed"] in said


# ---- run logs of records that no reader would make ----


def drive(stamp_s: float, robot: str = "a", x: float = 1.0, cov: float = 1e-4) -> Odometry:
    return Odometry(stamp_s - 1.0, stamp_s, robot, Pose2(x, 0, 0), cov * np.eye(3))


def fix(stamp_s: float, range_m: float) -> BearingRangeFix:
    return BearingRangeFix(stamp_s, "a", "b", 0.5, range_m, 1e-4 * np.eye(2))


def written(path: Path, header: LogHeader, *records) -> Path:
    with RunLogWriter(path, header) as writer:
        writer.extend(records)
    return path


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (drive(1e18), ["Odometry", "1e+18", "seconds"]),
        (drive(2, x=1e300), ["Odometry", "T_start_now", "1e+300"]),
        (drive(2, cov=1e300), ["Odometry", "cov_now", "1e+300"]),
        (fix(1, 1e300), ["BearingRangeFix", "range_m", "1e+300"]),
    ],
)
def test_numbers_beyond_all_bounds_are_refused(tmp_path, record, words):
    log = written(tmp_path / "x.mcap", LogHeader(("a", "b")), drive(1), drive(1, "b"), record)
    code, said, _ = replayed(log)
    assert code == 2 and [word for word in [*words, "x.mcap"] if word not in said] == [], said


@pytest.mark.parametrize("name", ["../evil", "a/b", ".hidden", "x" * 300, "line\nbreak", "a.causal", ""])
def test_a_name_that_no_file_can_have_is_refused(tmp_path, name):
    log = written(tmp_path / "x.mcap", LogHeader((name,)), drive(1, name))
    code, said, _ = replayed(log)
    assert code == 2 and "robot" in said and not list(tmp_path.rglob("*.tum"))


def test_a_header_of_other_robots(tmp_path):
    code, said, _ = replayed(written(tmp_path / "x.mcap", LogHeader(("other",)), drive(1), drive(2)))
    assert code == 2 and "other" in said and "header" in said


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_robot_in_the_header_that_has_no_records_is_counted(tmp_path, estimator):
    log = written(tmp_path / "x.mcap", LogHeader(("a", "ghost")), drive(1), drive(2))
    code, said, summary = replayed(log, estimator)
    assert code == 0 and summary["records"]["dropped"] == {"ghost: no records of it": 1}, said
    assert {path.name for path in tmp_path.rglob("*.tum")} - {"a.causal.tum"} == {"a.tum"}


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_first_robot_that_has_no_records_leaves_the_others_without_an_origin(tmp_path, estimator):
    log = written(tmp_path / "x.mcap", LogHeader(("ghost", "a")), drive(1), drive(2))
    code, said, summary = replayed(log, estimator)
    assert code == 3 and "a is not connected to ghost" in said and "failed" in summary["estimators"][estimator]


def test_pipes_and_directories_with_the_name_of_a_log(tmp_path):
    for name in ("log.mcap", "log.pyfg", "log.g2o"):
        os.mkfifo(tmp_path / name)
        code, said, _ = replayed(tmp_path / name)
        assert code == 2 and name in said and "expected" in said


def test_a_name_with_brackets_is_no_markup(tmp_path, capsys):
    log = shutil.copy(PYFG, tmp_path / "[red] [nothing]&<b>.pyfg")
    assert call_replay(log, "--out", tmp_path / "out") == 0
    assert "[red] [nothing]&<b>.pyfg" in " ".join(capsys.readouterr().out.split())
    report = (tmp_path / "out" / "report.html").read_text()
    assert "<b>.pyfg" not in report and "&lt;b&gt;" in report


@pytest.mark.parametrize(
    ("name", "encoding"), [(b"\xff.pyfg", "utf-8:strict"), (b"l\xc3\xb6g.pyfg", "ascii"), (b"two\nlines.pyfg", "utf-8")]
)
def test_names_that_a_terminal_cannot_show(tmp_path, name, encoding):
    """In a process of its own, since the encoding is chosen when Python starts."""
    log = os.path.join(os.fsencode(tmp_path), name)
    shutil.copy(PYFG, log)
    command = [sys.executable, SCRIPTS / "replay.py", log, "--figures", "none", "--out", tmp_path / "out"]
    done = subprocess.run(command, capture_output=True, env={**os.environ, "PYTHONIOENCODING": encoding})
    assert done.returncode == 0 and done.stderr == b"", done.stderr.decode(errors="replace")
