"""A display that redraws only when there is something to see.

A robot drives off at 1.5 m/s, stops for a second, and creeps on at 0.24 m/s; its odometry says so 100 times a second. A
display follows it, but redraws only when it has moved by 0.1 m, and at most ten times a second. While it hurries, the
rate decides; while it creeps, the distance; while it stands, nothing is drawn. The radar that turns on top of it costs
the display nothing.

Run it with `python demos/watch.py`. The time is simulated, so it ends at once and always prints the same.
"""

import anyio

import tfbus


async def drive(bus: tfbus.Bus) -> None:
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async for tick in bus.clock.ticks(100.0):
        time = tick / 100.0
        driven = 1.5 * min(time, 1.0) + 0.24 * max(time - 2.0, 0.0)
        odometry.send("map", "base_link", tfbus.Transform((driven, 0.0, 0.0)))


async def turn_the_radar(bus: tfbus.Bus) -> None:
    radar = tfbus.TransformBroadcaster(bus, authority="radar")
    async for tick in bus.clock.ticks(100.0):
        radar.send("base_link", "radar", tfbus.Transform.from_axis_angle((0.0, 0.0, 1.0), 0.1 * tick))


async def display(buffer: tfbus.Buffer) -> None:
    clock = buffer.bus.clock
    redrawn = 0
    with buffer.watch("map", "base_link", min_translation=0.1, max_rate=10.0) as changes:
        async for map_from_base in changes:
            redrawn += 1
            x = map_from_base.transform.translation[0]
            print(f"{tfbus.to_seconds(clock.now()):.2f} s: redraw the robot at {x:.3f} m")
    print(f"redrawn {redrawn} times; {changes.skipped} updates went by unseen")


async def main() -> None:
    clock = tfbus.SimulatedClock()
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        async with anyio.create_task_group() as robot:
            robot.start_soon(drive, bus)
            robot.start_soon(turn_the_radar, bus)
            async with anyio.create_task_group() as displays:
                displays.start_soon(display, buffer)
                await clock.advance(5.0)
                buffer.close()
            robot.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main)
