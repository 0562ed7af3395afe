"""The output of the subcommands: lines, tables, progress, values as text for people, files and log lines.

Results go to standard output, all else to standard error. On a terminal a line of the result is at most as wide as it:
`fitted` and `wrapped` break texts between words, `table_lines` leaves out columns, `shorten` cuts the middle of a name
out. A pipe has room for any line. Names are escaped by `tfbus.plain.printable` before they are measured.
"""

import csv
import logging
import os
import shutil
import sys
import textwrap
import threading
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from tfbus.cli.arguments import UsageError
from tfbus.cli.lazy_imports import lazy_imports

with lazy_imports():
    from tfbus.geometry.transform import Transform
    from tfbus.plain import printable
    from tfbus.stamps import format_duration, from_seconds

ItemT = TypeVar("ItemT")

_ELLIPSIS = "…"
_STEP = 4
"""The width of the guides of one level of a tree."""
_GAP = "  "
"""The blanks between two columns of a table."""
_FIRST_WINDOW = 0.3
"""The time in s for which the first log line of a kind is held back, to count the lines that follow."""
_LONGEST_WINDOW = 10.0


def print_now(line: str) -> None:
    """Print a line of the result at once; through a pipe it would otherwise wait for a block of many lines."""
    print(line, flush=True)


def fitted(line: str, indent: int = 2) -> str:
    """A line of the result, broken between words where it is longer than the terminal is wide."""
    return "\n".join(wrapped(line, terminal_width(), indent))


def say(line: str) -> None:
    """Print a notice to standard error, in one line, even if a name in it has line breaks."""
    print(printable(line), file=sys.stderr, flush=True)


def warn(message: str) -> None:
    """Print a warning or an error to standard error, with the name of the command before it."""
    say(f"tfbus: {message}")


def terminal_width() -> int | None:
    """The greatest length of a line on standard output; None if it is not a terminal: then any line fits.

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
    """Cut out the middle of a text that is longer than `width`: the ends of a name distinguish it from others."""
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


class Column(NamedTuple):
    """A column of a table.

    Parameters
    ----------
    title : str
    right : bool
        Whether its cells stand at the right.
    importance : int or None
        If the table is too wide, the column with the lowest number is dropped first; a column with None never is.
    """

    title: str
    right: bool = False
    importance: int | None = None


def table_lines(
    columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int | None, titles: bool = True
) -> Iterator[str]:
    """The lines of a table, its titles first; empty columns are left out.

    Parameters
    ----------
    columns : sequence of Column
    rows : sequence of sequence of str
        The cells of each row; names need not be printable.
    width : int, optional
        The greatest length of a line; if columns that are never dropped do not fit, their longest cells are shortened.
    titles : bool
        Whether the first line has the titles.
    """
    rows = [list(map(printable, row)) for row in rows]
    shown = [at for at in range(len(columns)) if any(row[at] for row in rows)]
    lines = [[column.title for column in columns], *rows] if titles else list(rows)
    widths = [max(cells(line[at]) for line in lines) for at in range(len(columns))] if rows else []

    def room() -> int:
        return sum(widths) if width is None else width - len(_GAP) * (len(shown) - 1)

    while sum(widths[at] for at in shown) > room():
        optional = {at: importance for at in shown if (importance := columns[at].importance) is not None}
        if not optional:
            break
        shown.remove(min(optional, key=optional.__getitem__))
    fitted = dict(zip(shown, shorten_widest([widths[at] for at in shown], room()), strict=True))
    for line in lines:
        yield _GAP.join(align(shorten(line[at], fitted[at]), fitted[at], columns[at].right) for at in shown).rstrip()


@contextmanager
def progress_bar() -> Iterator[Any]:
    """A `rich.progress.Progress` on standard error for the body of a ``with``; it disappears and moves no other output.

    Use it only if standard error is a terminal.
    """
    # Loaded for a terminal only.
    from rich.console import Console
    from rich.progress import Progress

    # With its redirection, rich would print results that go to standard output on standard error.
    with Progress(console=Console(stderr=True), transient=True, redirect_stdout=False, redirect_stderr=False) as bar:
        yield bar


@contextmanager
def progress(total: int | None, description: str) -> Iterator[Callable[[int], object]]:
    """Show a progress bar for the body of a ``with``, if standard error is a terminal; yields how to advance."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    with progress_bar() as bar:
        task = bar.add_task(description, total=total)
        yield lambda count: bar.advance(task, count)


