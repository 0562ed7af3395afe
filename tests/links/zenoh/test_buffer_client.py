import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import islice
from typing import Any

import anyio
import anyio.to_thread
import pytest
import zenoh
from support.asking import settle
from support.processes import until
from support.samples import moving, static

from tfbus import (
    LATEST,
    Buffer,
    Bus,
    DisconnectedError,
    FutureExtrapolationError,
    Hold,
    LookupTimeoutError,
    PastExtrapolationError,
    RecordingError,
    RemoteLookupError,
    TransformStamped,
    UnknownFrameError,
)
from tfbus.links._remote_lookup import Cancellation, read_question, write_answer
from tfbus.links.zenoh import BufferClient, BufferServer, ZenohLink, buffer_client
from tfbus.links.zenoh._lookup_session import LookupSession
from tfbus.links.zenoh._settings import settings
from tfbus.links.zenoh.buffer_client import PATIENCE
from tfbus.links.zenoh.buffer_server import LONGEST_WAIT

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def asked(address: str, domain: str, **options: Any) -> AsyncIterator[tuple[Bus, BufferServer, BufferClient]]:
    """A bus whose buffer is served, its server, and a client that has met it."""
    with Bus(max_ahead=None) as bus, Buffer(bus, keep=None) as buffer:
        async with (
            BufferServer(buffer, domain, robot="r1", listen=address, **options) as server,
            BufferClient(domain, robot="r1", connect=address) as client,
        ):
            yield bus, server, client


@pytest.mark.every_loop
async def test_a_lookup_is_answered_at_once_or_waits_there_until_it_can_be(address: str, domain: str) -> None:
    async with asked(address, domain) as (bus, server, client):
        bus.publish([static("base", "lidar", x=2.0), moving("map", "base", 5, x=1.0), moving("map", "base", 9, x=5.0)])
        found = await client.lookup("map", "lidar")
        assert (found.parent, found.child, found.stamp, found.transform.translation) == ("map", "lidar", 9, (7, 0, 0))
        assert (await client.lookup("map", "base", 6)).transform.translation == (2, 0, 0)
        held = await client.lookup("map", "base", 12, extrapolate=Hold(1.0))
        assert (held.transform.translation, held.extrapolated_by) == ((5, 0, 0), 3)
        travelled = await client.lookup("base", "base", 9, source_at=5, fixed="map")
        assert travelled.transform.translation == (-4, 0, 0)
        answers = []

        async def wait() -> None:
            answers.append(await client.lookup("map", "base", 20))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait)
            await until(lambda: server.statistics().waiting == 1)
            bus.publish(moving("map", "base", 20, x=8.0))
        assert answers[0].transform.translation == (8, 0, 0)
        counts = server.statistics()
        assert (counts.waiting, counts.answered, counts.failed, counts.cancelled, counts.refused) == (0, 5, 0, 0, {})


async def test_each_error_is_that_of_the_other_buffer_with_its_facts(address: str, domain: str) -> None:
    async with asked(address, domain) as (bus, server, client):
        bus.publish([moving("map", "base", 5, authority="odometry"), moving("world", "other", 5)])
        with pytest.raises(PastExtrapolationError) as past:
            await client.lookup("map", "base", 4)
        assert (past.value.child, past.value.stamp, past.value.oldest) == ("base", 4, 5)
        assert past.value.authority == "odometry"
        with pytest.raises(LookupTimeoutError) as late:
            await client.lookup("map", "base", 6, timeout=0.0)
        assert (late.value.timeout, late.value.target, late.value.source) == (0.0, "map", "base")
        assert isinstance(late.value.__cause__, FutureExtrapolationError)
        assert late.value.__cause__.newest == 5
        for source, kind in (("bse", UnknownFrameError), ("other", DisconnectedError)):
            with pytest.raises(LookupTimeoutError) as missing:
                await client.lookup("map", source, timeout=0.0)
            assert isinstance(missing.value.__cause__, kind)
        with pytest.raises(TypeError, match="fixed"):
            await client.lookup("map", "base", source_at=3)
        with pytest.raises(TypeError, match="from_seconds"):
            await client.lookup("map", "base", 1.5)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="timeout"):
            await client.lookup("map", "base", timeout=-1.0)
        assert server.statistics().failed == 5


