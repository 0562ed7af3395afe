"""Bring scans into the map of a robot that is localised: four ways, with how late and how wrong each is.

The robot drives at 1 m/s. Its odometry comes 50 times a second, 10 ms late, and loses 2 % of the way. Its localisation
corrects this twice a second, 50 ms late: it sends where `odom` is in `map`. The laser scans ten times a second and sees
a wall 30 m from the origin of the map. A scan that waits for the correction of its own instant waits for up to half a
second; the three other ways do not.

Run it with `python demos/localisation.py`. The time is simulated, so it ends at once and always prints the same.
"""

from collections.abc import Awaitable, Callable

import anyio

import tfbus
from tfbus import LATEST, PointStamped, Transform, from_seconds
from tfbus.testing import simulate

WALL = 30.0  # m
DRIFT = 0.02
SECONDS = 10.0
Place = Callable[[tfbus.Buffer, PointStamped], Awaitable[PointStamped]]


async def publish_odometry(bus: tfbus.Bus) -> None:
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async for tick in bus.clock.ticks(50.0):
        await bus.clock.sleep_until(from_seconds(tick / 50 + 0.01))
        odometry.send("odom", "laser", Transform(((1 - DRIFT) * tick / 50, 0.0, 0.0)), at=from_seconds(tick / 50))


async def localise(bus: tfbus.Bus, post_date: float) -> None:
    localisation = tfbus.TransformBroadcaster(bus, authority="localisation")
    async for tick in bus.clock.ticks(2.0):
        await bus.clock.sleep_until(from_seconds(tick / 2 + 0.05))
        localisation.send("map", "odom", Transform((DRIFT * tick / 2, 0.0, 0.0)), at=from_seconds(tick / 2 + post_date))


async def wait(buffer: tfbus.Buffer, seen: PointStamped) -> PointStamped:
    return await buffer.transform(seen, "map", timeout=1.0)


async def newest_correction(buffer: tfbus.Buffer, seen: PointStamped) -> PointStamped:
    return await buffer.transform(seen, "map", at=LATEST, fixed="odom", timeout=1.0)


async def tolerate(buffer: tfbus.Buffer, seen: PointStamped) -> PointStamped:
    in_odom = await buffer.transform(seen, "odom", timeout=1.0)
    return await buffer.transform(in_odom, "map", tolerance=0.6, timeout=1.0)


async def compare(name: str, place: Place, post_date: float = 0.0) -> None:
    clock = tfbus.SimulatedClock()
    late: list[float] = []
    wrong: list[float] = []

    async def put_into_map(buffer: tfbus.Buffer, stamp: int) -> None:
        seen = PointStamped("laser", stamp, (WALL - tfbus.to_seconds(stamp), 0.0, 0.0))
        in_map = await place(buffer, seen)
        late.append(tfbus.to_seconds(clock.now() - stamp))
        wrong.append(abs(in_map.point[0] - WALL))

    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        async with anyio.create_task_group() as tasks:

            async def scan() -> None:
                await clock.sleep(1.0)
                async with anyio.create_task_group() as scans:
                    async for tick in clock.ticks(10.0):
                        if tick == 10 * SECONDS:
                            break
                        scans.start_soon(put_into_map, buffer, clock.now())

            tasks.start_soon(publish_odometry, bus)
            tasks.start_soon(localise, bus, post_date)
            await simulate(clock, scan)
            tasks.cancel_scope.cancel()
    print(f"{name:26} at most {1000 * max(late):3.0f} ms late, at most {1000 * max(wrong):4.1f} mm wrong")


async def main() -> None:
    await compare("wait for the correction", wait)
    await compare("take the newest correction", newest_correction)
    await compare("post-date it by 0.6 s", wait, post_date=0.6)
    await compare("tolerate one 0.6 s old", tolerate)


if __name__ == "__main__":
    anyio.run(main)
