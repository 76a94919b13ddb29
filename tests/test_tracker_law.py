"""The law of the tracker's errors: against known laws, scipy's likelihood and hand-worked rows."""

import csv
import json
import sys
from math import pi
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

SCRIPTS = Path(__file__).parents[1] / "scripts"
sys.path[:0] = [str(SCRIPTS), str(SCRIPTS / "benchmarks")]

import tracker_law  # noqa: E402
from _cli import run  # noqa: E402
from _law import (  # noqa: E402
    fitted_line,
    normalized_square,
    resampled,
    robust_sigma,
    share_between,
)
from _rigs import BuildErrors, differences, errors_of, true_sheet  # noqa: E402
from _scenes import sheet_of  # noqa: E402

from coopslam.errors import UnderDetermined  # noqa: E402
from coopslam.se2 import Pose2  # noqa: E402

RANGES_M = np.tile([0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0], 500)


def drawn(floor: float, slope: float, seed: int) -> np.ndarray:
    return np.hypot(floor, slope * RANGES_M) * np.random.default_rng(seed).standard_normal(len(RANGES_M))


@pytest.mark.parametrize(("floor", "slope"), [(0.005, 0.002), (0.02, 0.001), (0.001, 0.004)])
def test_a_known_law_is_found(floor, slope):
    """4000 errors: a sigma of all would be known to 1.1 %; each of two parts that cover half the ranges, to 10 %."""
    errors = drawn(floor, slope, 1)
    line = fitted_line(errors, RANGES_M)
    assert line.floor == pytest.approx(floor, rel=0.1) and line.slope == pytest.approx(slope, rel=0.1)
    assert normalized_square(errors, RANGES_M, line) == pytest.approx(1.0, abs=0.07)  # three sigmas of a chi-square


def test_no_law_is_more_likely():
    """Against scipy's normal density on a grid about the answer, a few per cent either way."""
    errors = drawn(0.004, 0.001, 2)
    line = fitted_line(errors, RANGES_M)

    def likelihood(floor: float, slope: float) -> float:
        return float(norm.logpdf(errors, scale=np.hypot(floor, slope * RANGES_M)).sum())

    best = likelihood(line.floor, line.slope)
    others = [
        likelihood(f * line.floor, s * line.slope) for f in (0.97, 1.0, 1.03) for s in (0.97, 1.0, 1.03) if f * s != 1.0
    ]
    assert max(others) < best


def test_a_part_that_is_not_there_vanishes():
    errors = drawn(0.0, 0.002, 3)
    line = fitted_line(errors, RANGES_M)
    assert line.floor < 0.0002 and line.slope == pytest.approx(0.002, rel=0.05)
    flat = fitted_line(errors, RANGES_M, constant=True)
    assert flat.slope == 0 and flat.floor == pytest.approx(np.sqrt(np.mean(errors**2)))
    with pytest.raises(UnderDetermined, match="at least 8"):
        fitted_line(errors[:7], RANGES_M[:7])
    with pytest.raises(UnderDetermined):
        fitted_line(np.zeros(20), RANGES_M[:20])


def test_a_law_that_does_not_hold_is_seen_to():
    """Errors by the square of the range: sigma 0.01 m at 10 m, which a straight law makes smaller."""
    errors = 1e-4 * RANGES_M**2 * np.random.default_rng(4).standard_normal(len(RANGES_M))
    line = fitted_line(errors, RANGES_M)
    far, near = RANGES_M == 10.0, RANGES_M == 2.0
    assert normalized_square(errors[far], RANGES_M[far], line) > 1.5
    assert normalized_square(errors[near], RANGES_M[near], line) < 0.5


def test_figures_by_hand():
    assert robust_sigma(np.array([-3.0, 1.0, 2.0])) == pytest.approx(2 / norm.ppf(0.75), rel=1e-4)
    groups = np.repeat([0, 1], 2)
    assert share_between(np.array([1.0, 1.0, -2.0, -2.0]), groups) == pytest.approx(1.0)  # each group is of one error
    assert share_between(np.array([1.0, -1.0, 2.0, -2.0]), groups) == pytest.approx(-1.0)
    assert np.isnan(share_between(np.array([1.0, 2.0]), np.array([0, 1])))


