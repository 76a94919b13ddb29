"""The data sheets of the repository, by name, beside those of users, by path."""

from pathlib import Path

from coopslam.errors import BadInput, shown
from tracker.data_sheet import DataSheet, load_data_sheet

SHEETS_DIR = Path(__file__).parents[1] / "datasets" / "calibrations"


def sheet_names() -> list[str]:
    """Names of the data sheets in the repository."""
    return sorted(path.stem for path in SHEETS_DIR.glob("*.toml"))


def sheet_path(path_or_name: str | Path) -> Path:
    """Where a data sheet is. Raises BadInput for what is neither a known name nor a path."""
    text = str(path_or_name)
    if text in sheet_names():
        return SHEETS_DIR / f"{text}.toml"
    if Path(text).suffix or Path(text).name != text:
        return Path(text)
    raise BadInput(f"no data sheet {shown(text)}; expected a path to a TOML file or one of: {', '.join(sheet_names())}")


def load_sheet(path_or_name: str | Path) -> DataSheet:
    """A data sheet by its name in the repository, or by its path. Raises BadInput."""
    return load_data_sheet(sheet_path(path_or_name))
