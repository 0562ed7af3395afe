"""The command ``tfbus``, one subcommand a module in `tfbus.cli.commands`.

Standard output carries the result of a command; notices, warnings and errors go to standard error.
"""

import os
import sys
from importlib.metadata import version
from io import TextIOWrapper

try:
    from cyclopts import App, CycloptsError
except ImportError:
    raise SystemExit('tfbus: the command needs some packages more: pip install "tfbus[cli]"') from None

from tfbus import kernel
from tfbus.cli.arguments import UsageError
from tfbus.cli.commands.broadcast import broadcast
from tfbus.cli.commands.check import check
from tfbus.cli.commands.compare import compare
from tfbus.cli.commands.convert import convert
from tfbus.cli.commands.demo import demo
from tfbus.cli.commands.echo import echo
from tfbus.cli.commands.foxglove import foxglove
from tfbus.cli.commands.info import info
from tfbus.cli.commands.listen import listen
from tfbus.cli.commands.play import play
from tfbus.cli.commands.plot import plot
from tfbus.cli.commands.query import query
from tfbus.cli.commands.record import record
from tfbus.cli.commands.robot import robot
from tfbus.cli.commands.router import router
from tfbus.cli.commands.static import static
from tfbus.cli.commands.tree import tree
from tfbus.cli.commands.view import view
from tfbus.cli.output import warn
from tfbus.errors import RecordingError, TransformLookupError

LOOKUP_FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130

app = App(
    name="tfbus",
    help="Stamped coordinate transforms for asyncio and trio.",
    version=lambda: f"{version('tfbus')} ({kernel} kernel)",
    suppress_keyboard_interrupt=False,
)
COMMANDS = (
    demo,
    broadcast,
    listen,
    static,
    robot,
    echo,
    tree,
    record,
    play,
    info,
    query,
    check,
    convert,
    compare,
    router,
    view,
    plot,
    foxglove,
)
for command in COMMANDS:
    app.command(command)


def main() -> None:
    """Run the command and exit: 0 for success, 1 for a failed lookup, 2 for a usage error, 130 for Ctrl-C."""
    status = 0
    if isinstance(sys.stdout, TextIOWrapper):
        # Its encoding may lack the letters of a frame name.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        app(sys.argv[1:], exit_on_error=False, print_error=False, result_action="return_value")
    except* (CycloptsError, UsageError, RecordingError) as errors:
        for error in errors.exceptions:
            warn(str(error))
        status = USAGE_ERROR
    except* TransformLookupError as failures:
        for failure in failures.exceptions:
            warn(str(failure))
        status = LOOKUP_FAILED
    except* KeyboardInterrupt:
        status = INTERRUPTED
    except* BrokenPipeError:
        # The reader has closed the pipe; without this, Python would report that again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(status)
