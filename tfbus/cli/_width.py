"""Text that fits the width of the terminal."""

import os
import shutil
import sys
import textwrap
import unicodedata
from collections.abc import Sequence

from tfbus.plain import printable

_ELLIPSIS = "…"
_STEP = 4
"""The width of the guides of one level of a tree."""


def terminal_width() -> int | None:
    """The greatest length of a line on standard output; None where it is no terminal, which has room for any line.

    The variable ``COLUMNS`` of the environment decides, if it is set.
    """
    if not sys.stdout.isatty() and not os.environ.get("COLUMNS", "").isdecimal():
        return None
    return shutil.get_terminal_size((80, 24)).columns


def cells(text: str) -> int:
    """The number of columns that a text takes on a terminal: two for a wide letter, none for a combining mark."""
    if text.isascii():
        return len(text)
    return sum(
        2 if unicodedata.east_asian_width(letter) in "WF" else int(not unicodedata.combining(letter)) for letter in text
    )


def shorten(text: str, width: int) -> str:
    """Cut the middle of a text out, where it is longer than `width`: both ends of a name tell it from others."""
    if cells(text) <= width:
        return text
    if width <= 1:
        return _ELLIPSIS[:width]
    head, tail = "", ""
    room = width - 1
    start, end = 0, len(text)
    while start < end:
        from_tail = cells(tail) <= cells(head)
        letter = text[end - 1] if from_tail else text[start]
        if cells(head) + cells(tail) + cells(letter) > room:
            break
        if from_tail:
            tail, end = letter + tail, end - 1
        else:
            head, start = head + letter, start + 1
    return f"{head}{_ELLIPSIS}{tail}"


def wrapped(text: str, width: int | None, indent: int) -> list[str]:
    """The lines of a text that is broken between words, all but the first indented; a longer word is shortened.

    Control characters in names are escaped first: no name begins a line.
    """
    text = printable(text)
    if width is None or cells(text) <= width:
        return [text]
    room = max(1, width - indent)
    words = [shorten(word, room) if word else word for word in text.split(" ")]
    return textwrap.wrap(
        " ".join(words), width, subsequent_indent=" " * indent, break_long_words=True, break_on_hyphens=False
    )


def align(text: str, width: int, right: bool = False) -> str:
    """Fill a text with blanks up to a width."""
    blanks = " " * (width - cells(text))
    return blanks + text if right else text + blanks


def shorten_widest(widths: Sequence[int], room: int, least: int = 8) -> list[int]:
    """The widths of columns, the widest made narrower until all fit `room`, none below `least` unless it is already."""
    fitted = list(widths)
    while sum(fitted) > room and max(fitted, default=0) > least:
        fitted[fitted.index(max(fitted))] -= 1
    return fitted


def narrow_guides(guides: str, step: int) -> str:
    """The lines before a frame in a drawn tree with 1, 2 or all 4 columns a level."""
    if step == _STEP:
        return guides
    return "".join(guides[at : at + step].replace("─", " ") for at in range(0, len(guides), _STEP))
