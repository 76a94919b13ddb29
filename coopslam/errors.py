"""The one family of errors that scripts turn into a line and an exit code."""

from math import isfinite


class CoopSlamError(Exception):
    """Base of every error that coopslam raises on purpose."""

    exit_code = 2


class BadRecord(CoopSlamError):
    """A measurement or decision that cannot be true, whatever the world looks like."""


class BadInput(CoopSlamError):
    """A file, an argument or a setting that cannot be used; the message names it and what was expected."""


class UnderDetermined(CoopSlamError):
    """The records do not tie down every variable of the estimate."""

    exit_code = 3


class BadMove(CoopSlamError):
    """A move that the addressed robot cannot execute where it stands."""

    exit_code = 3


def require_positive(**settings: float) -> None:
    """Raises BadInput for the first setting that is not finite and more than zero."""
    for name, value in settings.items():
        if not (isfinite(value) and value > 0):
            raise BadInput(f"{name}: more than zero expected, got {value}")
