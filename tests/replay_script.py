"""replay.py and compare.py as tests call them."""

from collections.abc import Callable
from pathlib import Path

import compare
import replay
from script_calls import exit_code, require_refused

LOGS = Path(__file__).parents[1] / "datasets" / "logs"
MRCLAM, PYFG, G2O = LOGS / "two_robots_mrclam", LOGS / "two_robots.pyfg", LOGS / "two_robots.g2o"


def call_replay(*arguments) -> int:
    """Exit code of replay.py in this process."""
    return exit_code(replay.main, *arguments)


def call_compare(*arguments) -> int:
    """Exit code of compare.py in this process."""
    return exit_code(compare.main, *arguments)


def refused_replay(capsys, *arguments, words, code=2) -> str:
    """The one line that an impossible call of replay.py gives."""
    return require_refused(replay.main, capsys, *arguments, words=words, code=code)


def refused_compare(capsys, *arguments, words, code=2) -> str:
    """The one line that an impossible call of compare.py gives."""
    return require_refused(compare.main, capsys, *arguments, words=words, code=code)


def results_in(folder: Path, call: Callable[..., int]) -> Callable[..., Path]:
    """A call without figures that ends with the expected exit code; the directory of its results, below the folder."""

    def called(*arguments, out="out", code=0) -> Path:
        assert call(*arguments, "--figures", "none", "--out", folder / out) == code
        return folder / out

    return called
