"""Pictures for track.py: a folder of images, in natural order, or a video; each with its stamp."""

import csv
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from coopslam.errors import BadInput, shown

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp")
LARGEST_STAMP_S = 1e11
DEFAULT_FPS = 10.0  # of folders
MISCOUNTED = 0.02  # by such a share the head of a video may be wrong about the number of its frames


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One picture; None when it cannot be read."""

    name: str
    stamp_s: float
    image: np.ndarray | None  # (H, W) uint8


class ShotSource(Protocol):
    """Where pictures come from."""

    count: int | None  # None: only its end tells

    def __iter__(self) -> Iterator[Shot]:
        """The pictures in order."""


class Folder:
    """The images of a folder; a number in a name counts as a number."""

    def __init__(self, folder: Path, fps: float, stamps: Path | None):
        try:
            paths = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES]
        except OSError as error:
            raise BadInput(f"{folder}: cannot be read: {error.strerror}") from error
        if not paths:
            raise BadInput(f"{folder}: no images in it; expected files with one of the endings {', '.join(IMAGES)}")
        self._paths = sorted(paths, key=_natural)
        self.count = len(paths)
        self._stamps_s = [k / fps for k in range(self.count)]
        if stamps is not None:
            self._stamps_s = read_stamps(stamps, [path.name for path in self._paths])

    def __iter__(self) -> Iterator[Shot]:
        """See ShotSource."""
        for path, stamp_s in zip(self._paths, self._stamps_s, strict=True):
            yield Shot(path.name, stamp_s, read_image(path))


class Video:
    """The frames of a video file."""

    def __init__(self, path: Path, fps: float | None, stamps: Path | None):
        self._path, self._capture = path, _opened(path)
        own_fps = self._capture.get(cv2.CAP_PROP_FPS)
        if fps is None and not (isfinite(own_fps) and own_fps > 0):
            raise BadInput(f"{path}: the video does not say how many pictures a second it has; --fps expected")
        self._fps = fps or own_fps
        frames = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.count = frames if frames > 0 else None
        self._stamps_s = None if stamps is None else read_stamps(stamps, None)

    def __iter__(self) -> Iterator[Shot]:
        """See ShotSource.  A frame that cannot be decoded is the last one."""
        number = 0
        while True:
            read, frame = self._capture.read()
            if not read:
                break
            yield Shot(f"{self._path.name} frame {number}", self._stamp_s(number), _grey(frame))
            number += 1
        if number == 0:
            raise BadInput(f"{self._path}: no picture in it can be decoded; expected a video")
        if self.count is not None and number < self.count - max(2, MISCOUNTED * self.count):
            yield Shot(f"{self._path.name} frame {number} of {self.count}", self._stamp_s(number), None)

    def _stamp_s(self, number: int) -> float:
        if self._stamps_s is None:
            return number / self._fps
        if number >= len(self._stamps_s):
            raise BadInput(f"--stamps: {len(self._stamps_s)} stamps for a video with more frames; one each expected")
        return self._stamps_s[number]


def shots_of(path: Path, fps: float | None, stamps: Path | None) -> ShotSource:
    """Raises BadInput for what is neither a folder with images nor a video."""
    if path.is_dir():
        return Folder(path, fps or DEFAULT_FPS, stamps)
    if not path.is_file():
        raise BadInput(f"{str(path)[:200]}: not there; expected a folder of images or a video file")
    return Video(path, fps, stamps)


def read_image(path: Path) -> np.ndarray | None:
    """(H, W) uint8 grey picture; None for what is none."""
    try:
        data = np.fromfile(path, dtype=np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    except (OSError, cv2.error):
        return None


def read_stamps(path: Path, names: list[str] | None) -> list[float]:
    """Seconds, in the order of the pictures, from a CSV with a column stamp_s, and one `file` where there are names.

    Raises BadInput, with the line, unless each picture has one stamp and they ascend.
    """
    rows = read_table(path, ("stamp_s",) if names is None else ("file", "stamp_s"))
    stamps = {}
    for line, row in rows:
        try:
            stamp_s = float(row["stamp_s"])
        except (TypeError, ValueError):
            stamp_s = float("nan")
        if not abs(stamp_s) <= LARGEST_STAMP_S:
            raise BadInput(f"{path}:{line}: stamp_s: seconds expected, got {shown(row['stamp_s'])}")
        stamps[row["file"] if names is not None else line] = (stamp_s, line)
    if names is not None:
        missing = [name for name in names if name not in stamps]
        if missing:
            raise BadInput(f"{path}: no stamp for {missing[0]}; one for each of {len(names)} images expected")
    ordered = list(stamps.values()) if names is None else [stamps[name] for name in names]
    for (before_s, _), (stamp_s, line) in zip(ordered, ordered[1:], strict=False):
        if not stamp_s > before_s:
            raise BadInput(f"{path}:{line}: stamp_s: more than {before_s:g} s of the picture before it expected")
    return [stamp_s for stamp_s, _ in ordered]


def read_table(path: Path, columns: tuple[str, ...]) -> list[tuple[int, dict[str, str | None]]]:
    """Rows of a CSV file that must have these columns and may have others, each with the number of its last line.

    Raises BadInput for a file that cannot be read or lacks a column.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream)
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or "not a CSV file"
        raise BadInput(f"{path}: cannot be read: {reason}; expected columns {', '.join(columns)}") from error
    missing = [name for name in columns if name not in (reader.fieldnames or ())]
    if missing:
        raise BadInput(f"{path}:1: no column {missing[0]}; expected {', '.join(columns)}")
    return rows


def _opened(path: Path) -> cv2.VideoCapture:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # what is wrong is said in one line, by us
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(str(path))
    except cv2.error as error:
        raise BadInput(f"{path}: cannot be read as a video") from error
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        raise BadInput(f"{path}: cannot be read as a video; expected one, or a folder of images")
    return capture


def _grey(frame: np.ndarray) -> np.ndarray:
    return frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)


def _natural(path: Path) -> list:
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", path.name.lower())]
