"""The report of a replayed log and of estimators compared on it: a single HTML file that needs nothing else."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np

from coopslam.report.comparison_figures import best_estimator
from coopslam.report.comparison_panels import nis_text, number
from coopslam.report.comparison_view import ComparisonView, EstimatorView
from coopslam.report.html_page import explained, figures, table, write_page
from coopslam.report.html_text import HOW_TO_READ
from coopslam.report.number_text import DASH, count, digits, length, scaled

DEGREES = 180 / np.pi
COLUMNS = (  # heading, key in the scores, factor to the unit of the heading; only those that some estimator has
    ("ATE (cm)", "ate_rmse_m", 100.0),
    ("heading rmse (°)", "heading_rmse_rad", DEGREES),
    ("causal ATE (cm)", "causal_ate_rmse_m", 100.0),
    ("causal heading rmse (°)", "causal_heading_rmse_rad", DEGREES),
    ("RPE (cm)", "rpe", 100.0),
    ("landmarks rmse (cm)", "landmark_rmse_m", 100.0),
    ("NEES (3 expected)", "nees_mean", 1.0),
    ("NIS per dof", "nis", 1.0),
    ("CRLB ratio", "crlb_ratio", 1.0),
    ("update, median (ms)", "latency_p50_seconds", 1000.0),
    ("update, p99 (ms)", "latency_p99_seconds", 1000.0),
    ("time (s)", "wall_seconds", 1.0),
)
CAPTIONS = {
    "trajectories": (
        "Where the robots went",
        "The closer a coloured path lies to the wide grey line, the true path, the better; all panels have one scale "
        "and estimates that leave it are cut off, while landmark ellipses and the lines to the true landmarks are "
        "enlarged by the factor in the panel's title, and the ellipses are relative to the first robot's start, so "
        "larger than what is left after the alignment.",
    ),
    "errors": (
        "Errors beside what was claimed",
        "Curves should stay inside the grey band, three of the estimator's own standard deviations (of a position "
        "along its worst direction, relative to the first robot's start), ticks on top mark where a robot is beyond "
        "its own band, and an axis that ends below the largest error in its title cuts it off; where the figure says "
        "after alignment, the alignment has taken error away that the band still owns up to, so that staying inside "
        "does not prove honesty, which NEES judges.",
    ),
    "bars": (
        "Errors of all robots together",
        "Shorter is better: full bars are the final estimate with all records, hatched ones each pose as it was known "
        "when it was made; mind the axis, which is logarithmic where it says so.",
    ),
    "consistency": (
        "Honesty of the covariances",
        "Left, 95 % of the dots should lie inside the band and the running mean near 3, above means too confident and "
        "below too cautious; right, bars reach from 1 to the mean squared residual over its degrees of freedom, where "
        "innovations of a filter should be at 1 and residuals of a smoothed graph at or below it.",
    ),
    "latency": (
        "Computing time",
        "A running median that rises to the right is an estimator that slows down as the log gets longer, and the 99 % "
        "quantile says how long a robot may have to wait; an estimator that takes everything at once has its total "
        "time only.",
    ),
    "error_by_exchange": (
        "Error against role exchanges",
        "Error of the robot that moved at the end of each of its legs: the flatter a line, the less is lost each time "
        "the robots exchange roles.",
    ),
    "ekf_against_smoothing": (
        "Filtering against smoothing",
        "Medians over runs and the range between their quartiles against role exchanges, one column for each noise: "
        "lower is better for the ATE, and the dashed lines are what an efficient and honest estimator has.",
    ),
}
WORDS = (
    (
        "Frames",
        "Paths and errors are after one rotation and translation, without scale, of all robots' paths together onto "
        "the truth; final and causal paths have one each. NEES is in the frame of the first robot's true start, "
        "without alignment, and so are all covariances.",
    ),
    *((word, meaning) for word, meaning in HOW_TO_READ if word in ("ATE", "CRLB ratio")),
    (
        "RPE",
        "Relative pose error: how wrong the way between two poses of a robot is that lie so far apart along its path. "
        "It needs no alignment.",
    ),
    (
        "NEES",
        "Normalized estimation error squared: 3 is expected of poses. Much more means too confident, much less too "
        "cautious. Poses of one log share errors: only the mean over many logs judges an estimator.",
    ),
    (
        "NIS",
        "Normalized innovations squared, over their degrees of freedom: of a filter, 1 is expected, and far more means "
        "that the sensors are worse than believed. For a smoothed graph residuals stand in their place, which are "
        "smaller than 1 even when all is honest, because the solution has bent towards the measurements.",
    ),
)


def write_comparison_report(path: Path, view: ComparisonView, drawn: Sequence[Path]) -> None:
    """Write the report of a log; the figures that were drawn are embedded, in the order given."""
    sections = [
        _headline(view),
        _tiles(view),
        _estimators(view.estimators),
        _relative(view.estimators),
        _robots(view.estimators),
        _nis(view.estimators),
        _records(view),
        figures(drawn, CAPTIONS),
        explained(WORDS),
    ]
    write_page(path, f"{view.log}: replay", sections)


def _headline(view: ComparisonView) -> str:
    """The log, what there is of truth, and which estimators came to nothing."""
    names = ", ".join(estimator.name for estimator in view.estimators)
    known = list(view.summary.get("truth") or view.true_paths)
    truth = f"Truth is known of {', '.join(known)}." if known else "There is no truth: errors are not known."
    lines = [
        f"<h1>{escape(view.log)}</h1>",
        f'<p class="muted">A recorded log, replayed by {escape(names or "no estimator")}. {escape(truth)}</p>',
    ]
    for estimator in view.estimators:
        if estimator.note:
            words = f"<p><b>{escape(estimator.name)} has no result.</b></p><p>{escape(estimator.note)}</p>"
            lines.append(f'<div class="notice bad" role="alert">{words}</div>')
    return "\n".join(lines)


def _tiles(view: ComparisonView) -> str:
    """The key figures."""
    summary, best = view.summary, best_estimator(view)
    records = summary.get("records") or {}
    used = sum(_counts(records).values()) if records else None
    duration_s = number(summary, "duration_s")
    tiles = [
        ("robots", count(len(summary["robots"]) if "robots" in summary else None), ""),
        ("landmarks", count(len(summary["landmarks"]) if "landmarks" in summary else None), ""),
        ("duration", DASH if duration_s is None else f"{digits(duration_s)} s", ""),
        ("records", count(used), f"{count(sum((records.get('dropped') or {}).values()))} dropped by the reader"),
    ]
    ate_m = number(best.scores, "ate_rmse_m") if best else None
    if ate_m is not None:
        only = len(view.estimators) == 1
        tiles.append(("ATE" if only else "lowest ATE", length(ate_m), "" if only else best.name))
    cells = []
    for label, value, note in tiles:
        value, note = (DASH, "not known") if value == DASH else (value, note)
        small = f"<small>{escape(note)}</small>" if note else ""
        cells.append(f'<div class="tile"><dt>{escape(label)}</dt><dd>{escape(value)}{small}</dd></div>')
    body = "\n".join(cells)
    return f'<h2>Key figures</h2>\n<dl class="tiles">\n{body}\n</dl>'


def _counts(records: Mapping) -> dict[str, int]:
    """Records by kind."""
    return {str(kind): n for kind, n in records.items() if kind not in ("ignored", "dropped")}


def _estimators(estimators: Sequence[EstimatorView]) -> str:
    """One row an estimator, a column for each figure that any of them has."""
    if not estimators:
        return ""
    over = next((str(over) for e in estimators for over in e.scores.get("rpe") or ()), "")
    columns, cells = [], []
    for heading, key, factor in COLUMNS:
        values = [_score(estimator.scores, key, over) for estimator in estimators]
        if any(value is not None for value in values):
            columns.append(heading.replace("RPE", f"RPE over {over}"))
            cells.append([scaled(value, factor) for value in values])
    rows = [[e.name, *(column[k] for column in cells)] for k, e in enumerate(estimators)]
    return "<h2>Estimators</h2>\n" + table(["", *columns], rows)


def _score(scores: Mapping, key: str, over: str) -> float | None:
    """A figure of the table: the relative error over one distance, the mean of all NIS, or a score as it is."""
    if key == "rpe":
        return number((scores.get("rpe") or {}).get(over) or {}, "translation_rmse_m")
    if key == "nis":
        kinds = (scores.get("nis") or {}).values()
        total = sum(kind["count"] for kind in kinds)
        return sum(kind["count"] * kind["mean_per_dof"] for kind in kinds) / total if total else None
    return number(scores, key)


def _relative(estimators: Sequence[EstimatorView]) -> str:
    """Relative errors over all distances, and of robots to each other."""
    distances = list(dict.fromkeys(over for e in estimators for over in e.scores.get("rpe") or ()))
    found = [({**(e.scores.get("rpe") or {}), "": e.scores.get("robot_to_robot")}, e.name) for e in estimators]
    keys = [(over, f"over {over}") for over in distances]
    keys += [("", "robot to robot")] if any(errors[""] for errors, _ in found) else []
    if not keys:
        return ""
    headings = ["", *(f"{words} ({unit})" for _, words in keys for unit in ("cm", "°"))]
    rows = []
    for errors, name in found:
        rows.append([name])
        for key, _ in keys:
            pair = errors.get(key) or {}
            rows[-1].append(scaled(pair.get("translation_rmse_m"), 100))
            rows[-1].append(scaled(pair.get("rotation_rmse_rad"), DEGREES))
    return "<h2>Relative errors</h2>\n" + table(headings, rows)


def _robots(estimators: Sequence[EstimatorView]) -> str:
    """Errors of each robot: rows are robots, columns estimators."""
    judged = [e for e in estimators if e.scores.get("robots")]
    names = list(dict.fromkeys(robot for e in judged for robot in e.scores["robots"]))
    if not names:
        return ""
    headings = ["", *(f"{e.name}: {what}" for e in judged for what in ("ATE (cm)", "heading (°)"))]
    rows = []
    for name in names:
        rows.append([name])
        for estimator in judged:
            own = estimator.scores["robots"].get(name) or {}
            rows[-1] += [scaled(own.get("ate_rmse_m"), 100), scaled(own.get("heading_rmse_rad"), DEGREES)]
    return "<h2>Robots</h2>\n" + table(headings, rows)


def _nis(estimators: Sequence[EstimatorView]) -> str:
    """Mean NIS per degree of freedom by kind of measurement."""
    judged = [e for e in estimators if e.scores.get("nis")]
    kinds = list(dict.fromkeys(kind for e in judged for kind in e.scores["nis"]))
    if not kinds:
        return ""
    rows = []
    for kind in kinds:
        rows.append([kind.replace("_", " ")])
        for estimator in judged:
            one = estimator.scores["nis"].get(kind)
            rows[-1].append(nis_text(one) if one else DASH)
    return "<h2>NIS per degree of freedom (count)</h2>\n" + table(["", *(e.name for e in judged)], rows)


def _records(view: ComparisonView) -> str:
    """What the log holds, and what was left out by whom and why: reasons are rows, who dropped it columns."""
    records = view.summary.get("records") or {}
    rows = [[kind, count(n)] for kind, n in _counts(records).items()]
    rows += [["ignored, as asked", count(records["ignored"])]] if records.get("ignored") else []
    lines = ["<h2>Records</h2>", table(["kind", "in the log"], rows)] if rows else []
    droppers = {"reader": records.get("dropped") or {}}
    droppers |= {estimator.name: estimator.scores.get("dropped") or {} for estimator in view.estimators}
    droppers = {who: {str(why): n for why, n in dropped.items()} for who, dropped in droppers.items() if dropped}
    reasons = list(dict.fromkeys(why for dropped in droppers.values() for why in dropped))
    if reasons:
        rows = [[why, *(count(dropped.get(why)) for dropped in droppers.values())] for why in reasons]
        lines += ["<h2>Records that were dropped</h2>", table(["reason", *droppers], rows)]
    return "\n".join(lines)
