from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from queue import Queue
from uuid import uuid4

import anyio
import pytest
from support.processes import free_ports, new_domain, until
from support.samples import moving, static

from tfbus.links._carrier import SendReport
from tfbus.links._inbox import ReceivedBatch, ReceivedMessage
from tfbus.links._outbox import OutgoingBatch, RemovedFrame, Turn
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.zenoh._carrier import ZenohCarrier
from tfbus.links.zenoh._settings import settings

pytestmark = pytest.mark.anyio

ORIGIN = b"0123456789abcdef"


class End:
    """A carrier, the items that it has received, and the errors of what it could not send."""

    def __init__(self, prefix: str, address: str, listens: bool) -> None:
        config = settings(address if listens else [], None if listens else address, None, 2.0)
        self.carrier = ZenohCarrier(config, prefix, uuid4().hex)
        self.errors: list[Exception] = []
        self.report = SendReport(self.errors.append)
        self._items: Queue[Received] = Queue()

    def put(self, item: Received) -> None:
        self._items.put(item)

    async def next(self) -> ReceivedMessage | Presence:
        """The next item, read."""
        await until(lambda: not self._items.empty())
        content = self._items.get().content
        return content if isinstance(content, Presence) else self.carrier.read(content)


@asynccontextmanager
async def ends() -> AsyncIterator[tuple[End, End]]:
    """Two open carriers that run and know of each other."""
    prefix, address = f"tfbus/{new_domain()}", f"tcp/127.0.0.1:{free_ports(1)[0]}"
    both = End(prefix, address, listens=True), End(prefix, address, listens=False)
    async with anyio.create_task_group() as tasks:
        for end in both:
            await end.carrier.open(end.put, end.report)
            tasks.start_soon(end.carrier.run)
        for end in both:
            assert await end.next() is Presence.JOINED
        yield both
        tasks.cancel_scope.cancel()
    for end in both:
        await end.carrier.close()


def kept(name: str, x: float = 0.0) -> OutgoingBatch:
    return OutgoingBatch(ORIGIN, 1, (static("map", name, x),))


def frames(message: ReceivedMessage | Presence) -> list[str]:
    assert isinstance(message, ReceivedMessage)
    return [sample.child for entry in message.entries if isinstance(entry, ReceivedBatch) for sample in entry.samples]


async def test_the_entries_of_a_turn_go_out_as_one_numbered_message_and_are_counted() -> None:
    async with ends() as (here, there):
        batch = OutgoingBatch(ORIGIN, 7, (moving("map", "a", 1), moving("map", "b", 1)))
        here.carrier.send(Turn([batch, RemovedFrame(ORIGIN, 8, "c")], {}))
        message = await there.next()
        assert isinstance(message, ReceivedMessage)
        assert frames(message) == ["a", "b"]
        assert (message.number, message.entries[1]) == (1, RemovedFrame(ORIGIN, 8, "c"))
        assert (here.report.messages, here.report.samples, here.errors) == (1, 2, [])


async def test_static_frames_are_kept_as_messages_without_a_number_and_what_no_message_can_hold_is_not() -> None:
    async with ends() as (here, there):
        names = [f"{number}" for number in range(150)]
        bad = OutgoingBatch(ORIGIN, 1, (static("map", "bad", authority="\ud800"),))
        here.carrier.send(Turn([], {"bad": bad, **{name: kept(name) for name in names}}))
        found: set[str] = set()
        while len(found) < 150:
            message = await there.next()
            assert isinstance(message, ReceivedMessage)
            assert message.number == 0
            found.update(frames(message))
        assert found == set(names)
        assert here.report.messages == 0, "only live messages are counted"


async def test_a_peer_that_joins_again_has_what_it_keeps_delivered_again() -> None:
    async with ends() as (here, there):
        here.carrier.send(Turn([], {"lidar": kept("lidar")}))
        assert frames(await there.next()) == ["lidar"]
        there.carrier.peer_joined(here.carrier.id, again=False)
        here.carrier.send(Turn([], {"camera": kept("camera")}))
        assert frames(await there.next()) == ["camera"], "a new peer delivers by itself"
        there.carrier.peer_joined(here.carrier.id, again=True)
        assert {frames(await there.next())[0] for _ in range(2)} == {"lidar", "camera"}


async def test_failures_to_send_are_reported_and_never_raised() -> None:
    async with ends() as (here, _):
        long = OutgoingBatch(ORIGIN, 1, (moving("map", "a", 2**62),))
        here.carrier.send(Turn([long], {}))
        assert here.report.not_sent == {"stamp": 1}
        await here.carrier.close()
        here.carrier.send(Turn([OutgoingBatch(ORIGIN, 2, (moving("map", "a", 1),))], {}))
        assert here.report.messages == 0
        assert len(here.errors) == 2
