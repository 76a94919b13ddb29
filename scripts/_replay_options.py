"""What replay.py and compare.py share on the command line: options, output directory, progress, the table of scores."""

import argparse
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import degrees
from pathlib import Path

from _calibration import read_calibration
from _replay import Recording, ReplaySettings
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from coopslam.errors import BadInput, NotWritten
from coopslam.io.toml import from_mapping, load_toml
from coopslam.report.run_directory import FILES, FOLDERS, fresh_directory, prepare_run_directory


def add_replay_options(parser: argparse.ArgumentParser) -> None:
    """Options of every command that replays logs."""
    parser.add_argument("--out", metavar="DIR", type=Path, help="output directory; default: a new one in runs/")
    parser.add_argument("--force", action="store_true", help="overwrite results in --out")
    parser.add_argument("--config", metavar="C.toml", type=Path, help="settings from a TOML file; options override it")
    parser.add_argument(
        "--ignore", choices=["nothing", "landmarks", "robots"], help="do not use sightings of these; default: nothing"
    )
    parser.add_argument(
        "--loss", choices=["squares", "huber", "cauchy"], help="of bearings and ranges, in smoothers; default: cauchy"
    )
    parser.add_argument("--period", metavar="S", type=float, help="shortest time between two updates, s; default: 0.25")
    parser.add_argument("--figures", choices=["none", "static"], help="default: static")
    parser.add_argument(
        "--source", metavar="FILE.py:CLASS", help="read LOG with a LogSource of your own: CLASS(path) in a Python file"
    )
    parser.add_argument(
        "--random-start",
        metavar="SEED",
        type=int,
        help="guess the robots anywhere at first, and tell everything in the frame of a random one; default: not",
    )
    add_part_options(parser)
    calibration = parser.add_mutually_exclusive_group()
    calibration.add_argument(
        "--calibrate", action="store_true", help="first let the log calibrate its own sensors, without truth"
    )
    calibration.add_argument(
        "--calibration", metavar="C.toml", type=Path, help="sensors as calibrate.py found them, in this log or another"
    )


def add_part_options(parser: argparse.ArgumentParser) -> None:
    """Which part of a log is used."""
    for end, default in (("from", "its start"), ("to", "its end")):
        parser.add_argument(
            f"--{end}",
            dest=f"{end}_s",
            metavar="S",
            type=float,
            help=f"use the log {end} here, s after its first record began; default: {default}",
        )


def replay_settings(options: argparse.Namespace) -> ReplaySettings:
    """Config file first, then options. Raises BadInput."""
    settings = ReplaySettings()
    if options.config is not None:
        settings = from_mapping(ReplaySettings, load_toml(options.config), str(options.config))
    named = {} if options.calibration is None else {"calibration": read_calibration(options.calibration)}
    named |= {"calibrate": True} if options.calibrate else {}
    given = named | {
        name: getattr(options, name)
        for name in ("ignore", "figures", "source", "from_s", "to_s")
        if getattr(options, name) is not None
    }
    settings, estimation = replace(settings, **given), settings.estimation
    if options.loss is not None:
        loss = replace(estimation.timeline.loss, kind=options.loss)
        estimation = replace(estimation, timeline=replace(estimation.timeline, loss=loss))
    if options.random_start is not None:
        timeline = replace(estimation.timeline, random_start=options.random_start)
        estimation = replace(estimation, timeline=timeline)
    if options.period is not None:
        estimation = replace(estimation, period_s=options.period)
    return replace(settings, estimation=estimation)


def output_directory(options: argparse.Namespace, name: str, logs: Sequence[Path]) -> Path:
    """The directory of --out, or a new one under runs/. logs: what is replayed.

    Raises BadInput when it holds results already, unless --force is given: then older results are deleted. Raises
    BadInput also when the log that is replayed, or the calibration that is used, would be among these.
    """
    out = options.out or fresh_directory(Path("runs") / slug(name))
    read = [path for log in logs for path in (log, log / "log.mcap")]
    read = {
        path.resolve() for path in (*read, *([options.calibration] if options.calibration else [])) if path.exists()
    }
    for path in (out / name for name in (*FILES, *FOLDERS)):
        if path.resolve() in read:
            raise BadInput(f"--out {out}: its {path.name} is what is read; expected another directory")
    older = older_results(out) if options.force else []
    prepare_run_directory(out, options.force)
    for path in older:
        path.unlink(missing_ok=True)
    return out


