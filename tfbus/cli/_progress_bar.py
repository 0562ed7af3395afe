"""The progress bar of long commands; a module of its own, so that `rich` is imported only for a terminal."""

from rich.console import Console
from rich.progress import Progress


def progress_bar() -> Progress:
    """A progress bar on standard error that disappears at its end and leaves other output alone."""
    # With its redirection, rich would print results that go to standard output on standard error.
    return Progress(console=Console(stderr=True), transient=True, redirect_stdout=False, redirect_stderr=False)
