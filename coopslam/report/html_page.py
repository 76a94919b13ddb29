"""The parts that all HTML reports are made of: the page, tables, embedded figures, words explained."""

import base64
import mimetypes
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path

from coopslam.report.html_text import STYLE


def write_page(path: Path, title: str, sections: Iterable[str]) -> None:
    """One file that needs nothing else; empty sections are left out."""
    head = (
        '<meta charset="utf-8">\n<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>"
    )
    body = "\n".join(section for section in sections if section)
    page = f"<head>\n{head}\n</head>\n<body>\n<main>\n{body}\n</main>\n</body>"
    text = f'<!DOCTYPE html>\n<html lang="en">\n{page}\n</html>\n'
    path.write_text(text, encoding="utf-8", errors="replace")


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table that scrolls sideways on a narrow screen; the first cell of a row names it."""
    top = "".join(f'<th scope="col">{escape(heading)}</th>' for heading in headings)
    lines = []
    for first, *others in rows:
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in others)
        lines.append(f'<tr><th scope="row">{escape(first)}</th>{cells}</tr>')
    body = "\n".join(lines)
    return f'<div class="wide"><table>\n<thead><tr>{top}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'


def figures(paths: Sequence[Path], captions: Mapping[str, tuple[str, str]]) -> str:
    """Every picture or film on a white card. captions: stem of the file -> title and caption."""
    return "<h2>Figures</h2>\n" + "\n".join(_figure(path, captions) for path in paths) if paths else ""


def explained(words: Iterable[tuple[str, str]]) -> str:
    """A list of words and what they mean."""
    lines = "\n".join(f"<dt>{escape(word)}</dt><dd>{escape(meaning)}</dd>" for word, meaning in words)
    return f'<h2>How to read this</h2>\n<dl class="words">\n{lines}\n</dl>'


def _figure(path: Path, captions: Mapping[str, tuple[str, str]]) -> str:
    title, caption = captions.get(path.stem, (path.stem.replace("_", " "), ""))
    media = mimetypes.guess_type(path.name)[0] or "image/png"
    data = f"data:{media};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
    if media.startswith("video/"):
        picture = f'<video controls loop muted playsinline aria-label="{escape(title)}" src="{data}"></video>'
    else:
        picture = f'<img src="{data}" alt="{escape(title)}">'
    return (
        f'<figure><div class="picture">{picture}</div>\n'
        f"<figcaption><b>{escape(title)}.</b> {escape(caption)}</figcaption></figure>"
    )
