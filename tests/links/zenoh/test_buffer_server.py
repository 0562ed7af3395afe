import json
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import anyio
import anyio.to_thread
import pytest
import zenoh
from support.asking import settle
from support.processes import PATIENCE, until
from support.samples import static

from tfbus import LATEST, Buffer, Bus, RemoteLookupError, TransformStamped
from tfbus.links._remote_lookup import Cancellation, RemoteQuestion, read_answer, write_question
from tfbus.links.zenoh import BufferClient, BufferServer, ZenohLink, buffer_server
from tfbus.links.zenoh._lookup_session import Failures
from tfbus.links.zenoh._settings import settings

pytestmark = pytest.mark.anyio


async def reason_of(client: BufferClient) -> str:
    with pytest.raises(RemoteLookupError) as refused:
        await client.lookup("map", "base")
    return refused.value.reason


async def test_more_lookups_than_may_wait_or_come_are_refused_and_counted(address: str, domain: str) -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        async with (
            BufferServer(buffer, domain, listen=address, capacity=2) as server,
            BufferServer(buffer, domain, robot="slow", connect=address, rate=1.0) as slow,
            BufferClient(domain, connect=address) as client,
            BufferClient(domain, robot="slow", connect=address) as patient,
            anyio.create_task_group() as tasks,
        ):
            for _ in range(2):
                tasks.start_soon(client.lookup, "map", "base")
            tasks.start_soon(patient.lookup, "map", "base")
            await until(lambda: server.statistics().waiting == 2 and slow.statistics().waiting == 1)
            assert await reason_of(client) == "busy"
            assert await reason_of(patient) == "busy"
            assert server.statistics().refused == slow.statistics().refused == {"busy": 1}
            # Those that wait have their answers all the same.
            bus.publish(static("map", "base"))
            await until(lambda: server.statistics().answered == 2 and slow.statistics().answered == 1)


async def test_what_is_no_question_is_refused_and_harms_nobody(address: str, domain: str) -> None:
    config = settings([], address, {"mode": "client"}, 2.0)
    with Bus() as bus, Buffer(bus) as buffer:
        async with BufferServer(buffer, domain, listen=address) as server:
            bus.publish(static("map", "base"))
            session = await anyio.to_thread.run_sync(zenoh.open, config)
            bad = [b"", b"garbage", b"{}", b"[" * 60_000, b"x" * 100_000, b'{"type": "Cancellation"}']

            def ask() -> list[Any]:
                replies = []
                for payload in bad:
                    replies += list(session.get(f"tfbus/{domain}/~/lookup", payload=payload, timeout=PATIENCE))
                return replies

            try:
                replies = await anyio.to_thread.run_sync(ask)
            finally:
                await anyio.to_thread.run_sync(session.close)
            assert len(replies) == len(bad)
            for reply in replies:
                error = read_answer(reply.ok.payload.to_bytes(), domain, None)
                assert isinstance(error, RemoteLookupError)
                assert error.reason == "malformed"
            assert server.statistics().refused == {"malformed": len(bad)}
            async with BufferClient(domain, connect=address) as client:
                assert (await client.lookup("map", "base")).static


HOSTILE: list[dict[str, Any]] = [
    *({name: int("9" * 401)} for name in ("timeout", "max_age", "tolerance", "max_gap", "hold", "at", "number")),
    {"max_gap": 2**64},
    {"max_gap": [[[[[]]]]]},
    {"target": "m" * 2_000},
    {"target": "\ud800"},
    {"type": [0] * 1_000},
]


