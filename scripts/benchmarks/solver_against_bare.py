"""How long the batch solver takes, against nothing but GTSAM on the same graph from the same start.

The graph of a whole log and its start are those of `replay`. Bare is a Levenberg-Marquardt optimizer with Cholesky, the
faster of COLAMD and METIS, once with our stopping tolerances and once with GTSAM's own. Each time is the best of some
repetitions, in turns. Beside it: the cost, and how far the variable that is farthest off is from the minimum, in its
sigmas.
"""

import sys
import time
from argparse import ArgumentParser
from pathlib import Path

import gtsam
import numpy as np

sys.path[:0] = [str(Path(__file__).parents[2])]

from coopslam.estimation import graph_check
from coopslam.estimation.batch import ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE, optimize
from coopslam.estimation.covariances import Covariances
from coopslam.estimation.offline import smooth
from coopslam.estimation.synchronize import synchronized
from coopslam.io.sources import open_log

CONVERGED = 1e-12  # relative and absolute tolerance of what counts as the minimum


def main() -> int:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", metavar="LOG", help="run directory, .mcap, MR.CLAM directory or .pyfg file")
    parser.add_argument("--repetitions", type=int, default=2, help="default: %(default)s")
    options = parser.parse_args()
    for log in options.logs:
        graph, start = _problem(log)
        print(f"{log}: {start.size()} variables, {graph.size()} factors, cost of the start {graph.error(start):.6g}")
        _compare(graph, start, options.repetitions)
    return 0


def _problem(path: str) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    log = open_log(path).read()
    smoothed = smooth(synchronized(log.records), log.header.robots, log.header.landmarks)
    return smoothed.solution.graph, smoothed.start


def _compare(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, repetitions: int) -> None:
    def bare(ordering, *tolerances):
        return lambda: _bare(graph, start, ordering, *tolerances)

    solvers = {"check of the graph": lambda: graph_check.check(graph, start), "ours": lambda: optimize(graph, start)}
    for ordering in ("COLAMD", "METIS"):
        solvers[f"{ordering}, our tolerances"] = bare(ordering, RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE)
        solvers[f"{ordering}, its own"] = bare(ordering)
    seconds, values = {}, {}
    for _ in range(repetitions):
        for name, solve in solvers.items():
            began = time.perf_counter()
            values[name] = solve()
            seconds[name] = min(seconds.get(name, np.inf), time.perf_counter() - began)
    away = _away(graph, values["ours"])
    for name, solution in values.items():
        quality = "" if solution is None else f"cost {graph.error(solution):.9g}, {away(solution):.2g} sigma away"
        print(f"  {name:24s} {seconds[name]:8.3f} s  {quality}")
    for tolerances in ("our tolerances", "its own"):
        fastest = min(seconds[f"{ordering}, {tolerances}"] for ordering in ("COLAMD", "METIS"))
        print(f"  ours over bare, {tolerances:14s}: {seconds['ours'] / fastest:.2f}", flush=True)


def _bare(graph, start, ordering: str, relative: float | None = None, absolute: float | None = None) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrderingType(ordering)
    if relative is not None:
        parameters.setRelativeErrorTol(relative)
        parameters.setAbsoluteErrorTol(absolute)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def _away(graph: gtsam.NonlinearFactorGraph, near: gtsam.Values):
    """The largest Mahalanobis distance of a variable from the minimum, as a function of values."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setOrderingType("METIS")
    parameters.setRelativeErrorTol(CONVERGED)
    parameters.setAbsoluteErrorTol(CONVERGED)
    minimum = gtsam.LevenbergMarquardtOptimizer(graph, near, parameters).optimize()
    keys = list(minimum.keys())
    covariances = Covariances(graph, minimum).marginals(keys)

    def away(values: gtsam.Values) -> float:
        steps = minimum.localCoordinates(values)
        squares = [
            step @ np.linalg.solve(cov, step) for step, cov in zip(map(steps.at, keys), covariances, strict=True)
        ]
        return float(np.sqrt(max(squares)))

    return away


if __name__ == "__main__":
    sys.exit(main())
