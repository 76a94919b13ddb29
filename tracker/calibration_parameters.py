"""What of a data sheet can be calibrated: names, where each is in the sheet, and how well a sheet is believed at first.

Heights count from the floor, but a picture only shows differences between camera and target. So `bottom` is what the
other heights are measured from, unless it is asked for.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from coopslam.errors import BadInput, shown
from tracker.data_sheet import DataSheet


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number of the data sheet."""

    path: tuple[str, ...]  # of fields
    unit: str
    tolerance: float  # standard deviation of what a nominal sheet says, before any picture
    per_width: bool = False  # the tolerance is a share of the picture's width
    scaled: str | None = None  # another field of the same table, which is scaled alike


_LENS, _MOUNT, _HELIX, _CUBE = ("camera", "lens"), ("camera", "mount"), ("helix",), ("tag_cube",)
_CAMERA = {
    "height": Parameter((*_MOUNT, "height_m"), "m", 0.01),
    "tilt": Parameter((*_MOUNT, "tilt_rad"), "rad", 0.0175),
    "yaw": Parameter((*_MOUNT, "yaw_rad"), "rad", 0.0175),
    "fx": Parameter((*_LENS, "fx_px"), "px", 0.015, per_width=True),
    "fy": Parameter((*_LENS, "fy_px"), "px", 0.015, per_width=True),
    "cx": Parameter((*_LENS, "cx_px"), "px", 0.01, per_width=True),
    "cy": Parameter((*_LENS, "cy_px"), "px", 0.01, per_width=True),
    "k1": Parameter((*_LENS, "k1"), "", 0.05),
    "k2": Parameter((*_LENS, "k2"), "", 0.05),
    "p1": Parameter((*_LENS, "p1"), "", 0.002),
    "p2": Parameter((*_LENS, "p2"), "", 0.002),
    "k3": Parameter((*_LENS, "k3"), "", 0.05),
}
_OF_HELIX = {
    "radius": Parameter((*_HELIX, "radius_m"), "m", 0.003),
    "bottom": Parameter((*_HELIX, "bottom_m"), "m", 0.005),
    "top": Parameter((*_HELIX, "top_m"), "m", 0.005),
    "pitch": Parameter((*_HELIX, "pitch_m"), "m", 0.005),
    "start": Parameter((*_HELIX, "start_rad"), "rad", 0.035),
}
_OF_CUBE = {
    "tag": Parameter((*_CUBE, "tag_m"), "m", 0.003, scaled="face_m"),  # a printer scales all of a sheet of paper
    "bottom": Parameter((*_CUBE, "bottom_m"), "m", 0.005),
}
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2")
_USUAL = {"helix": ("height", "tilt", "radius", "top", "pitch"), "tag_cube": ("height", "tilt", "tag")}


def known_parameters(sheet: DataSheet) -> Mapping[str, Parameter]:
    """Every parameter that this kind of sheet has, by name."""
    return _CAMERA | (_OF_CUBE if sheet.helix is None else _OF_HELIX)


def usual_parameters(sheet: DataSheet) -> tuple[str, ...]:
    """What is estimated when nothing else is asked for: the camera's height and tilt, and the target's dimensions."""
    return _USUAL["tag_cube" if sheet.helix is None else "helix"]


def require_known(sheet: DataSheet, names: Iterable[str]) -> tuple[str, ...]:
    """The names. Raises BadInput for one that the sheet does not have, a second time the same, or none at all."""
    names, known = tuple(names), known_parameters(sheet)
    for name in names:
        if name not in known:
            raise BadInput(f"parameter {shown(name)}: expected some of {', '.join(known)}")
    if len(set(names)) != len(names) or not names:
        raise BadInput(f"parameters {', '.join(names) or 'none'}: at least one, and none of them twice, expected")
    return names


def values_of(sheet: DataSheet, names: Sequence[str]) -> np.ndarray:
    """(P,) what the sheet says of parameters."""
    known = known_parameters(sheet)
    return np.array([reduce(getattr, known[name].path, sheet) for name in names], dtype=float)


def with_values(sheet: DataSheet, names: Sequence[str], values: np.ndarray) -> DataSheet:
    """The sheet with (P,) other values. Raises BadInput for values that cannot be."""
    known = known_parameters(sheet)
    changed: dict[tuple[str, ...], dict[str, float]] = {}
    for name, value in zip(names, np.asarray(values).tolist(), strict=True):
        *table, field = known[name].path
        own = changed.setdefault(tuple(table), {})
        own[field] = value
        if known[name].scaled is not None:
            settings = reduce(getattr, table, sheet)
            own[known[name].scaled] = getattr(settings, known[name].scaled) * value / getattr(settings, field)
    for table, fields in changed.items():  # all of one table at once: bottom and top may both move
        sheet = _replaced(sheet, table, fields)
    return sheet


def tolerances_of(sheet: DataSheet, names: Sequence[str]) -> np.ndarray:
    """(P,) standard deviations of what a nominal sheet says."""
    known, width = known_parameters(sheet), sheet.camera.lens.width_px
    return np.array([known[name].tolerance * (width if known[name].per_width else 1.0) for name in names])


def _replaced(settings, path: Sequence[str], fields: Mapping[str, float]):
    if not path:
        return replace(settings, **fields)
    return replace(settings, **{path[0]: _replaced(getattr(settings, path[0]), path[1:], fields)})
