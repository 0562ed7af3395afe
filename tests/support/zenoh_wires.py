"""Wires over zenoh that tests listen at, and routers in processes of their own."""

import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

import anyio
from support.processes import Program, until

from tfbus.links.seams import Hearing, Joined, Left, WireItem
from tfbus.links.zenoh.wire import ZenohWire

LIVE = "live"
HEARS_ALL = (Hearing("*", LIVE),)


class Ear:
    """A wire with everything that has come by it."""

    def __init__(self, wire: ZenohWire) -> None:
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

    def receive(self, link: str, item: WireItem) -> None:
        self.items.append((link, item))


@asynccontextmanager
async def listening(
    domain: str, robot: str = "", *, hears: Sequence[Hearing] = HEARS_ALL, **options: Any
) -> AsyncIterator[Ear]:
    """A wire that is open, and closed at the end."""
    ear = Ear(wire := ZenohWire(domain, robot, **options))
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


async def talk(*ears: Ear) -> None:
    """Wait until each of them has a new message of each other one, published and sent."""
    for ear in ears:
        for other in ears:
            if ear is not other:
                await until_heard(ear, other)


async def until_heard(ear: Ear, other: Ear) -> None:
    before = len(ear.items)

    def heard() -> bool:
        other.wire.publish(LIVE, b"published")
        other.wire.send(ear.id, b"sent")
        news = ear.items[before:]
        return (other.id, b"published") in news and (other.id, b"sent") in news

    await until(heard)


_ROUTER = """
import sys, anyio
from tfbus.links.zenoh.zenoh_router import ZenohRouter
async def main(listen, *connect):
    async with ZenohRouter(listen, connect=connect, lease=1.0):
        print("ready", flush=True)
        await anyio.sleep_forever()
anyio.run(main, *sys.argv[1:])
"""


def start_router(listen: str, *connect: str) -> Program:
    """A router in a process of its own, with a lease of 1 s; use it as a context."""
    program = Program(sys.executable, "-c", _ROUTER, listen, *connect)
    program.output.expect("ready")
    return program
