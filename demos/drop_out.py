"""A tracker loses its target: an answer for the gap, and a way to know that there was one.

A drone flies a circle of 2 m radius, once in 4 s. A tracker reports it at 100 Hz, but not between 2 s and 3 s. Each
lookup says how far the answer may depart from the measurements, and each answer tells how far it did. The true place is
known here, so each answer is printed with its error. Run it with `python demos/drop_out.py`; time is simulated.
"""

import math
from functools import partial

import anyio

import tfbus
from tfbus.testing import simulate


def true_place(stamp: int) -> tfbus.Transform:
    turn = math.tau * tfbus.to_seconds(stamp) / 4.0
    return tfbus.Transform((2.0 * math.cos(turn), 2.0 * math.sin(turn), 1.5))


async def track(bus: tfbus.Bus) -> None:
    tracker = tfbus.TransformBroadcaster(bus, authority="tracker")
    async for _ in bus.clock.ticks(100.0):
        if not 2.0 < tfbus.to_seconds(bus.clock.now()) < 3.0:
            tracker.send("room", "drone", true_place(bus.clock.now()))


def show(question: str, found: tfbus.TransformStamped) -> None:
    error = math.dist(found.transform.translation, true_place(found.stamp).translation)
    held, gap = tfbus.to_seconds(found.extrapolated_by), tfbus.to_seconds(found.gap or 0)
    print(f"{question}: {error:.2f} m off (extrapolated by {held:.2f} s, gap {gap:.2f} s)")


async def ask(buffer: tfbus.Buffer) -> None:
    where = partial(buffer.lookup, "room", "drone")
    await buffer.bus.clock.sleep(2.2)
    show("now, at 2.2 s, held for 0.3 s at most", await where(buffer.bus.clock.now(), extrapolate=tfbus.Hold(0.3)))
    middle = tfbus.from_seconds(2.5)
    # Without a policy this waits until the drone is seen again, and then takes the straight line across the gap.
    show("at 2.5 s, whatever the gap", await where(middle, max_gap=math.inf))
    try:
        await where(middle, max_gap=0.1)
    except tfbus.GapError as error:
        print(f"at 2.5 s, across 0.1 s at most: {error}")
    show("at 2.9 s, as seen 0.2 s away at most", await where(tfbus.from_seconds(2.9), max_gap=0.1, tolerance=0.2))


async def main() -> None:
    clock = tfbus.SimulatedClock()
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(track, bus)
            await simulate(clock, partial(ask, buffer), limit=10.0)
            tasks.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main)
