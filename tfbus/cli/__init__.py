"""The command ``tfbus``. Standard output is for what was asked; everything else goes to standard error."""

import os
import sys

try:
    from cyclopts import App, CycloptsError
except ImportError:
    raise SystemExit('tfbus: the command needs some packages more: pip install "tfbus[cli]"') from None

from tfbus.cli.demo import demo
from tfbus.cli.link import UnusableError

USAGE_ERROR = 2
INTERRUPTED = 130

app = App(
    name="tfbus",
    help="Stamped coordinate transforms for asyncio and trio.",
    suppress_keyboard_interrupt=False,
)
app.command(demo)


def main() -> None:
    """Run the command and exit: 0 when done, 2 for a wrong call, 130 for Ctrl-C."""
    status = 0
    try:
        app(exit_on_error=False, print_error=False, result_action="return_value")
    except* (CycloptsError, UnusableError) as wrong:
        for error in wrong.exceptions:
            print(f"tfbus: {error}", file=sys.stderr)
        status = USAGE_ERROR
    except* KeyboardInterrupt:
        status = INTERRUPTED
    except* BrokenPipeError:
        # Whoever read the lines has had enough; Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(status)
