"""Our side of tests against a real ROS, in which each side needs the frames of the other."""

import time

from tfbus import Buffer, Bus, Transform, TransformBroadcaster
from tfbus.geometry.stamped import Batch


def seconds(stamp: int) -> float:
    """The time of the day, or so: between two samples the answer is exact, however late the second one is."""
    return stamp % 10**14 / 1e9


class Program:
    """Our side: it broadcasts ``base:arm``, x = 2 t, and the static ``arm:tool``, and asks for ``odom:tool``."""

    def __init__(self, bus: Bus, buffer: Buffer) -> None:
        self.bus = bus
        self.buffer = buffer
        self.latencies: list[float] = []
        self.authorities: set[str] = set()
        self.answered = self.failed = self.wrong = 0
        bus.subscribe(self._hear)
        self._broadcaster = TransformBroadcaster(bus, authority="here")
        self._broadcaster.send_static("arm", "tool", Transform((0.1, 0.0, 0.0)))

    def _hear(self, batch: Batch) -> None:
        for sample in batch:
            if sample.child in ("base", "laser"):
                self.authorities.add(sample.authority)
                if not sample.static:
                    self.latencies.append((time.time_ns() - sample.stamp) / 1e6)

    async def send(self) -> None:
        async for _ in self.bus.clock.ticks(100.0):
            stamp = time.time_ns()
            self._broadcaster.send("base", "arm", Transform((2 * seconds(stamp), 0.0, 0.0)), at=stamp)

    async def ask(self) -> None:
        """Wait for the transform of the present, again and again."""
        async for _ in self.bus.clock.ticks(100.0):
            stamp = time.time_ns()
            try:
                found = await self.buffer.lookup("odom", "tool", stamp, timeout=1.0)
            except TimeoutError:
                self.failed += 1
                continue
            self.answered += 1
            self.wrong += abs(found.transform.translation[0] - (3 * seconds(stamp) + 0.1)) > 1e-6
