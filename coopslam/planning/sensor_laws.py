"""How well the robots that mapped a place measure: laws that stand in the map's dual graph, for whoever plans there.

All are standard deviations; variances of what is driven and turned add up, those of a sighting grow with its range.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from math import isfinite
from typing import Any

import numpy as np

from coopslam.errors import BadInput, shown


@dataclass(frozen=True, slots=True)
class OdometryLaw:
    """Random walk of a robot that turns on the spot and drives straight: variances grow with metres and radians."""

    translation_sigma_per_m: float  # along the way, m per sqrt(m)
    heading_sigma_per_m: float  # drift of heading, rad per sqrt(m)
    heading_sigma_per_rad: float  # of a turn, rad per sqrt(rad)

    def __post_init__(self):
        _require_sigmas(self)

    def slipping(self, factor: float) -> "OdometryLaw":
        """The same on ground that multiplies every sigma."""
        return OdometryLaw(*(factor * getattr(self, entry.name) for entry in fields(self)))


@dataclass(frozen=True, slots=True)
class SightingLaw:
    """A sensor that sees a pose along a line of sight: the robot tracker, or the finder of corners."""

    along_sigma_m: float  # at range zero
    along_sigma_per_m: float
    across_sigma_m: float  # at range zero
    across_sigma_rad: float
    heading_sigma_rad: float | None  # None: it does not see how its target stands
    reach_m: float  # the longest range at which it was used

    def __post_init__(self):
        _require_sigmas(self)

    def line_covariance(self, range_m: float) -> np.ndarray:
        """(3, 3) covariance of (along, across, heading) in the axes of the line of sight, m, m, rad.

        Raises BadInput when the sensor does not see headings.
        """
        if self.heading_sigma_rad is None:
            raise BadInput("a sighting law without heading has no (3, 3) covariance")
        return np.diag([*self.line_variances(range_m), self.heading_sigma_rad**2])

    def line_variances(self, range_m: float) -> tuple[float, float]:
        """Along and across the line of sight, m^2."""
        return (
            self.along_sigma_m**2 + (self.along_sigma_per_m * range_m) ** 2,
            self.across_sigma_m**2 + (self.across_sigma_rad * range_m) ** 2,
        )


@dataclass(frozen=True, slots=True)
class SensorLaws:
    """What is believed of the sensors; None: none of that kind was used."""

    odometry: OdometryLaw | None
    finder: SightingLaw | None
    tracker: SightingLaw | None

    def to_mapping(self) -> dict[str, dict[str, float | None] | None]:
        """As it stands in a dual graph."""
        return {entry.name: (law := getattr(self, entry.name)) and asdict(law) for entry in fields(self)}

    @classmethod
    def from_mapping(cls, data: Any, where: str) -> "SensorLaws":
        """Raises BadInput, which begins with `where`, for what is no such mapping."""
        kinds = {"odometry": OdometryLaw, "finder": SightingLaw, "tracker": SightingLaw}
        if not isinstance(data, Mapping) or not set(kinds) <= set(data):
            raise BadInput(f"{where}: an object with odometry, finder and tracker expected, got {shown(data)}")
        laws = {}
        for name, kind in kinds.items():
            law = data[name]
            expected = [entry.name for entry in fields(kind)]
            if law is not None and (not isinstance(law, Mapping) or set(law) != set(expected)):
                raise BadInput(f"{where}.{name}: null or {', '.join(expected)} expected, got {shown(law)}")
            try:
                laws[name] = law and kind(**law)
            except BadInput as error:
                raise BadInput(f"{where}.{name}.{error}") from error
        return cls(**laws)


def _require_sigmas(law: OdometryLaw | SightingLaw) -> None:
    """Raises BadInput for a sigma that is no number of zero or more."""
    for entry in fields(law):
        value = getattr(law, entry.name)
        if value is None and entry.name == "heading_sigma_rad":
            continue
        if not isinstance(value, int | float) or isinstance(value, bool) or not isfinite(value) or value < 0:
            raise BadInput(f"{entry.name}: zero or more expected, got {shown(value)}")
