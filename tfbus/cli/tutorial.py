"""The robot of the classic tf tutorial, as two timed tasks.

A laser is mounted 0.1 m forward of the base's rotational centre and 0.2 m above it. A broadcaster says so at 100 Hz; a
listener takes a point in the laser's frame once a second and prints it in the base's.
"""

import logging
import math
from collections.abc import Callable

import anyio

from tfbus._log import OnceLogger
from tfbus.buffer.buffer import Buffer
from tfbus.bus.broadcaster import TransformBroadcaster
from tfbus.bus.bus import Bus
from tfbus.clock import Clock, SimulatedClock
from tfbus.data import PointStamped
from tfbus.errors import InvalidTransformError, TransformError
from tfbus.geometry.rows import Vector
from tfbus.geometry.transform import Transform
from tfbus.stamps import LATEST, SECOND, to_seconds

BASE, LASER = "base_link", "base_laser"
BASE_FROM_LASER = Transform((0.1, 0.0, 0.2))
POINT: Vector = (1.0, 0.2, 0.0)

Print = Callable[[str], object]


async def broadcast(bus: Bus, rate: float = 100.0) -> None:
    """Send the laser's transform `rate` times a second, each stamped with now, without drift and without end.

    A transform that the bus refuses, because of what somebody else has sent, is logged once and tried again.
    """
    broadcaster = TransformBroadcaster(bus, authority="robot_tf_publisher")
    log = OnceLogger(logging.getLogger("tfbus"))
    async for _ in bus.clock.ticks(rate):
        try:
            broadcaster.send(BASE, LASER, BASE_FROM_LASER)
        except InvalidTransformError as error:
            log.warning(error.reason, "not sent: %s", error)


async def listen(buffer: Buffer, rate: float = 1.0, *, lines: float = math.inf, output: Print = print) -> None:
    """Print the point in the base's frame `rate` times a second, or what is missing; the first time after one period.

    Parameters
    ----------
    buffer : Buffer
    rate : float
        Hz.
    lines : float
        After how many to stop.
    output : callable
        Takes each line.
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
                f"[ERROR] {_ros_time(clock)}: Received an exception trying to transform a point "
                f'from "{LASER}" to "{BASE}": {error}'
            )
        else:
            output(f"[ INFO] {_ros_time(clock)}: {format_points(point, in_base)}")
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
    """Run both tasks on one bus for a duration in s, or for ever. A `SimulatedClock` is driven as fast as can be."""
    with Bus(clock) as bus, Buffer(bus) as buffer:
        start = clock.now()
        async with anyio.create_task_group() as tasks:
            if broadcaster:
                tasks.start_soon(broadcast, bus, rate)
            if isinstance(clock, SimulatedClock):
                tasks.start_soon(_drive, clock)
            await listen(buffer, listen_rate, lines=_ticks_within(duration, listen_rate), output=output)
            await clock.sleep(max(0.0, duration - to_seconds(clock.now() - start)))
            tasks.cancel_scope.cancel()


def format_points(point: PointStamped, in_base: PointStamped) -> str:
    """The tutorial's line, its stray dot included."""
    x, y, z = point.point
    bx, by, bz = in_base.point
    assert isinstance(in_base.stamp, int)
    return (
        f"{point.frame}: ({x:.2f}, {y:.2f}. {z:.2f}) -----> {in_base.frame}: ({bx:.2f}, {by:.2f}, {bz:.2f}) "
        f"at time {to_seconds(in_base.stamp):.2f}"
    )


async def _drive(clock: SimulatedClock) -> None:
    while True:
        await clock.advance(1.0)


def _ticks_within(duration: float, rate: float) -> float:
    # A duration of 0.3 s at 10 Hz is three ticks, although 0.3 * 10 < 3.
    return duration if math.isinf(duration) else math.floor(duration * rate + 1e-9)


def _ros_time(clock: Clock) -> str:
    seconds, nanoseconds = divmod(clock.now(), SECOND)
    return f"{seconds}.{nanoseconds:09d}"
