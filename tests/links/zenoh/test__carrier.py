from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from queue import Queue
from typing import Any, ClassVar, cast
from uuid import uuid4

import anyio
import pytest
from support.processes import free_ports, new_domain, until
from support.samples import moving, static

from tfbus.links._carrier import SendReport
from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame
from tfbus.links._inbox import ReceivedBatch, ReceivedMessage
from tfbus.links._outbox import Turn
from tfbus.links._part_writer import PartWriter
from tfbus.links._receive_queue import Answer, Presence, Question, Received
from tfbus.links._state import StateStep
from tfbus.links.zenoh._carrier import ZenohCarrier
from tfbus.links.zenoh._keys import Keys
from tfbus.links.zenoh._settings import patch_settings, settings

pytestmark = pytest.mark.anyio

ORIGIN = b"0123456789abcdef"


class End:
    """A carrier, the items that it has received, and the errors of what it could not send."""

    def __init__(self, domain: str, address: str, listens: bool) -> None:
        config = settings(address if listens else [], None if listens else address, None, 2.0)
        self.carrier = ZenohCarrier(config, lambda where: patch_settings(where, None, 2.0), Keys(domain, uuid4().hex))
        self.errors: list[Exception] = []
        self.report = SendReport(self.errors.append)
        self._items: Queue[Received] = Queue()

    def put(self, item: Received) -> None:
        self._items.put(item)

    async def next(self) -> ReceivedMessage | Presence | Question | Answer:
        """The content of the next item, read if it is a message."""
        await until(lambda: not self._items.empty())
        content = self._items.get().content
        return content if isinstance(content, Presence | Question | Answer) else self.carrier.read(content)


@asynccontextmanager
async def ends() -> AsyncIterator[tuple[End, End]]:
    """Two open carriers that run and know of each other."""
    domain, address = new_domain(), f"tcp/127.0.0.1:{free_ports(1)[0]}"
    both = End(domain, address, listens=True), End(domain, address, listens=False)
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


def frames(message: object) -> list[str]:
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


async def test_a_question_is_answered_with_entries_and_a_step_and_claims_go_to_all() -> None:
    async with ends() as (here, there):
        there.carrier.ask(here.carrier.id, 5)
        question = await here.next()
        assert isinstance(question, Question)
        assert question.since == 5
        told = here.carrier.write_answer([kept("lidar"), MovingFrame("base")], StateStep(5, 7, 99))
        here.carrier.answer(question, told)
        answer = await there.next()
        assert isinstance(answer, Answer)
        message = there.carrier.read(answer.message)
        assert (frames(message), message.entries[1:]) == (["lidar"], [MovingFrame("base")])
        assert (message.number, message.step) == (0, StateStep(5, 7, 99))
        here.carrier.claim(StateStep(7, 7, 99))
        claim = await there.next()
        assert isinstance(claim, ReceivedMessage)
        assert (claim.entries, claim.number, claim.step) == ([], 0, StateStep(7, 7, 99))
        assert here.report.messages == 0, "only live messages are counted"


async def test_a_question_that_nobody_answers_ends_without_an_answer() -> None:
    async with ends() as (here, there):
        there.carrier.ask(uuid4().hex, 0)
        answer = await there.next()
        assert answer == Answer(None)
        await there.carrier.close()
        there.carrier.ask(here.carrier.id, 0)
        assert await there.next() == Answer(None)


async def test_an_answer_that_one_message_cannot_hold_is_refused() -> None:
    async with ends() as (here, there):
        there.carrier.ask(here.carrier.id, 0)
        question = await here.next()
        assert isinstance(question, Question)
        long = OutgoingBatch(ORIGIN, 1, [static("map", "a")] * 100_000)
        with pytest.raises(ValueError, match="more than"):
            here.carrier.write_answer([long], StateStep(0, 1, 0))
        here.carrier.answer(question, here.carrier.write_answer([], StateStep(0, 0, 0)))
        assert isinstance(await there.next(), Answer)


async def test_nothing_is_written_while_nobody_hears_it_and_whoever_comes_back_sees_a_gap() -> None:
    async with ends() as (here, there):
        unsendable = OutgoingBatch(ORIGIN, 1, (moving("map", "a", 2**62),))
        here.carrier.send(Turn([OutgoingBatch(ORIGIN, 1, (moving("map", "a", 1),))], {}))
        message = await there.next()
        assert isinstance(message, ReceivedMessage)
        await there.carrier.close()
        await until(lambda: not here.carrier._sessions.is_heard())
        here.carrier.send(Turn([unsendable], {}))
        assert (here.report.messages, here.report.not_sent, here.errors) == (1, {}, [])
        assert here.carrier._writer.write([RemovedFrame(ORIGIN, 8, "c")])[0].number == message.number + 2


def test_sessions_serve_other_filters_as_soon_as_there_are_others() -> None:
    class Sessions:
        filters: ClassVar[dict[str, set[str]]] = {}
        served: ClassVar[list[dict[str, set[str]]]] = []
        serve = served.append

    carrier = End(new_domain(), "tcp/127.0.0.1:0", listens=True).carrier
    carrier._sessions = cast(Any, Sessions)
    carrier._parts = PartWriter(SendReport(print))
    carrier._filters = Sessions.filters
    for filters in ({"near": {"a"}}, {}):
        Sessions.filters = filters
        carrier._serve_filters()
        carrier._serve_filters()
    assert Sessions.served == [{"near": {"a"}}, {}]


@pytest.mark.parametrize(("heard", "sent"), [(True, 1), (False, 0)])
async def test_the_newest_samples_are_sent_slowly_once_if_anybody_hears_them(
    monkeypatch: pytest.MonkeyPatch, heard: bool, sent: int
) -> None:
    class Sessions:
        put: ClassVar[list[object]] = []
        is_heard_slowly = staticmethod(lambda: heard)
        put_slowly = put.extend

    carrier = End(new_domain(), "tcp/127.0.0.1:0", listens=True).carrier
    carrier._sessions = cast(Any, Sessions)
    carrier._newest.claim(StateStep(3, 5, 99))
    periods = iter(range(3))

    async def sleep(_: float) -> None:
        if next(periods) == 2:
            raise TimeoutError

    monkeypatch.setattr(anyio, "sleep", sleep)
    with pytest.raises(TimeoutError):
        await carrier._send_slowly()
    assert len(Sessions.put) == sent


async def test_failures_to_send_are_reported_and_never_raised() -> None:
    async with ends() as (here, _):
        long = OutgoingBatch(ORIGIN, 1, (moving("map", "a", 2**62),))
        here.carrier.send(Turn([long], {}))
        assert here.report.not_sent == {"stamp": 1}
        await here.carrier.close()
        here.carrier.send(Turn([OutgoingBatch(ORIGIN, 2, (moving("map", "a", 1),))], {}))
        assert here.report.messages == 0
        assert len(here.errors) == 2
