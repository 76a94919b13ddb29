"""The one family of errors that scripts turn into a line and an exit code."""

from math import inf


class CoopSlamError(Exception):
    """Base of every error that coopslam raises on purpose."""

    exit_code = 2


class BadRecord(CoopSlamError):
    """A measurement or decision that cannot be true, whatever the world looks like."""


class BadInput(CoopSlamError):
    """A file, an argument or a setting that cannot be used; the message names it and what was expected."""


class NotWritten(CoopSlamError):
    """A disk or directory that does not take what is to be written."""

    def __init__(self, message: str, done: bool):
        super().__init__(message)
        self.exit_code = 3 if done else 2  # done: the job itself was, only its results are not all there


class UnderDetermined(CoopSlamError):
    """The records do not tie down every variable of the estimate."""

    exit_code = 3


class BadMove(CoopSlamError):
    """A move that the addressed robot cannot execute where it stands."""

    exit_code = 3


def require_positive(most: float = inf, /, **settings: float) -> None:
    """Raises BadInput for the first setting that is not finite, more than zero and at most `most`."""
    for name, value in settings.items():
        if not (0 < value < inf and value <= most):
            limit = "" if most == inf else f" and at most {most:g}"
            raise BadInput(f"{name}: more than zero{limit} expected, got {value}")


def require_between(least: float, most: float, /, **settings: float) -> None:
    """Raises BadInput for the first setting that is not in the closed interval."""
    for name, value in settings.items():
        if not least <= value <= most:
            raise BadInput(f"{name}: {least:g} to {most:g} expected, got {value}")


def shown(value) -> str:
    """A value as it is quoted in a message: in one line, of at most 60 characters."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # an integer with more digits than Python writes
        text = "a number without end"
    return text if len(text) <= 60 else text[:57] + "..."
