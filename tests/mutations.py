"""Damage that happens to files: for tests that readers either read a damaged file or say in one line what is wrong."""

from hypothesis import strategies as st

_NASTY = [b"nan", b"inf", b"-1", b"1e300", b"-1e300", b"1e-320", b"99999999999999999999", b"x", b"\x00", b"\xff", b"0"]
_NUMBERS = [b"0", b"-1", b"3", b"1e-5", b"1e-12", b"1e-300", b"1e6", b"1e12", b"1e20", b"1e300", b"1000.5", b"1e11"]


@st.composite
def damaged(draw, content: bytes) -> bytes:
    """The content after one to four accidents: bytes flipped, words replaced, lines lost, doubled, shuffled, cut."""
    for _ in range(draw(st.integers(1, 4))):
        lines = content.split(b"\n")
        at = draw(st.integers(0, len(lines) - 1))
        match draw(st.sampled_from(["flip", "word", "lose", "double", "move", "cut", "crlf"])):
            case "flip" if content:
                place = draw(st.integers(0, len(content) - 1))
                content = content[:place] + bytes([draw(st.integers(0, 255))]) + content[place + 1 :]
            case "word":
                words = lines[at].split() or [b""]
                words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(_NASTY))
                content = b"\n".join([*lines[:at], b" ".join(words), *lines[at + 1 :]])
            case "lose":
                content = b"\n".join(lines[:at] + lines[at + draw(st.integers(1, 5)) :])
            case "double":
                content = b"\n".join(lines[: at + 1] + lines[at:])
            case "move":
                line = lines.pop(at)
                lines.insert(draw(st.integers(0, len(lines))), line)
                content = b"\n".join(lines)
            case "cut":
                content = content[: draw(st.integers(0, len(content)))]
            case "crlf":
                content = content.replace(b"\n", b"\r\n")
    return content


@st.composite
def mistaken(draw, content: bytes) -> bytes:
    """The content with one to three mistakes that leave its form: other numbers, lines lost or doubled."""
    lines = [line.split() for line in content.split(b"\n")]
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(lines) - 1))
        match draw(st.sampled_from(["number", "number", "number", "lose", "double"])):
            case "number" if lines[at]:
                place = draw(st.integers(0, len(lines[at]) - 1))
                if lines[at][place][:1].isdigit() or lines[at][place][:1] == b"-":
                    lines[at] = [*lines[at][:place], draw(st.sampled_from(_NUMBERS)), *lines[at][place + 1 :]]
            case "lose" if len(lines) > 6:
                del lines[at : at + draw(st.integers(1, 5))]
                lines = lines or [[]]
            case "double":
                lines.insert(draw(st.integers(0, len(lines))), lines[at])
    return b"\n".join(b" ".join(words) for words in lines)
