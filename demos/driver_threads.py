"""Two drivers, each in a thread of its own, publish on a bus that lives in an event loop.

A driver that blocks, for example on a serial port, has a thread. It hands its samples over through `bus.threadsafe()`;
the event loop publishes them, and a task reads them from a stream. At first, a thread calls `bus.publish` itself, to
show the error.

Run it with `python demos/driver_threads.py`; it takes a quarter of a second.
"""

import time
from collections import Counter
from functools import partial

import anyio
import anyio.to_thread

import tfbus

SAMPLES = 50


def drive(publish: tfbus.ThreadPublisher, name: str, direction: float) -> None:
    """Read a sensor 200 times a second, as a driver does: blocking."""
    for k in range(SAMPLES):
        time.sleep(0.005)
        moved = tfbus.Transform((direction * k / 100, 0.0, 0.0))
        publish(tfbus.TransformStamped("base_link", name, k * 5_000_000, moved, authority=name))


async def run_drivers(bus: tfbus.Bus) -> None:
    with bus.threadsafe() as publish:
        async with anyio.create_task_group() as drivers:
            drivers.start_soon(anyio.to_thread.run_sync, partial(drive, publish, "left_wheel", 1.0))
            drivers.start_soon(anyio.to_thread.run_sync, partial(drive, publish, "right_wheel", -1.0))
    # The end of the `with` has published the pending samples; now the stream can end.
    bus.close()


async def main() -> None:
    with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer, bus.stream(overflow="drop_oldest") as batches:
        sample = tfbus.TransformStamped("base_link", "imu", 0, tfbus.Transform())
        try:
            await anyio.to_thread.run_sync(bus.publish, sample)
        except RuntimeError as error:
            print(f"RuntimeError: {error}")

        newest: Counter[str] = Counter()
        counts: Counter[str] = Counter()
        in_order = True
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run_drivers, bus)
            async for batch in batches:
                for sample in batch:
                    in_order = in_order and sample.stamp >= newest[sample.child]
                    newest[sample.child] = sample.stamp
                    counts[sample.child] += 1
        print(f"{dict(sorted(counts.items()))}, in order: {in_order}, dropped: {batches.dropped}")
        # To look up is safe in every thread.
        apart = await anyio.to_thread.run_sync(buffer.lookup_nowait, "left_wheel", "right_wheel")
        print(f"the wheels are {-apart.transform.translation[0]:.2f} m apart")


if __name__ == "__main__":
    anyio.run(main)
