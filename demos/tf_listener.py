"""The second of the tutorial's two programs: it transforms a point that the laser sees into the base.

Run it with `python demos/tf_listener.py`, and `python demos/tf_broadcaster.py` in another terminal, in any order.
Without a broadcaster it says what is missing. Ctrl-C ends it. `tfbus listen` does the same with options.
"""

import anyio

import tfbus


async def main() -> None:
    with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer:
        async with tfbus.LocalLink(bus):
            async for _ in bus.clock.ticks(1.0):
                # The newest transform will do for a point that we just made up; a real scan has a stamp.
                point = tfbus.PointStamped("base_laser", tfbus.LATEST, (1.0, 0.2, 0.0))
                try:
                    in_base = await buffer.transform(point, "base_link", timeout=0.5, max_age=1.0)
                except tfbus.TransformError as error:
                    print(error, flush=True)
                else:
                    print(in_base.frame, in_base.point, flush=True)


if __name__ == "__main__":
    try:
        anyio.run(main)
    except* KeyboardInterrupt:
        pass
