"""A parameter study: many simulated explorations over worlds, settings and seeds; a table, pictures, and it resumes.

The study is a TOML file; scripts/studies has some. Its keys: name, description, worlds (names, or GeoJSON files
relative to the study), seeds (a count or a list), [base] (settings as in a config file, SI units and radians), and
what is varied: [axes] (setting -> values) or [[axes]] tables with `setting` and `values`, with `scale` (settings or
tables of settings) and factors as `values`, or with tables as `values`, each with a `label`, perhaps a number `at`,
and the settings that it changes. Every combination is run with every seed, and checked before any is run.
"""

import signal
import sys
import tempfile
import threading
from argparse import ArgumentTypeError, RawDescriptionHelpFormatter
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from _cli import OneLineParser, run
from _study import Study, load_study
from _study_crash import CRASH
from _study_dask import connect, run_on_dask
from _study_display import StudyProgress, combination_table
from _study_files import only_sweep, require_same_study, write_anew, writing
from _study_pool import processors, run_in_pool
from _study_run import job_of, run_job
from _study_table import ResultsTable, columns_of, identities

from coopslam.errors import BadInput
from coopslam.report.study_figures import draw_study
from coopslam.report.study_panels import Dimension, StudyResults


def main(arguments: Sequence[str] | None = None) -> int:
    """Check, run what is not done yet, print, draw. Returns the exit code."""
    options = _parser().parse_args(arguments)
    if options.processes is not None and options.processes < 1:
        raise BadInput(f"--processes: 1 or more expected, got {options.processes}")
    study = load_study(options.study)
    columns, known = columns_of(study, str(options.study)), identities(study)
    client = connect(options.dask) if options.dask else None
    try:
        with (
            _ended_like_an_interrupt(),
            only_sweep(_directory(options.out or Path("runs") / f"study-{options.study.stem}")) as out,
        ):
            if not options.force:
                require_same_study(out, study.name)
            table = ResultsTable(out / "results.csv", columns, known)
            if table.torn:
                print(f"{table.path}: a torn line of an interrupted sweep dropped")
            write_anew(out / "study.toml", study.text.encode())
            _run(study, table, known, out, options, client)
            return _report(study, table, out)
    finally:
        if client is not None:
            client.close()


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="sweep.py", description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("study", metavar="STUDY.toml", type=Path, help="what is to be varied")
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=_path,
        help="for results.csv, study.toml and figures/; default: runs/study-NAME. Runs that its results.csv has are "
        "not run again: say the same command again after an interruption, or after the study was extended. A run is "
        "known by its settings, world, seed and the version of the program; code that was changed under one version "
        "keeps the old rows: use a new directory",
    )
    parser.add_argument("--force", action="store_true", help="add to the table of a study of another name in DIR")
    parser.add_argument(
        "--processes", metavar="N", type=int, help=f"worker processes; default: one per processor, {processors()} here"
    )
    parser.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="run on the workers of this Dask scheduler (tcp://HOST:PORT) instead; needs `make cluster`, here and in "
        "the repository that the workers are started from: .venv/bin/dask worker tcp://HOST:PORT --nthreads 1",
    )
    parser.add_argument(
        "--keep-runs", action="store_true", help="keep each run directory (about 1 MB), as DIR/runs/KEY; default: not"
    )
    parser.add_argument("--retry-crashed", action="store_true", help="run those with outcome crash again")
    return parser


def _path(text: str) -> Path:
    if not text.strip():
        raise ArgumentTypeError("a directory expected, got nothing")
    return Path(text)


@contextmanager
def _ended_like_an_interrupt() -> Iterator[None]:
    """SIGTERM ends what is within as Ctrl-C does: workers and temporary directories go, what is done stays."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only that one may say what a signal does
        return

    def interrupt(number, frame) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one would interrupt the cleaning up
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _directory(out: Path) -> Path:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"--out {str(out)[:80]}: a directory expected: {error.strerror}") from error
    return out


def _run(study: Study, table: ResultsTable, known: dict, out: Path, options, client) -> None:
    """Run what the table does not have; each row is safe before the next is waited for."""
    done = {key for key in known if key in table.rows}
    if options.retry_crashed:
        done -= {key for key in done if table.rows[key]["outcome"] == CRASH}
    todo = [each for each in study.runs if each.key not in done]
    succeeded = sum(table.rows[key]["success"] == "true" for key in done)
    keep = (out / "runs").absolute() if options.keep_runs else None
    if todo:
        table.require_writable()
    for directory in [out / "figures", *([keep] if keep else [])]:
        with writing(directory):  # faults come before the first run
            directory.mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory(prefix="coopslam-sweep-", ignore_cleanup_errors=True) as scratch,
        StudyProgress(study.name, len(study.runs), len(done), succeeded) as progress,
    ):
        jobs = [job_of(each, Path(scratch), keep) for each in todo]
        with closing(_results(jobs, options.processes or processors(), client)) as finished:
            for job, results in finished:
                table.append(known[job["key"]] | results)
                progress.count(results)
    if todo:
        print(f"{len(todo)} runs, {progress.runs_per_s:.2f} per second")


def _results(jobs: list[dict], processes: int, client) -> Generator:
    if client is not None:
        return run_on_dask(jobs, client)
    return run_in_pool(jobs, min(processes, max(len(jobs), 1)), run_job)


def _report(study: Study, table: ResultsTable, out: Path) -> int:
    results = results_of(study, table)
    print(f"\n{study.name}: medians over the runs that succeeded\n{combination_table(results)}\n")
    with writing(out / "figures"):
        figures = draw_study(results, out / "figures")
    print(f"{table.path} and {len(figures)} figures in {out / 'figures'} written")
    crashed = [row for row in map(table.rows.get, (each.key for each in study.runs)) if row["outcome"] == CRASH]
    if crashed:
        print(f"{len(crashed)} of {len(study.runs)} runs crashed; the first: {crashed[0]['error']}", file=sys.stderr)
        return 3
    return 0


def results_of(study: Study, table: ResultsTable) -> StudyResults:
    """The study's rows as arrays, for table and figures."""
    worlds = tuple(world.name for world in study.worlds)
    sizes = tuple(float(world.world.n) for world in study.worlds)
    dimensions = [Dimension("world", "vertices of the world", worlds, sizes)]
    for axis in study.axes:
        places = [value.at for value in axis.values]
        numeric = None if None in places else tuple(places)
        title = f"{axis.name} ({axis.unit})" if axis.unit else axis.name
        dimensions.append(Dimension(axis.name, title, tuple(value.label for value in axis.values), numeric))
    index = np.array([(study.worlds.index(each.world), *each.values) for each in study.runs])
    return StudyResults(study.name, tuple(dimensions), index, [table.rows[each.key] for each in study.runs])


if __name__ == "__main__":
    sys.exit(run(main))
