"""Wires that tests listen at."""

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

import anyio
from support.processes import until

from tfbus.links.seams import Hearing, Joined, Left, Wire, WireItem
from tfbus.tf_message import MalformedMessageError

LIVE = "all"
HEARS_ALL = (Hearing("*", LIVE),)


class Ear:
    """A wire with everything that has come by it."""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        self.id = wire.id
        self.items: list[tuple[str, WireItem]] = []
        self.warnings: list[Exception] = []

    @property
    def present(self) -> dict[str, str]:
        """The robot of each link that is there."""
        found: dict[str, str] = {}
        for link, item in list(self.items):
            if isinstance(item, Joined):
                assert link not in found, "it has not left"
                found[link] = item.robot
            elif isinstance(item, Left):
                del found[link]
        return found

    @property
    def messages(self) -> list[tuple[str, bytes]]:
        return [(link, item) for link, item in list(self.items) if isinstance(item, bytes)]

    def of(self, other: "Ear") -> list[WireItem]:
        """All items of another one."""
        return [item for link, item in list(self.items) if link == other.id]

    def said(self, link: str) -> list[bytes]:
        """The messages of a link."""
        return [message for sender, message in self.messages if sender == link]

    def refused(self, link: str) -> list[str]:
        """The reasons for which messages of a link were refused."""
        items = [item for sender, item in list(self.items) if sender == link]
        return [item.reason for item in items if isinstance(item, MalformedMessageError)]

    def receive(self, link: str, item: WireItem) -> None:
        self.items.append((link, item))

    async def joined(self, link: str) -> None:
        await until(lambda: link in self.present)

    async def left(self, link: str) -> None:
        await until(lambda: (link, Left()) in self.items and link not in self.present)


@asynccontextmanager
async def running(wire: Wire, hears: Sequence[Hearing] = HEARS_ALL) -> AsyncIterator[Ear]:
    """Use a wire as a link does."""
    ear = Ear(wire)
    try:
        await wire.open(hears, ear.receive, ear.warnings.append)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wire.run)
            yield ear
            tasks.cancel_scope.cancel()
    finally:
        await wire.close()


async def met(*ears: Ear) -> None:
    """Wait until all of them are present to each other."""
    for ear in ears:
        others = {other.id for other in ears} - {ear.id}
        await until(lambda ear=ear, others=others: others <= set(ear.present))  # type: ignore[misc]
