"""Pictures to films, frame by frame: GIF by Pillow, H.264 in MP4 by PyAV."""

from collections.abc import Sequence
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image

FRAMES_PER_S = 12.5  # a GIF counts in hundredths of a second: 8 of them
FRAME_MS = round(1000 / FRAMES_PER_S)
BLENDS = (1 / 3, 2 / 3)  # shades of a line on a ground, for smooth edges
QUALITY = "20"  # constant rate factor of x264; lower is better


def palette_of(grounds: Sequence[str], lines: Sequence[str]) -> Image.Image:
    """An image whose palette holds all colours (#rrggbb), and each line's blends with each ground."""
    ground, line = (np.array([_bytes(colour) for colour in colours], float) for colours in (grounds, lines))
    blends = [share * a + (1 - share) * b for a in line for b in ground for share in BLENDS]
    between = [(a + b) / 2 for k, a in enumerate(ground) for b in ground[:k]]
    colours = np.rint(np.vstack([ground, line, *blends, *between])).astype(int)
    colours = np.unique(colours, axis=0)[:255]  # one is left for "as before"
    image = Image.new("P", (1, 1))
    image.putpalette(colours.ravel().tolist())
    return image


def _bytes(colour: str) -> list[int]:
    return [int(colour[k : k + 2], 16) for k in (1, 3, 5)]


class GifWriter:
    """Frames of one palette without dithering, so that little changes from one to the next."""

    def __init__(self, path: Path, palette: Image.Image, hold: int = 0):
        """hold: for how many frames more the last picture is shown."""
        self._path, self._palette, self._hold = path, palette, hold
        self._frames: list[Image.Image] = []

    def add(self, picture: np.ndarray) -> None:
        """One more frame, (height, width, 3) bytes."""
        self._frames.append(Image.fromarray(picture).quantize(palette=self._palette, dither=Image.Dither.NONE))

    def close(self) -> None:
        """Write the file."""
        first, *others = self._frames
        durations_ms = [FRAME_MS] * len(others) + [(self._hold + 1) * FRAME_MS]
        # optimize: what is as in the frame before becomes transparent, and costs next to nothing
        options = {"save_all": True, "append_images": others, "loop": 0, "optimize": True, "disposal": 1}
        first.save(self._path, format="GIF", duration=durations_ms, **options)


def mp4_is_possible() -> bool:
    """Whether the package that encodes H.264 is installed."""
    return find_spec("av") is not None


class Mp4Writer:
    """H.264 with 4:2:0 colours and its index in front: what browsers play."""

    def __init__(self, path: Path, hold: int = 0):
        """hold: how many more frames show the last picture."""
        import av  # not at the top: all but this file works without it

        self._frame_of = av.VideoFrame.from_ndarray
        self._file = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        self._stream, self._hold, self._last = None, hold, None

    def add(self, picture: np.ndarray) -> None:
        """One more frame, (height, width, 3) bytes; height and width are even."""
        if self._stream is None:
            self._stream = self._file.add_stream("libx264", rate=Fraction(FRAMES_PER_S))
            self._stream.height, self._stream.width = picture.shape[:2]
            self._stream.pix_fmt = "yuv420p"
            self._stream.options = {"crf": QUALITY, "preset": "medium", "tune": "animation"}
        self._last = picture
        self._file.mux(self._stream.encode(self._frame_of(np.ascontiguousarray(picture), format="rgb24")))

    def close(self) -> None:
        """Hold the last picture, and finish the file."""
        for _ in range(self._hold):
            self.add(self._last)
        self._file.mux(self._stream.encode())
        self._file.close()
