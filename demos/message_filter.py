"""Pair camera detections with the transforms at their own stamps, and count the detections without one.

The odometry of a robot that drives at 1 m/s arrives 80 ms late; a camera detection arrives at once. The filter holds
each detection until its transform is known. Two detections never come out: one is a minute old, one comes from an
unknown camera. They are counted, and the callback gets the reason.

Run it with `python demos/message_filter.py`.
"""

from collections.abc import AsyncIterator

import anyio

import tfbus

LATENESS = tfbus.from_seconds(0.08)


async def publish_odometry(bus: tfbus.Bus, start: int) -> None:
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async for _ in bus.clock.ticks(50.0):
        stamp = bus.clock.now() - LATENESS
        driven = tfbus.to_seconds(stamp - start) * 1.0
        odometry.send("map", "camera", tfbus.Transform(translation=(driven, 0.0, 0.0)), at=stamp)


async def detections(clock: tfbus.Clock) -> AsyncIterator[tfbus.PointStamped]:
    ahead = (2.0, 0.0, 0.0)
    async for tick in clock.ticks(10.0):
        if tick == 5:
            return
        if tick == 2:
            yield tfbus.PointStamped("camera", clock.now() - 60 * tfbus.SECOND, ahead)
            yield tfbus.PointStamped("arm_camera", clock.now(), ahead)
        yield tfbus.PointStamped("camera", clock.now(), ahead)


def tell(_detection: tfbus.PointStamped, reason: str, error: tfbus.TransformError | None) -> None:
    print(f"dropped, {reason}: {error}")


async def main(clock: tfbus.Clock | None = None) -> None:
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        start = bus.clock.now()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(publish_odometry, bus, start)
            await bus.clock.sleep(0.5)
            messages = detections(bus.clock)
            async with tfbus.MessageFilter(messages, buffer, "map", timeout=0.3, on_drop=tell) as pairs:
                async for detection, transform in pairs:
                    x = tfbus.do_transform(detection, transform).point[0]
                    late = tfbus.to_seconds(bus.clock.now() - transform.stamp)
                    print(f"x = {x:.3f} m, {late * 1000:.0f} ms after it was seen")
            print(f"{pairs.arrived} detections, {pairs.delivered} placed, dropped: {dict(pairs.dropped)}")
            tasks.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main)
