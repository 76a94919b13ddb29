"""replay.py and compare.py as tests call them, and what they read of the directories that these leave."""

import sys
from pathlib import Path

SCRIPTS = Path(__file__).parents[1] / "scripts"
sys.path.insert(0, str(SCRIPTS))

import compare  # noqa: E402
import replay  # noqa: E402
from _cli import run  # noqa: E402

LOGS = Path(__file__).parents[1] / "datasets" / "logs"
MRCLAM, PYFG, G2O = LOGS / "two_robots_mrclam", LOGS / "two_robots.pyfg", LOGS / "two_robots.g2o"


def call_replay(*arguments) -> int:
    """Exit code of replay.py in this process."""
    return _call(replay.main, arguments)


def call_compare(*arguments) -> int:
    """Exit code of compare.py in this process."""
    return _call(compare.main, arguments)


def without_seconds(value):
    """What does not depend on the clock, at any depth."""
    if isinstance(value, dict):
        return {key: without_seconds(item) for key, item in value.items() if not key.endswith("_seconds")}
    if isinstance(value, list):
        return [without_seconds(item) for item in value]
    return value


def _call(main, arguments) -> int:
    try:
        return run(main, [str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code
