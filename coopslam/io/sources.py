"""Any recording that coopslam understands, by its path."""

from collections import Counter
from pathlib import Path

from coopslam.errors import BadInput, shown
from coopslam.io.g2o_log import G2oSource
from coopslam.io.log import Log, LogSource, Truth, true_track
from coopslam.io.mrclam import MrclamSource, is_mrclam
from coopslam.io.pyfg import PyfgSource
from coopslam.io.run_log import read_run_log
from coopslam.io.tum import read_tum

UNDERSTOOD = "a run directory (with log.mcap), a .mcap run log, a directory of MR.CLAM, a .pyfg or a .g2o file"
TRUNCATED = "truncated: what precedes the break was read"


class RunLogSource:
    """A run of our own: a run directory or its log.mcap. The truth of a simulation lies in truth/ beside the log."""

    def __init__(self, path: str | Path):
        path = Path(path)
        self.path = path / "log.mcap" if path.is_dir() else path

    def read(self) -> Log:
        """All records; of a log that breaks off, those before the break, which `dropped` then says.

        Raises BadInput for what is not a run log.
        """
        dropped: Counter[str] = Counter()
        try:
            header, records = read_run_log(self.path)
        except BadInput:
            header, records = read_run_log(self.path, allow_truncated=True)  # raises again when this is no help
            dropped[TRUNCATED] += 1
        name = self.path.absolute().parent.name if self.path.name == "log.mcap" else self.path.name
        return Log(name, header, records, dropped)

    def truth(self) -> Truth | None:
        """truth/ROBOT.tum of each robot that has one."""
        if self.path.name != "log.mcap":
            return None
        tracks = {}
        for path in sorted((self.path.parent / "truth").glob("*.tum")):
            tracks[path.name.removesuffix(".tum")] = true_track(*read_tum(path))
        return Truth(tracks) if tracks else None


def open_log(path: str | Path) -> LogSource:
    """The reader for a recording. Raises BadInput when nothing is there, or nothing that is understood."""
    path = Path(path)
    try:
        is_directory = path.is_dir()
        if not path.exists():
            raise BadInput(f"{_short(path)}: does not exist; expected {UNDERSTOOD}")
        if not is_directory and not path.is_file():  # a pipe that nobody may ever write to
            raise BadInput(f"{_short(path)}: neither a file nor a directory; expected {UNDERSTOOD}")
        if is_directory and (path / "log.mcap").exists():
            return RunLogSource(path)
        if is_directory and is_mrclam(path):
            return MrclamSource(path)
    except (OSError, ValueError) as error:  # ValueError: a path that no system can have
        reason = getattr(error, "strerror", None) or error
        raise BadInput(f"{_short(path)}: cannot be read: {reason}; expected {UNDERSTOOD}") from error
    readers = {".mcap": RunLogSource, ".pyfg": PyfgSource, ".g2o": G2oSource}
    if not is_directory and path.suffix.lower() in readers:
        return readers[path.suffix.lower()](path)
    raise BadInput(f"{_short(path)}: not a recording; expected {UNDERSTOOD}")


def _short(path: Path) -> str:
    """A path that fits on a line."""
    return str(path) if len(str(path)) <= 200 and str(path).isprintable() else shown(str(path))
