"""track.py on pictures of render_tracker.py, as black boxes: records against truth; what is wrong, in one line."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import render_tracker
import track
from script_calls import exit_code, require_one_line, rows_of

from coopslam.io.run_log import read_run_log
from coopslam.records import BearingRangeFix, RelativePoseFix
from coopslam.se2 import xytheta
from tracker.sheets import SHEETS_DIR

FRAMES = 8
KINDS = ["helix", "tag_cube"]


@pytest.fixture(scope="module", params=KINDS)
def tracked(request, tmp_path_factory) -> tuple[str, Path, Path]:
    """(data sheet, pictures, what was tracked in them)"""
    sheet, folder = f"{request.param}_640x480", tmp_path_factory.mktemp(request.param)
    pictures, out = folder / "pictures", folder / "out"
    assert exit_code(render_tracker.main, "--sheet", sheet, "--out", pictures, "--frames", FRAMES) == 0
    assert exit_code(track.main, pictures, "--sheet", sheet, "--out", out, "--stamps", pictures / "truth.csv") == 0
    return sheet, pictures, out


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cube") / "pictures"
    assert exit_code(render_tracker.main, "--sheet", SHEET, "--out", folder, "--frames", 4) == 0
    return folder


SHEET = "tag_cube_640x480"


def test_the_table_holds_the_truth(tracked):
    """Each measurement is within five of its own sigmas, and these are as small as was demanded at 3 m."""
    _, pictures, out = tracked
    rows, truth = rows_of(out / "records.csv"), rows_of(pictures / "truth.csv")
    assert [row["image"] for row in rows] == [row["file"] for row in truth]
    assert [float(row["stamp_s"]) for row in rows] == [float(row["stamp_s"]) for row in truth]
    found = [(row, true) for row, true in zip(rows, truth, strict=True) if row["found"] == "pose"]
    assert len(found) >= FRAMES - 2
    for row, true in found:
        for name in ("range_m", "bearing_rad", "heading_rad"):
            error = float(row[name]) - float(true[name])
            error = error if name == "range_m" else float(np.angle(np.exp(1j * error)))
            assert abs(error) < 5 * float(row[name.replace("_", "_sigma_")]), (row["image"], name, error)
        assert float(row["range_sigma_m"]) < 0.025 * float(row["range_m"])


def test_the_log_holds_what_the_table_says(tracked):
    """Covariances of the table against those of the log: carried over by numeric derivatives."""
    _, _, out = tracked
    header, records = read_run_log(out / "log.mcap")
    assert header.robots == ("robot0", "robot1") and "pictures" in header.provenance
    rows = [row for row in rows_of(out / "records.csv") if row["found"] != "nothing"]
    assert len(records) == len(rows)

    def polar(pose: np.ndarray) -> np.ndarray:
        return np.array([np.arctan2(pose[1], pose[0]), np.hypot(pose[0], pose[1]), pose[2]])

    for record, row in zip(records, rows, strict=True):
        assert (record.observer, record.target) == ("robot0", "robot1")
        assert record.stamp_s == pytest.approx(float(row["stamp_s"]), abs=1e-9)
        if isinstance(record, BearingRangeFix):
            assert row["found"] == "bearing and range" and row["heading_rad"] == ""
            continue
        assert isinstance(record, RelativePoseFix)
        pose, step = xytheta(record.T_observer_target), 1e-6
        jacobian = np.column_stack([(polar(pose + e) - polar(pose - e)) / (2 * step) for e in step * np.eye(3)])
        cov = jacobian @ record.cov_observer @ jacobian.T
        named = [
            ["cov_bearing_bearing_rad2", "cov_bearing_range_m_rad", "cov_bearing_heading_rad2"],
            ["cov_bearing_range_m_rad", "cov_range_range_m2", "cov_range_heading_m_rad"],
            ["cov_bearing_heading_rad2", "cov_range_heading_m_rad", "cov_heading_heading_rad2"],
        ]
        said = np.array([[float(row[name]) for name in names] for names in named])
        scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
        np.testing.assert_allclose(said / scale, cov / scale, atol=1e-6)
        np.testing.assert_allclose(
            [float(row[name]) for name in ("bearing_rad", "range_m", "heading_rad")], polar(pose), rtol=1e-9, atol=1e-12
        )


def test_figures_and_summary(tracked):
    _, _, out = tracked
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    rows = rows_of(out / "records.csv")
    assert summary["images"] == FRAMES and summary["unreadable"] == []
    assert summary["detections"] == sum(row["found"] != "nothing" for row in rows)
    sheet = cv2.imread(str(out / "figures" / "contact_sheet.png")).astype(int)
    green = (sheet[..., 1] > sheet[..., 2] + 60) & (sheet[..., 1] > sheet[..., 0] + 60)
    assert green.sum() > 50  # outlines; the pictures themselves are grey
    assert cv2.imread(str(out / "figures" / "track.png")) is not None
    pytest.importorskip("av")
    film = cv2.VideoCapture(str(out / "figures" / "annotated.mp4"))
    assert film.isOpened() and film.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES


def test_a_video_is_tracked_like_its_pictures(pictures, tmp_path):
    film = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"MJPG"), 5.0, (640, 480), isColor=False)
    for path in sorted(pictures.glob("*.png")):
        writer.write(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    writer.release()
    assert exit_code(track.main, film, "--sheet", SHEET, "--out", tmp_path / "out") == 0
    rows, truth = rows_of(tmp_path / "out" / "records.csv"), rows_of(pictures / "truth.csv")
    assert [float(row["stamp_s"]) for row in rows] == [0.0, 0.2, 0.4, 0.6]
    for row, true in zip(rows, truth, strict=True):  # JPEG adds errors that the detector does not expect
        assert float(row["range_m"]) == pytest.approx(float(true["range_m"]), rel=0.01)


def test_a_video_that_breaks_off_is_said(pictures, tmp_path, capsys):
    film = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"MJPG"), 5.0, (640, 480), isColor=False)
    for _ in range(8):
        writer.write(cv2.imread(str(pictures / "frame_00000.png"), cv2.IMREAD_GRAYSCALE))
    writer.release()
    film.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
    assert exit_code(track.main, film, "--sheet", SHEET, "--out", tmp_path / "out") == 2
    require_one_line(capsys.readouterr().err, "drive.avi frame 4 of 8", "cannot be read", "4 pictures before it")
    assert len(rows_of(tmp_path / "out" / "records.csv")) == 4


def test_images_come_in_natural_order(pictures, tmp_path):
    """At the rate that was asked for; a picture without target is a line of the table and no record."""
    folder = tmp_path / "images"
    folder.mkdir()
    (folder / "notes.txt").write_text("not a picture", encoding="utf-8")
    data = (pictures / "frame_00000.png").read_bytes()
    for name in ("shot2.png", "shot10.png"):
        (folder / name).write_bytes(data)
    cv2.imwrite(str(folder / "shot9.png"), np.full((480, 640), 90, np.uint8))
    arguments = ["--sheet", SHEET, "--fps", 4, "--observer", "ann", "--target", "bob", "--out", tmp_path / "out"]
    assert exit_code(track.main, folder, *arguments) == 0
    rows = rows_of(tmp_path / "out" / "records.csv")
    assert [(row["image"], row["stamp_s"], row["found"]) for row in rows] == [
        ("shot2.png", "0.0", "pose"),
        ("shot9.png", "0.25", "nothing"),
        ("shot10.png", "0.5", "pose"),
    ]
    assert rows[1]["range_m"] == "" and rows[0]["range_m"] == rows[2]["range_m"]
    _, records = read_run_log(tmp_path / "out" / "log.mcap")
    assert [(record.stamp_s, record.observer, record.target) for record in records] == [
        (0.0, "ann", "bob"),
        (0.5, "ann", "bob"),
    ]


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (b"", ["frame_00002.png", "cannot be read"]),
        (b"no picture", ["frame_00002.png", "cannot be read"]),
        ("small", ["frame_00002.png", "640 x 480 pixels expected", "320 x 240"]),
    ],
    ids=["empty", "text", "small"],
)
def test_a_bad_picture_stops_the_run_and_loses_nothing(bad, words, pictures, tmp_path, capsys):
    folder, out = tmp_path / "images", tmp_path / "out"
    folder.mkdir()
    for path in pictures.glob("*.png"):
        (folder / path.name).write_bytes(path.read_bytes())
    if bad == "small":
        bad = cv2.imencode(".png", np.zeros((240, 320), np.uint8))[1].tobytes()
    (folder / "frame_00002.png").write_bytes(bad)
    assert exit_code(track.main, folder, "--sheet", SHEET, "--out", out) == 2
    require_one_line(capsys.readouterr().err, *words, "2 pictures before it")
    assert len(read_run_log(out / "log.mcap")[1]) == len(rows_of(out / "records.csv")) == 2
    assert (out / "figures" / "track.png").is_file() and (out / "summary.json").is_file()
    assert exit_code(track.main, folder, "--sheet", SHEET, "--out", out) == 2
    require_one_line(capsys.readouterr().err, "already holds a run")
    assert exit_code(track.main, folder, "--sheet", SHEET, "--out", out, "--force", "--skip-unreadable") == 0
    assert "1 could not be used" in capsys.readouterr().out
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["images"] == 3 and summary["unreadable"] == ["frame_00002.png"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{tmp}/nothing", "--sheet", SHEET], ["nothing", "expected a folder of images or a video"]),
        (["{tmp}", "--sheet", SHEET], ["no images in it"]),
        (["{tmp}/bad.toml", "--sheet", SHEET], ["bad.toml", "cannot be read as a video"]),
        (["{pictures}", "--sheet", "{tmp}/bad.toml"], ["--sheet", "bad.toml", "height_m"]),
        (["{pictures}", "--sheet", "{tmp}/none.toml"], ["--sheet", "none.toml"]),
        (["{pictures}", "--sheet", "helix"], ["--sheet", "helix_640x480"]),
        (["{pictures}", "--sheet", SHEET, "--target", "robot0"], ["--target", "another robot"]),
        (["{pictures}", "--sheet", SHEET, "--fps", "0"], ["--fps"]),
        (["{pictures}", "--sheet", SHEET, "--stamps", "{tmp}/few.csv"], ["few.csv", "no stamp for frame_00001.png"]),
        (["{pictures}", "--sheet", SHEET, "--stamps", "{tmp}/back.csv"], ["back.csv:3", "more than 1 s"]),
        (["{pictures}", "--sheet", SHEET, "--stamps", "{tmp}/words.csv"], ["words.csv:2", "seconds expected"]),
        (["{pictures}", "--sheet", SHEET, "--stamps", "{tmp}/bad.toml"], ["bad.toml:1", "no column file"]),
        (["{pictures}", "--sheet", SHEET, "--stamps", "{tmp}/none.csv"], ["none.csv", "No such file"]),
    ],
)
def test_what_is_wrong_is_said_in_one_line(arguments, words, pictures, tmp_path, capsys):
    text = (SHEETS_DIR / f"{SHEET}.toml").read_text(encoding="utf-8")
    (tmp_path / "bad.toml").write_text(text.replace("height_m = 0.60", "height_m = -0.60"), encoding="utf-8")
    names = [f"frame_{k:05d}.png" for k in range(4)]
    for name, stamps in (("few", [0.0]), ("back", [1.0, 0.5, 2.0, 3.0]), ("words", ["soon", 1, 2, 3])):
        lines = [f"{file},{stamp}" for file, stamp in zip(names, stamps, strict=False)]
        (tmp_path / f"{name}.csv").write_text("\n".join(["file,stamp_s", *lines, ""]), encoding="utf-8")
    places = {"tmp": tmp_path, "pictures": pictures}
    arguments = [argument.format(**places) for argument in arguments]
    assert exit_code(track.main, *arguments, "--out", tmp_path / "out") == 2
    require_one_line(capsys.readouterr().err, *words)
    assert not (tmp_path / "out").exists()
