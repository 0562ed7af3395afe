"""The classic tf tutorial in one process: a broadcaster at 100 Hz and a listener at 1 Hz share a bus.

A robot has a base, `base_link`, and a laser, `base_laser`, mounted 0.1 m forward of it and 0.2 m above. The broadcaster
publishes this transform, and the listener transforms a point that the laser sees into the base.

Run it with `python demos/robot_setup.py`; Ctrl-C ends it. `tfbus demo` does the same with options.
"""

import anyio

import tfbus


async def broadcast(bus: tfbus.Bus) -> None:
    # No edge of another program may end the loop: refused samples are left out, counted, and logged once.
    broadcaster = tfbus.TransformBroadcaster(bus, authority="robot_tf_publisher", invalid="drop")
    base_from_laser = tfbus.Transform(translation=(0.1, 0.0, 0.2))
    async for _ in bus.clock.ticks(100.0):
        broadcaster.send("base_link", "base_laser", base_from_laser)


async def listen(buffer: tfbus.Buffer) -> None:
    clock = buffer.bus.clock
    async for tick in clock.ticks(1.0):
        if tick == 0:
            continue
        # The newest transform will do for a point that we just made up; a real scan has the stamp when it was taken.
        laser_point = tfbus.PointStamped("base_laser", tfbus.LATEST, (1.0, 0.2, 0.0))
        try:
            base_point = await buffer.transform(laser_point, "base_link", timeout=0.5, max_age=1.0)
        except tfbus.TransformError as error:
            print(
                f"[ERROR] {now(clock)}: Received an exception trying to transform a point "
                f'from "base_laser" to "base_link": {error}'
            )
        else:
            assert isinstance(base_point.stamp, int)  # an answer's stamp is never LATEST
            x, y, z = laser_point.point
            bx, by, bz = base_point.point
            print(
                f"[ INFO] {now(clock)}: base_laser: ({x:.2f}, {y:.2f}. {z:.2f}) -----> "
                f"base_link: ({bx:.2f}, {by:.2f}, {bz:.2f}) at time {tfbus.to_seconds(base_point.stamp):.2f}"
            )


def now(clock: tfbus.Clock) -> str:
    seconds, nanoseconds = divmod(clock.now(), tfbus.SECOND)
    return f"{seconds}.{nanoseconds:09d}"


async def main(clock: tfbus.Clock | None = None) -> None:
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(broadcast, bus)
            tasks.start_soon(listen, buffer)


if __name__ == "__main__":
    try:
        anyio.run(main)
    except KeyboardInterrupt:
        raise SystemExit(130) from None
