"""A network in memory for links of tfbus: it delivers at once, or loses, cuts and freezes as a test wants it."""

import os
from collections.abc import Callable, Sequence

import anyio

from tfbus.links.seams import Hearing, Joined, Left, Receive, first_match


class MemoryNetwork:
    """Knows all wires that are open."""

    def __init__(self) -> None:
        self.wires: dict[str, MemoryWire] = {}
        self.cut: set[tuple[str, str]] = set()
        self.stopped: dict[str, list[Callable[[], object]]] = {}
        self.lose: Callable[[str, str, bytes], bool] = lambda *_: False

    def wire(self, robot: str = "") -> "MemoryWire":
        return MemoryWire(self, robot)

    def stop(self, link: str) -> None:
        """Freeze a process: what comes waits, up to a hundred messages."""
        self.stopped[link] = []

    def go_on(self, link: str) -> None:
        for deliver in self.stopped.pop(link):
            deliver()

    def heal(self) -> None:
        self.cut.clear()
        for one in self.wires.values():
            for other in self.wires.values():
                if one is not other:
                    one.meet(other)

    def kill(self, link: str) -> None:
        """End a process without a word."""
        del self.wires[link]
        for other in self.wires.values():
            other.part(link)

    def carry(self, sender: str, link: str, message: bytes) -> bool:
        if link not in self.wires or (sender, link) in self.cut or self.lose(sender, link, message):
            return False
        receive = self.wires[link].receive
        if link in self.stopped:
            waiting = self.stopped[link]
            if len(waiting) < 100:
                waiting.append(lambda: receive(sender, message))
        else:
            receive(sender, message)
        return True


class MemoryWire:
    """See `tfbus.links.seams.Wire`."""

    receive: Receive
    rest = 2.0

    def __init__(self, network: MemoryNetwork, robot: str) -> None:
        self.id = os.urandom(16).hex()
        self._network = network
        self.robot = robot
        self.met: set[str] = set()
        self._hears: Sequence[Hearing] = ()

    async def open(
        self,
        hears: Sequence[Hearing],
        receive: Receive,
        warn: Callable[[Exception], object],  # noqa: ARG002 - a network in memory has nothing to warn of
    ) -> None:
        self._hears, self.receive = hears, receive
        self._network.wires[self.id] = self
        for other in list(self._network.wires.values()):
            if other is not self:
                self.meet(other)
                other.meet(self)

    async def run(self) -> None:
        await anyio.sleep_forever()

    async def close(self) -> None:
        if self.id in self._network.wires:
            self._network.kill(self.id)

    def channel_of(self, robot: str) -> str | None:
        hearing = first_match(self._hears, robot)
        return hearing and hearing.channel

    def meet(self, other: "MemoryWire") -> None:
        is_new = self.channel_of(other.robot) is not None and other.id not in self.met
        if is_new and (other.id, self.id) not in self._network.cut:
            self.met.add(other.id)
            self.receive(other.id, Joined(other.robot))

    def part(self, other: str) -> None:
        if other in self.met:
            self.met.remove(other)
            self.receive(other, Left())

    def is_heard(self, channel: str) -> bool:
        return any(other.channel_of(self.robot) == channel for other in self._others())

    def is_behind(self) -> bool:
        return False

    def publish(self, channel: str, message: bytes) -> None:
        for other in self._others():
            if other.channel_of(self.robot) == channel and self.id in other.met:
                self._network.carry(self.id, other.id, message)

    def send(self, link: str, message: bytes) -> bool:
        return self._network.carry(self.id, link, message)

    def _others(self) -> list["MemoryWire"]:
        return [wire for wire in self._network.wires.values() if wire is not self]
