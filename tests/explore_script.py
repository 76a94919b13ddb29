"""explore_and_optimize.py as tests call it, and what they read of its run directories."""

from pathlib import Path

from explore_and_optimize import main
from script_calls import SCRIPTS, exit_code, load, require_one_line, without_seconds  # noqa: F401

ROBOTS = ("robot0", "robot1")
FILES = [
    "config.toml",
    "log.mcap",
    *[f"trajectories/{robot}{causal}.tum" for robot in ROBOTS for causal in ("", ".causal")],
    "map.geojson",
    "dual_graph.json",
    "pose_graph.g2o",
    "pose_graph.keys.json",
    "summary.json",
    "report.html",
    "truth/world.geojson",
    "truth/vertices.json",
    *[f"truth/{robot}.tum" for robot in ROBOTS],
]
BARE = [
    *["world", "seed", "noise", "estimator", "outcome", "outcome_reason", "vertices", "holes", "triangles", "moves"],
    *["role_exchanges", "travel_m", "total_seconds"],
]
SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]


def call(*arguments) -> int:
    """Exit code of the script in this process."""
    return exit_code(main, *arguments)


def summary_of(out: Path):
    """What does not depend on the clock."""
    return without_seconds(load(out / "summary.json"))
