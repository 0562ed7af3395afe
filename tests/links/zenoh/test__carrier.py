import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from queue import Queue
from types import SimpleNamespace
from uuid import uuid4

import anyio
import anyio.from_thread
import pytest
import zenoh
from support.processes import PATIENCE, free_ports, new_domain, until
from support.samples import moving, static

from tfbus.links._carrier import SendReport
from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame
from tfbus.links._inbox import ReceivedBatch, ReceivedMessage
from tfbus.links._message import Message
from tfbus.links._outbox import Turn
from tfbus.links._receive_queue import Answer, Presence, Question, Received
from tfbus.links._state import StateStep
from tfbus.links.zenoh import _carrier, _closing
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


class Sessions:
    """Notes what a carrier has its sessions do."""

    def __init__(self, slowly: bool = False, broken: bool = False) -> None:
        self.filters: dict[str, set[str]] = {}
        self.served: list[dict[str, set[str]]] = []
        self.serve = self.served.append
        self.sent: list[Message] = []
        self.sent_slowly: list[Message] = []
        self.parts: list[tuple[str, Message]] = []
        self.is_heard_slowly = lambda: slowly
        self.closing: list[threading.Thread] = []
        self._broken = broken

    def open(self) -> None:
        pass

    def is_heard(self) -> bool:
        self._check()
        return True

    def put(self, message: Message) -> None:
        self._check()
        self.sent.append(message)

    def put_part(self, name: str, message: Message) -> None:
        self._check()
        self.parts.append((name, message))

    def put_slowly(self, messages: list[Message]) -> None:
        self._check()
        self.sent_slowly += messages

    def close(self) -> list[threading.Thread]:
        return self.closing

    def _check(self) -> None:
        if self._broken:
            raise zenoh.ZError("the session is closed")


async def alone(sessions: Sessions, monkeypatch: pytest.MonkeyPatch) -> End:
    """A carrier that is open, with sessions that a test gives."""
    monkeypatch.setattr(_carrier, "ZenohSessions", lambda *_: sessions)
    end = End(new_domain(), "tcp/127.0.0.1:0", listens=True)
    await end.carrier.open(end.put, end.report)
    return end


async def test_sessions_serve_other_filters_as_soon_as_there_are_others(monkeypatch: pytest.MonkeyPatch) -> None:
    sessions = Sessions()
    sessions.filters = {"near": {"a"}}
    carrier = (await alone(sessions, monkeypatch)).carrier
    for _ in range(2):
        carrier.claim(StateStep(0, 0, 0))
    assert sessions.served == [{"near": {"a"}}]
    assert [name for name, _ in sessions.parts] == ["near"] * 2
    sessions.filters = {}
    for _ in range(2):
        carrier.send(Turn([OutgoingBatch(ORIGIN, 1, (moving("map", "a", 1),))], {}))
    assert sessions.served == [{"near": {"a"}}, {}]
    assert len(sessions.parts) == 2, "nobody has a filter any more"


async def test_what_goes_to_a_filter_is_counted_as_a_message_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    sessions = Sessions()
    sessions.filters = {"near": {"a", "b"}, "far": {"z"}}
    end = await alone(sessions, monkeypatch)
    names = ("a", "b", "c")
    end.carrier.send(Turn([OutgoingBatch(ORIGIN, 1, tuple(moving("map", name, 1) for name in names))], {}))
    assert (len(sessions.sent), [name for name, _ in sessions.parts]) == (1, ["near"])
    assert (end.report.messages, end.report.samples) == (2, 5)


async def test_a_claim_behind_what_cannot_be_sent_is_no_live_message(monkeypatch: pytest.MonkeyPatch) -> None:
    end = await alone(sessions := Sessions(), monkeypatch)
    end.carrier.send(Turn([OutgoingBatch(ORIGIN, 1, (moving("map", "a", 2**62),))], {}, StateStep(0, 1, 99)))
    assert [message.number for message in sessions.sent] == [0]
    assert (end.report.messages, end.report.not_sent) == (0, {"stamp": 1})


