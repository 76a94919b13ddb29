"""How often a detector sees a robot where there is none: rooms, stripes, people, banded columns, mosaics like tags.

Both detectors look at the same pictures. A picture with a false detection is written, drawn over with what was found.
The last line is the one-sided 95 % upper limit of the rate (Clopper and Pearson 1934).
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

import cv2
import numpy as np
from _cli import OneLineParser, run
from _empty_scenes import KINDS, empty_picture
from _files import make_directory
from _jobs import count, in_processes, whole
from _scenes import SIZES, TARGETS, sheet_of
from scipy.stats import beta

from coopslam.se2 import xytheta
from tracker.camera import Camera
from tracker.detector import Detection, Detector
from tracker.detectors import make_detector

OUT = Path("runs/tracker_false_alarms")
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Job:
    """A picture to look at."""

    size: str
    kind: str
    number: int
    seed: int
    out: Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Take all pictures, print a line for each kind. Returns the exit code."""
    options = _parser().parse_args(arguments)
    make_directory(options.out)
    for old in options.out.glob("false_*.png"):
        old.unlink()
    kinds = [KINDS[k % len(KINDS)] for k in range(options.pictures)]
    jobs = [Job(options.size, kind, k, options.seed, options.out) for k, kind in enumerate(kinds)]
    alarms = in_processes(looked_at, jobs, options.processes, "pictures")
    print(f"false detections at {options.size}, seed {options.seed}")
    print(f"{'pictures of':12s} {'n':>6s} " + " ".join(f"{target:>10s}" for target in TARGETS))
    for kind in KINDS:
        own = [each for each, job in zip(alarms, jobs, strict=True) if job.kind == kind]
        _print(kind, len(own), own)
    _print("all", len(jobs), alarms)
    limits = [upper_limit(sum(target in each for each in alarms), len(jobs)) for target in TARGETS]
    print(
        f"{'rate at most':19s} " + " ".join(f"{limit:10.2%}" for limit in limits) + f"  ({CONFIDENCE:.0%} confidence)"
    )
    if any(alarms):
        print(f"pictures with false detections: {options.out}/false_*.png")
    return 0


def looked_at(job: Job) -> tuple[str, ...]:
    """Which targets a detector sees in an empty picture."""
    rng = np.random.default_rng([job.seed, SIZES.index(job.size), job.number])
    camera, detectors = _detectors(job.size)
    image = empty_picture(job.kind, camera, rng)
    found = {target: detector.detect(image) for target, detector in detectors.items()}
    wrong = {target: detection for target, detection in found.items() if detection is not None}
    for target, detection in wrong.items():
        path = job.out / f"false_{target}_{job.kind}_{job.number:05d}.png"
        cv2.imwrite(str(path), _drawn(image, detection))
    return tuple(wrong)


def upper_limit(events: int, trials: int) -> float:
    """Upper end of the one-sided interval of a binomial rate."""
    return 1.0 if events == trials else float(beta.ppf(CONFIDENCE, events + 1, trials - events))


@lru_cache(maxsize=2)
def _detectors(size: str) -> tuple[Camera, dict[str, Detector]]:
    """The camera is the same in all data sheets of a size."""
    sheets = {target: sheet_of(target, size) for target in TARGETS}
    return sheets[TARGETS[0]].camera, {target: make_detector(sheet) for target, sheet in sheets.items()}


def _drawn(image: np.ndarray, found: Detection) -> np.ndarray:
    """The picture with the features, and where the robot is said to be."""
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    lines = [np.rint(line).astype(np.int32).reshape(-1, 1, 2) for line in found.features_px if len(line)]
    cv2.polylines(picture, lines, False, (0, 0, 255))
    x, y, heading = xytheta(found.T_observer_target)
    text = f"range {np.hypot(x, y):.2f} m, bearing {np.degrees(np.arctan2(y, x)):.1f} deg"
    text += f", heading {np.degrees(heading):.1f} deg" if found.heading_known else ", no heading"
    return cv2.putText(picture, text, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 255))


def _print(kind: str, n: int, alarms: Sequence[Sequence[str]]) -> None:
    counts = " ".join(f"{sum(target in each for each in alarms):10d}" for target in TARGETS)
    print(f"{kind:12s} {n:6d} {counts}", flush=True)


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="tracker_false_alarms.py", description=__doc__)
    parser.add_argument("--pictures", type=count, default=2000, help="of all kinds together; default: %(default)s")
    parser.add_argument("--size", choices=SIZES, default=SIZES[0], help="pixels; default: %(default)s")
    parser.add_argument("--seed", type=whole, default=0, help="of all random numbers; default: %(default)s")
    parser.add_argument("--processes", type=count, default=2, help="default: %(default)s")
    help_out = "directory of the pictures with false detections, which are replaced; default: %(default)s"
    parser.add_argument("--out", metavar="DIR", type=Path, default=OUT, help=help_out)
    return parser


if __name__ == "__main__":
    sys.exit(run(main))
