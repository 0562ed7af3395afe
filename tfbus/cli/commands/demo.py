"""``tfbus demo``."""

from functools import partial
from typing import Annotated

import anyio
from cyclopts import Parameter

from tfbus.cli import tutorial
from tfbus.cli.options import Backend, Duration, Rate
from tfbus.clock import Clock, SimulatedClock, SystemClock


def demo(
    *,
    duration: Duration = float("inf"),
    rate: Rate = 100.0,
    listen_rate: Rate = 1.0,
    backend: Backend = "asyncio",
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
