"""What a study writes below its directory: one sweep at a time, of one study, and faults said in one line."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from _study_axes import brief, one_line

from coopslam.errors import BadInput
from coopslam.io.toml import load_toml
from sim.world_checks import short


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """A fault of the file system becomes a line that names the file. Raises BadInput."""
    try:
        yield
    except OSError as error:
        place = error.filename if isinstance(error.filename, str) else path
        raise BadInput(f"{place}: cannot be written: {error.strerror or error}") from error


def write_anew(path: Path, content: bytes) -> None:
    """The whole file in one step: whatever interrupts it, the old one or the new one is there. Raises BadInput."""
    require_writable(path)
    new = path.with_suffix(".new")
    with writing(path):
        with open(new, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)


def require_writable(path: Path) -> None:
    """A file that is there and may not be changed is not replaced by another one either. Raises BadInput."""
    if path.exists():
        with writing(path), open(path, "ab"):
            pass


@contextmanager
def only_sweep(directory: Path) -> Iterator[Path]:
    """Holds the directory. Raises BadInput when another sweep does; the lock of a process that is gone is none."""
    path = directory / "sweep.lock"
    with writing(path):
        file = open(path, "a+", encoding="utf-8", errors="replace")  # noqa: SIM115
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            holder = brief(file.read()) or "unknown"
            raise BadInput(f"{directory}: another sweep (process {holder}) is writing here") from error
        with writing(path):
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
        yield directory
        with writing(path):
            file.truncate(0)


def require_same_study(directory: Path, name: str) -> None:
    """Raises BadInput when the directory has the results of a study of another name."""
    path = directory / "study.toml"
    if not path.exists():
        return
    there = load_toml(path).get("name")
    if not isinstance(there, str) or one_line(there) != name:
        raise BadInput(f"{directory}: has the study {short(there)}, not {short(name)}; --force adds to its table")
