"""Data sheets: the camera and the target that it looks for, in one TOML file.

[camera.lens]     size, focal lengths, principal point, distortion       (fields of tracker.lens.Lens)
[camera.mount]    height, tilt, forward offset, yaw                      (tracker.camera.Mount)
[helix]           or [tag_cube]: the target                              (tracker.helix.Helix, tracker.tag_cube.TagCube)
[[helix.body]]    plain cylinders that are the rest of the robot         (tracker.target.Drum)
"""

from dataclasses import dataclass
from pathlib import Path

from coopslam.errors import BadInput
from coopslam.io.toml import dump_toml, from_mapping, load_toml, to_mapping
from tracker.camera import Camera
from tracker.helix import Helix
from tracker.tag_cube import TagCube


@dataclass(frozen=True, slots=True)
class DataSheet:
    """A camera and exactly one kind of target."""

    camera: Camera
    helix: Helix | None = None
    tag_cube: TagCube | None = None

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
