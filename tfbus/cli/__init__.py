"""The command ``tfbus``: its exit status, and its behaviour at Ctrl-C.

Of the subcommands in `tfbus.cli.commands`, it loads only the one that is called. `tfbus.cli.application` parses the
words with cyclopts. The help of all is printed without cyclopts, which takes several times as long to load as all else,
and the version without anything but the kernel.

A subcommand returns its exit status, or None for success. For a fault that a user can cause, it raises `UsageError`, a
`RecordingError` or a `TransformLookupError`, and `run` prints a line for each. Standard output carries the result of a
command; notices, warnings and errors go to standard error.
"""

# `signal` would load enum, and Ctrl-C would still show a traceback meanwhile.
import _signal as signal  # type: ignore[import-not-found]
import gc
import os
import sys
from collections.abc import Callable, Sequence
from io import TextIOWrapper

from tfbus.cli.statuses import FAILED, INTERRUPTED, USAGE_ERROR


def main() -> None:
    """Run the command and exit with the status that its help names; Ctrl-C never shows a traceback.

    While modules are loaded, and after the command has ended, Ctrl-C has its default action, which is silent: a
    `KeyboardInterrupt` would show a traceback there.
    """
    is_default = signal.getsignal(signal.SIGINT) is signal.default_int_handler

    def begin() -> None:
        gc.freeze()
        gc.enable()
        if is_default:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    if is_default:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Modules are never garbage: a collection while they are loaded takes a sixth of the time of the help.
    gc.disable()
    try:
        status = run(sys.argv[1:], begin)
    finally:
        gc.enable()
        if is_default:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(status)


def run(words: Sequence[str], loaded: Callable[[], object] = lambda: None) -> int:
    """Run the command with arguments, and return its exit status.

    Parameters
    ----------
    words : sequence of str
        The words that a user types after ``tfbus``.
    loaded : callable
        Called once all modules of the subcommand are there, before it begins.
    """
    if isinstance(sys.stdout, TextIOWrapper):
        # Its encoding may lack the letters of a frame name.
        sys.stdout.reconfigure(errors="backslashreplace")
    parse = _print_version
    if list(words) != ["--version"]:
        from tfbus.cli.application import parser_of

        parse = parser_of(words)
    status = 0
    try:
        program = parse()
        # A page has been printed by now.
        if program is not None:
            loaded()
            status = program() or 0
        sys.stdout.flush()
    except* KeyboardInterrupt:
        status = INTERRUPTED
    except* BrokenPipeError:
        # The reader has closed the pipe; without this, Python would report that again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except* _usage_errors() as errors:
        status = _report(errors, USAGE_ERROR)
    except* _lookup_errors() as errors:
        status = _report(errors, FAILED)
    return status


def _print_version() -> Callable[[], int | None] | None:
    from tfbus.cli.version import version

    print(version())
    return None


# The modules below are loaded where they are used, because the help and the version need none of them.


def _report(errors: BaseExceptionGroup[BaseException], status: int) -> int:
    from tfbus.cli.output import warn

    for error in errors.exceptions:
        warn(str(error))
    return status


def _usage_errors() -> tuple[type[Exception], ...]:
    from cyclopts import CycloptsError

    from tfbus.cli.arguments import UsageError
    from tfbus.errors import RecordingError

    return CycloptsError, UsageError, RecordingError


def _lookup_errors() -> type[Exception]:
    from tfbus.errors import TransformLookupError

    return TransformLookupError