async def test_the_end_of_an_asker_ends_its_waiters_there(address: str, domain: str) -> None:
    async with asked(address, domain) as (_bus, server, client):
        async with anyio.create_task_group() as tasks:
            for _ in range(3):
                tasks.start_soon(client.lookup, "map", "base")
            await until(lambda: server.statistics().waiting == 3)
            tasks.cancel_scope.cancel()
        await until(lambda: server.statistics().waiting == 0)
        assert server.statistics().cancelled == 3
        async with anyio.create_task_group() as tasks:
            async with BufferClient(domain, robot="r1", connect=address) as other:

                async def fail() -> None:
                    with pytest.raises(RemoteLookupError):
                        await other.lookup("map", "base")

                tasks.start_soon(fail)
                await until(lambda: server.statistics().waiting == 1)
            await until(lambda: server.statistics().cancelled == 4)


async def test_a_server_that_goes_ends_the_lookups_and_one_that_never_was_is_told_of(address: str, domain: str) -> None:
    reasons = []
    with Bus() as bus, Buffer(bus) as buffer:
        async with (
            ZenohLink(bus, domain, listen=address, robot="r1") as link,
            BufferClient(domain, robot="r1", connect=address) as client,
            BufferClient(domain, connect=address) as nobody,
        ):
            with pytest.raises(RemoteLookupError) as absent:
                await nobody.lookup("map", "base", timeout=0.2)
            assert (absent.value.reason, absent.value.domain, absent.value.robot) == ("absent", domain, None)
            # What makes no sense is refused before anybody is asked.
            with pytest.raises(ValueError, match="max_gap"):
                await nobody.lookup("map", "base", timeout=0.2, max_gap=-1.0)

            async def ask() -> None:
                with pytest.raises(RemoteLookupError) as lost:
                    await client.lookup("map", "base")
                reasons.append(lost.value.reason)

            async with anyio.create_task_group() as tasks, BufferServer(buffer, robot="r1", link=link) as server:
                tasks.start_soon(ask)
                await until(lambda: server.statistics().waiting == 1)
            assert reasons == ["lost"]
            assert not link._zenoh_session().is_closed(), "it is the link's"


async def test_a_client_has_a_bound_and_is_entered_once(address: str, domain: str) -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        async with (
            BufferServer(buffer, domain, listen=address) as server,
            ZenohLink(bus, domain, connect=address) as link,
        ):
            client = BufferClient(link=link, capacity=1)
            with pytest.raises(RuntimeError, match="not entered"):
                await client.lookup("map", "base", timeout=0.0)
            async with client, anyio.create_task_group() as tasks:
                tasks.start_soon(client.lookup, "map", "base", LATEST)
                await until(lambda: server.statistics().waiting == 1)
                with pytest.raises(RuntimeError, match="1 lookups wait"):
                    await client.lookup("map", "base")
                tasks.cancel_scope.cancel()
            with pytest.raises(RuntimeError, match="not entered"):
                await client.lookup("map", "base")
            with pytest.raises(RuntimeError, match="entered once"):
                await client.__aenter__()
    with pytest.raises(ValueError, match="capacity"):
        BufferClient(domain, capacity=0)
    with Bus() as bus, pytest.raises(RuntimeError, match="not entered"):
        async with BufferClient(link=ZenohLink(bus, domain)):
            raise AssertionError("it has no session")


SHORT = FutureExtrapolationError(child="base", stamp=9, oldest=1, newest=5, authority="odometry")
FOUND = moving("map", "base", 7)
MISSING = UnknownFrameError(frame="base", known=("map",))
LATE = LookupTimeoutError(target="map", source="base", timeout=LONGEST_WAIT, missing=MISSING)
LATE.__cause__ = MISSING


