"""The UTIAS multi-robot cooperative localization and mapping data set (MR.CLAM): a directory of text files.

    RobotN_Odometry.dat       time, forward velocity, angular velocity: commands, each holds until the next
    RobotN_Measurement.dat    time, barcode, range, bearing
    RobotN_Groundtruth.dat    time, x, y, orientation                            (motion capture)
    Barcodes.dat              subject, barcode                                   (subjects 1 to 5 are the robots)
    Landmark_Groundtruth.dat  subject, x, y, standard deviation of x, of y       (motion capture)

Times are Unix time; m and rad. Leung, Halpern, Barfoot, Liu: The UTIAS multi-robot cooperative localization and
mapping dataset (IJRR 2011).
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from coopslam.errors import BadInput, require_between, require_positive
from coopslam.io.log import Log, TrueTrack, Truth, true_track
from coopslam.io.number_table import in_time_order, is_there, read_table
from coopslam.io.velocity_commands import CommandNoise, odometry_of_commands
from coopslam.records import BearingRangeFix, LogHeader, Odometry
from coopslam.se2 import Pose2

ROBOTS = range(1, 6)  # the subjects that drive; those after them are landmarks
FASTEST = 100.0  # m/s and rad/s; a command beyond is none
FARTHEST_M = 1e4  # a range beyond is none


@dataclass(frozen=True, slots=True)
class MrclamSettings:
    """How the numbers in the files are understood.

    The "range" is in fact the depth along the camera's optical axis, z, and the range is z / cos(bearing). But the
    cameras also measure 0.1 to 0.2 m too far. In data set 6 the two errors cancel in the median (to 5 cm), so without
    a calibration the numbers serve better as they are; with one, set `range_is_depth`.
    """

    odometry_period_s: float = 0.1  # longest step of odometry in motion
    longest_gap_s: float = 2.0  # a command does not hold longer: what the robot did then is unknown
    odometry: CommandNoise = field(default_factory=CommandNoise)
    range_is_depth: bool = False  # take the "range" for a depth
    range_sigma_m: float = 0.06  # at range zero; what follows adds to it, since a camera sees the far badly
    range_sigma_per_m: float = 0.0
    range_sigma_per_m2: float = 0.009
    bearing_sigma_rad: float = 0.01

    def __post_init__(self):
        require_between(1e-3, 1e3, odometry_period_s=self.odometry_period_s)
        require_between(1e-3, 1e4, longest_gap_s=self.longest_gap_s)
        require_positive(1e3, range_sigma_m=self.range_sigma_m, bearing_sigma_rad=self.bearing_sigma_rad)
        require_between(0.0, 1e3, range_sigma_per_m=self.range_sigma_per_m)
        require_between(0.0, 1e3, range_sigma_per_m2=self.range_sigma_per_m2)

    def range_sigma(self, range_m):
        """Standard deviation of a measured range, m; scalars and arrays."""
        return self.range_sigma_m + (self.range_sigma_per_m + self.range_sigma_per_m2 * range_m) * range_m


def is_mrclam(path: Path) -> bool:
    """Whether a directory holds a file that only MR.CLAM has."""
    return is_there(path / "Barcodes.dat") or bool(_robots(path))


class MrclamSource:
    """A directory in the format of MR.CLAM. The robots are robot1 to robot5, the landmarks landmark6 and up."""

    def __init__(self, path: str | Path, settings: MrclamSettings | None = None):
        self.path = Path(path)
        self.settings = settings or MrclamSettings()

    def read(self) -> Log:
        """Records by their stamps. Files that are missing are counted; at least one robot must have one.

        Raises BadInput, with file and line, for what is not in the format, and when there is nothing in it.
        """
        dropped: Counter[str] = Counter()
        robots = _robots(self.path)
        if not robots:
            raise BadInput(f"{self.path}: no Robot1_Odometry.dat or the like; expected a directory of MR.CLAM")
        fixes = self._sightings(robots, dropped)
        records = [(fix.stamp_s, 1, fix) for fix in fixes]
        for robot, number in robots.items():
            needed = [fix.stamp_s for fix in fixes if robot in (fix.observer, fix.target)]
            records += [(step.stamp_s, 0, step) for step in self._odometry(robot, number, needed, dropped)]
        if not records:
            raise BadInput(f"{self.path}: neither motion nor a sighting in it; expected a recording of MR.CLAM")
        records.sort(key=lambda entry: entry[:2])  # odometry that ends when a sighting is made comes before it
        landmarks = sorted({fix.target for fix in fixes} - robots.keys(), key=lambda name: (len(name), name))
        header = LogHeader(
            tuple(robots),
            tuple(landmarks),
            sensor_models={"mrclam": asdict(self.settings)},
            provenance=f"MR.CLAM {self.path.name}",
        )
        return Log(self.path.name, header, [record for _, _, record in records], dropped)

    def truth(self) -> Truth | None:
        """Motion capture of the robots and landmarks that have some, in its own frame; stamps ascend."""
        tracks = {}
        for number in ROBOTS:
            path = self.path / f"Robot{number}_Groundtruth.dat"
            if is_there(path):
                tracks[f"robot{number}"] = _true_track(path)
        path = self.path / "Landmark_Groundtruth.dat"
        landmarks = {}
        if is_there(path):
            rows = read_table(path, ("subject", "x", "y", "sigma of x", "sigma of y"), Counter())
            landmarks = {_name(subject, path): np.array([x, y]) for subject, x, y, _, _ in rows.tolist()}
            if not np.isfinite(rows).all():
                raise BadInput(f"{path}: NaN or infinity in it; expected positions in m")
        return Truth(tracks, landmarks) if tracks or landmarks else None

    def _odometry(self, robot: str, number: int, needed_s: list[float], dropped: Counter[str]) -> list[Odometry]:
        path = self.path / f"Robot{number}_Odometry.dat"
        rows = np.zeros((0, 3))
        if is_there(path):
            rows = read_table(path, ("time", "forward velocity", "angular velocity"), dropped)
            rows = in_time_order(path, rows, dropped)
        if not len(rows):
            dropped[f"{robot}: no odometry, its motion is unknown"] += 1
        driven = (np.abs(rows[:, 1:]) <= FASTEST).all(axis=1)
        _count(dropped, f"odometry: command of {robot} beyond {FASTEST:g} m/s or rad/s", int((~driven).sum()))
        settings = self.settings
        steps, unknown = odometry_of_commands(
            robot,
            rows[driven],
            settings.odometry,
            settings.odometry_period_s,
            settings.longest_gap_s,
            np.array(needed_s, dtype=float),
        )
        gap = f"odometry: nothing of {robot} for more than {settings.longest_gap_s:g} s; taken as unknown motion"
        _count(dropped, gap, unknown)
        return steps

    def _sightings(self, robots: dict[str, int], dropped: Counter[str]) -> list[BearingRangeFix]:
        tables = {}
        for robot, number in robots.items():
            path = self.path / f"Robot{number}_Measurement.dat"
            if is_there(path):
                rows = read_table(path, ("time", "barcode", "range", "bearing"), dropped)
                tables[robot] = in_time_order(path, rows, dropped)
            else:
                dropped[f"{robot}: no measurement file"] += 1
        if not any(map(len, tables.values())):
            return []
        owners = _owners(self.path / "Barcodes.dat", dropped)
        fixes = []
        for robot, rows in tables.items():
            fixes += self._fixes(robot, rows, owners, robots, dropped)
        return fixes

    def _fixes(self, robot: str, rows: np.ndarray, owners: dict, robots: dict, dropped: Counter[str]) -> Iterator:
        """Sightings by one robot that name somebody and can be. Depth z at bearing b is the range z / cos b."""
        settings = self.settings
        raw, bearings = rows[:, 2], rows[:, 3]
        possible = (raw > 0) & (raw <= FARTHEST_M) & (np.abs(bearings) <= 2 * np.pi)
        if settings.range_is_depth:
            possible &= raw <= FARTHEST_M * np.cos(bearings)
        _count(dropped, "bearing_range: range or bearing that cannot be", int((~possible).sum()))
        rows = rows[possible]
        ranges = rows[:, 2] / np.cos(rows[:, 3]) if settings.range_is_depth else rows[:, 2]
        cov = np.zeros((len(rows), 2, 2))
        cov[:, 0, 0] = settings.bearing_sigma_rad**2
        cov[:, 1, 1] = settings.range_sigma(ranges) ** 2
        for (stamp, barcode, _, bearing), range_m, cov_fix in zip(rows.tolist(), ranges.tolist(), cov, strict=True):
            target = owners.get(barcode)
            if target is None:
                dropped[f"bearing_range: barcode {barcode:g} belongs to nobody"] += 1
            elif target == robot:
                dropped[f"bearing_range: {robot} sees its own barcode"] += 1
            elif target.startswith("robot") and target not in robots:
                dropped[f"bearing_range: {target} has no files"] += 1
            else:
                yield BearingRangeFix(stamp, robot, target, bearing, range_m, cov_fix)


def _robots(path: Path) -> dict[str, int]:
    """Name -> number of the robots that left a file."""
    kinds = ("Odometry", "Measurement")
    present = [n for n in ROBOTS if any(is_there(path / f"Robot{n}_{kind}.dat") for kind in kinds)]
    return {f"robot{number}": number for number in present}


def _owners(path: Path, dropped: Counter[str]) -> dict[float, str]:
    """Barcode -> name of the robot or landmark that carries it."""
    owners: dict[float, str] = {}
    for subject, barcode in read_table(path, ("subject", "barcode"), dropped).tolist():
        name = _name(subject, path)
        if owners.setdefault(barcode, name) != name:
            raise BadInput(f"{path}: barcode {barcode:g} belongs to {owners[barcode]} and {name}; expected one owner")
    return owners


def _name(subject: float, path: Path) -> str:
    if not (1 <= subject < 1e6 and subject == int(subject)):
        raise BadInput(f"{path}: subject {subject:g}; expected a whole number, one or more")
    return f"robot{subject:.0f}" if subject in ROBOTS else f"landmark{subject:.0f}"


def _true_track(path: Path) -> TrueTrack:
    rows = in_time_order(path, read_table(path, ("time", "x", "y", "orientation"), Counter()), Counter())
    return true_track(rows[:, 0], [Pose2(x, y, heading) for x, y, heading in rows[:, 1:].tolist()])


def _count(dropped: Counter[str], what: str, number: int) -> None:
    if number:
        dropped[what] += number