async def test_a_session_that_fails_is_taken_for_one_that_is_heard_so_that_it_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    end = await alone(Sessions(broken=True), monkeypatch)
    end.carrier.send(Turn([OutgoingBatch(ORIGIN, 1, (moving("map", "a", 1),))], {}))
    assert ([type(error) for error in end.errors], end.report.messages) == ([zenoh.ZError], 0)


def two_periods(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Have the time pass at once until two periods have, and then end the task; returns the periods."""
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        if len(slept) == 2:
            raise TimeoutError
        slept.append(seconds)

    monkeypatch.setattr(anyio, "sleep", sleep)
    return slept


@pytest.mark.parametrize("heard", [True, False])
async def test_the_newest_samples_are_sent_slowly_once_if_anybody_hears_them(
    monkeypatch: pytest.MonkeyPatch, heard: bool
) -> None:
    end = await alone(sessions := Sessions(slowly=heard), monkeypatch)
    end.carrier.send(Turn([OutgoingBatch(ORIGIN, 1, (moving("map", "a", 1),))], {}, StateStep(2, 3, 98)))
    end.carrier.claim(StateStep(3, 5, 99))
    assert two_periods(monkeypatch) == []
    with pytest.raises(TimeoutError):
        await end.carrier._send_slowly()
    told = [end.carrier.read((message.payload, message.attachment)) for message in sessions.sent_slowly]
    assert [(frames(message), message.step) for message in told] == [(["a"], StateStep(5, 5, 99))] * heard


async def test_newest_samples_that_cannot_be_sent_are_reported_and_the_next_are_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    end = await alone(sessions := Sessions(slowly=True), monkeypatch)
    end.carrier.claim(StateStep(3, 5, 99))
    sessions._broken = True
    slept = two_periods(monkeypatch)
    with pytest.raises(TimeoutError):
        await end.carrier._send_slowly()
    assert [type(error) for error in end.errors] == [zenoh.ZError]
    assert slept == [1.0, 1.0]


@pytest.mark.parametrize("late", [True, False])
async def test_sessions_that_do_not_close_in_time_are_reported(monkeypatch: pytest.MonkeyPatch, late: bool) -> None:
    monkeypatch.setattr(_closing, "CLOSING_TIME", 0.01 if late else PATIENCE)
    end, may_close = await alone(sessions := Sessions(), monkeypatch), threading.Event()
    sessions.closing = [threading.Thread(target=may_close.wait)]
    sessions.closing[0].start()
    if not late:
        may_close.set()
    await end.carrier.close()
    assert [type(error) for error in end.errors] == [TimeoutError] * late
    may_close.set()


async def test_an_end_that_is_cancelled_while_it_opens_does_not_wait_for_zenoh(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    may_open, opened = threading.Event(), list[bool]()

    def open_slowly() -> None:
        anyio.from_thread.run_sync(scope.cancel)
        opened.append(may_open.wait(PATIENCE))

    monkeypatch.setattr(_carrier, "ZenohSessions", lambda *_: SimpleNamespace(open=open_slowly))
    end = End(new_domain(), "tcp/127.0.0.1:0", listens=True)
    with anyio.CancelScope() as scope:
        await end.carrier.open(end.put, end.report)
    assert (scope.cancelled_caught, opened) == (True, [])
    may_open.set()


async def test_failures_to_send_are_reported_and_never_raised() -> None:
    async with ends() as (here, _):
        long = OutgoingBatch(ORIGIN, 1, (moving("map", "a", 2**62),))
        here.carrier.send(Turn([long], {}))
        assert here.report.not_sent == {"stamp": 1}
        await here.carrier.close()
        here.carrier.send(Turn([OutgoingBatch(ORIGIN, 2, (moving("map", "a", 1),))], {}))
        assert here.report.messages == 0
        assert len(here.errors) == 2
