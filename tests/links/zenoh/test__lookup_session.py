import subprocess
import sys
import threading
import time
from functools import partial
from types import SimpleNamespace
from typing import Any

import anyio
import anyio.to_thread
import pytest
import zenoh
from support.processes import until

from tfbus.links.zenoh import _closing, _lookup_session
from tfbus.links.zenoh._lookup_session import LookupSession, reply_now

pytestmark = pytest.mark.anyio


async def test_servers_and_askers_of_one_robot_are_heard_of_and_no_others(address: str, domain: str) -> None:
    noted: list[tuple[str, bool]] = []
    here = LookupSession(domain, "r1", None, address, None, None, 2.0)
    there = LookupSession(domain, "r1", None, None, address, None, 2.0)
    elsewhere = LookupSession(domain, "r2", None, None, address, None, 2.0)
    sessions = (here, there, elsewhere)
    for session in sessions:
        await session.open()
    try:
        here.follow("@asking", lambda asker, present: noted.append((asker, present)))
        elsewhere.announce_asker("other")
        there.announce_asker("me")
        await until(lambda: noted == [("me", True)])
        await there.close()
        await until(lambda: noted == [("me", True), ("me", False)])
    finally:
        for session in sessions:
            await session.close()
    assert here.key("lookup") == f"tfbus/{domain}/r1/lookup"


async def test_without_a_domain_it_is_tf_and_without_a_robot_a_tilde() -> None:
    assert LookupSession(None, None, None, None, None, None, 2.0).key("@lookup", "a") == "tfbus/tf/~/@lookup/a"


async def test_of_several_servers_of_one_robot_one_has_a_question_and_all_have_what_is_for_all(
    address: str, domain: str
) -> None:
    servers = [LookupSession(domain, None, None, address, None, None, 2.0)]
    servers.append(LookupSession(domain, None, None, None, address, None, 2.0))
    asker = LookupSession(domain, None, None, None, address, None, 2.0)
    asked, known, answers = list[tuple[int, bytes]](), set[str](), list[bytes | None]()

    def answer_as(server: int, query: zenoh.Query) -> None:
        assert query.payload is not None
        asked.append((server, query.payload.to_bytes()))
        reply_now(query, b"answer")

    for session in (*servers, asker):
        await session.open()
    try:
        for number, server in enumerate(servers):
            server.answer(partial(answer_as, number), f"server {number}")
        asker.follow("@lookup", lambda server, _: known.add(server))
        await until(lambda: len(known) == 2)
        for number in range(10):
            asker.ask(b"%d" % number, answers.append, 10.0)
            await until(lambda number=number: len(answers) > number)  # type: ignore[misc]
        asker.ask(b"all", answers.append, 10.0, to_all=True)
        await until(lambda: len(asked) >= 12)
    finally:
        for session in (*servers, asker):
            await session.close()
    assert answers == [b"answer"] * 11
    assert [payload for _, payload in asked[:10]] == [b"%d" % number for number in range(10)]
    assert sorted(asked[10:]) == [(0, b"all"), (1, b"all")]


async def test_a_session_that_never_opened_closes() -> None:
    await LookupSession("yard", None, None, None, None, None, 2.0).close()


class Network:
    """Notes the questions that are asked, and fails where the session has ended."""

    def __init__(self, failing: bool = False) -> None:
        self.asked: list[tuple[str, Any, dict[str, Any]]] = []
        self._failing = failing

    def get(self, key: str, handler: Any, **options: Any) -> None:
        if self._failing:
            raise zenoh.ZError("the session is closed")
        self.asked.append((key, handler, options))


@pytest.mark.parametrize(
    ("replies", "answer"), [((), None), ((None,), None), ((None, b"yes"), b"yes"), ((b"yes", b"no"), b"yes")]
)
@pytest.mark.parametrize("to_all", [False, True])
async def test_a_question_has_one_answer_or_none(
    replies: tuple[bytes | None, ...], answer: bytes | None, to_all: bool
) -> None:
    session, network, took = LookupSession("yard", None, None, None, None, None, 2.0), Network(), list[bytes | None]()
    session._session = network  # type: ignore[assignment]
    session.ask(b"question", took.append, 3.0, to_all)
    assert (session.unsent, took) == (1, [])
    # As the session's thread does.
    session._sending.get()()  # type: ignore[misc]
    ((key, handler, options),) = network.asked
    for reply in replies:
        ok = None if reply is None else SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda reply=reply: reply))
        handler.callback(SimpleNamespace(ok=ok))
    handler.drop()
    assert took == [answer]
    assert (key, options["payload"], options["timeout"]) == ("tfbus/yard/~/lookup", b"question", 3.0)
    assert options["target"] == (zenoh.QueryTarget.ALL if to_all else zenoh.QueryTarget.BEST_MATCHING)
    # The sender must not wait in zenoh for others.
    assert options["express"] is True
    assert not handler.indirect, "it needs no thread of its own"


