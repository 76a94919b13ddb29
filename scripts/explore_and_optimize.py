"""Two robots explore a polygonal world that they do not know; GTSAM smooths what they sense; out comes a map."""

import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from _cli import run
from _exploration import Prepared, conclude, draw, drive, prepare
from _exploration_display import ProgressDisplay, print_result, show_frames
from _exploration_options import parser, settings_of
from _exploration_settings import ExplorationSettings
from _resume import read_old_run, resume
from rich.console import Console

from coopslam.errors import BadInput, NotWritten
from coopslam.report import html
from coopslam.report.animation import write_animation
from coopslam.report.figures import drawn_in
from coopslam.report.run_directory import fresh_directory, prepare_run_directory
from coopslam.report.run_view import RunView
from coopslam.report.video import mp4_is_possible


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, explore, draw, print. Returns the exit code."""
    options = parser(__doc__).parse_args(arguments)
    settings = settings_of(options)
    old = read_old_run(Path(settings.resume_map)) if settings.resume_map else None
    if old is not None:
        settings = old.settings_for(settings, keep_world=options.world is not None or options.config is not None)
    ready = _prepare(settings, options)  # whatever the settings get wrong comes before an old run is deleted
    world = ready.world.name
    out = options.out or fresh_directory(Path("runs") / f"{_slug(world)}-{settings.noise_name}-{settings.seed}")
    if old is not None and out.resolve() == old.path.resolve():
        raise BadInput(f"--out {out}: is the run whose map is resumed; another directory expected")
    prepare_run_directory(out, options.force)
    began = time.perf_counter()
    finished = None
    try:
        with ProgressDisplay(world) as display:
            finished = resume(ready, old, out, display.show) if old else drive(ready, out, display.show)
            conclude(finished, out)
        view = draw(finished, out)
        if settings.figures == "all":
            _animate(view, out)
    except BrokenPipeError:  # nobody reads what is printed
        raise
    except OSError as error:
        reason = f"cannot be written: {error.strerror or error}"
        raise NotWritten(f"--out {str(out)[:200]}: {reason}", done=finished is not None) from error
    print_result(finished, out, time.perf_counter() - began)
    if finished.mission.outcome != "complete":
        print(f"exploration {finished.mission.outcome}: {finished.mission.reason}", file=sys.stderr)
        return 3
    return 0


def _prepare(settings: ExplorationSettings, options) -> Prepared:
    """Raises BadInput with the option or the file that a wrong setting comes from."""
    try:
        return prepare(settings)
    except BadInput as error:
        if options.world is not None and str(error).startswith("world: "):
            raise BadInput(f"--{error}") from error
        if options.tracker_sheet is not None and str(error).startswith("vision."):
            raise BadInput(f"--tracker-sheet: {str(error).partition(': ')[2]}") from error
        raise BadInput(f"{options.config or 'default settings'}: {error}") from error


def _animate(view: RunView, out: Path) -> None:
    """The animation, and the report once more with it. It takes longest, so the report without it was written first."""
    films = write_animation(view, out / "figures", show_frames(Console()))
    if not films:
        print("there is no animation: no robot moved")
    elif not mp4_is_possible():
        print("figures/exploration.mp4 is left out: it needs the package av")
    html.write_report(out / "report.html", view, [*films[:1], *drawn_in(out / "figures")])


def _slug(name: str) -> str:
    """A world's name as part of a path."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).lstrip(".")[:60] or "world"


if __name__ == "__main__":
    sys.exit(run(main))
