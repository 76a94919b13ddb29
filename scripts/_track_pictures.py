"""What track.py draws: pictures with what was detected in them, a film of all and a sheet of some."""

from pathlib import Path

import cv2
import numpy as np

from coopslam.errors import NotWritten
from coopslam.report.video import Mp4Writer, mp4_is_possible
from tracker.detector import Detection

GREEN, ORANGE, RED, WHITE, BLACK = (90, 220, 60), (240, 160, 0), (240, 70, 60), (255, 255, 255), (0, 0, 0)  # RGB
FONT = cv2.FONT_HERSHEY_SIMPLEX
FIXED_POINT_BITS = 4  # of cv2's subpixel coordinates
TILES, COLUMNS, TILE_WIDTH_PX = 24, 4, 400


def annotated(image: np.ndarray, found: Detection | None, lines: list[str]) -> np.ndarray:
    """(H, W, 3) RGB of a (H, W) grey picture: features green (orange where the heading is withheld), and text."""
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    scale = image.shape[1] / 640
    if found is not None:
        colour = GREEN if found.heading_known else ORANGE
        for line in found.features_px:
            _draw_feature(picture, np.asarray(line, dtype=float), colour, scale)
    for k, text in enumerate(lines):
        x, y = round(8 * scale), image.shape[0] - round((10 + 20 * (len(lines) - 1 - k)) * scale)
        for ink, off in ((BLACK, 1), (RED if found is None else WHITE, 0)):  # with a shadow
            cv2.putText(picture, text, (x + off, y + off), FONT, 0.5 * scale, ink, max(1, round(scale)), cv2.LINE_AA)
    return picture


def _draw_feature(picture: np.ndarray, line: np.ndarray, colour, scale: float) -> None:
    """A polyline, or a dot."""
    points = np.rint(line[np.isfinite(line).all(axis=1)] * 2**FIXED_POINT_BITS).astype(np.int32)
    if len(points) == 1:
        cv2.circle(picture, points[0].tolist(), round(2 * scale * 2**FIXED_POINT_BITS), colour, -1, cv2.LINE_AA, 4)
    elif len(points):
        cv2.polylines(picture, [points], False, colour, max(1, round(scale)), cv2.LINE_AA, FIXED_POINT_BITS)


class ContactSheet:
    """Up to 24 pictures, evenly spread over all that were added."""

    def __init__(self):
        self._kept, self._every, self._count = [], 1, 0

    def add(self, picture: np.ndarray) -> None:
        """One more picture, (H, W, 3) RGB."""
        if self._count % self._every == 0:
            height = round(picture.shape[0] * TILE_WIDTH_PX / picture.shape[1])
            self._kept.append(cv2.resize(picture, (TILE_WIDTH_PX, height), interpolation=cv2.INTER_AREA))
            if len(self._kept) > TILES:
                self._kept, self._every = self._kept[::2], 2 * self._every
        self._count += 1

    def write(self, path: Path) -> None:
        """As PNG; nothing without pictures."""
        if not self._kept:
            return
        spare = -len(self._kept) % COLUMNS if len(self._kept) > COLUMNS else 0
        tiles = [*self._kept, *[np.full_like(self._kept[0], 255)] * spare]
        columns = min(COLUMNS, len(tiles))
        rows = [np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)]
        done, data = cv2.imencode(".png", cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))
        if not done:
            raise NotWritten(f"{path}: cannot be written as PNG", done=True)
        path.write_bytes(data.tobytes())


class Film:
    """All pictures as MP4, where the package that encodes it is installed."""

    def __init__(self, path: Path):
        self._path, self._writer = path, None

    def add(self, picture: np.ndarray) -> None:
        """One more picture, (H, W, 3) RGB; a last odd row or column is left out."""
        if not mp4_is_possible():
            return
        self._writer = self._writer or Mp4Writer(self._path)
        height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
        self._writer.add(picture[:height, :width])

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()