async def test_a_question_of_a_session_that_has_ended_has_no_answer() -> None:
    session, took = LookupSession("yard", None, None, None, None, None, 2.0), list[bytes | None]()
    session._session = Network(failing=True)  # type: ignore[assignment]
    session.ask(b"question", took.append, 3.0)
    session._sending.get()()  # type: ignore[misc]
    assert took == [None]


@pytest.mark.parametrize("cancelled", [False, True])
async def test_what_waits_to_be_sent_is_sent_before_the_session_ends(
    address: str, domain: str, cancelled: bool
) -> None:
    session, ending, sent = LookupSession(domain, None, None, address, None, None, 2.0), threading.Event(), list[bool]()
    await session.open()
    opened = session._opened()
    session._declared.append(SimpleNamespace(undeclare=ending.set))
    session.soon(lambda: ending.wait(10))
    session.soon(partial(time.sleep, 0.02))
    session.soon(lambda: sent.append(opened.is_closed()))
    at_exit = session._close_at_exit
    assert at_exit is not None
    with anyio.CancelScope() as scope:
        if cancelled:
            scope.cancel()
        await session.close()
    assert (sent, opened.is_closed(), at_exit.alive) == ([False], True, False)


async def test_a_thread_that_does_not_come_back_is_left_behind_and_waited_for_at_the_end_of_the_interpreter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_lookup_session, "_CLOSING_TIME", 0.01)
    may_end = threading.Event()
    session = LookupSession(None, None, None, "tcp/127.0.0.1:0", None, None, 2.0)
    await session.open()
    sender = session._sender
    assert sender is not None
    session._declared.append(SimpleNamespace(undeclare=lambda: may_end.wait(10)))
    session.soon(lambda: may_end.wait(10))
    await session.close()
    assert sender.is_alive()
    assert not may_end.is_set()
    assert sender.daemon, "the interpreter must not wait for it without a limit"
    threading.Timer(0.02, may_end.set).start()
    _closing._wait_at_exit()
    assert not sender.is_alive()


@pytest.mark.parametrize("by_itself", [False, True])
async def test_a_session_that_nobody_refers_to_ends_when_all_is_sent(by_itself: bool) -> None:
    may_end, sent = threading.Event(), list[bool]()
    session = LookupSession(None, None, None, "tcp/127.0.0.1:0", None, None, 2.0)
    await session.open()
    opened, sender = session._opened(), session._sender
    assert sender is not None
    if by_itself:
        # What the thread sends holds the last reference.
        session.soon(partial(lambda _: sent.append(may_end.wait(10)), session))
        del session
        may_end.set()
        await anyio.to_thread.run_sync(sender.join)
    else:
        session.soon(lambda: sent.append(may_end.wait(10)))
        threading.Timer(0.02, may_end.set).start()
        del session
    assert (sent, sender.is_alive(), opened.is_closed()) == ([True], False, True)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("first", "limit", "end"),
    [
        ("", 0.01, "await session.close()"),
        ("", 0.01, "pass"),
        # The finalizers of a program that has some before are called after all else at its end.
        ("weakref.finalize(weakref, str)", 60.0, "pass"),
    ],
)
def test_the_interpreter_ends_after_the_thread_that_sends(first: str, limit: float, end: str) -> None:
    """A thread that comes back from a call of zenoh after the end of the interpreter aborts the process."""
    program = f"""
import time, weakref
{first}
import anyio
from tfbus.links.zenoh import _lookup_session
_lookup_session._CLOSING_TIME = {limit}
session = _lookup_session.LookupSession(None, None, None, "tcp/127.0.0.1:0", None, None, 2.0)
async def main():
    await session.open()
    session.soon(lambda: (time.sleep(0.5), print("sent")))
    {end}
anyio.run(main)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert (done.stdout.strip(), done.stderr) == ("sent", "")


async def test_an_answer_is_sent_at_once_and_the_question_ends_whether_or_not_the_asker_is_there() -> None:
    done: list[object] = []
    for failing in (False, True):

        def reply(key: str, answer: bytes, express: bool, failing: bool = failing) -> None:
            done.append((key, answer, express))
            if failing:
                raise zenoh.ZError("the asker has gone")

        reply_now(SimpleNamespace(key_expr="k", reply=reply, drop=lambda: done.append("drop")), b"a")  # type: ignore[arg-type]
    assert done == [("k", b"a", True), "drop"] * 2
