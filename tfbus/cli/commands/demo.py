"""``tfbus demo``."""

from functools import partial

from tfbus.cli import tutorial
from tfbus.cli._event_loop import run
from tfbus.cli.arguments import Backend, Duration, Flag, Rate
from tfbus.cli.output import fitted, print_now
from tfbus.clock import Clock, SimulatedClock, SystemClock


def demo(
    *,
    duration: Duration = float("inf"),
    rate: Rate = 100.0,
    listen_rate: Rate = 1.0,
    backend: Backend = "asyncio",
    simulated: Flag = False,
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
        Run on a simulated clock, as fast as possible.
    broadcaster
        Whether to run the broadcaster; without it, the listener says what is missing.
    """
    clock: Clock = SimulatedClock() if simulated else SystemClock()
    robot = partial(
        tutorial.run,
        clock,
        rate=rate,
        listen_rate=listen_rate,
        duration=duration,
        broadcaster=broadcaster,
        output=lambda line: print_now(fitted(line)),
    )
    run(robot, backend)
