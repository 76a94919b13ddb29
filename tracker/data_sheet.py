"""Data sheets: the camera and the target that it looks for, in one TOML file.

[camera.lens]     size, focal lengths, principal point, distortion       (fields of tracker.lens.Lens)
[camera.mount]    height, tilt, forward offset, yaw                      (tracker.camera.Mount)
[helix]           or [tag_cube]: the target                              (tracker.helix.Helix, tracker.tag_cube.TagCube)
[[helix.body]]    plain cylinders that are the rest of the robot         (tracker.target.Drum)
[calibration]     of a calibrated sheet: how well its numbers are known  (CalibrationNote)
"""

from dataclasses import dataclass, field
from math import inf
from pathlib import Path

import numpy as np

from coopslam.errors import BadInput, require_between
from coopslam.io.toml import dump_toml, from_mapping, load_toml, to_mapping
from tracker.camera import Camera
from tracker.helix import Helix
from tracker.tag_cube import TagCube


@dataclass(frozen=True, slots=True)
class CalibrationNote:
    """How well the calibrated numbers of a sheet are known. Raises BadInput naming the field."""

    pictures: int  # that were used
    residual_rms_px: float  # of edges
    sigmas: dict[str, float] = field(default_factory=dict)  # parameter -> standard deviation, in the sheet's unit
    correlation: tuple[tuple[float, ...], ...] = ()  # of the parameters, in the same order

    def __post_init__(self):
        require_between(1, 1_000_000, pictures=self.pictures)
        require_between(0.0, 1e4, residual_rms_px=self.residual_rms_px)
        for name, sigma in self.sigmas.items():
            if not 0 <= sigma < inf:
                raise BadInput(f"sigmas: {name}: zero or more expected, got {sigma}")
        rows = self.correlation
        if len(rows) != len(self.sigmas) or any(len(row) != len(rows) for row in rows):
            raise BadInput(f"correlation: a square of {len(self.sigmas)} rows, one for each of sigmas, expected")

    @property
    def cov(self) -> np.ndarray:
        """(P, P) covariance of the parameters, in the order of `sigmas`."""
        sigmas = np.array(list(self.sigmas.values()))
        return np.array(self.correlation).reshape(len(sigmas), -1) * np.outer(sigmas, sigmas)


@dataclass(frozen=True, slots=True)
class DataSheet:
    """A camera and exactly one kind of target."""

    camera: Camera
    helix: Helix | None = None
    tag_cube: TagCube | None = None
    calibration: CalibrationNote | None = None

    def __post_init__(self):
        if (self.helix is None) == (self.tag_cube is None):
            raise BadInput("one table [helix] or [tag_cube] expected")

    @property
    def target(self) -> Helix | TagCube:
        """The one that it has."""
        return self.tag_cube if self.helix is None else self.helix


def load_data_sheet(path: str | Path) -> DataSheet:
    """Raises BadInput with file and key for a missing or unknown key, a wrong type or an impossible value."""
    return from_mapping(DataSheet, load_toml(path), str(path))


def dump_data_sheet(sheet: DataSheet) -> str:
    """TOML text that `load_data_sheet` reads back."""
    return dump_toml(to_mapping(sheet))
