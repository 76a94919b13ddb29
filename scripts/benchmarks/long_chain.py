"""Does a long run of two robots solve, and give covariances, on a stack of ordinary or small size?

Odometry between successive poses, and a fix of one robot by the other every few poses; from dead reckoning. Try it
under `ulimit -s 8192` (the usual stack, in kB) and less. Prints the time of each step and the peak memory.
"""

import resource
import sys
import time
from argparse import ArgumentParser
from pathlib import Path

import gtsam
import numpy as np

sys.path[:0] = [str(Path(__file__).parents[2])]

from coopslam.estimation.batch import chi_square, solve_batch
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.factors import gauge_prior
from coopslam.estimation.keys import pose_key
from coopslam.se2 import Pose2

ODOMETRY_SIGMAS = np.array([0.01, 0.01, 0.002])  # m, m, rad; each step
FIX_SIGMAS = np.array([0.02, 0.03, 0.01])


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=300_000, help="of both robots; default: %(default)s")
    parser.add_argument("--fix-every", type=int, default=5, help="poses of each robot; default: %(default)s")
    parser.add_argument("--marginals", type=int, default=100, help="how many poses; default: %(default)s")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    stack, _ = resource.getrlimit(resource.RLIMIT_STACK)
    size = "unlimited" if stack == resource.RLIM_INFINITY else f"{stack // 1024} kB"
    print(f"{options.poses} poses, a fix every {options.fix_every}, stack {size}", flush=True)
    rng = np.random.default_rng(options.seed)
    graph, initial = _timed("build", two_robots, options.poses, options.fix_every, rng)
    values = _timed("solve", solve_batch, graph, initial)
    covariances = _timed("eliminate", Covariances, graph, values)
    asked = [pose_key(1, int(i)) for i in np.linspace(0, options.poses // 2 - 1, options.marginals)]
    marginals = _timed(f"{len(asked)} marginals", covariances.marginals, asked)
    squares, dof = chi_square(graph, values)
    print(f"chi-square per degree of freedom {squares / dof:.4f} ({dof} degrees)")
    print(f"sigma of the last position: {np.sqrt(np.trace(marginals[-1][:2, :2])):.3f} m")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    return 0


def two_robots(poses: int, fix_every: int, rng: np.random.Generator) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The graph, and the poses by odometry alone."""
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    odometry, fix = (gtsam.noiseModel.Diagonal.Sigmas(sigmas) for sigmas in (ODOMETRY_SIGMAS, FIX_SIGMAS))
    graph.push_back(gauge_prior(pose_key(0, 0)))
    truth = [Pose2(), Pose2(1.0, -0.5, 0.4)]
    reckoned = list(truth)
    for i in range(poses // 2):
        for robot in (0, 1):
            if i:
                delta = Pose2(0.1, 0.0, 0.01 * np.sin(i / 50 + robot))
                measured = delta * Pose2(*(rng.standard_normal(3) * ODOMETRY_SIGMAS))
                truth[robot] *= delta
                reckoned[robot] *= measured
                keys = pose_key(robot, i - 1), pose_key(robot, i)
                graph.push_back(gtsam.BetweenFactorPose2(*keys, measured, odometry))
            initial.insert(pose_key(robot, i), reckoned[robot])
        if i % fix_every == 0:
            seen = truth[0].between(truth[1]) * Pose2(*(rng.standard_normal(3) * FIX_SIGMAS))
            graph.push_back(gtsam.BetweenFactorPose2(pose_key(0, i), pose_key(1, i), seen, fix))
    return graph, initial


def _timed(what: str, function, *arguments):
    began = time.perf_counter()
    result = function(*arguments)
    print(f"{what:15s} {time.perf_counter() - began:8.2f} s", flush=True)
    return result


if __name__ == "__main__":
    sys.exit(main())
