"""The second of the tutorial's two programs: it transforms a point that the laser sees into the base.

Run it with `python demos/tf_listener.py`, and `python demos/tf_broadcaster.py` in another terminal, in any order.
Without a broadcaster it says what is missing. Ctrl-C ends it. `tfbus listen` does the same with options.
"""

import sys

import anyio

import tfbus


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
                f'from "base_laser" to "base_link": {error}',
                flush=True,
            )
        else:
            assert isinstance(base_point.stamp, int)  # an answer's stamp is never LATEST
            x, y, z = laser_point.point
            bx, by, bz = base_point.point
            print(
                f"[ INFO] {now(clock)}: base_laser: ({x:.2f}, {y:.2f}. {z:.2f}) -----> "
                f"base_link: ({bx:.2f}, {by:.2f}, {bz:.2f}) at time {tfbus.to_seconds(base_point.stamp):.2f}",
                flush=True,
            )


def now(clock: tfbus.Clock) -> str:
    seconds, nanoseconds = divmod(clock.now(), tfbus.SECOND)
    return f"{seconds}.{nanoseconds:09d}"


async def main(domain: str) -> None:
    with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer:
        async with tfbus.LocalLink(bus, domain):
            await listen(buffer)


if __name__ == "__main__":
    try:
        anyio.run(main, sys.argv[1] if len(sys.argv) > 1 else "tf")
    except KeyboardInterrupt:
        raise SystemExit(130) from None
