"""The film of a run: what a frame shows at a moment, and the files."""

import dataclasses
from html.parser import HTMLParser

import av
import explore_and_optimize
import numpy as np
import pytest
from _cli import run
from _exploration import ExplorationSettings, explore, prepare
from _exploration_output import view_of
from PIL import Image

from coopslam.records import MoveNote, TriangleDecision
from coopslam.report import animation, canvas
from coopslam.report.animation import HOLD_FRAMES, Film, frame_times, write_animation
from coopslam.report.story import Story
from coopslam.report.video import FRAME_MS, FRAMES_PER_S, palette_of

FRAMES = 24


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return explore(prepare(ExplorationSettings("paper_two_occluders")), tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def view(finished):
    return view_of(finished)


@pytest.fixture(scope="module")
def film(view):
    return Film(view)


@pytest.fixture(scope="module")
def files(view, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(animation, "FRAMES_AT_MOST", FRAMES)
        return write_animation(view, tmp_path_factory.mktemp("film"))


def lasting(view, seconds: float):
    """The same run, as if it had taken so long."""
    move = dataclasses.replace(view.story.moves[0], start_s=0.0, end_s=seconds)
    return dataclasses.replace(view, story=dataclasses.replace(view.story, moves=(move,)))


@pytest.mark.parametrize(("seconds", "frames"), [(0.1, 25), (40.0, 126), (90.0, 275), (1e5, 275)])
def test_a_film_lasts_half_a_minute_at_most(view, seconds, frames):
    times = frame_times(lasting(view, seconds))
    assert len(times) == frames and (times[0], times[-1]) == (0.0, seconds)
    assert (len(times) + HOLD_FRAMES) / FRAMES_PER_S <= 30


def test_a_frame_shows_the_triangles_decided_until_then(finished, view, film):
    decided = [record.stamp_s for record in finished.records if isinstance(record, TriangleDecision)]
    for time_s in frame_times(view)[::10]:
        film.frame(time_s)
        known = sum(stamp_s <= time_s for stamp_s in decided)
        assert len(film.triangles.get_paths()) == known
        assert f"triangles {known:3d}" in film.text.get_text()
        assert len(film.gates.get_segments()) == len(view.story.gates_at(time_s))


def test_the_mover_is_filled_and_the_other_stands(finished, film):
    notes = [record for record in finished.records if isinstance(record, MoveNote)]
    assert {note.robot for note in notes} == {"robot0", "robot1"}
    for note in notes:
        film.frame(note.stamp_s)
        for robot, parts in film.robots.items():
            assert parts["mover"].get_visible() == (robot == note.robot)
            assert parts["stander"].get_visible() == (robot != note.robot)


def test_robots_are_where_the_estimate_has_them_when_a_move_ends(finished, view, film):
    for note in (record for record in finished.records if isinstance(record, MoveNote)):
        film.frame(note.stamp_s)
        stamps_s, path = view.stamps_s["smoothed"][note.robot], view.paths["smoothed"][note.robot]
        k = int(np.argmin(np.abs(stamps_s - note.stamp_s)))
        parts = film.robots[note.robot]
        assert np.ravel(parts["mover"].get_data()) == pytest.approx(path[k])
        largest = np.sqrt(5.991 * np.linalg.eigvalsh(view.path_covariances[note.robot][k])[-1])
        assert parts["ellipse"].width == pytest.approx(2 * film.factor * largest)


def test_without_contact_there_is_no_line(view):
    moves = tuple(dataclasses.replace(move, watched=False) for move in view.story.moves)
    blind = Film(dataclasses.replace(view, story=dataclasses.replace(view.story, moves=moves)))
    blind.frame(10.0)
    assert not blind.contact.get_visible()


def test_a_frame_depends_on_its_moment_alone(view, film):
    first = film.frame(20.0)
    other = film.frame(60.0)
    assert (film.frame(20.0) == first).all() and (other != first).any()
    height, width, channels = first.shape
    assert (width, channels) == (720, 3) and height % 2 == 0


def test_the_gif_is_complete_and_small(files):
    gif = files[1]
    assert gif.name == "exploration.gif" and gif.stat().st_size < 5e6
    with Image.open(gif) as film:
        pictures, lasts_ms = [], 0
        for k in range(film.n_frames):
            film.seek(k)
            pictures.append(np.array(film.convert("RGB")))
            lasts_ms += film.info["duration"]
        assert film.info["loop"] == 0
    assert lasts_ms == (FRAMES + HOLD_FRAMES) * FRAME_MS  # equal neighbours would be one longer frame
    assert FRAMES - 3 <= len(pictures) <= FRAMES
    assert (pictures[0] != pictures[-1]).any(axis=-1).mean() > 0.1
    for colour in (canvas.BLUE, canvas.VERMILLION, canvas.MAPPED, canvas.SOLID):
        wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        assert (pictures[-1] == wanted).all(axis=-1).any(), colour


def test_the_mp4_is_what_browsers_play(files, view, film):
    mp4 = files[0]
    assert mp4.name == "exploration.mp4"
    with av.open(str(mp4)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate) == FRAMES_PER_S
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(pictures) == FRAMES + HOLD_FRAMES
    last = film.frame(view.story.end_s).astype(int)
    assert np.abs(pictures[-1] - last).mean() < 3  # of 255; colours at half resolution
    assert np.abs(pictures[0] - last).mean() > 6
    head = mp4.read_bytes()[:4096]
    assert b"ftyp" in head and b"moov" in head  # the index comes first: it plays while it loads


def test_without_the_encoder_there_is_still_a_gif(view, tmp_path, monkeypatch):
    monkeypatch.setattr(animation, "FRAMES_AT_MOST", 3)
    monkeypatch.setattr(animation, "FRAMES_AT_LEAST", 3)
    monkeypatch.setattr(animation, "mp4_is_possible", lambda: False)
    assert write_animation(view, tmp_path) == [tmp_path / "exploration.gif"]


def test_an_interrupted_film_leaves_nothing(view, tmp_path):
    def interrupted(times):
        yield times[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_animation(view, tmp_path, interrupted)
    assert list(tmp_path.iterdir()) == []


def test_a_run_without_moves_has_no_film(view, tmp_path):
    still = dataclasses.replace(view, story=Story((), (), (), {}))
    assert write_animation(still, tmp_path / "film") == [] and not (tmp_path / "film").exists()


def test_a_palette_has_the_colours_as_they_are():
    palette = palette_of(["#ffffff", "#dcdcdc"], ["#0072B2", "#222222"]).getpalette()
    colours = [tuple(palette[k : k + 3]) for k in range(0, len(palette), 3)]
    assert {(255, 255, 255), (220, 220, 220), (0, 114, 178), (34, 34, 34)} <= set(colours)
    assert len(colours) == 4 + 2 * 2 * 2 + 1


class Media(HTMLParser):
    def __init__(self, text: str):
        super().__init__()
        self.tags = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag in ("video", "img"):
            self.tags.append((tag, dict(attrs)["src"].partition(";")[0]))


@pytest.mark.parametrize("encoder", [True, False])
def test_all_figures_of_a_run(encoder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(animation, "FRAMES_AT_MOST", 4)
    monkeypatch.setattr(animation, "FRAMES_AT_LEAST", 4)
    monkeypatch.setattr(animation, "mp4_is_possible", lambda: encoder)
    monkeypatch.setattr(explore_and_optimize, "mp4_is_possible", lambda: encoder)
    out = tmp_path / "run"
    assert run(explore_and_optimize.main, ["--figures", "all", "--max-moves", "4", "--out", str(out)]) == 3
    printed = capsys.readouterr().out.splitlines()
    assert ("figures/exploration.mp4 is left out: it needs the package av" in printed) != encoder
    assert (out / "figures" / "exploration.gif").is_file()
    assert (out / "figures" / "exploration.mp4").is_file() == encoder
    first, *others = Media((out / "report.html").read_text(encoding="utf-8")).tags
    assert first == (("video", "data:video/mp4") if encoder else ("img", "data:image/gif"))
    assert others == [("img", "data:image/png")] * len(list((out / "figures").glob("*.png")))
