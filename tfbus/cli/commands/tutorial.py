"""``tfbus broadcast``, ``tfbus listen`` and ``tfbus demo``: the robot of the classic tf tutorial.

A laser is mounted 0.1 m forward of the centre of the base and 0.2 m above it. A broadcaster sends that transform at
100 Hz; once a second, a listener transforms a point from the frame of the laser to the base and prints it. They
are two programs of a domain, or for ``demo`` two tasks of one process.
"""

import math
from collections.abc import Callable
from functools import partial

from tfbus.cli.arguments import Backend, Duration, Flag, Rate
from tfbus.cli.domain import DEFAULT_HEARING, DEFAULT_LINK, HearingOptions, LinkOptions, run
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import fitted, print_now, say

with lazy_imports():
    import anyio

    from tfbus.buffer.buffer import Buffer
    from tfbus.bus.broadcaster import TransformBroadcaster
    from tfbus.bus.bus import Bus
    from tfbus.cli.replay_clock import ReplayClock
    from tfbus.clock import Clock, SimulatedClock, SystemClock
    from tfbus.data import PointStamped
    from tfbus.errors import TransformError
    from tfbus.geometry.transform import Transform
    from tfbus.stamps import LATEST, format_seconds, to_seconds

BASE, LASER = "base_link", "base_laser"
POINT = (1.0, 0.2, 0.0)

Print = Callable[[str], object]


def broadcast(*, rate: Rate = 100.0, link: LinkOptions = DEFAULT_LINK) -> None:
    """Broadcast the transform of the tutorial's laser, until Ctrl-C; `tfbus listen` in another terminal receives it.

    Example: tfbus broadcast --rate 50

    Parameters
    ----------
    rate
        Broadcasts per second.
    """

    async def broadcast_laser(bus: Bus) -> None:
        laser = f"{LASER!r} in {BASE!r}"
        say(f"broadcasting {laser} at {rate:g} Hz on {link.place}, until Ctrl-C")
        await send_laser(bus, rate)

    link.run(broadcast_laser)


def listen(*, rate: Rate = 1.0, link: HearingOptions = DEFAULT_HEARING) -> None:
    """Print a point of the tutorial's laser in the frame of the base, again and again, until Ctrl-C.

    Start `tfbus broadcast` in another terminal, before or after. Without it, the lines say what is missing.

    Example: tfbus listen

    Parameters
    ----------
    rate
        Lines per second.
    """

    async def print_points(bus: Bus) -> None:
        with Buffer(bus) as buffer:
            await link.first_transform(bus)
            await transform_points(buffer, rate, output=_print_fitted)

    link.run(print_points, clock=ReplayClock())


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
        run_robot,
        clock,
        rate=rate,
        listen_rate=listen_rate,
        duration=duration,
        broadcaster=broadcaster,
        output=_print_fitted,
    )
    run(robot, backend)


async def send_laser(bus: Bus, rate: float = 100.0) -> None:
    """Send the transform of the laser `rate` times a second, without drift and without end.

    If the bus refuses a transform, because it conflicts with transforms of other authorities, that is logged once, and
    the next one is sent all the same.
    """
    broadcaster = TransformBroadcaster(bus, authority="robot_tf_publisher", invalid="drop")
    base_from_laser = Transform((0.1, 0.0, 0.2))
    async for _ in bus.clock.ticks(rate):
        broadcaster.send(BASE, LASER, base_from_laser)


async def transform_points(
    buffer: Buffer, rate: float = 1.0, *, lines: float = math.inf, output: Print = print
) -> None:
    """Print the point in the base frame `rate` times a second, or the error; the first line comes after one period.

    Parameters
    ----------
    buffer : Buffer
    rate : float
        Lines per second.
    lines : float
        The number of lines after which to stop.
    output : callable
        Called with each line.
    """
    clock = buffer.bus.clock
    if lines < 1:
        return
    async for tick in clock.ticks(rate):
        if tick == 0:
            continue
        point = PointStamped(LASER, LATEST, POINT)
        try:
            in_base = await buffer.transform(point, BASE, timeout=0.5, max_age=1.0)
        except TransformError as error:
            output(
                f"[ERROR] {format_seconds(clock.now())}: Received an exception trying to transform a point "
                f'from "{LASER}" to "{BASE}": {error}'
            )
        else:
            output(f"[ INFO] {format_seconds(clock.now())}: {format_points(point, in_base)}")
        if tick >= lines:
            return


async def run_robot(
    clock: Clock,
    *,
    rate: float = 100.0,
    listen_rate: float = 1.0,
    duration: float = math.inf,
    broadcaster: bool = True,
    output: Print = print,
) -> None:
    """Run both tasks on one bus for a duration in s, or for ever; a `SimulatedClock` is advanced as fast as possible.

    Parameters
    ----------
    clock : Clock
    rate, listen_rate : float
        Broadcasts and lines per second.
    duration : float
        Seconds.
    broadcaster : bool
        Whether to run the broadcaster.
    output : callable
        Called with each line.
    """
    with Bus(clock) as bus, Buffer(bus) as buffer:
        start = clock.now()
        async with anyio.create_task_group() as tasks:
            if broadcaster:
                tasks.start_soon(send_laser, bus, rate)
            if isinstance(clock, SimulatedClock):
                tasks.start_soon(_advance, clock)
            await transform_points(buffer, listen_rate, lines=_ticks_within(duration, listen_rate), output=output)
            await clock.sleep(max(0.0, duration - to_seconds(clock.now() - start)))
            tasks.cancel_scope.cancel()


def format_points(point: PointStamped, in_base: PointStamped) -> str:
    """The line that the tutorial prints, including its stray dot."""
    x, y, z = point.point
    bx, by, bz = in_base.point
    assert isinstance(in_base.stamp, int)
    return (
        f"{point.frame}: ({x:.2f}, {y:.2f}. {z:.2f}) -----> {in_base.frame}: ({bx:.2f}, {by:.2f}, {bz:.2f}) "
        f"at time {to_seconds(in_base.stamp):.2f}"
    )


async def _advance(clock: SimulatedClock) -> None:
    while True:
        await clock.advance(1.0)


def _ticks_within(duration: float, rate: float) -> float:
    # A duration of 0.3 s at 10 Hz is three ticks, although 0.3 * 10 < 3.
    return duration if math.isinf(duration) else math.floor(duration * rate + 1e-9)


def _print_fitted(line: str) -> None:
    print_now(fitted(line))
