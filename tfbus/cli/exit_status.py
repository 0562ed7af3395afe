"""Runs the command: the exit status for whatever happens."""

import os
import sys
from collections.abc import Callable, Sequence
from io import TextIOWrapper

from tfbus.cli._overview import COMMANDS, asks_for_overview, overview

LOOKUP_FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130


def run(words: Sequence[str], loaded: Callable[[], object] = lambda: None) -> int:
    """Run the command with arguments, and return its exit status; errors that a user can cause are a line each.

    Parameters
    ----------
    words : sequence of str
        What a user types after ``tfbus``.
    loaded : callable
        Called once all modules of the subcommand are there, before it begins.
    """
    if isinstance(sys.stdout, TextIOWrapper):
        # Its encoding may lack the letters of a frame name.
        sys.stdout.reconfigure(errors="backslashreplace")
    program = _print_overview if asks_for_overview(words) else _command(words, loaded)
    status = 0
    try:
        program()
        sys.stdout.flush()
    except* KeyboardInterrupt:
        status = INTERRUPTED
    except* BrokenPipeError:
        # The reader has closed the pipe; without this, Python would report that again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except* _usage_errors() as errors:
        status = _report(errors, USAGE_ERROR)
    except* _lookup_errors() as errors:
        status = _report(errors, LOOKUP_FAILED)
    return status


def _print_overview() -> None:
    print(overview())


def _command(words: Sequence[str], loaded: Callable[[], object]) -> Callable[[], None]:
    # Loads cyclopts, which the overview does without.
    from tfbus.cli.application import application

    def parse_and_run() -> None:
        app = application(next((word for word in words if word in COMMANDS), None))
        prepare, arguments, _ = app.meta.parse_args(words, exit_on_error=False, print_error=False)
        program = prepare(*arguments.args, **arguments.kwargs)
        # Help has been printed by now.
        if program is not None:
            loaded()
            program()

    return parse_and_run


def _report(errors: BaseExceptionGroup[BaseException], status: int) -> int:
    from tfbus.cli.output import warn

    for error in errors.exceptions:
        warn(str(error))
    return status


# Their modules take long to load, and most commands end without an error.
def _usage_errors() -> tuple[type[Exception], ...]:
    from cyclopts import CycloptsError

    from tfbus.cli.arguments import UsageError
    from tfbus.errors import RecordingError

    return CycloptsError, UsageError, RecordingError


def _lookup_errors() -> type[Exception]:
    from tfbus.errors import TransformLookupError

    return TransformLookupError
