"""Scripts called in this process, what they leave, and what they say when they refuse."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

from _cli import run

SCRIPTS = Path(__file__).parents[1] / "scripts"


def exit_code(main: Callable[[list[str]], int], *arguments) -> int:
    """Of a script's `main`."""
    try:
        return run(main, [str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code


def require_refused(main: Callable[[list[str]], int], capsys, *arguments, words=(), code: int = 2) -> str:
    """The one line that an impossible call gives; it holds the words."""
    capsys.readouterr()
    assert exit_code(main, *arguments) == code
    said = capsys.readouterr().err
    require_one_line(said, *words)
    return said


def require_one_line(said: str, *words: str) -> None:
    assert said.endswith("\n") and len(said.splitlines()) == 1, said
    assert "Traceback" not in said and [word for word in words if word not in said] == [], said


def full_disk_at(monkeypatch, name: str) -> None:
    """From now on nothing can be written to files of that name."""
    real = Path.write_text

    def fails(path, *arguments, **options):
        if path.name == name:
            raise OSError(28, "No space left on device")
        return real(path, *arguments, **options)

    monkeypatch.setattr(Path, "write_text", fails)


def load(path: Path):
    return json.loads(path.read_text(encoding="utf-8"))


def rows_of(path: Path) -> list[dict]:
    """Of a CSV file."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def files_of(out: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def without_seconds(value):
    """What does not depend on the clock, at any depth."""
    if isinstance(value, dict):
        return {key: without_seconds(item) for key, item in value.items() if not key.endswith("_seconds")}
    if isinstance(value, list):
        return [without_seconds(item) for item in value]
    return value
