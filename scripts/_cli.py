"""What all scripts share: one line for what the user can mend, and the exit code that goes with it."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from coopslam.errors import BadInput, CoopSlamError

# Matrices here are small: threads that share the work on one cost more than they bring. Before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong with an argument in one line; exit code 2."""

    def error(self, message: str) -> NoReturn:
        message = " ".join(word if len(word) <= 60 else word[:57] + "..." for word in message.split())
        print(f"{self.prog}: {message} (see --help)", file=sys.stderr)
        raise SystemExit(2)


def run(main: Callable[[Sequence[str] | None], int], arguments: Sequence[str] | None = None) -> int:
    """The exit code of `main`; errors of ours become a line, unknown ones keep their traceback."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # file names may hold what the terminal cannot show
    try:
        return main(arguments)
    except CoopSlamError as error:
        print(f"{type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # who read what is printed has gone; the last flush must not complain of it again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        print("interrupted; what was recorded so far is in the output directory", file=sys.stderr)
        return 130


def require_out_file(path: Path, kind: str, read: Callable[[Path], object]) -> None:
    """Raises BadInput when --out can be no file, or holds something else than `kind`, which `read` refuses."""
    try:
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise BadInput(f"--out {str(path)[:200]}: expected a file in a directory that exists")
        exists = path.exists() and path.stat().st_size > 0
    except (OSError, ValueError) as error:  # ValueError: a path that no system can have
        raise BadInput(f"--out {str(path)[:200]}: cannot be written; expected a file") from error
    if exists:
        try:
            read(path)
        except BadInput as error:
            raise BadInput(f"--out {path}: holds something else than {kind}; expected another file") from error
