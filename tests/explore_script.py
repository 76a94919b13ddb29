"""explore_and_optimize.py as tests call it, and what they read of its run directories."""

import json
import sys
from pathlib import Path

SCRIPTS = Path(__file__).parents[1] / "scripts"
sys.path.insert(0, str(SCRIPTS))

from _cli import run  # noqa: E402
from _exploration import DRIVERS  # noqa: E402, F401
from explore_and_optimize import main  # noqa: E402

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
    try:
        return run(main, [str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code


def load(path: Path):
    return json.loads(path.read_text(encoding="utf-8"))


def without_seconds(value):
    if isinstance(value, dict):
        return {key: without_seconds(item) for key, item in value.items() if not key.endswith("_seconds")}
    return value


def files_of(out: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def summary_of(out: Path):
    """What does not depend on the clock."""
    return without_seconds(load(out / "summary.json"))


def require_one_line(said: str, *words: str) -> None:
    assert said.endswith("\n") and len(said.splitlines()) == 1, said
    assert "Traceback" not in said and [word for word in words if word not in said] == [], said
