"""Wires over zenoh that tests listen at, and routers in processes of their own."""

import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Any

import anyio
from anyio.abc import SocketStream
from support.processes import Program, free_address, until
from support.wires import HEARS_ALL, LIVE, Ear, running

from tfbus.links.seams import Hearing
from tfbus.links.zenoh.wire import ZenohWire


@asynccontextmanager
async def listening(
    domain: str, robot: str = "", *, hears: Sequence[Hearing] = HEARS_ALL, **options: Any
) -> AsyncIterator[Ear]:
    """A wire over zenoh that is open, and closed at the end."""
    async with running(ZenohWire(domain, robot, **options), hears) as ear:
        yield ear


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


class Way:
    """Passes on what goes between a router that connects to an address, and the router behind it."""

    def __init__(self, to: str) -> None:
        self.address = free_address()
        self.open: list[tuple[SocketStream, SocketStream]] = []
        self._to = to

    async def run(self) -> None:
        (_, port), (_, behind) = (address.removeprefix("tcp/").split(":") for address in (self.address, self._to))

        async def take(near: SocketStream) -> None:
            with suppress(OSError):
                async with near, await anyio.connect_tcp("127.0.0.1", int(behind)) as far:
                    ends = near, far
                    self.open.append(ends)
                    async with anyio.create_task_group() as tasks:
                        tasks.start_soon(pass_on, ends, near, far)
                        tasks.start_soon(pass_on, ends, far, near)

        async def pass_on(ends: tuple[SocketStream, SocketStream], one: SocketStream, other: SocketStream) -> None:
            with suppress(anyio.EndOfStream, anyio.BrokenResourceError, anyio.ClosedResourceError):
                async for data in one:
                    await other.send(data)
            if ends in self.open:
                self.open.remove(ends)
                await other.aclose()

        listener = await anyio.create_tcp_listener(local_host="127.0.0.1", local_port=int(port))
        async with listener:
            await listener.serve(take)

    async def cut(self, *, far_only: bool = False) -> None:
        """End all connections, or let only the router behind the address notice."""
        ended, self.open = self.open, []
        for near, far in ended:
            await far.aclose()
            if not far_only:
                await near.aclose()


@asynccontextmanager
async def way_to(address: str) -> AsyncIterator[Way]:
    """A way on which a program is to connect to an address."""
    way = Way(address)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(way.run)
        yield way
        tasks.cancel_scope.cancel()


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
    program = Program(sys.executable, "-P", "-c", _ROUTER, listen, *connect)
    program.output.expect("ready")
    return program