async def test_no_question_ends_a_server_and_each_is_counted(address: str, domain: str) -> None:
    config = settings([], address, {"mode": "client"}, 2.0)
    question = RemoteQuestion("me", 1, "map", "base", LATEST).to_dict()
    bad = [json.dumps(question | change).encode() for change in HOSTILE]
    with Bus() as bus, Buffer(bus) as buffer:
        async with BufferServer(buffer, domain, listen=address) as server:
            bus.publish(static("map", "base"))
            session = await anyio.to_thread.run_sync(zenoh.open, config)
            try:
                for payload in bad:
                    found = await anyio.to_thread.run_sync(lookup_by_hand, session, domain, payload)
                    assert isinstance(found, RemoteLookupError)
                    assert found.reason == "malformed"
                # Also by an expression, whose answer goes to the asker all the same.
                healthy = write_question(RemoteQuestion("me", 2, "map", "base", LATEST))
                for key in (f"tfbus/{domain}/**", f"tfbus/{domain}/*/lookup", f"tfbus/{domain}/~/lookup?a=1;b"):
                    found = await anyio.to_thread.run_sync(lookup_by_hand, session, domain, healthy, key)
                    assert isinstance(found, TransformStamped)
            finally:
                await anyio.to_thread.run_sync(session.close)
            assert server.statistics().refused == {"malformed": len(bad)}


def lookup_by_hand(session: zenoh.Session, domain: str, payload: bytes, key: str = "") -> object:
    (reply,) = session.get(key or f"tfbus/{domain}/~/lookup", payload=payload, timeout=PATIENCE)
    assert reply.ok is not None
    return read_answer(reply.ok.payload.to_bytes(), domain, None)


class BrokenBuffer(Buffer):
    """A buffer of a user, with a bug for some frames: at once, or only when it is waited for."""

    def lookup_nowait(self, target: str, source: str, *args: Any, **options: Any) -> TransformStamped:
        if source == "bug":
            raise OverflowError("a bug")
        return super().lookup_nowait(target, source, *args, **options)

    async def lookup(self, target: str, source: str, *args: Any, **options: Any) -> TransformStamped:
        if source == "late bug":
            raise RecursionError("a bug")
        return await super().lookup(target, source, *args, **options)


@pytest.mark.every_loop
async def test_a_bug_of_a_buffer_fails_the_question_and_neither_the_server_nor_its_thread(
    address: str, domain: str, caplog: pytest.LogCaptureFixture
) -> None:
    with Bus() as bus, BrokenBuffer(bus) as buffer:
        bus.publish(static("map", "base"))
        async with BufferServer(buffer, domain, listen=address) as server, BufferClient(domain, connect=address) as one:
            for source in ("bug", "late bug", "bug"):
                with pytest.raises(RemoteLookupError, match=r"failed there with (Overflow|Recursion)Error") as failed:
                    await one.lookup("map", source)
                assert failed.value.reason == "internal"
                assert (await one.lookup("map", "base")).static
            counts = server.statistics()
            assert (counts.answered, counts.failed, counts.refused, counts.waiting) == (3, 0, {"internal": 3}, 0)
    told = [record.getMessage() for record in caplog.records]
    assert told == [
        "a lookup of another process failed with OverflowError",
        "a lookup of another process failed with RecursionError",
    ]


async def test_a_number_under_which_a_lookup_waits_is_refused_for_another_one(address: str, domain: str) -> None:
    config = settings([], address, {"mode": "client"}, 2.0)
    replies: list[Any] = []
    with Bus() as bus, Buffer(bus) as buffer:
        async with BufferServer(buffer, domain, listen=address) as server:
            session = await anyio.to_thread.run_sync(zenoh.open, config)
            try:
                for frame in ("base", "arm"):
                    question = RemoteQuestion("me", 1, "map", frame, LATEST, timeout=PATIENCE)
                    session.get(
                        f"tfbus/{domain}/~/lookup",
                        zenoh.handlers.Callback(replies.append, indirect=False),
                        payload=write_question(question),
                        timeout=PATIENCE,
                    )
                    await until(lambda: server.statistics().waiting == 1)
                await until(lambda: len(replies) == 1)
                bus.publish([static("map", "base", 2.0), static("map", "arm")])
                await until(lambda: len(replies) == 2)
            finally:
                await anyio.to_thread.run_sync(session.close)
            refused, answered = (read_answer(reply.ok.payload.to_bytes(), domain, None) for reply in replies)
            assert isinstance(refused, RemoteLookupError)
            assert refused.reason == "malformed"
            assert isinstance(answered, TransformStamped)
            assert answered.child == "base"
            assert server.statistics().refused == {"malformed": 1}