def deep(depth: int) -> bytes:
    error = LATE.to_dict()
    for _ in range(depth):
        error = LATE.to_dict() | {"cause": error}
    return json.dumps(error).encode()


def of_digits(digits: int) -> bytes:
    return write_answer(SHORT).replace(b'"newest": 5', b'"newest": ' + b"9" * digits)


@pytest.mark.parametrize(
    "answer",
    [
        pytest.param(write_answer(static("map", "arm")), id="other frames"),
        pytest.param(write_answer(moving("map", "base", 4)), id="another stamp"),
        pytest.param(of_digits(20), id="20 digits"),
        pytest.param(of_digits(401), id="401 digits"),
        pytest.param(of_digits(5_000), id="5,000 digits"),
        pytest.param(deep(240), id="deep"),
        pytest.param(b'{"type": "TransformStamped"', id="cut off"),
        pytest.param(b'{"type": [], "message": ""}', id="no type"),
        pytest.param(write_answer(RecordingError("cut off", path="/", reason="damaged")), id="foreign error"),
    ],
)
async def test_whatever_a_server_answers_a_lookup_has_its_answer_or_a_remote_lookup_error(
    answer: bytes, address: str, domain: str
) -> None:
    answers = [answer, write_answer(moving("map", "base", 5))]

    def reply(query: zenoh.Query) -> None:
        if query.payload is not None and isinstance(read_question(query.payload.to_bytes()), Cancellation):
            return
        query.reply(query.key_expr, answers.pop(0))

    rogue = await anyio.to_thread.run_sync(zenoh.open, settings(address, None, None, 2.0))
    try:
        keep = [
            rogue.declare_queryable(f"tfbus/{domain}/~/lookup", zenoh.handlers.Callback(reply, indirect=False)),
            rogue.liveliness().declare_token(f"tfbus/{domain}/~/@lookup/{0:032x}"),
        ]
        async with BufferClient(domain, connect=address) as client:
            with pytest.raises(RemoteLookupError) as refused:
                await client.lookup("map", "base", 5)
            assert refused.value.reason == "malformed"
            assert len(str(refused.value)) < 500
            assert await client.lookup("map", "base", 5) == moving("map", "base", 5)
        del keep
    finally:
        await anyio.to_thread.run_sync(rogue.close)


class Session:
    """Answers the questions of a client by what a test gives, in a time that passes only while they wait.

    None is the end of a question without an answer. The questions behind the last answer stay open.
    """

    domain, robot, is_closed = "yard", None, False

    def __init__(self, answers: list[TransformStamped | Exception | None]) -> None:
        self.now = 100.0
        self.unsent = 0
        self.asked: list[float] = []
        self.cancelled: list[int] = []
        self._answers = iter(answers)

    def ask(self, payload: bytes, take: Callable[[bytes | None], object], timeout: float, to_all: bool = False) -> None:
        question = read_question(payload)
        assert to_all is isinstance(question, Cancellation), "nobody knows who of them has the question"
        if isinstance(question, Cancellation):
            self.cancelled.append(question.number)
            return
        assert question.timeout is not None
        assert timeout > question.timeout + buffer_client.PATIENCE, "zenoh must not give up before the client does"
        self.asked.append(question.timeout)
        for answer in islice(self._answers, 1):
            if isinstance(answer, LookupTimeoutError):
                self.now += question.timeout
            take(None if answer is None else write_answer(answer))

    async def close(self) -> None:
        pass


def met(session: Session, monkeypatch: pytest.MonkeyPatch, **options: Any) -> BufferClient:
    """A client of a session that has met a server."""
    monkeypatch.setattr(buffer_client, "monotonic", lambda: session.now)
    monkeypatch.setattr(buffer_client, "_SETTLING", 0.001)
    client = BufferClient(**options)
    client._session = session  # type: ignore[assignment]
    client._waker.bind()
    client._is_open = True
    client._note_server("server", True)
    client._handle_arrived()
    return client


