"""The small MR.CLAM log, what records it becomes, and rows added to its files."""

from collections import Counter
from pathlib import Path

from coopslam.io.log import Log
from coopslam.records import BearingRangeFix, Odometry

SMALL = Path(__file__).parents[1] / "datasets" / "logs" / "two_robots_mrclam"


def steps_of(log: Log, robot: str) -> list[Odometry]:
    return [record for record in log.records if isinstance(record, Odometry) and record.robot == robot]


def fixes_of(log: Log, robot: str | None = None) -> list[BearingRangeFix]:
    """Of one observer, or of all."""
    fixes = [record for record in log.records if isinstance(record, BearingRangeFix)]
    return [fix for fix in fixes if robot in (None, fix.observer)]


def count(log: Log) -> Counter:
    """Records by their type's name."""
    return Counter(type(record).__name__ for record in log.records)


def append(path: Path, text: str) -> None:
    with path.open("a", encoding="utf-8", newline="") as stream:
        stream.write(text)
