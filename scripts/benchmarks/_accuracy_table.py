"""Tables of a robot tracker's accuracy: a line for each range, from the samples of one method at one picture size."""

from collections.abc import Sequence
from math import nan

import numpy as np
from _accuracy import Sample
from scipy.stats import chi2, norm

KEPT = 0.95  # of the ratios to the bound, for the trimmed root mean square
WRONG_SIGMAS = 5.0
MEDIAN_OF_SIGMA = float(norm.ppf(0.75))  # median of |e| of a Gaussian of sigma 1

RATED = ("range", "bearing", "heading")
COLUMNS = (  # of a table: heading, what it says, width
    ("range", "m", 8),
    ("n", "", 5),
    ("seen", "%", 6),
    ("head", "%", 6),
    ("range", "med %", 8),
    ("error", "95 %", 7),
    ("bearing", "med deg", 9),
    ("error", "95 %", 7),
    ("heading", "med deg", 9),
    ("error", "95 %", 7),
    ("NEES", "per dof", 8),
    ("95 % band", "", 13),
    ("heads off", "> 5 s", 10),
    ("error /", "range", 14),
    ("bound,", "bearing", 14),
    ("(rms)", "heading", 14),
)


def line_of(samples: Sequence[Sample]) -> dict:
    """Figures of some samples; NaN for those of nothing.

    Errors are of what was detected, those of headings of what was not withheld.
    """
    seen = [sample for sample in samples if sample.detected]
    told = [sample for sample in seen if sample.heading_known]
    line = {
        "n": len(samples),
        "detected": len(seen) / max(len(samples), 1),
        "heading_known": len(told) / max(len(samples), 1),
    }
    errors = {
        "range_error_percent": [100 * abs(s.range_error_m) / s.range_m for s in seen],
        "bearing_error_deg": np.degrees([abs(s.bearing_error_rad) for s in seen]),
        "heading_error_deg": np.degrees([abs(s.heading_error_rad) for s in told]),
    }
    for name, values in errors.items():
        line[f"{name}_median"], line[f"{name}_95"] = _percentiles(values, 50, 95)
    line |= honesty(seen, told)
    for name, some in zip(RATED, (seen, seen, told), strict=True):
        unit = "m" if name == "range" else "rad"
        error = np.array([getattr(s, f"{name}_error_{unit}") for s in some])
        bound = np.array([getattr(s, f"{name}_bound_{unit}") for s in some])
        line[f"{name}_over_bound"], line[f"{name}_over_bound_rms"] = over_bound(error, bound)
    line |= _bounds(samples)
    line["process_ms_median"], line["process_ms_95"] = _percentiles([1e3 * s.process_s for s in samples], 50, 95)
    return line


def honesty(seen: Sequence[Sample], told: Sequence[Sample]) -> dict:
    """NEES per degree of freedom, the two-sided 95 % band of its mean, and how many headings are off by many sigmas."""
    judged = [s for s in seen if s.dof]
    dof = sum(s.dof for s in judged)
    if not dof:
        return {"nees_per_dof": nan, "nees_low": nan, "nees_high": nan, "headings_judged": 0, "headings_wrong": 0}
    low, high = chi2.ppf([0.025, 0.975], dof) / dof
    rated = [abs(s.heading_error_rad) / s.heading_sigma_rad for s in told if s.dof]
    return {
        "nees_per_dof": float(sum(s.nees for s in judged) / dof),
        "nees_low": float(low),
        "nees_high": float(high),
        "headings_judged": len(rated),
        "headings_wrong": sum(ratio > WRONG_SIGMAS for ratio in rated),
    }


def over_bound(error: np.ndarray, bound: np.ndarray) -> tuple[float, float]:
    """How many times the bound errors are: by the median, and by the root mean square without the largest 5 %.

    Both are one for Gaussian errors that reach the bound: a trimmed square of sigma 1 is smaller by
    1 - 2 q phi(q) / KEPT, q the quantile up to which |e| is kept.
    """
    ratio = np.sort(np.abs(error / bound))
    ratio = ratio[np.isfinite(ratio)]
    if not len(ratio):
        return nan, nan
    kept = ratio[: max(round(KEPT * len(ratio)), 1)]
    q = norm.ppf((1 + KEPT) / 2)
    full = np.sqrt(1 - 2 * q * norm.pdf(q) / KEPT)
    return float(np.median(ratio) / MEDIAN_OF_SIGMA), float(np.sqrt(np.mean(kept**2)) / full)


def table_of(lines: Sequence[dict]) -> str:
    """Text; a line's `range` is what stands in its first column. Ratios to the bound: by the median (trimmed rms)."""
    widths = [width for _, _, width in COLUMNS]
    rows = [[column[k] for column in COLUMNS] for k in (0, 1)] + list(map(_cells, lines))
    return "\n".join("".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)


def _cells(line: dict) -> list[str]:
    band = f"{line['nees_low']:.2f}..{line['nees_high']:.2f}" if np.isfinite(line["nees_low"]) else "-"
    shares = [f"{100 * line[name]:.1f}" for name in ("detected", "heading_known")]
    errors = ("range_error_percent", "bearing_error_deg", "heading_error_deg")
    return [
        f"{line['range']:g}" if isinstance(line["range"], float) else str(line["range"]),
        str(line["n"]),
        *shares,
        *(_number(line[f"{name}_{which}"]) for name in errors for which in ("median", "95")),
        _number(line["nees_per_dof"]),
        band,
        f"{line['headings_wrong']}/{line['headings_judged']}",
        *(f"{_number(line[f'{q}_over_bound'])} ({_number(line[f'{q}_over_bound_rms'])})" for q in RATED),
    ]


def _number(value: float) -> str:
    """Three digits, four places at most; a dash for nothing."""
    if not np.isfinite(value):
        return "-"
    digits = int(np.clip(2 - np.floor(np.log10(max(abs(value), 1e-9))), 0, 4))
    return f"{value:.{digits}f}"


def _bounds(samples: Sequence[Sample]) -> dict:
    """Medians of the bound over all pictures, whether a target was found or not."""
    return {
        "range_bound_percent": _percentiles([100 * s.range_bound_m / s.range_m for s in samples], 50)[0],
        "bearing_bound_deg": _percentiles(np.degrees([s.bearing_bound_rad for s in samples]), 50)[0],
        "heading_bound_deg": _percentiles(np.degrees([s.heading_bound_rad for s in samples]), 50)[0],
    }


def _percentiles(values, *percents: float) -> list[float]:
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    return np.percentile(values, percents).tolist() if len(values) else [nan] * len(percents)