def track(items: Iterable[ItemT], total: int | None, description: str) -> Iterator[ItemT]:
    """Iterate over the items with a progress bar, if standard error is a terminal."""
    with progress(total, description) as advance:
        for item in items:
            yield item
            advance(1)


class _Rows:
    """Standard output for the rows of CSV: they end as lines do."""

    def write(self, row: str) -> int:
        """Write a row that ends with a carriage return and a newline."""
        return sys.stdout.write(row.removesuffix("\r\n") + "\n")


def csv_writer() -> Any:
    """A writer of CSV on standard output."""
    # With newlines alone as ends, a name with a carriage return is not quoted, and begins a row for readers.
    return csv.writer(_Rows(), lineterminator="\r\n")


def csv_name(name: str) -> str:
    """A name as a cell of CSV: unchanged for programs and files; escaped for a terminal, which would obey it."""
    return printable(name) if sys.stdout.isatty() else name


def format_numbers(numbers: Iterable[float]) -> str:
    """Numbers with six digits at most, separated by blanks."""
    # Adding zero turns -0 into 0.
    return " ".join(f"{number + 0.0:g}" for number in numbers)


def format_transform(transform: Transform) -> str:
    """A transform in one line: ``xyz 0.1 0 0.2 m, rpy 0 0 1.5708 rad``."""
    return f"xyz {format_numbers(transform.translation)} m, rpy {format_numbers(transform.as_rpy())} rad"


def format_span(seconds: float | None) -> str:
    """A duration in s for people, such as ``20 ms``; empty if it is not known."""
    return "" if seconds is None else format_duration(from_seconds(seconds))


def format_counts(counts: Mapping[str, int]) -> str:
    """Counts by reason in one line: ``3 x not finite, 1 x cycle``."""
    return ", ".join(f"{count:,} x {reason}" for reason, count in counts.items())


def write_file(path: Path, content: bytes) -> None:
    """Write a file, all of it or nothing; a pipe or a device is written to directly.

    Raises
    ------
    UsageError
        If the file cannot be written.
    """
    replaceable = path.is_file() or not path.exists()
    # Its packages take long to load, and few commands write a file.
    from tfbus.recording.convert import new_file

    try:
        with new_file(path) if replaceable else nullcontext(path) as written:
            written.write_bytes(content)
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}") from None


@contextmanager
def log_lines(level: str, first_window: float = _FIRST_WINDOW) -> Iterator[None]:
    """Show the log lines of tfbus, at a level or a higher one, on standard error for the body of a ``with``.

    Parameters
    ----------
    level : str
    first_window : float
        The time in s for which the first line of a kind is held back, to count the lines that follow.
    """
    logger = logging.getLogger("tfbus")
    handler = _FoldingHandler(first_window)
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)
        handler.close()


class _FoldingHandler(logging.Handler):
    """Prints the first line of a kind with the number of lines that follow within a short time.

    Lines are of one kind if they differ only in their arguments. The time doubles each time that a kind comes again, up
    to `_LONGEST_WINDOW`, and nothing is lost: `close` prints all lines that are still held back.
    """

    def __init__(self, first_window: float) -> None:
        super().__init__()
        self._first_window = first_window
        self._waiting: dict[str, tuple[str, int, threading.Timer]] = {}
        self._windows: dict[str, float] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Hold a line back; or count it, if another line of its kind is held back."""
        kind = str(record.msg)
        if kind in self._waiting:
            line, more, timer = self._waiting[kind]
            self._waiting[kind] = (line, more + 1, timer)
            return
        window = self._windows.get(kind, self._first_window)
        self._windows[kind] = min(2 * window, _LONGEST_WINDOW)
        timer = threading.Timer(window, self._tell, (kind,))
        timer.daemon = True
        self._waiting[kind] = (self.format(record), 0, timer)
        timer.start()

    def close(self) -> None:
        """Print all lines that are held back."""
        for kind, (_, _, timer) in list(self._waiting.items()):
            timer.cancel()
            self._tell(kind)
        super().close()

    def _tell(self, kind: str) -> None:
        # A timer calls it in its own thread.
        self.acquire()
        try:
            waiting = self._waiting.pop(kind, None)
        finally:
            self.release()
        if waiting is not None:
            line, more, _ = waiting
            # Only a traceback has several lines. No message in it begins a line as those of tfbus do.
            first, *traceback = line.split("\n")
            warn(f"{first} (and {more:,} more like it)" if more else first)
            for part in traceback:
                say(f"  {part}")
