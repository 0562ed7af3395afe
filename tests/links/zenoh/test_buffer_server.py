import math
from dataclasses import replace
from typing import Any

import anyio
import anyio.to_thread
import pytest
import zenoh
from support.processes import PATIENCE, until
from support.samples import static

from tfbus import LATEST, Buffer, Bus, RemoteLookupError, TransformStamped
from tfbus.links._remote_lookup import RemoteQuestion, read_answer, write_question
from tfbus.links.zenoh import BufferClient, BufferServer, ZenohLink
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
