"""Trajectories in the TUM format: one line `t x y z qx qy qz qw` per pose; seconds, metres, unit quaternion."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from gtsam import Rot2

from coopslam.errors import BadInput
from coopslam.se2 import Pose2, xytheta

_PLANE_TOLERANCE = 1e-6  # m for z, and the size of a quaternion's x and y
_NORM_TOLERANCE = 1e-3  # other people's files round to few digits


def write_tum(path: str | Path, stamps_s: Sequence[float], poses: Sequence[Pose2]) -> None:
    """Planar poses, in the order given. Raises ValueError when the lengths differ or a number is not finite."""
    lines = ["# t x y z qx qy qz qw (s, m)"]
    for stamp_s, pose in zip(stamps_s, poses, strict=True):
        x, y, theta = xytheta(pose)
        if not np.isfinite([stamp_s, x, y, theta]).all():
            raise ValueError(f"the pose at t = {stamp_s} s is not finite: {x}, {y}, {theta}")
        qz, qw = np.sin(theta / 2), np.cos(theta / 2)
        lines.append(f"{stamp_s:.9f} {x:.12f} {y:.12f} 0 0 0 {qz:.15f} {qw:.15f}")
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_tum(path: str | Path) -> tuple[np.ndarray, list[Pose2]]:
    """Stamps (N,) in seconds and N planar poses, in the order of the file.

    Raises BadInput, with the line, when there are not eight finite numbers or the pose leaves the plane z = 0.
    """
    stamps, poses = [], []
    for number, line in enumerate(_lines(Path(path)), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        stamp, pose = _parse(line, f"{path}: line {number}")
        stamps.append(stamp)
        poses.append(pose)
    return np.array(stamps, dtype=float), poses


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise BadInput(f"{path}: cannot read the trajectory: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: not a text file; expected lines t x y z qx qy qz qw") from error


def _parse(line: str, where: str) -> tuple[float, Pose2]:
    try:
        values = [float(word) for word in line.split()]
    except ValueError as error:
        raise BadInput(f"{where}: {error}; expected the numbers t x y z qx qy qz qw") from error
    if len(values) != 8 or not np.isfinite(values).all():
        raise BadInput(f"{where}: expected eight finite numbers t x y z qx qy qz qw, got {line.strip()!r}")
    stamp, x, y, z, qx, qy, qz, qw = values
    if abs(np.linalg.norm([qx, qy, qz, qw]) - 1.0) > _NORM_TOLERANCE:
        raise BadInput(f"{where}: expected a unit quaternion qx qy qz qw, got {qx:g} {qy:g} {qz:g} {qw:g}")
    if max(abs(z), abs(qx), abs(qy)) > _PLANE_TOLERANCE:
        raise BadInput(f"{where}: expected a pose in the plane (z, qx and qy zero), got {z:g}, {qx:g}, {qy:g}")
    return stamp, Pose2(Rot2(2.0 * np.arctan2(qz, qw)), np.array([x, y]))
