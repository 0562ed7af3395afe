"""A robot whose clock is 0.3 s ahead: a dashboard is told of it, and its answers are 0.3 m off, or corrected.

The robot drives along x with 1 m/s and stamps its frame by its own clock. Two dashboards hear it over a router, one as
it is, and one with ``correct_clocks=True``. Both compare their answers with the place where the robot was.

Run it with `python demos/clocks.py`; it needs the extra `zenoh`, and takes some seconds.
"""

import socket

import anyio

import tfbus
from tfbus.links.zenoh import ZenohLink

AHEAD = 0.3
SPEED = 1.0


class ClockAhead(tfbus.SystemClock):
    """The clock of a robot that nobody has synchronised."""

    def now(self) -> int:
        return super().now() + tfbus.from_seconds(AHEAD)


async def drive(address: str, began: int) -> None:
    """Be the robot."""
    bus = tfbus.Bus(ClockAhead())
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async with ZenohLink(bus, connect=address):
        async for _ in bus.clock.ticks(50.0):
            x = SPEED * tfbus.to_seconds(tfbus.SystemClock().now() - began)
            odometry.send("odom", "base_link", tfbus.Transform((x, 0.0, 0.0)))


async def look(address: str, began: int, *, correct_clocks: bool) -> None:
    """Be a dashboard: wait until the clock is measured, and ask where the robot was half a second ago."""
    with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer, bus.events() as events:
        async with ZenohLink(bus, connect=address, correct_clocks=correct_clocks) as link:
            async for event in events:
                if isinstance(event, tfbus.ClockOffset):
                    break
            await anyio.sleep(1.5)
            at = bus.clock.now() - tfbus.SECOND // 2
            answer = await buffer.lookup("odom", "base_link", at, timeout=5.0)
            error = answer.transform.translation[0] - SPEED * tfbus.to_seconds(at - began)
            (clock,) = (clock for clock in link.statistics().clocks if "odometry" in clock.authorities)
            assert clock.offset is not None
            how = "corrected" if correct_clocks else "as it is"
            print(f"{how}: the clock of 'odometry' is {clock.offset:.2f} s ahead, the answer is {abs(error):.2f} m off")


async def main() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    began = tfbus.SystemClock().now()
    async with ZenohLink(tfbus.Bus(), listen=address), anyio.create_task_group() as tasks:
        tasks.start_soon(drive, address, began)
        await look(address, began, correct_clocks=False)
        await look(address, began, correct_clocks=True)
        tasks.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main)
