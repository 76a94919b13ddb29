"""Does it matter where a smoother is told to begin? A log is smoothed from random starts, and scored against truth.

In each draw every robot is first guessed anywhere within 100 m and in any direction, and another robot's start is the
origin; landmarks have no start at all. What the sightings say of where robots began must bring all to the same answer.
"""

import sys
from argparse import ArgumentParser
from dataclasses import replace
from math import degrees
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from _replay import ReplaySettings, open_recording, run_estimator
from _replay_output import score

from coopslam.estimation.estimators import BATCH, NAMES


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path, help="any recording with truth")
    parser.add_argument("--draws", type=int, default=20, help="default: %(default)s")
    parser.add_argument("--estimator", choices=NAMES, default=BATCH, help="default: %(default)s")
    options = parser.parse_args()
    settings, worst = ReplaySettings(), [0.0, 0.0]
    for seed in range(options.draws):
        timeline = replace(settings.estimation.timeline, random_start=seed)
        drawn = replace(settings, estimation=replace(settings.estimation, timeline=timeline))
        recording = open_recording(options.log, drawn)
        outcome = run_estimator(options.estimator, recording, drawn)
        if outcome.replay is None:
            print(f"draw {seed:2d}: {outcome.failure}", flush=True)
            worst = [float("inf")] * 2
            continue
        scores = score(outcome, recording).scores
        errors = [scores["ate_rmse_m"], degrees(scores["heading_rmse_rad"])]
        worst = [max(pair) for pair in zip(worst, errors, strict=True)]
        print(f"draw {seed:2d}: ATE {errors[0]:.4f} m, heading {errors[1]:.3f} degrees", flush=True)
    print(f"worst of {options.draws} draws: ATE {worst[0]:.4f} m, heading {worst[1]:.3f} degrees")
    return 0


if __name__ == "__main__":
    sys.exit(main())
