"""A progress bar for long work."""

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

ItemT = TypeVar("ItemT")


def watched(items: Iterable[ItemT], total: int | None, what: str) -> Iterator[ItemT]:
    """The items one by one; a bar on standard error shows how many have gone by, if that is a terminal."""
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import Progress

    # Redirected, what is printed meanwhile would go to standard error too.
    bar = Progress(console=Console(stderr=True), transient=True, redirect_stdout=False, redirect_stderr=False)
    with bar:
        yield from bar.track(items, total=total, description=what)