async def test_what_is_known_is_answered_while_the_event_loop_is_busy(address: str, domain: str) -> None:
    config = settings([], address, {"mode": "client"}, 2.0)
    question = RemoteQuestion("asker", 1, "map", "base", LATEST)
    with Bus() as bus, Buffer(bus) as buffer:
        async with BufferServer(buffer, domain, listen=address) as server:
            bus.publish(static("map", "base", 2.0))
            session = await anyio.to_thread.run_sync(zenoh.open, config)
            try:
                # Nothing is awaited here, so the event loop stands still until the answer has come.
                for asked, kind in ((question, TransformStamped), (replace(question, source_at=5), Exception)):
                    (reply,) = session.get(f"tfbus/{domain}/~/lookup", payload=write_question(asked), timeout=30.0)
                    assert reply.ok is not None
                    assert isinstance(read_answer(reply.ok.payload.to_bytes(), domain, None), kind)
            finally:
                await anyio.to_thread.run_sync(session.close)
            counts = server.statistics()
            assert (counts.answered, counts.failed, counts.waiting, counts.queue.dropped) == (1, 1, 0, 0)


class Session:
    """Notes what a server has its session's thread do; so many things wait for that thread."""

    domain, robot = "yard", None

    def __init__(self) -> None:
        self.failures = Failures()
        self.unsent = 0
        self.waiting: list[Callable[[], object]] = []
        self.replies: list[tuple[object, bytes]] = []

    def soon(self, do: Callable[[], object]) -> None:
        self.waiting.append(do)

    def reply(self, query: object, answer: bytes) -> None:
        self.replies.append((query, answer))


class Query:
    """A question as zenoh hands it over."""

    def __init__(self, question: RemoteQuestion | Cancellation | None = None) -> None:
        text = b"" if question is None else write_question(question)
        self.payload = SimpleNamespace(to_bytes=lambda: text)
        self.dropped = 0

    def drop(self) -> None:
        self.dropped += 1


def unopened(buffer: Buffer, **options: Any) -> tuple[Any, Session]:
    """A server that is not entered, and its session."""
    server, session = BufferServer(buffer, **options), Session()
    server._session = session  # type: ignore[assignment]
    return server, session


async def test_beyond_the_capacity_questions_and_answers_are_dropped_and_counted() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        server, session = unopened(buffer, capacity=3)
        for session.unsent, dropped in ((2, 0), (3, 1)):
            asked, answered = Query(), Query()
            server._receive(asked)
            server._answer(answered, static("map", "base"))
            assert (asked.dropped, answered.dropped) == (dropped, dropped)
            assert (len(session.waiting), len(session.replies)) == (1, 1)
        assert server.statistics().queue.dropped == 2
        session.unsent = 0
        server._received.extend(["gone"] * 3)
        server._receive(asked := Query())
        assert (asked.dropped, server.statistics().queue.dropped) == (1, 3), "what waits for the event loop counts too"


async def test_an_asker_ends_behind_its_questions_and_only_when_it_goes() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        server, session = unopened(buffer)
        server._note_asker("me", True)
        assert session.waiting == []
        server._receive(query := Query(RemoteQuestion("me", 1, "map", "base", LATEST)))
        server._note_asker("me", False)
        for do in session.waiting:
            do()
        assert list(server._received) == [(query, RemoteQuestion("me", 1, "map", "base", LATEST)), "me"]


