"""Numbers as a person reads them: three significant digits, a unit, a dash for what is not known."""

from math import floor, isfinite, log10

DASH = "–"


def digits(value, significant: int = 3) -> str:
    """Plain decimals, with an exponent only below 1e-4; a dash for None, NaN and what is no number."""
    if not _is_number(value):
        return DASH
    if value == 0:
        return "0"
    magnitude = floor(log10(abs(value)))
    if magnitude < -4:
        return f"{value:.{significant - 1}e}".replace("e-0", "e-")
    return f"{value:,.{max(significant - 1 - magnitude, 0)}f}"


def count(value) -> str:
    """A whole number with thousands marked."""
    return f"{value:,.0f}" if _is_number(value) else DASH


def length(value_m) -> str:
    """In the largest of m, cm and mm that leaves a number of 1 or more."""
    if not _is_number(value_m):
        return DASH
    factor, unit = next(((f, u) for f, u in ((1, "m"), (100, "cm")) if abs(value_m) * f >= 1), (1000, "mm"))
    return f"{digits(factor * value_m)} {unit}"


def scaled(value, factor: float, significant: int = 3) -> str:
    """In another unit, without saying which: for columns that name it."""
    return digits(factor * value, significant) if _is_number(value) else DASH


def percent(fraction) -> str:
    """Never rounded up to 100 % or down to 0 %; differences below 1e-9 count as arithmetic."""
    if not _is_number(fraction):
        return DASH
    if abs(fraction) < 1e-9:
        return "0 %"
    if abs(fraction - 1) < 1e-9:
        return "100 %"
    if 1 - 5e-7 < fraction < 1:
        return "> 99.9999 %"
    return f"{100 * fraction:.4f}".rstrip("0").rstrip(".") + " %" if fraction >= 1e-4 else f"{digits(100 * fraction)} %"


def _is_number(value) -> bool:
    if isinstance(value, bool):
        return False
    try:
        return isfinite(value)
    except TypeError:
        return False
