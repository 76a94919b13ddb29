"""Run a detector over pictures: records, one by one, into the log, the table, the film; what is left in memory."""

import csv
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from _track_pictures import ContactSheet, Film, annotated
from _track_source import Shot

from coopslam.errors import BadInput
from coopslam.io.run_log import RunLogWriter
from coopslam.records import LogHeader
from coopslam.report.track_figure import draw_track
from coopslam.se2 import position
from tracker.detector import Detection, Detector

AXES = ("bearing", "range", "heading")
UNITS = {"bearing": "rad", "range": "m", "heading": "rad"}
PAIRS = [(i, j) for i in range(3) for j in range(i + 1)]


def _covariance_column(i: int, j: int) -> str:
    one, other = AXES[j], AXES[i]
    unit = f"{UNITS[one]}2" if UNITS[one] == UNITS[other] else "m_rad"
    return f"cov_{one}_{other}_{unit}"


COLUMNS = (
    *("stamp_s", "image", "found", "range_m", "bearing_rad", "heading_rad"),
    *("range_sigma_m", "bearing_sigma_rad", "heading_sigma_rad"),
    *(_covariance_column(i, j) for i, j in PAIRS),
)


@dataclass(frozen=True, slots=True)
class Names:
    """Who looks at whom."""

    observer: str
    target: str


@dataclass(slots=True)
class Tracked:
    """What became of the pictures so far."""

    images: int = 0
    detections: int = 0
    headings_withheld: int = 0
    unreadable: list[str] = field(default_factory=list)
    stamps_s: list[float] = field(default_factory=list)
    values: list[np.ndarray] = field(default_factory=list)  # (3,) range, bearing, heading; NaN where nothing is known
    sigmas: list[np.ndarray] = field(default_factory=list)


class Recorder:
    """Everything that grows picture by picture in an output directory; a context manager."""

    def __init__(self, out: Path, header: LogHeader, names: Names):
        self._out, self._names, self.tracked = out, names, Tracked()
        (out / "figures").mkdir(exist_ok=True)
        self._log = RunLogWriter(out / "log.mcap", header)
        self._stream = (out / "records.csv").open("w", newline="", encoding="utf-8")
        self._table = csv.writer(self._stream)
        self._table.writerow(COLUMNS)
        self._sheet, self._film = ContactSheet(), Film(out / "figures" / "annotated.mp4")

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_) -> None:
        self._log.close()
        self._stream.close()
        self._film.close()
        self._sheet.write(self._out / "figures" / "contact_sheet.png")

    def add(self, shot: Shot, found: Detection | None) -> None:
        """A picture that was searched, and what was found in it."""
        tracked = self.tracked
        tracked.images += 1
        tracked.stamps_s.append(shot.stamp_s)
        values, cov = np.full(3, np.nan), np.full((3, 3), np.nan)
        if found is not None:
            tracked.detections += 1
            tracked.headings_withheld += not found.heading_known
            self._log.append(found.record(shot.stamp_s, self._names.observer, self._names.target))
            values, cov = polar(found)
        sigmas = np.sqrt(np.diag(cov))
        tracked.values.append(values[[1, 0, 2]])
        tracked.sigmas.append(sigmas[[1, 0, 2]])
        self._table.writerow(_row(shot, found, values, cov))
        picture = annotated(shot.image, found, _lines(shot, found, values, sigmas))
        self._sheet.add(picture)
        self._film.add(picture)

    def draw(self, title: str) -> None:
        """The figure over time of all that was added."""
        tracked = self.tracked
        if tracked.images:
            arrays = np.array(tracked.stamps_s), np.array(tracked.values), np.array(tracked.sigmas)
            draw_track(self._out / "figures" / "track.png", title, *arrays)


def search(shot: Shot, detector: Detector, size: tuple[int, int]) -> Detection | None:
    """size: (rows, columns) of the data sheet. Raises BadInput for a picture that is none, or of another size."""
    if shot.image is None:
        raise BadInput(f"{shot.name}: cannot be read; expected a picture")
    if shot.image.shape != size:
        (rows, columns), (its_rows, its_columns) = size, shot.image.shape
        raise BadInput(f"{shot.name}: {columns} x {rows} pixels expected (data sheet), got {its_columns} x {its_rows}")
    return detector.detect(shot.image)


def polar(found: Detection) -> tuple[np.ndarray, np.ndarray]:
    """(3,) bearing, range and heading, and their (3, 3) covariance; NaN for a heading that is withheld.

    First order, by the Jacobian of (atan2(y, x), hypot(x, y), theta).
    """
    x, y = position(found.T_observer_target)
    range_m = float(np.hypot(x, y))
    jacobian = np.array([[-y / range_m**2, x / range_m**2, 0.0], [x / range_m, y / range_m, 0.0], [0.0, 0.0, 1.0]])
    values = np.array([np.arctan2(y, x), range_m, found.T_observer_target.theta()])
    cov = jacobian @ found.cov_observer @ jacobian.T
    if not found.heading_known:
        values[2], cov[2, :], cov[:, 2] = np.nan, np.nan, np.nan
    return values, cov


def _row(shot: Shot, found: Detection | None, values: np.ndarray, cov: np.ndarray) -> list:
    bearing, range_m, heading = values
    sigmas = np.sqrt(np.diag(cov))
    kind = "nothing" if found is None else "pose" if found.heading_known else "bearing and range"
    numbers = [range_m, bearing, heading, sigmas[1], sigmas[0], sigmas[2], *(cov[i, j] for i, j in PAIRS)]
    return [repr(float(shot.stamp_s)), shot.name, kind, *("" if np.isnan(n) else repr(float(n)) for n in numbers)]


def _lines(shot: Shot, found: Detection | None, values: np.ndarray, sigmas: np.ndarray) -> list[str]:
    """What is written into a picture."""
    first = f"{shot.stamp_s:.2f} s  {shot.name}"
    if found is None:
        return [first, "no target found"]
    (bearing, heading), (bearing_sigma, heading_sigma) = np.degrees(values[[0, 2]]), np.degrees(sigmas[[0, 2]])
    said = [
        f"range {values[1]:.3f} m  sigma {1000 * sigmas[1]:.2f} mm",
        f"bearing {bearing:.2f} deg  sigma {bearing_sigma:.3f}",
        f"heading {heading:.1f} deg  sigma {heading_sigma:.2f}" if found.heading_known else "heading withheld",
    ]
    return [first, *said]
