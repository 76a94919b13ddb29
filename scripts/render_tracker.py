"""Pictures to try track.py on: a robot with a target drives loops in front of the camera; truth.csv says where."""

import csv
import sys
from collections.abc import Sequence
from math import cos, pi, sin
from pathlib import Path

import cv2
import numpy as np
from _cli import OneLineParser, run

from coopslam.errors import BadInput, NotWritten
from coopslam.se2 import Pose2, position
from sim.vision import motion_blurred
from tracker.background import Background
from tracker.data_sheet import DataSheet
from tracker.render import RenderSettings, render
from tracker.sensor import Sensor
from tracker.sheets import load_sheet, sheet_names

LOOPS_S = 40.0  # for both loops: about half a metre a second
EXPOSURE_S = 0.01
NEAREST_M, FARTHEST_M, HALF_VIEW_RAD = 1.5, 6.0, 0.42  # of the loops, as seen from the camera
COLUMNS = ("file", "stamp_s", "range_m", "bearing_rad", "heading_rad")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, render, write. Returns the exit code."""
    parser = OneLineParser(prog="render_tracker.py", description=__doc__)
    known = ", ".join(sheet_names())
    parser.add_argument("--sheet", metavar="SHEET.toml", required=True, help=f"a TOML file or one of: {known}")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="a new directory")
    parser.add_argument("--frames", metavar="N", type=int, default=80, help="pictures in all; default: 80")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of clutter and noise; default: 0")
    parser.add_argument(
        "--background",
        choices=["plain", "gradient", "clutter"],
        default="clutter",
        help="behind the robot; default: clutter",
    )
    options = parser.parse_args(arguments)
    if not 1 <= options.frames <= 100_000:
        raise BadInput(f"--frames: 1 to 100000 expected, got {options.frames}")
    if options.seed < 0:
        raise BadInput(f"--seed: zero or more expected, got {options.seed}")
    sheet = load_sheet(options.sheet)
    try:
        if options.out.exists() and any(options.out.iterdir()):
            raise BadInput(f"--out {options.out}: an empty or new directory expected")
        options.out.mkdir(parents=True, exist_ok=True)
        _write(sheet, options)
    except OSError as error:
        raise NotWritten(f"--out {options.out}: cannot be written: {error.strerror or error}", done=False) from error
    print(f"{options.frames} pictures and truth.csv written to {options.out}")
    return 0


def _write(sheet: DataSheet, options) -> None:
    rng = np.random.default_rng(options.seed)
    background = Background(options.background).radiance(sheet.camera, rng, FARTHEST_M + 1.0)
    with (options.out / "truth.csv").open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream)
        table.writerow(COLUMNS)
        for k in range(options.frames):
            name, pose = f"frame_{k:05d}.png", _pose(k, options.frames, sheet.camera.mount.yaw_rad)
            after = _pose(k + 0.01, options.frames, sheet.camera.mount.yaw_rad)
            velocity = (position(after) - position(pose)) / (0.01 * LOOPS_S / options.frames)
            sensor = motion_blurred(Sensor(), sheet.camera, sheet.target, pose, velocity * EXPOSURE_S)
            picture = render(sheet.camera, sheet.target, pose, RenderSettings(sensor=sensor), rng, background)
            (options.out / name).write_bytes(cv2.imencode(".png", picture)[1].tobytes())
            x, y = position(pose)
            table.writerow(
                [name, k * LOOPS_S / options.frames, float(np.hypot(x, y)), float(np.arctan2(y, x)), pose.theta()]
            )


def _pose(frame: float, frames: int, yaw_rad: float) -> Pose2:
    """On a path that crosses the view from near to far and back, looking along it."""

    def place(s: float) -> np.ndarray:
        range_m = (NEAREST_M + FARTHEST_M) / 2 - (FARTHEST_M - NEAREST_M) / 2 * cos(2 * pi * s)
        bearing = yaw_rad + HALF_VIEW_RAD * sin(4 * pi * s)
        return range_m * np.array([cos(bearing), sin(bearing)])

    s = frame / frames
    ahead = place(s + 1e-6) - place(s)
    return Pose2(*place(s), np.arctan2(ahead[1], ahead[0]))


if __name__ == "__main__":
    sys.exit(run(main))