def older_results(out: Path) -> list[Path]:
    """Files of an older replay or comparison in a directory that `prepare_run_directory` does not know."""
    if not all((out / name).is_file() for name in ("config.toml", "summary.json")) or (out / "log.mcap").exists():
        return []
    own = ["trajectories/*.tum", "trajectories/*/*.tum", "figures/*.png"]
    many = ["summary.json", "report.html", "calibration.toml"]  # of one log of several
    patterns = [*own, *(f"[0-9][0-9][0-9]-*/{name}" for name in (*many, *own))]
    return [path for pattern in patterns for path in out.glob(pattern) if path.is_file()]


@contextmanager
def written_to(out: Path, done: bool) -> Iterator[None]:
    """Raises NotWritten when what is written inside finds no place. done: an estimator has been run already."""
    try:
        yield
    except BrokenPipeError:  # nobody reads what is printed
        raise
    except OSError as error:
        reason = error.strerror or error
        raise NotWritten(f"--out {str(out)[:200]}: cannot be written: {reason}", done) from error


def slug(name: str) -> str:
    """A log's name as part of a path."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).lstrip(".")[:80] or "log"


@contextmanager
def progress(recording: Recording, names: Sequence[str]) -> Iterator[Callable[[float], None]]:
    """A bar over the log's time on a terminal, one line elsewhere; gives what is to be told each stamp."""
    console = Console()
    if not console.is_terminal or os.environ.get("CI"):
        print(f"replaying {recording.log.name}: {', '.join(names)}", flush=True)
        yield lambda stamp_s: None
        return
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task(
            escape(f"{recording.log.name}: {', '.join(names)}"), total=recording.records[-1].stamp_s - recording.start_s
        )
        yield lambda stamp_s: bar.update(task, completed=stamp_s - recording.start_s)


def print_scores(summary: dict) -> None:
    """A table of the estimators."""
    table = Table(title=f"{summary['log']}: {len(summary['robots'])} robots, {summary['duration_s']:.1f} s")
    table.add_column("estimator", no_wrap=True)
    for column in ("ATE m", "heading deg", "causal ATE m", "NEES (3)", "landmarks m", "time s", "p99 ms"):
        table.add_column(column, justify="right")
    for name, scores in summary["estimators"].items():
        if "failed" in scores:
            table.add_row(name, scores["failed"])
            continue
        heading, latency = scores.get("heading_rmse_rad"), scores.get("latency_p99_seconds")
        table.add_row(
            name,
            _shown(scores.get("ate_rmse_m"), ".4f"),
            _shown(None if heading is None else degrees(heading), ".2f"),
            _shown(scores.get("causal_ate_rmse_m"), ".4f"),
            _shown(scores.get("nees_mean"), ".2f"),
            _shown(scores.get("landmark_rmse_m"), ".4f"),
            _shown(scores["wall_seconds"], ".1f"),
            _shown(None if latency is None else 1e3 * latency, ".1f"),
        )
    print_table(table)


def print_spread(estimators: dict, logs: int) -> None:
    """Median and quartiles over several logs."""
    table = Table(title=f"{logs} logs: median (quartiles)")
    table.add_column("estimator")
    columns = [("ate_rmse_m", "ATE m"), ("causal_ate_rmse_m", "causal ATE m"), ("nees_mean", "NEES (3)")]
    for _, heading in columns:
        table.add_column(heading, justify="right")
    for name, scores in estimators.items():
        cells = [scores.get(key) for key, _ in columns]
        table.add_row(
            name, *("" if c is None else f"{c['median']:.4f} ({c['q25']:.4f}, {c['q75']:.4f})" for c in cells)
        )
    print_table(table)


def print_table(table: Table) -> None:
    """As wide as it needs where no terminal sets a limit."""
    console = Console(markup=False)  # names of logs may hold brackets
    (console if console.is_terminal else Console(width=120, markup=False)).print(table)


def _shown(number: float | None, form: str) -> str:
    return "" if number is None else format(number, form)
