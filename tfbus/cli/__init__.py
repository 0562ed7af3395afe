"""The command ``tfbus``. Standard output is for what was asked; everything else goes to standard error."""

import os
import sys
from io import TextIOWrapper

try:
    from cyclopts import App, CycloptsError
except ImportError:
    raise SystemExit('tfbus: the command needs some packages more: pip install "tfbus[cli]"') from None

from tfbus.cli.commands.broadcast import broadcast
from tfbus.cli.commands.demo import demo
from tfbus.cli.commands.echo import echo
from tfbus.cli.commands.info import info
from tfbus.cli.commands.listen import listen
from tfbus.cli.commands.play import play
from tfbus.cli.commands.query import query
from tfbus.cli.commands.record import record
from tfbus.cli.commands.robot import robot
from tfbus.cli.commands.static import static
from tfbus.cli.commands.tree import tree
from tfbus.cli.domain import UnusableError
from tfbus.errors import RecordingError, TransformLookupError

UNANSWERED = 1
USAGE_ERROR = 2
INTERRUPTED = 130

app = App(
    name="tfbus",
    help="Stamped coordinate transforms for asyncio and trio.",
    suppress_keyboard_interrupt=False,
)
app.command(demo)
app.command(broadcast)
app.command(listen)
app.command(static)
app.command(robot)
app.command(echo)
app.command(tree)
app.command(record)
app.command(play)
app.command(info)
app.command(query)


def main() -> None:
    """Run the command and exit: 0 when done, 1 for a question without an answer, 2 for a wrong call, 130 for Ctrl-C."""
    status = 0
    if isinstance(sys.stdout, TextIOWrapper):
        # It may not have the letters of a frame's name.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        app(sys.argv[1:], exit_on_error=False, print_error=False, result_action="return_value")
    except* (CycloptsError, UnusableError, RecordingError) as wrong:
        for error in wrong.exceptions:
            print(f"tfbus: {error}", file=sys.stderr)
        status = USAGE_ERROR
    except* TransformLookupError as missing:
        for reason in missing.exceptions:
            print(f"tfbus: {reason}", file=sys.stderr)
        status = UNANSWERED
    except* KeyboardInterrupt:
        status = INTERRUPTED
    except* BrokenPipeError:
        # Whoever read the lines has had enough; Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(status)
