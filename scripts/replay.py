"""Run one estimator over a recorded log, offline: trajectories, covariances, errors where there is truth, a report."""

import sys
from collections.abc import Sequence
from pathlib import Path

from _cli import OneLineParser, run
from _replay import Outcome, Recording, open_recording, run_estimator
from _replay_options import add_replay_options, output_directory, print_scores, progress, replay_settings, written_to
from _replay_output import (
    judged,
    summarize,
    view_of,
    write_landmarks,
    write_own_calibration,
    write_trajectories,
)

from coopslam.estimation.estimators import BATCH, NAMES
from coopslam.evaluation.replay_score import ReplayScore
from coopslam.io.toml import dump_toml, to_mapping
from coopslam.report.comparison_figures import draw_comparison
from coopslam.report.comparison_html import write_comparison_report
from coopslam.report.pose_graph_file import write_pose_graph
from coopslam.report.run_directory import write_json


def main(arguments: Sequence[str] | None = None) -> int:
    parser = OneLineParser(prog="replay.py", description=__doc__)
    parser.add_argument(
        "log", metavar="LOG", type=Path, help="a run directory, .mcap, MR.CLAM directory, .pyfg or .g2o"
    )
    parser.add_argument(
        "--estimator", metavar="E", choices=NAMES, default=BATCH, help=f"{', '.join(NAMES)}; default: {BATCH}"
    )
    add_replay_options(parser)
    options = parser.parse_args(arguments)
    settings = replay_settings(options)
    recording = open_recording(options.log, settings)
    out = output_directory(options, f"replay-{recording.log.name}-{options.estimator}", [options.log])
    with written_to(out, done=False):
        (out / "config.toml").write_text(dump_toml(to_mapping(settings)), encoding="utf-8")
        write_own_calibration(out, recording)
    with progress(recording, [options.estimator]) as watch:
        outcome = run_estimator(options.estimator, recording, settings, watch)
    outcome, result = judged(outcome, recording)
    summary = summarize(recording, [outcome], [result])
    with written_to(out, done=True):
        write_json(out / "summary.json", summary)
        if result is not None:
            _write(out, recording, outcome, result, summary, settings.figures)
    if result is None:
        print(f"{options.estimator}: {outcome.failure}", file=sys.stderr)
        return outcome.exit_code
    print_scores(summary)
    print(f"{out / 'report.html'} and the directory {out} written")
    return 0


def _write(out: Path, recording: Recording, outcome: Outcome, result: ReplayScore, summary: dict, figures: str) -> None:
    """Everything but the summary."""
    write_trajectories(out / "trajectories", result)
    write_landmarks(out / "map.geojson", outcome.replay)
    write_pose_graph(out, outcome.replay.graph, outcome.replay.estimate)
    view = view_of(recording, summary, [outcome], [result])
    drawn = draw_comparison(view, out / "figures") if figures != "none" else []
    write_comparison_report(out / "report.html", view, drawn)


if __name__ == "__main__":
    sys.exit(run(main))
