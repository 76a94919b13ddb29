"""How long a detector takes beside the library's: process time of one core, on the same pictures in the same run.

Each method looks at the pictures one after the other, as it would at those of its camera; the methods take turns, in
another order each time, and of the repetitions the median of a picture counts. Pictures show the helix, the tag cube
or no target, near and far, before plain, graded and cluttered backgrounds. The ratio is that to aruco with its default
parameters, picture by picture, and its median.
"""

import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

import numpy as np
from _aruco_pose import REFINEMENTS, aruco_detector
from _cli import OneLineParser, run
from _jobs import count, one_thread, whole
from _scenes import (
    BACKGROUNDS,
    RANGES_M,
    SIZES,
    TARGETS,
    random_background,
    random_light,
    random_scene,
    random_sensor,
    sheet_of,
)

from tracker.detectors import make_detector
from tracker.render import RenderSettings, render_background

REFERENCE = "aruco none"
SHOWN = (*TARGETS, "neither")


def main(arguments: Sequence[str] | None = None) -> int:
    """Time all methods, print a line for each kind of picture. Returns the exit code."""
    options = _parser().parse_args(arguments)
    one_thread()
    rng = np.random.default_rng(options.seed)
    methods = _methods(options.size)
    print(f"process time at {options.size}, one core, ms: median and 95 % over pictures; median ratio to {REFERENCE}")
    print(f"{'picture of':11s} {'n':>5s} " + " ".join(f"{name:>24s}" for name in methods))
    everything = []
    for shown in SHOWN:
        pictures = [_picture(shown, options.size, k, rng) for k in range(options.pictures)]
        times = timed(methods, pictures, options.repetitions, rng)
        _print(shown, methods, times)
        everything.append(times)
    _print("all", methods, np.concatenate(everything))
    return 0


def timed(
    methods: dict[str, Callable], pictures: Sequence[np.ndarray], repetitions: int, rng: np.random.Generator
) -> np.ndarray:
    """(P, M) process time of each picture and method in ms: the median of some repetitions."""
    names = list(methods)
    spent = np.empty((repetitions, len(pictures), len(names)))
    for turn in spent:
        for k in rng.permutation(len(names)):
            for row, picture in zip(turn, pictures, strict=True):
                began = time.process_time()
                methods[names[k]](picture)
                row[k] = time.process_time() - began
    return 1e3 * np.median(spent, axis=0)


def _methods(size: str) -> dict[str, Callable]:
    methods = {f"aruco {name}": aruco_detector(name).detectMarkers for name in REFINEMENTS}
    return methods | {target: make_detector(sheet_of(target, size)).detect for target in TARGETS}


def _picture(shown: str, size: str, number: int, rng: np.random.Generator) -> np.ndarray:
    """Ranges and backgrounds in turns."""
    if shown in TARGETS:
        sheet = sheet_of(shown, size)
        scene = random_scene(sheet, RANGES_M[number % len(RANGES_M)], False, rng)
        return scene.picture(sheet.camera, sheet.target, rng)
    background = random_background(rng, BACKGROUNDS[number % len(BACKGROUNDS)])
    settings = RenderSettings(random_light(rng), background, random_sensor(rng))
    return render_background(sheet_of(TARGETS[0], size).camera, settings, rng)


def _print(shown: str, methods: dict[str, Callable], times: np.ndarray) -> None:
    ratios = np.median(times / times[:, [list(methods).index(REFERENCE)]], axis=0)
    middle, most = np.percentile(times, [50, 95], axis=0)
    cells = (f"{a:8.2f} {b:7.2f} ({r:5.2f})" for a, b, r in zip(middle, most, ratios, strict=True))
    print(f"{shown:11s} {len(times):5d} " + " ".join(f"{cell:>24s}" for cell in cells), flush=True)


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="tracker_time.py", description=__doc__)
    parser.add_argument("--pictures", type=count, default=48, help="of each kind; default: %(default)s")
    parser.add_argument("--repetitions", type=count, default=5, help="of each picture; default: %(default)s")
    parser.add_argument("--size", choices=SIZES, default=SIZES[0], help="pixels; default: %(default)s")
    parser.add_argument("--seed", type=whole, default=0, help="of all random numbers; default: %(default)s")
    return parser


if __name__ == "__main__":
    sys.exit(run(main))
