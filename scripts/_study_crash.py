"""The row of a run that has no results."""

CRASH = "crash"  # the outcome of a run that ended in an exception, or with its process


def crashed(error: str) -> dict:
    """What the table says of such a run."""
    return {"outcome": CRASH, "outcome_reason": "", "success": False, "error": " ".join(error.split())[:500]}
