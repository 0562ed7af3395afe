"""Wait for the transform at the stamp of a detection.

The odometry of a robot that drives at 1 m/s arrives 80 ms late. A camera detection arrives at once, so its stamp is 80
ms ahead of the newest transform. Where was the detection in the map? Three detections, three answers:

* The first is awaited, and comes out as soon as the odometry has caught up: exact, not extrapolated.
* The second is older than all samples in the buffer. Waiting cannot help, so it fails at once.
* The third comes from an unknown camera. It times out, and the error says what was still missing.

Run it with `python demos/future_transform.py`.
"""

import anyio

import tfbus

LATENESS = tfbus.from_seconds(0.08)


async def publish_odometry(bus: tfbus.Bus, start: int) -> None:
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async for _ in bus.clock.ticks(50.0):
        stamp = bus.clock.now() - LATENESS
        driven = tfbus.to_seconds(stamp - start) * 1.0
        odometry.send("map", "base_link", tfbus.Transform(translation=(driven, 0.0, 0.0)), at=stamp)


async def locate(buffer: tfbus.Buffer, name: str, detection: tfbus.PointStamped) -> None:
    clock = buffer.bus.clock
    asked = clock.now()
    try:
        in_map = await buffer.transform(detection, "map", timeout=0.5)
        x, y, z = in_map.point
        result = f"({x:.3f}, {y:.3f}, {z:.3f}) in the map"
    except tfbus.TransformLookupError as error:
        result = f"{type(error).__name__}: {error}"
    waited = tfbus.to_seconds(clock.now() - asked)
    print(f"{name}: after {waited * 1000:.0f} ms: {result}")


async def main(clock: tfbus.Clock | None = None) -> None:
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        start = bus.clock.now()
        camera = tfbus.TransformBroadcaster(bus, authority="calibration")
        camera.send_static("base_link", "camera", tfbus.Transform(translation=(0.3, 0.0, 0.5)))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(publish_odometry, bus, start)
            await bus.clock.sleep(0.5)

            ahead = (2.0, 0.0, 0.0)
            seen_now = tfbus.PointStamped("camera", bus.clock.now(), ahead)
            await locate(buffer, "seen just now", seen_now)

            seen_long_ago = tfbus.PointStamped("camera", bus.clock.now() - 60 * tfbus.SECOND, ahead)
            await locate(buffer, "seen a minute ago", seen_long_ago)

            seen_by_a_stranger = tfbus.PointStamped("arm_camera", bus.clock.now(), ahead)
            await locate(buffer, "seen by an unknown camera", seen_by_a_stranger)

            tasks.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main)
