"""Recorded logs through several estimators: errors, consistency, time; medians and spread of several logs."""

import sys
from argparse import ArgumentTypeError
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from _cli import OneLineParser, run
from _replay import Outcome, Recording, ReplaySettings, open_recording, run_estimator
from _replay_options import (
    add_replay_options,
    output_directory,
    print_scores,
    print_spread,
    progress,
    replay_settings,
    slug,
    written_to,
)
from _replay_output import judged, spread, summarize, view_of, write_own_calibration, write_trajectories

from coopslam.estimation.estimators import NAMES
from coopslam.evaluation.replay_score import ReplayScore
from coopslam.io.toml import dump_toml, to_mapping
from coopslam.report.comparison_figures import draw_comparison
from coopslam.report.comparison_html import write_comparison_report
from coopslam.report.run_directory import write_json


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """One log through all estimators."""

    recording: Recording
    outcomes: list[Outcome]
    scored: list[ReplayScore | None]
    summary: dict


def main(arguments: Sequence[str] | None = None) -> int:
    """Replay every log with every estimator. Exit code 3 when an estimator came to nothing."""
    parser = OneLineParser(prog="compare.py", description=__doc__)
    parser.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        type=Path,
        help="run directories, .mcap, MR.CLAM directories, .pyfg or .g2o files",
    )
    parser.add_argument(
        "--estimators", metavar="E,E", type=_names, default=NAMES, help=f"default: all, {', '.join(NAMES)}"
    )
    add_replay_options(parser)
    options = parser.parse_args(arguments)
    settings = replay_settings(options)
    recordings = [open_recording(log, settings) for log in options.logs]
    out = output_directory(options, f"compare-{recordings[0].log.name}", options.logs)
    with written_to(out, done=False):
        (out / "config.toml").write_text(dump_toml(to_mapping(settings)), encoding="utf-8")
    compared = []
    for number, recording in enumerate(recordings):
        own = out if len(recordings) == 1 else out / f"{number:03d}-{slug(recording.log.name)}"
        with written_to(out, done=True):
            compared.append(_compare(recording, options.estimators, settings, own))
        print_scores(compared[-1].summary)
    summary = compared[0].summary
    if len(compared) > 1:
        summary = {"logs": [one.summary for one in compared], "estimators": spread([one.summary for one in compared])}
        with written_to(out, done=True):
            write_json(out / "summary.json", summary)
        print_spread(summary["estimators"], len(compared))
    print(f"{out / 'summary.json'} and what belongs to it written")
    failures = [outcome for one in compared for outcome in one.outcomes if outcome.replay is None]
    if failures:
        print("; ".join(f"{failure.name}: {failure.failure}" for failure in failures), file=sys.stderr)
    return max((failure.exit_code for failure in failures), default=0)


def _compare(recording: Recording, names: Sequence[str], settings: ReplaySettings, out: Path) -> Compared:
    """All estimators over one log, and everything written that is to be known of them."""
    out.mkdir(exist_ok=True)
    write_own_calibration(out, recording)
    outcomes, scored = [], []
    for name in names:
        with progress(recording, [name]) as watch:
            outcome = run_estimator(name, recording, settings, watch)
        outcome, result = judged(outcome, recording)
        outcomes.append(outcome)
        scored.append(result)
    summary = summarize(recording, outcomes, scored)
    write_json(out / "summary.json", summary)
    for outcome, result in zip(outcomes, scored, strict=True):
        if result is not None:
            write_trajectories(out / "trajectories" / outcome.name, result)
    view = view_of(recording, summary, outcomes, scored)
    drawn = draw_comparison(view, out / "figures") if settings.figures != "none" else []
    write_comparison_report(out / "report.html", view, drawn)
    return Compared(recording, outcomes, scored, summary)


def _names(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    unknown = [name for name in names if name not in NAMES]
    if unknown or not names:
        raise ArgumentTypeError(f"names of {', '.join(NAMES)} expected, with commas, got {text!r}")
    return names


if __name__ == "__main__":
    sys.exit(run(main))