def test_the_bootstrap_knows_that_errors_of_a_group_are_one():
    """The mean of 30 groups of ten equal errors scatters by sigma / sqrt(30); 400 draws know that to 4 %, 30 groups the
    sigma itself, which the draws are compared with."""
    of_group = np.random.default_rng(5).standard_normal(30)
    values, groups = np.repeat(of_group, 10), np.repeat(np.arange(30), 10)
    means = resampled(lambda rows: (values[rows].mean(),), groups, np.random.default_rng(6), 400)
    assert means.std() == pytest.approx(of_group.std() / np.sqrt(30), rel=0.15)


def test_errors_along_and_across_the_line_of_sight():
    """A target at 2 m to the left, seen 1 cm farther and 2 cm to its right, turned from just below to just above pi."""
    row = errors_of(Pose2(0.02, 2.01, -pi + 0.01), Pose2(0.0, 2.0, pi - 0.01), True)
    assert row["range_error_m"] == pytest.approx(0.01, abs=1.1e-4)  # and 0.02^2 / 4 by Pythagoras
    assert row["across_error_m"] == pytest.approx(-0.02)
    assert row["bearing_error_rad"] == pytest.approx(-0.02 / 2.01, abs=1e-6)
    assert row["heading_error_rad"] == pytest.approx(0.02)
    assert not row["elsewhere"] and errors_of(Pose2(0.5, 2.0, 0.0), Pose2(0.0, 2.0, 0.0), False)["elsewhere"]


def test_rigs_scatter_as_they_are_told_to():
    """300 rigs: standard deviations known to 4 %. Heights are compared above the lower end, whose own error adds."""
    nominal, rng = sheet_of("helix", "640x480"), np.random.default_rng(7)
    sheets = [true_sheet(nominal, BuildErrors(0.5, 0.01, 0.0005), rng) for _ in range(300)]
    away = [differences(nominal, sheet) for sheet in sheets]
    spread = {name: np.std([each[name] for each in away]) for name in away[0]}
    assert spread["tilt"] == pytest.approx(0.5 * 0.0175, rel=0.15)
    assert spread["height"] == pytest.approx(0.5 * np.hypot(0.01, 0.005), rel=0.15)
    assert spread["top"] == pytest.approx(0.5 * np.hypot(0.005, 0.005), rel=0.15)
    assert spread["fx"] == pytest.approx(0.01, rel=0.15) and spread["fx"] == pytest.approx(spread["fy"])
    assert np.std([sheet.helix.ring_m for sheet in sheets]) == pytest.approx(0.0005, rel=0.15)
    untold = [(sheet.camera.mount.yaw_rad, sheet.helix.start_rad, sheet.camera.lens.cx_px) for sheet in sheets]
    assert set(untold) == {(0.0, 0.0, 319.5)}


def test_a_small_run(tmp_path, capsys):
    """Of rigs as their sheet says and of wrong ones; the files hold what is printed."""
    common = ["--rigs", "2", "--pictures", "16", "--processes", "1"]
    assert run(tracker_law.main, [*common, "--perfect", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    with (tmp_path / "samples.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * 16
    assert f"{summary['calibrated']['law']['range_sigma_per_m']:.6f}" in printed
    errors = [float(row["range_error_m"]) for row in rows if row["sheet"] == "perfect" and row["detected"] == "True"]
    assert summary["perfect"]["all"]["range_error_m_rms"] == pytest.approx(np.sqrt(np.mean(np.square(errors))))
    assert summary["perfect"]["all"]["range_error_m_rms"] < summary["calibrated"]["all"]["range_error_m_rms"]
    with pytest.raises(SystemExit) as left:
        run(tracker_law.main, ["--focal-sigma", "2"])
    assert left.value.code == 2
    assert run(tracker_law.main, ["--estimate", "hue", "--out", str(tmp_path)]) == 2
