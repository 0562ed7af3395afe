"""An hour of patrol in a second, and the effect of a jump back of the clock.

A robot goes round a circle once in ten minutes and says where it is once a second. A camera takes a picture every
quarter of an hour, between two of these samples, so that each picture waits for the next sample. All of it runs on a
`SimulatedClock`, so an hour takes about a second, and prints the same on every event loop.

Then the simulation starts anew: the clock jumps back to 0. Moving frames are forgotten, static frames stay, and a wait
for a stamp of the old time raises an error.

Run it with `python demos/simulated_time.py`.
"""

import math

import anyio

import tfbus
from tfbus.testing import simulate


async def patrol(bus: tfbus.Bus) -> None:
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async for _ in bus.clock.ticks(1.0):
        angle = math.tau * tfbus.to_seconds(bus.clock.now()) / 600.0
        odometry.send("map", "base_link", tfbus.Transform((math.cos(angle), math.sin(angle), 0.0)))


async def take_pictures(buffer: tfbus.Buffer) -> None:
    clock = buffer.bus.clock
    for quarter in (1, 2, 3, 4):
        await clock.sleep_until(tfbus.from_seconds(900 * quarter - 0.25))
        taken = clock.now()
        found = await buffer.lookup("map", "camera", taken, timeout=5.0)
        x, y, z = found.transform.translation
        waited = tfbus.to_seconds(clock.now() - taken)
        print(f"picture at {tfbus.to_seconds(taken):.2f} s: ({x:.3f}, {y:.3f}, {z:.3f}), known {waited:.2f} s later")


async def wait_for_tomorrow(buffer: tfbus.Buffer) -> None:
    try:
        await buffer.lookup("map", "camera", tfbus.from_seconds(86_400.0))
    except tfbus.ClockResetError as error:
        print(f"ClockResetError: {error}")


async def main() -> None:
    clock = tfbus.SimulatedClock()
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        tfbus.TransformBroadcaster(bus, "calibration").send_static(
            "base_link", "camera", tfbus.Transform((0.0, 0.0, 1.5))
        )
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(patrol, bus)
            await simulate(clock, lambda: take_pictures(buffer))
            tasks.cancel_scope.cancel()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait_for_tomorrow, buffer)
            await clock.advance(1.0)
            clock.set(0)
        print(f"camera on the base: {buffer.can_transform('base_link', 'camera')}")
        print(f"camera on the map: {buffer.can_transform('map', 'camera')}")


if __name__ == "__main__":
    anyio.run(main)
