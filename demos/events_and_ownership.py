"""An arm takes up a tool, defends its frame, and puts it down, and a monitor prints all events.

An arm owns the frame of its tool for as long as it holds the tool. A second program believes that it holds the same
tool: its samples are refused with the reason. The odometry dies and comes back. The localisation and a person disagree
about the place of the robot: that is allowed, and reported.

Run it with `python demos/events_and_ownership.py`. The time is simulated, so it ends at once and always prints the
same.
"""

import anyio

import tfbus
from tfbus.testing import simulate


async def monitor(bus: tfbus.Bus) -> None:
    """Print each event, one line each."""
    with bus.events(stale_after=0.5) as events:
        async for event in events:
            print(event)


async def drive(bus: tfbus.Bus) -> None:
    """Odometry at 10 Hz that is silent between 1 s and 2 s."""
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async for tick in bus.clock.ticks(10.0):
        if not 10 < tick < 20:
            odometry.send("odom", "base_link", tfbus.Transform((tick / 10, 0.0, 0.0)))


async def work(bus: tfbus.Bus) -> None:
    arm = tfbus.TransformBroadcaster(bus, authority="arm")
    other = tfbus.TransformBroadcaster(bus, authority="other_arm")
    await bus.clock.sleep(0.25)
    with arm.owning("gripper_tool"):
        arm.send_static("flange", "gripper_tool", tfbus.Transform((0.0, 0.0, 0.1)))
        try:
            other.send_static("other_flange", "gripper_tool", tfbus.Transform())
        except tfbus.InvalidTransformError as error:
            print(f"refused ({error.reason}, owner {error.owner!r}): {error}")
        await bus.clock.sleep(2.0)
    # Here the tool has been put down: nobody knows where it is any more.
    for authority in ("localisation", "person"):
        tfbus.TransformBroadcaster(bus, authority).send("map", "odom", tfbus.Transform())
    await bus.clock.sleep(0.25)


async def main() -> None:
    clock = tfbus.SimulatedClock()
    with tfbus.Bus(clock) as bus:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(monitor, bus)
            tasks.start_soon(drive, bus)
            await simulate(clock, lambda: work(bus), limit=10.0)
            counted = bus.statistics()
            print(f"rejected: {dict(counted.rejected)}, conflicts: {counted.authority_conflicts}")
            tasks.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main)
