"""The output of the subcommands: results, notices, warnings, and values as text for people."""

import csv
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

from tfbus.cli._width import terminal_width, wrapped
from tfbus.cli.arguments import UsageError
from tfbus.geometry.transform import Transform
from tfbus.plain import printable
from tfbus.stamps import SECOND

ItemT = TypeVar("ItemT")


def print_now(line: str) -> None:
    """Print a line of the result at once; through a pipe it would otherwise wait for a block of many lines."""
    print(line, flush=True)


def fitted(line: str) -> str:
    """A line of the result, broken between words where it is longer than the terminal is wide."""
    return "\n".join(wrapped(line, terminal_width(), 2))


def say(line: str) -> None:
    """Print a notice to standard error, in one line whatever names are in it."""
    print(printable(line), file=sys.stderr, flush=True)


def warn(message: str) -> None:
    """Print a warning or an error to standard error, with the name of the command before it."""
    say(f"tfbus: {message}")


def track(items: Iterable[ItemT], total: int | None, description: str) -> Iterator[ItemT]:
    """Iterate over the items with a progress bar, if standard error is a terminal."""
    with progress(total, description) as advance:
        for item in items:
            yield item
            advance(1)


@contextmanager
def progress(total: int | None, description: str) -> Iterator[Callable[[int], object]]:
    """Show a progress bar for the body of a ``with``, if standard error is a terminal; gives what advances it."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from tfbus.cli._progress_bar import progress_bar

    with progress_bar() as bar:
        task = bar.add_task(description, total=total)
        yield lambda count: bar.advance(task, count)


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
    """A name as a cell of CSV: as it is for programs and files, and escaped on a terminal, which would obey it."""
    return printable(name) if sys.stdout.isatty() else name


def format_seconds(nanoseconds: int) -> str:
    """Nanoseconds as seconds with all nine decimals."""
    whole, rest = divmod(abs(nanoseconds), SECOND)
    return f"{'-' if nanoseconds < 0 else ''}{whole}.{rest:09d}"


def format_numbers(numbers: Iterable[float]) -> str:
    """Numbers with six digits at most, separated by blanks."""
    # Adding zero turns -0 into 0.
    return " ".join(f"{number + 0.0:g}" for number in numbers)


def format_transform(transform: Transform) -> str:
    """A transform in one line: ``xyz 0.1 0 0.2 m, rpy 0 0 1.5708 rad``."""
    return f"xyz {format_numbers(transform.translation)} m, rpy {format_numbers(transform.as_rpy())} rad"


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