@pytest.mark.parametrize(
    ("timeout", "answers", "asked"),
    [
        (0.0, [LATE], [0.0]),
        (LONGEST_WAIT, [LATE], [LONGEST_WAIT]),
        (LONGEST_WAIT + 2.0, [LATE, LATE], [LONGEST_WAIT, 2.0]),
        (2 * LONGEST_WAIT + 2.0, [LATE, LATE, FOUND], [LONGEST_WAIT, LONGEST_WAIT, 2.0]),
        (None, [LATE, LATE, LATE, FOUND], [LONGEST_WAIT] * 4),
    ],
)
async def test_a_long_wait_is_asked_for_in_parts(
    timeout: float | None,
    answers: list[TransformStamped | Exception | None],
    asked: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = Session(answers)
    client = met(session, monkeypatch)
    if answers[-1] is FOUND:
        assert await client.lookup("map", "base", timeout=timeout) == FOUND
    else:
        with pytest.raises(LookupTimeoutError) as late:
            await client.lookup("map", "base", timeout=timeout)
        assert late.value.timeout == timeout, "it is that of the lookup, not of its last part"
        assert isinstance(late.value.__cause__, UnknownFrameError)
    assert (session.asked, session.cancelled) == (asked, [])


@pytest.mark.parametrize("timeout", [5.0, LONGEST_WAIT])
async def test_the_clock_of_the_other_bus_may_end_a_wait_sooner(
    timeout: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session([LATE])
    client = met(session, monkeypatch)
    monkeypatch.setattr(buffer_client, "monotonic", lambda: 100.0)
    with pytest.raises(LookupTimeoutError):
        await client.lookup("map", "base", timeout=timeout)
    assert session.asked == [timeout]


async def test_a_server_that_is_not_there_is_waited_for_no_longer_than_the_lookup_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = Session([FOUND])
    client = met(session, monkeypatch)
    client._note_server("server", False)
    await settle()
    with anyio.fail_after(PATIENCE / 2), pytest.raises(RemoteLookupError) as absent:
        await client.lookup("map", "base", timeout=0.0)
    assert (absent.value.reason, session.asked) == ("absent", [])
    answers = []

    async def ask() -> None:
        answers.append(await client.lookup("map", "base"))

    session = Session([FOUND] * 3)
    client._session = session  # type: ignore[assignment]
    with anyio.fail_after(PATIENCE / 2):
        async with anyio.create_task_group() as tasks:
            for _ in range(3):
                tasks.start_soon(ask)
            await settle()
            client._note_server("server", True)
    assert answers == [FOUND] * 3


@asynccontextmanager
async def all_lost(client: BufferClient, why: str) -> AsyncIterator[None]:
    """Three lookups wait while the body begins, and it makes each of them fail."""
    reasons = []

    async def ask() -> None:
        with pytest.raises(RemoteLookupError, match=why) as lost:
            await client.lookup("map", "base")
        reasons.append(lost.value.reason)

    with anyio.fail_after(PATIENCE / 2):
        async with anyio.create_task_group() as tasks:
            for _ in range(3):
                tasks.start_soon(ask)
            await settle()
            yield
    assert reasons == ["lost"] * 3


async def test_all_whose_questions_were_dropped_hear_at_once_that_the_server_has_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    client = met(Session([None] * 3), monkeypatch)
    monkeypatch.setattr(buffer_client, "_SETTLING", 60.0)
    async with all_lost(client, "it has gone"):
        client._note_server("server", False)


@pytest.mark.parametrize("losses", [0, 1, 3, 4])
async def test_a_question_that_was_dropped_is_asked_three_times_more(
    losses: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session([*[None] * losses, FOUND])
    client = met(session, monkeypatch)
    if losses > 3:
        with pytest.raises(RemoteLookupError) as silent:
            await client.lookup("map", "base")
        assert (silent.value.reason, silent.value.domain, silent.value.robot) == ("silent", "yard", None)
    else:
        assert await client.lookup("map", "base") == FOUND
    assert len(session.asked) == min(losses + 1, 4)
    assert (client._pending, session.cancelled) == ({}, [])


async def test_a_question_that_was_dropped_is_not_asked_again_when_its_time_is_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = Session([None, FOUND])
    client = met(session, monkeypatch)
    with pytest.raises(RemoteLookupError) as silent:
        await client.lookup("map", "base", timeout=0.0)
    assert (silent.value.reason, session.asked) == ("silent", [0.0])


async def test_a_server_that_says_nothing_is_given_up_after_a_while_and_told_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(buffer_client, "PATIENCE", 0.01)
    session = Session([])
    client = met(session, monkeypatch)
    with pytest.raises(RemoteLookupError, match=r"it has not answered within 0\.01 s") as silent:
        await client.lookup("map", "base", timeout=0.0)
    assert silent.value.reason == "silent"
    assert (session.asked, session.cancelled, client._pending) == ([0.0], [1], {})


async def test_the_end_of_a_client_ends_its_lookups_though_the_session_is_that_of_a_link(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    client = met(Session([]), monkeypatch)
    async with all_lost(client, "this client has ended"):
        await client.__aexit__(None, None, None)


@pytest.mark.parametrize(("unsent", "cancelled"), [(1, [1, 2]), (2, [])])
async def test_so_many_lookups_may_wait_and_those_given_up_are_cancelled_where_there_is_room(
    unsent: int, cancelled: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session([])
    client = met(session, monkeypatch, capacity=2)
    async with anyio.create_task_group() as tasks:
        for _ in range(2):
            tasks.start_soon(client.lookup, "map", "base")
        await settle()
        assert list(client._pending) == [1, 2]
        with pytest.raises(RuntimeError, match="2 lookups wait"):
            await client.lookup("map", "base")
        session.unsent = unsent
        tasks.cancel_scope.cancel()
    assert (sorted(session.cancelled), client._pending) == (cancelled, {})
    # Those that were given up wait to be sent.
    session.unsent = 2
    with pytest.raises(RuntimeError, match="2 lookups wait"):
        await client.lookup("map", "base")


@pytest.mark.thorough
@pytest.mark.parametrize("told", [True, False])
async def test_a_question_without_an_answer_is_asked_again_three_times(
    address: str, domain: str, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Told or not of the end of its question, the client waits so long for the news that the server has gone.
    for name in ("_SETTLING", "PATIENCE", "LONGEST_WAIT"):
        monkeypatch.setattr(buffer_client, name, 0.05)
    answer, losses = moving("map", "base", 7), 3
    numbers: list[int] = []
    kept: list[zenoh.Query] = []
    session = LookupSession(domain, "r1", None, address, None, None, 2.0)

    def receive(query: zenoh.Query) -> None:
        assert query.payload is not None
        question = read_question(query.payload.to_bytes())
        if not isinstance(question, Cancellation):
            numbers.append(question.number)
            if len(numbers) > losses:
                session.reply(query, write_answer(answer))
                return
            kept.append(query)
        if told:
            query.drop()

    async def ask() -> TransformStamped:
        async with BufferClient(domain, robot="r1", connect=address) as client:
            await until(lambda: bool(client._servers))
            return await client.lookup("map", "base")

    await session.open()
    try:
        session.answer(receive, "server")
        assert await ask() == answer
        assert numbers == [1, 2, 3, 4]
        numbers.clear()
        losses = 4
        with pytest.raises(RemoteLookupError) as silent:
            await ask()
        assert (silent.value.reason, numbers) == ("silent", [1, 2, 3, 4])
    finally:
        await session.close()


@pytest.mark.thorough
async def test_a_thousand_lookups_at_once_are_each_asked_once_and_answered(address: str, domain: str) -> None:
    async with asked(address, domain) as (bus, server, client), anyio.create_task_group() as tasks:
        bus.publish(static("map", "base"))
        for _ in range(1_000):
            tasks.start_soon(client.lookup, "map", "base")
        await until(lambda: server.statistics().answered == 1_000)
    assert client._number == 1_000
    assert server.statistics().queue.dropped == 0
