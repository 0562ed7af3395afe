import subprocess
import sys
import threading
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from support.processes import until

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


async def test_a_question_of_a_session_that_has_ended_has_no_answer() -> None:
    session, took = LookupSession("yard", None, None, None, None, None, 2.0), list[bytes | None]()
    session._session = Network(failing=True)  # type: ignore[assignment]
    session.ask(b"question", took.append, 3.0)
    session._sending.get()()  # type: ignore[misc]
    assert took == [None]


async def test_what_waits_to_be_sent_is_sent_before_the_session_ends(address: str, domain: str) -> None:
    session, ending, sent = LookupSession(domain, None, None, address, None, None, 2.0), threading.Event(), list[bool]()
    await session.open()
    opened = session._opened()
    session._declared.append(SimpleNamespace(undeclare=ending.set))
    session.soon(lambda: ending.wait(10))
    session.soon(lambda: sent.append(opened.is_closed()))
    await session.close()
    assert (sent, opened.is_closed()) == ([False], True)


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