async def test_an_asker_that_goes_ends_its_own_questions_only() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        server, session = unopened(buffer)
        queries = {(asker, number): Query() for asker in ("me", "other") for number in (1, 2)}
        async with anyio.create_task_group() as tasks:
            for (asker, number), query in queries.items():
                question = RemoteQuestion(asker, number, "map", "base", LATEST, timeout=PATIENCE)
                server._begin_to_wait(query, question, tasks)
            tasks.start_soon(server._take_all, tasks)
            for item, left in (("me", 2), ("nobody", 2), (Cancellation("other", 2), 1), (Cancellation("other", 3), 1)):
                server._received.append(item)
                server._came.set()
                await settle()
                assert server.statistics().waiting == left
            assert [query.dropped for query in queries.values()] == [1, 1, 0, 1]
            bus.publish(static("map", "base"))
            await settle()
            assert server.statistics().waiting == 0
            tasks.cancel_scope.cancel()
        assert [query for query, _ in session.replies] == [queries["other", 1]]
        counts = server.statistics()
        assert (counts.cancelled, counts.answered, counts.queue.pending) == (3, 1, 0)


async def test_what_waits_for_the_event_loop_ends_with_the_server(address: str, domain: str) -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        async with BufferServer(buffer, domain, listen=address) as server:
            await settle()
            # Nobody would answer it.
            server._received.append("me")
            assert server.statistics().queue.pending == 1
        assert server.statistics().queue.pending == 0


async def test_a_cancellation_needs_no_answer_and_a_question_that_is_cancelled_has_none() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        server, session = unopened(buffer)
        server._take(cancelling := Query(Cancellation("me", 1)))
        assert (cancelling.dropped, list(server._received)) == (1, [Cancellation("me", 1)])
        question = RemoteQuestion("me", 1, "map", "base", LATEST, timeout=PATIENCE)
        waiting, key = Query(question), ("me", 1)
        async with anyio.create_task_group() as tasks:
            server._begin_to_wait(waiting, question, tasks)
            await settle()
            assert server.statistics().waiting == 1
            server._cancel(key)
            server._cancel(key)
        assert (waiting.dropped, session.replies) == (1, [])
        counts = server.statistics()
        assert (counts.waiting, counts.cancelled, counts.answered, counts.failed) == (0, 1, 0, 0)


@pytest.mark.parametrize(("rate", "taken"), [(4.0, [4, 1, 0, 1, 3, 4]), (0.5, [1, 0, 0, 0, 0, 1])])
async def test_so_many_lookups_are_taken_in_a_second_and_at_once(
    rate: float, taken: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(buffer_server, "monotonic", lambda: now[0])
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish(static("map", "base"))
        server, session = unopened(buffer, rate=rate)
        monkeypatch.setattr(buffer_server, "reply_now", lambda *_: None)
        counts = [0]
        for now[0] in (100.0, 100.25, 100.375, 100.5, 101.25, 200.0):
            for number in range(10):
                server._take(Query(RemoteQuestion("me", number, "map", "base", LATEST)))
            counts.append(server.statistics().answered)
        assert [after - before for before, after in pairwise(counts)] == taken
        assert server.statistics().refused == {"busy": 60 - sum(taken)}
        error = read_answer(session.replies[0][1], "yard", None)
        assert isinstance(error, RemoteLookupError)
        assert error.reason == "busy"


async def test_what_makes_no_sense_is_refused_at_once(domain: str) -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        link = ZenohLink(bus, domain)
        for rate in (0.0, -1.0, math.nan):
            with pytest.raises(ValueError, match="rate"):
                BufferServer(buffer, rate=rate)
        with pytest.raises(ValueError, match="capacity"):
            BufferServer(buffer, capacity=0)
        with pytest.raises(ValueError, match="robot"):
            BufferServer(buffer, robot="a/b")
        with pytest.raises(TypeError, match="those of the link"):
            BufferServer(buffer, "other", link=link)
        with pytest.raises(RuntimeError, match="not entered"):
            async with BufferServer(buffer, link=link):
                raise AssertionError("it has no session")


async def test_a_server_is_entered_once_and_an_address_in_use_is_an_os_error(address: str, domain: str) -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        async with BufferServer(buffer, domain, listen=address) as server:
            with pytest.raises(RuntimeError, match="entered once"):
                await server.__aenter__()
            with pytest.raises(OSError, match="cannot open a session"):
                async with BufferServer(buffer, domain, listen=address):
                    raise AssertionError("it has opened")
