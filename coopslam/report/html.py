"""The report of one exploration: a single HTML file that needs nothing else."""

from html import escape
from pathlib import Path

import numpy as np

from coopslam.report.charts import vertex_errors
from coopslam.report.ellipses import ellipse_axes
from coopslam.report.html_page import explained, table, write_page
from coopslam.report.html_page import figures as embedded
from coopslam.report.html_text import CAPTIONS, HOW_TO_READ, OUTCOMES
from coopslam.report.number_text import DASH, count, digits, length, percent, scaled
from coopslam.report.run_view import RunView

ESTIMATOR_COLUMNS = (  # heading, key in summary["estimators"][name], factor to the unit of the heading
    ("ATE (cm)", "ate_rmse_m", 100.0),
    ("heading rmse (°)", "heading_rmse_rad", 180 / np.pi),
    ("causal ATE (cm)", "causal_ate_rmse_m", 100.0),
    ("NEES (3 expected)", "nees_mean", 1.0),
    ("CRLB ratio", "crlb_ratio", 1.0),
    ("time (s)", "wall_seconds", 1.0),
)


def write_report(path: Path, view: RunView, figures: list[Path]) -> None:
    """Write the report of a run; the figures are embedded, in the order given."""
    sections = [
        _headline(view),
        _tiles(view.summary),
        _estimators(view.summary),
        embedded(figures, CAPTIONS),
        explained(HOW_TO_READ),
        _vertices(view),
    ]
    write_page(path, f"{view.name}: exploration", sections)


def _headline(view: RunView) -> str:
    """World, outcome and why, and how the run was made."""
    outcome = _text(view.summary.get("outcome"))
    kind, warning = OUTCOMES.get(outcome, ("", ""))
    reason = _text(view.summary.get("outcome_reason"), "no reason was recorded")
    settings = [
        f"{label} {escape(_text(view.summary.get(key)))}"
        for label, key in (("seed", "seed"), ("noise", "noise"), ("driven by the estimator", "estimator"))
    ]
    badge = f'<span class="badge {kind}">{escape(outcome)}</span>'
    lines = [
        f"<h1>{escape(view.name)}</h1>",
        f'<p class="muted">Exploration by robots that watch each other: {", ".join(settings)}</p>',
    ]
    if warning:
        lines.append(
            f'<div class="notice {kind}" role="alert"><p>{badge}<b>{warning}.</b></p><p>{escape(reason)}</p></div>'
        )
    else:
        lines.append(f"<p>{badge}{escape(reason)}</p>")
    return "\n".join(lines)


def _tiles(summary: dict) -> str:
    """The key figures."""
    found, expected = count(summary.get("triangles")), count(summary.get("triangles_expected"))
    tiles = [
        ("triangles found", found, f"of {expected} expected" if expected != DASH else ""),
        ("vertices", count(summary.get("vertices")), ""),
        ("holes", count(summary.get("holes")), ""),
        ("role exchanges", count(summary.get("role_exchanges")), ""),
        *((f"distance of {robot}", f"{digits(m)} m", "") for robot, m in (summary.get("travel_m") or {}).items()),
        ("distance / perimeter", digits(summary.get("travel_over_perimeter")), "all robots together"),
        ("covered", percent(summary.get("covered_fraction")), "of the free space"),
        ("overlap", percent(summary.get("overlap_fraction")), "of the free space"),
        ("vertex rmse", length(summary.get("vertex_rmse_m")), "after alignment"),
        ("vertex NEES", digits(summary.get("vertex_nees_mean")), "2 expected"),
        ("total time", f"{digits(summary.get('total_seconds'))} s", "on this machine"),
    ]
    cells = []
    for label, value, note in tiles:
        if DASH in value:
            value, note = DASH, "not known"
        small = f"<small>{escape(note)}</small>" if note else ""
        cells.append(f'<div class="tile"><dt>{escape(label)}</dt><dd>{escape(value)}{small}</dd></div>')
    body = "\n".join(cells)
    return f'<h2>Key figures</h2>\n<dl class="tiles">\n{body}\n</dl>'


def _estimators(summary: dict) -> str:
    """The table of estimators on the records of this run."""
    estimators = summary.get("estimators") or {}
    if not estimators:
        return ""
    rows = []
    for name, scores in estimators.items():
        drove = " (drove)" if name == summary.get("estimator") else ""
        rows.append([str(name) + drove, *(scaled(scores.get(key), factor) for _, key, factor in ESTIMATOR_COLUMNS)])
    return "<h2>Estimators on the records of this run</h2>\n" + table(["", *(c[0] for c in ESTIMATOR_COLUMNS)], rows)


def _vertices(view: RunView) -> str:
    """The table of all map vertices, folded; errors only where the truth is known."""
    if not view.vertices:
        return ""
    ids = list(view.vertices)
    semi_axes, directions = ellipse_axes(np.array([view.covariances[v] for v in ids]), chi_square=1.0)
    judged, errors_m, _, nees = vertex_errors(view)
    truth = dict(zip(judged, zip(errors_m, nees, strict=True), strict=True))
    headings = ["vertex", "x (m)", "y (m)", "σ worst (cm)", "σ best (cm)", "worst along (°)"]
    rows = []
    for v, (worst, best), direction in zip(ids, semi_axes, directions, strict=True):
        x, y = (f"{value:.3f}" for value in view.vertices[v])
        rows.append([str(v), x, y, scaled(worst, 100), scaled(best, 100), f"{np.degrees(direction) % 180:.0f}"])
        if truth:
            error_m, squared = truth.get(v, (None, None))
            rows[-1] += [scaled(error_m, 100), scaled(squared, 1)]
    headings += ["error (cm)", "NEES"] if truth else []
    title = f"All {len(ids)} map vertices"
    return f"<h2>Vertices</h2>\n<details><summary>{title}</summary>\n{table(headings, rows)}\n</details>"


def _text(value, absent: str = DASH) -> str:
    return absent if value is None or value == "" else str(value)
