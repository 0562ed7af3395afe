"""The command ``tfbus``. Standard output is for what was asked; everything else goes to standard error."""

import os
import sys
from functools import partial
from typing import Annotated, Literal

import anyio

from tfbus import tutorial
from tfbus.clock import Clock, SimulatedClock, SystemClock

try:
    from cyclopts import App, CycloptsError, Parameter
    from cyclopts.validators import Number
except ImportError:
    raise SystemExit('tfbus: the command needs some packages more: pip install "tfbus[cli]"') from None

USAGE_ERROR = 2
INTERRUPTED = 130

app = App(
    name="tfbus",
    help="Stamped coordinate transforms for asyncio and trio.",
    suppress_keyboard_interrupt=False,
)

Rate = Annotated[float, Parameter(validator=Number(gt=0, lt=float("inf")))]
Duration = Annotated[float, Parameter(validator=Number(gte=0))]


@app.command
def demo(
    *,
    duration: Duration = float("inf"),
    rate: Rate = 100.0,
    listen_rate: Rate = 1.0,
    backend: Literal["asyncio", "trio"] = "asyncio",
    simulated: Annotated[bool, Parameter(negative="")] = False,
    broadcaster: bool = True,
) -> None:
    """Run the tutorial's robot: a 100 Hz broadcaster and a 1 Hz listener in one process, until Ctrl-C.

    Example: tfbus demo --simulated --duration 10

    Parameters
    ----------
    duration
        Stop after this many seconds.
    rate
        Broadcasts per second.
    listen_rate
        Lines per second.
    backend
        The event loop to run on.
    simulated
        Run on a simulated clock, as fast as can be.
    broadcaster
        Whether anybody sends the transform that the listener needs.
    """
    clock: Clock = SimulatedClock() if simulated else SystemClock()
    run = partial(
        tutorial.run,
        clock,
        rate=rate,
        listen_rate=listen_rate,
        duration=duration,
        broadcaster=broadcaster,
        # Piped output would else arrive in blocks of many lines.
        output=partial(print, flush=True),
    )
    anyio.run(run, backend=backend)


def main() -> None:
    """Run the command and exit: 0 when done, 2 for a wrong call, 130 for Ctrl-C."""
    status = 0
    try:
        app(exit_on_error=False, print_error=False, result_action="return_value")
    except* CycloptsError as wrong:
        for error in wrong.exceptions:
            print(f"tfbus: {error}", file=sys.stderr)
        status = USAGE_ERROR
    except* KeyboardInterrupt:
        status = INTERRUPTED
    except* BrokenPipeError:
        # Whoever read the lines has had enough; Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(status)


if __name__ == "__main__":
    main()
