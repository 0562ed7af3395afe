"""The robot of the classic tf tutorial, as two timed tasks.

A laser is mounted 0.1 m forward of the centre of the base and 0.2 m above it. A broadcaster sends that transform at
100 Hz; once a second, a listener transforms a point from the frame of the laser to that of the base and prints it.
"""

import math
from collections.abc import Callable

import anyio

from tfbus.buffer.buffer import Buffer
from tfbus.bus.broadcaster import TransformBroadcaster
from tfbus.bus.bus import Bus
from tfbus.cli.output import format_seconds
from tfbus.clock import Clock, SimulatedClock
from tfbus.data import PointStamped
from tfbus.errors import TransformError
from tfbus.geometry.transform import Transform
from tfbus.rows import Vector
from tfbus.stamps import LATEST, to_seconds

BASE, LASER = "base_link", "base_laser"
BASE_FROM_LASER = Transform((0.1, 0.0, 0.2))
POINT: Vector = (1.0, 0.2, 0.0)

Print = Callable[[str], object]


async def broadcast(bus: Bus, rate: float = 100.0) -> None:
    """Send the transform of the laser `rate` times a second, without drift and without end.

    A transform that the bus refuses, because it conflicts with those of other authorities, is logged once; the next one
    is sent all the same.
    """
    broadcaster = TransformBroadcaster(bus, authority="robot_tf_publisher", invalid="drop")
    async for _ in bus.clock.ticks(rate):
        broadcaster.send(BASE, LASER, BASE_FROM_LASER)


async def listen(buffer: Buffer, rate: float = 1.0, *, lines: float = math.inf, output: Print = print) -> None:
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


async def run(
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
                tasks.start_soon(broadcast, bus, rate)
            if isinstance(clock, SimulatedClock):
                tasks.start_soon(_advance, clock)
            await listen(buffer, listen_rate, lines=_ticks_within(duration, listen_rate), output=output)
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
