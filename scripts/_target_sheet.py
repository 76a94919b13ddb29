"""The pattern of a target on paper, at true scale: SVG, millimetres."""

from math import pi
from pathlib import Path

import numpy as np

from coopslam.errors import BadInput
from tracker.data_sheet import DataSheet
from tracker.helix import Helix
from tracker.tag_cube import FAMILY, MODULES, TagCube

MARGIN_MM, MARK_MM, OVERLAP_MM = 12.0, 6.0, 10.0
COLUMNS = 720  # steps of the stripe around the cylinder
CUT = 'stroke="#888" stroke-width="0.2"'


def write_target(path: Path, sheet: DataSheet) -> None:
    """Raises BadInput when the file cannot be written or its name does not end in .svg."""
    if path.suffix.lower() != ".svg":
        raise BadInput(f"--print-target {path}: a file that ends in .svg expected")
    text = _helix(sheet.helix) if sheet.helix is not None else _cube(sheet.tag_cube)
    try:
        path.write_text(text, encoding="utf-8")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise BadInput(f"--print-target {str(path)[:200]}: cannot be written: {reason}; expected a file") from error


def _helix(helix: Helix) -> str:
    """Unrolled, as seen from outside: the azimuth grows to the right, from the back over right, front and left.

    The strip beyond the circumference is light, to glue it under the other end.
    """
    around, scale = 2 * pi * helix.radius_m * 1000, 1000.0
    low, high = helix.bottom_m - helix.lower_collar_m, helix.top_m + helix.upper_collar_m
    width, height = around, (high - low) * scale

    def y(z_m) -> float:
        return (high - z_m) * scale

    parts = [_rect(0, y(z + helix.ring_m), width, helix.ring_m * scale) for z in (helix.bottom_m, helix.helix_top_m)]
    azimuth = np.linspace(-pi, pi, COLUMNS + 1)
    period = helix.pitch_m / helix.stripes
    base = helix.helix_bottom_m + helix.pitch_m * (azimuth - helix.start_rad) / (2 * pi)
    turns = int(np.ceil((helix.helix_top_m - helix.helix_bottom_m + 2 * helix.pitch_m) / period)) + 1
    x = (azimuth + pi) / (2 * pi) * width
    for turn in range(-turns, turns + 1):
        lower = np.clip(base + turn * period, helix.helix_bottom_m, helix.helix_top_m)
        upper = np.clip(base + (turn + helix.duty) * period, helix.helix_bottom_m, helix.helix_top_m)
        if (upper > lower).any():
            points = [*zip(x, y(lower), strict=True), *zip(x[::-1], y(upper)[::-1], strict=True)]
            parts.append(f'<polygon points="{" ".join(f"{a:.3f},{b:.3f}" for a, b in points)}"/>')
    front = width / 2  # azimuth zero
    notes = [
        f'<line x1="{front:.3f}" y1="{height:.3f}" x2="{front:.3f}" y2="{height + MARK_MM:.3f}" {CUT}/>',
        _text(front + 1, height + 5, f"front of the robot; lower edge {low * 1000:.1f} mm above the floor"),
        _text(
            1, -3, f"cylinder of {2000 * helix.radius_m:.1f} mm diameter; print at 100 %: {around:.1f} mm between cuts"
        ),
    ]
    notes += _cut_marks((0.0, width, width + OVERLAP_MM), (0.0, height))
    return _svg(width + OVERLAP_MM, height, parts + notes)


def _cube(cube: TagCube) -> str:
    """The four sides beside each other: front, left, back, right; to be cut apart or folded."""
    import cv2

    face, tag = cube.face_m * 1000, cube.tag_m * 1000
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILY)
    parts, notes = [], []
    for k, (number, name) in enumerate(zip(cube.side_ids, ("front", "left", "back", "right"), strict=True)):
        modules = cv2.aruco.generateImageMarker(dictionary, number, MODULES) == 0
        left, up, size = k * face + (face - tag) / 2, (face - tag) / 2, tag / MODULES
        parts += [_rect(left + c * size, up + r * size, size, size) for r, c in np.argwhere(modules)]
        notes.append(_text(k * face + 2, face + 5, f"{name}, tag 36h11 number {number}"))
    notes.append(_text(1, -3, f"cube of {face:.1f} mm; print at 100 %; lower edge {cube.bottom_m * 1000:.1f} mm up"))
    notes += _cut_marks([k * face for k in range(5)], (0.0, face))
    return _svg(4 * face, face, parts + notes)


def _rect(x: float, y: float, width: float, height: float) -> str:
    return f'<rect x="{x:.3f}" y="{y:.3f}" width="{width:.3f}" height="{height:.3f}"/>'


def _text(x: float, y: float, text: str) -> str:
    return f'<text x="{x:.3f}" y="{y:.3f}" font-size="3.5" font-family="sans-serif">{text}</text>'


def _cut_marks(columns, rows) -> list[str]:
    """Short lines outside of the paper that is used, at its corners and folds."""
    marks = []
    for x in columns:
        for y, away in ((rows[0], -MARK_MM), (rows[-1], MARK_MM)):
            marks.append(f'<line x1="{x:.3f}" y1="{y + away / 3:.3f}" x2="{x:.3f}" y2="{y + away:.3f}" {CUT}/>')
    for y in rows:
        for x, away in ((columns[0], -MARK_MM), (columns[-1], MARK_MM)):
            marks.append(f'<line x1="{x + away / 3:.3f}" y1="{y:.3f}" x2="{x + away:.3f}" y2="{y:.3f}" {CUT}/>')
    return marks


def _svg(width: float, height: float, parts: list[str]) -> str:
    w, h = width + 2 * MARGIN_MM, height + 2 * MARGIN_MM
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:.3f}mm" height="{h:.3f}mm" '
    head += f'viewBox="{-MARGIN_MM:.3f} {-MARGIN_MM:.3f} {w:.3f} {h:.3f}">'
    return "\n".join([head, *parts, "</svg>", ""])
