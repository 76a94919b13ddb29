"""Pictures of the target on another robot in, records of range, bearing and heading out."""

import os
import sys
from argparse import ArgumentTypeError
from collections.abc import Iterable, Sequence
from pathlib import Path

from _cli import OneLineParser, run
from _track import Names, Recorder, Tracked, search
from _track_source import DEFAULT_FPS, Shot, ShotSource, shots_of
from rich.console import Console
from rich.progress import track

from coopslam import __version__
from coopslam.errors import BadInput, NotWritten
from coopslam.io.toml import dump_toml, to_mapping
from coopslam.records import LogHeader
from coopslam.report.run_directory import prepare_run_directory, write_json
from coopslam.report.video import mp4_is_possible
from tracker.data_sheet import DataSheet
from tracker.detectors import make_detector
from tracker.sheets import load_sheet, sheet_names


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, track, draw, print. Returns the exit code."""
    options = _parser().parse_args(arguments)
    sheet = _sheet(options.sheet)
    shots = shots_of(options.images, options.fps, options.stamps)
    header = _header(options, sheet)
    prepare_run_directory(options.out, options.force)
    try:
        (options.out / "config.toml").write_text(dump_toml(_config(options, sheet)), encoding="utf-8")
        tracked, problem = _track(shots, sheet, header, options)
        write_json(options.out / "summary.json", _summary(options, sheet, tracked))
    except OSError as error:
        raise NotWritten(f"--out {options.out}: cannot be written: {error.strerror or error}", done=False) from error
    _print_result(tracked, options.out)
    if problem is not None:
        raise BadInput(f"{problem}; the {tracked.images} pictures before it are tracked in {options.out}") from problem
    return 0


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="track.py", description=__doc__)
    parser.add_argument("images", metavar="IMAGES", type=Path, help="a folder of images, or a video file")
    parser.add_argument(
        "--sheet",
        metavar="SHEET.toml",
        required=True,
        help=f"camera and target: a TOML file or one of: {', '.join(sheet_names())}",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="directory for what is found")
    parser.add_argument("--observer", metavar="NAME", default="robot0", help="that carries the camera; default: robot0")
    parser.add_argument("--target", metavar="NAME", default="robot1", help="that is looked at; default: robot1")
    parser.add_argument(
        "--fps",
        metavar="F",
        type=_fps,
        help=f"pictures a second; default: what the video says, {DEFAULT_FPS:g} for a folder",
    )
    parser.add_argument(
        "--stamps", metavar="CSV", type=Path, help="stamps instead: columns file (not for a video) and stamp_s, seconds"
    )
    parser.add_argument(
        "--skip-unreadable", action="store_true", help="count pictures that cannot be used instead of stopping there"
    )
    parser.add_argument("--force", action="store_true", help="overwrite what an earlier call left in --out")
    return parser


def _fps(text: str) -> float:
    try:
        fps = float(text)
    except ValueError:
        fps = float("nan")
    if not 1e-3 <= fps <= 1e4:
        raise ArgumentTypeError(f"0.001 to 10000 expected, got {text[:60]!r}")
    return fps


def _sheet(name: str) -> DataSheet:
    try:
        return load_sheet(name)
    except BadInput as error:
        raise BadInput(f"--sheet: {error}") from error


def _header(options, sheet: DataSheet) -> LogHeader:
    """Raises BadInput for two robots of one name."""
    models = {"tracker": _kind(sheet), "data_sheet": to_mapping(sheet)}
    provenance = f"tracked by coopslam {__version__} in {options.images.name}"
    if options.observer == options.target:
        raise BadInput(f"--target: another robot than the observer expected, got {options.target}")
    frame = f"no common one: {options.target} in the frame of {options.observer}"
    return LogHeader((options.observer, options.target), frame=frame, sensor_models=models, provenance=provenance)


def _kind(sheet: DataSheet) -> str:
    return "apriltag" if sheet.helix is None else "helix"


def _track(shots: ShotSource, sheet: DataSheet, header: LogHeader, options) -> tuple[Tracked, BadInput | None]:
    """Search all pictures; also what stopped it before the last one, if anything did."""
    detector, size = make_detector(sheet), (sheet.camera.lens.height_px, sheet.camera.lens.width_px)
    problem = None
    with Recorder(options.out, header, Names(options.observer, options.target)) as recorder:
        try:
            for shot in _shown(shots, shots.count):
                try:
                    found = search(shot, detector, size)
                except BadInput:
                    if not options.skip_unreadable:
                        raise
                    recorder.tracked.unreadable.append(shot.name)
                    continue
                recorder.add(shot, found)
        except BadInput as error:
            problem = error
        recorder.draw(f"{options.target} as {options.observer} sees it")
    return recorder.tracked, problem


def _shown(shots: Iterable[Shot], count: int | None) -> Iterable[Shot]:
    """A bar on a terminal, one line elsewhere."""
    console = Console()
    if console.is_terminal and not os.environ.get("CI"):
        return track(shots, "tracking", total=count, console=console, transient=True)
    print(f"tracking {count or 'all'} pictures", flush=True)
    return shots


def _config(options, sheet: DataSheet) -> dict:
    given = {"images": str(options.images.absolute()), "observer": options.observer, "target": options.target}
    given |= {"fps": options.fps, "stamps": options.stamps and str(options.stamps.absolute())}
    return {**given, "skip_unreadable": options.skip_unreadable, "data_sheet": to_mapping(sheet)}


def _summary(options, sheet: DataSheet, tracked: Tracked) -> dict:
    found = {
        "images": tracked.images,
        "detections": tracked.detections,
        "headings_withheld": tracked.headings_withheld,
        "unreadable": tracked.unreadable,
    }
    if tracked.images:
        found |= {"first_s": tracked.stamps_s[0], "last_s": tracked.stamps_s[-1]}
    return {"tracker": _kind(sheet), "robots": [options.observer, options.target], **found}


def _print_result(tracked: Tracked, out: Path) -> None:
    withheld = f", {tracked.headings_withheld} without heading" if tracked.headings_withheld else ""
    skipped = f"; {len(tracked.unreadable)} could not be used" if tracked.unreadable else ""
    print(f"{tracked.images} pictures, the target found in {tracked.detections}{withheld}{skipped}")
    film = "" if mp4_is_possible() else " (figures/annotated.mp4 is left out: it needs the package av)"
    print(f"log.mcap, records.csv and figures written to {out}{film}")


if __name__ == "__main__":
    sys.exit(run(main))
