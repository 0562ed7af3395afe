import gc
import json
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
import zenoh
from support.processes import OPEN_FILES, Program, free_address, until
from support.wires import LIVE, Ear, met
from support.zenoh_wires import listening, start_router, talk

from tfbus.links.seams import MAX_MESSAGE, Hearing, Joined, Left
from tfbus.links.zenoh import wire
from tfbus.links.zenoh.sessions import open_session, session_config
from tfbus.links.zenoh.wire import ZenohWire
from tfbus.links.zenoh.zenoh_router import ZenohRouter
from tfbus.tf_message import MalformedMessageError

pytestmark = pytest.mark.anyio


# Messages between links


async def test_messages_of_both_kinds_come_in_the_order_in_which_they_went(address: str, domain: str) -> None:
    async with (
        ZenohRouter(address),
        listening(domain, connect=address) as one,
        listening(domain, connect=address) as two,
    ):
        await met(one, two)
        sent = [b"%d" % number * (1 + number % 50 * 40) for number in range(300)]
        for number, message in enumerate(sent):
            if number % 3:
                one.wire.publish(LIVE, message)
            else:
                one.wire.send(two.id, message)
            if number % 20 == 19:
                # A network without room may drop published messages.
                await until(lambda: len(two.messages) == number + 1)  # noqa: B023
    assert [message for _, message in two.messages] == sent


@pytest.mark.thorough
async def test_a_link_knows_whether_anybody_may_hear_a_channel(address: str, domain: str) -> None:
    async with ZenohRouter(address), listening(domain, connect=address) as one:
        assert one.wire.is_heard(LIVE)
        one.wire.publish(LIVE, b"not known yet")
        await until(lambda: not one.wire.is_heard(LIVE))
        async with listening(domain, connect=address, hears=[Hearing("*", "slow")]) as two:
            await until(lambda: two.id in one.present)
            assert not one.wire.is_heard(LIVE)
            async with listening(domain, connect=address) as three:
                await until(lambda: three.id in one.present)
                assert one.wire.is_heard(LIVE)
                one.wire.publish(LIVE, b"heard")
                await until(lambda: bool(three.messages))
                assert one.wire.is_heard("slow")
                one.wire.publish("slow", b"heard too")
                await until(lambda: bool(two.messages))
            await until(lambda: not one.wire.is_heard(LIVE))
    assert not one.wire.is_heard(LIVE)
    assert not one.wire.send(two.id, b"closed")


async def test_a_link_may_publish_on_any_number_of_channels(address: str, domain: str) -> None:
    async with (
        ZenohRouter(address),
        listening(domain, connect=address) as one,
        listening(domain, connect=address, hears=[Hearing("*", "c0")]) as two,
    ):
        await until(lambda: two.id in one.present and one.id in two.present)
        for number in (*range(wire.MAX_CHANNELS + 1), 0):
            one.wire.publish(f"c{number}", b"%d" % number)
        await until(lambda: two.messages == [(one.id, b"0")] * 2)


# Routers that come, go and break


@pytest.mark.parametrize("hard", [False, pytest.param(True, marks=pytest.mark.thorough)])
async def test_all_links_leave_with_the_router_and_join_again_by_its_successor(
    address: str, domain: str, hard: bool
) -> None:
    async with listening(domain, connect=address) as one, listening(domain, connect=address) as two:
        if hard:
            with start_router(address) as router:
                await met(one, two)
                router.process.kill()
                await until(lambda: not one.present and not two.present)
        else:
            async with ZenohRouter(address):
                await met(one, two)
            await until(lambda: not one.present and not two.present)
        await until(lambda: not one.wire.is_heard(LIVE))
        assert not one.wire.send(two.id, b"to nobody")
        async with ZenohRouter(address):
            await met(one, two)
            await talk(one, two)
        assert two.of(one)[:3] == [Joined(""), Left(), Joined("")]


@pytest.mark.thorough
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_session_that_breaks_while_its_link_publishes_is_closed(address: str, domain: str) -> None:
    """A thread that fails would fail the test."""
    async with listening(domain, connect=address) as one, anyio.create_task_group() as tasks:

        async def publish() -> None:
            while True:
                one.wire.publish(LIVE, bytes(2**18))
                await anyio.lowlevel.checkpoint()

        tasks.start_soon(publish)
        for _ in range(10):
            async with ZenohRouter(address), listening(domain, connect=address) as two:
                await met(one, two)
            await until(lambda: not one.present)
        tasks.cancel_scope.cancel()


class Panic(BaseException):
    """As a panic of zenoh comes to Python."""


@pytest.mark.parametrize("error", [zenoh.ZError("broken"), Panic("broken")], ids=["error", "panic"])
async def test_a_link_whose_session_breaks_in_a_call_says_so_and_connects_again(
    error: BaseException, address: str, domain: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = wire._Session.look
    broken: list[Any] = []

    def break_once(session: Any, now: float) -> float | None:
        if session._wire is one.wire and not broken:
            broken.append(session)
            raise error
        return look(session, now)

    async with ZenohRouter(address), listening(domain, connect=address) as one:
        monkeypatch.setattr(wire._Session, "look", break_once)
        await until(lambda: bool(one.warnings))
        assert "connects again, because its session broke: broken" in str(one.warnings[0])
        async with listening(domain, connect=address) as two:
            await met(one, two)


async def test_of_several_addresses_the_first_that_answers_is_taken(address: str, domain: str) -> None:
    dead = free_address()
    async with (
        ZenohRouter(address),
        listening(domain, connect=[dead, address]) as one,
        listening(domain, connect=[address, dead]) as two,
    ):
        await met(one, two)
        await talk(one, two)


async def test_links_of_two_linked_routers_meet_and_go_to_the_other_one_when_theirs_ends(
    address: str, domain: str
) -> None:
    other = free_address()
    async with AsyncExitStack() as stack, ZenohRouter(other, connect=address):
        await stack.enter_async_context(ZenohRouter(address))
        async with (
            listening(domain, connect=[address, other]) as one,
            listening(domain, connect=[other, address]) as two,
        ):
            await met(one, two)
            await talk(one, two)
            await stack.aclose()
            await until(lambda: Left() in two.of(one))
            await met(one, two)
            await talk(one, two)


async def test_a_link_that_listens_is_the_router_of_the_others(address: str, domain: str) -> None:
    async with listening(domain, "base", listen=address) as base:
        async with listening(domain, connect=address) as one, listening(domain, connect=address) as two:
            await met(base, one, two)
            await talk(base, one, two)
            assert one.present[base.id] == "base"
            # It hears only what it means to hear, though all goes through it.
            two.wire.send(one.id, b"private")
            await until(lambda: (two.id, b"private") in one.messages)
        await until(lambda: base.present == {})
    assert (two.id, b"private") not in base.messages
    assert len(base.of(two)) == base.of(two).index(Left()) + 1


@pytest.mark.every_loop
async def test_links_that_listen_connect_to_each_other_and_survive_each_other(address: str, domain: str) -> None:
    other = free_address()
    async with (
        listening(domain, listen=other, connect=address) as early,
        listening(domain, connect=other) as guest,
    ):
        for _ in range(2):
            async with listening(domain, listen=address) as late:
                await met(early, late, guest)
                await talk(early, late, guest)
            await until(lambda: late.id not in guest.present | early.present)
            await talk(early, guest)


@pytest.mark.thorough
@pytest.mark.every_loop
async def test_a_link_without_a_router_opens_warns_once_and_connects_when_there_is_one(
    address: str, domain: str
) -> None:
    async with listening(domain, connect=address) as one:
        await until(lambda: bool(one.warnings))
        assert address in str(one.warnings[0])
        assert ".rs:" not in str(one.warnings[0])
        async with ZenohRouter(address), listening(domain, connect=address) as two:
            await met(one, two)
            await talk(one, two)
    assert len(one.warnings) == 1
    assert two.warnings == []


async def test_a_program_that_is_no_router_is_warned_of_once_and_dialled_with_pauses(
    address: str, domain: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts: list[object] = []

    def attempt(*arguments: Any) -> zenoh.Session:
        attempts.append(arguments)
        return open_session(*arguments)

    monkeypatch.setattr(wire, "open_session", attempt)
    peer = zenoh.Config()
    for path, value in (("mode", "peer"), ("listen/endpoints", [address]), ("scouting/multicast/enabled", False)):
        peer.insert_json5(path, json.dumps(value))
    with open_session(peer):
        async with listening(domain, connect=address) as one:
            await anyio.sleep(3.0)
            (warning,) = one.warnings
            assert f"no router answers at {address}" in str(warning)
            assert "is no router" in str(warning)
            assert 2 <= len(attempts) <= 15


@pytest.mark.thorough
@pytest.mark.parametrize("who", ["the router", "a link", "the router that is also a link"])
async def test_silence_for_longer_than_the_lease_is_healed(who: str, address: str, domain: str) -> None:
    routing = {"listen": address} if who == "the router that is also a link" else {"connect": address}
    with Stoppable() as stop:
        if who == "the router":
            stop.add(start_router(address))
        else:
            stop.add(Program(sys.executable, "-P", "-c", _LINK, domain, *next(iter(routing.items()))))
        async with AsyncExitStack() as stack:
            if who == "a link":
                await stack.enter_async_context(ZenohRouter(address))
            one = await stack.enter_async_context(listening(domain, connect=address))
            two = await stack.enter_async_context(listening(domain, connect=address))
            everybody = 1 if who == "the router" else 2
            await until(lambda: len(one.present) == len(two.present) == everybody)
            for _ in range(2):
                stop.signal(signal.SIGSTOP)
                await until(lambda: len(one.present) < everybody)
                stop.signal(signal.SIGCONT)
                await until(lambda: len(one.present) == len(two.present) == everybody)
                await talk(one, two)
                if who != "the router":
                    await until(new_beat(one))


def new_beat(ear: Ear) -> Callable[[], bool]:
    """Whether the program below has published something since now."""
    before = len(ear.messages)
    return lambda: any(message == b"beat" for _, message in ear.messages[before:])


class Stoppable:
    """A process that the test stops and continues."""

    def add(self, program: Program) -> None:
        self._program = program

    def signal(self, number: signal.Signals) -> None:
        self._program.process.send_signal(number)

    def __enter__(self) -> "Stoppable":
        return self

    def __exit__(self, *_: object) -> None:
        with self._program:
            pass


_LINK = """
import sys, anyio
from tfbus.links.seams import Hearing
from tfbus.links.zenoh.wire import ZenohWire
async def main(domain, which, address):
    wire = ZenohWire(domain, lease=1.0, **{which: address})
    await wire.open([Hearing("*", "all")], lambda link, item: None, print)
    while True:
        wire.publish("all", b"beat")
        await anyio.sleep(0.02)
anyio.run(main, *sys.argv[1:])
"""


@pytest.mark.thorough
async def test_a_router_that_is_stopped_holds_nobody_up(address: str, domain: str) -> None:
    dead = free_address()
    with start_router(dead) as stopped:
        stopped.process.send_signal(signal.SIGSTOP)
        async with (
            ZenohRouter(address),
            listening(domain, connect=[dead, address]) as one,
            listening(domain, connect=address) as two,
        ):
            await met(one, two)
            assert one.warnings == []


# The beginning and the end


async def test_a_link_needs_the_address_of_a_router(domain: str) -> None:
    given: list[dict[str, Any]] = [{}, {"connect": None}, {"connect": []}, {"connect": ""}, {"listen": []}]
    given += [{"listen": "", "connect": "tcp/127.0.0.1:7447"}]
    for options in given:
        with pytest.raises(ValueError, match=r"connect='tcp/host:7447'.* the local link"):
            ZenohWire(domain, **options)


def own_threads() -> int:
    return sum(thread.name == "tfbus and zenoh end" for thread in threading.enumerate())


@contextmanager
def leaving_nothing() -> Iterator[None]:
    """Find the threads and open files of this process as they were."""
    gc.collect()
    before = own_threads(), len(list(OPEN_FILES.iterdir())) if OPEN_FILES.is_dir() else 0
    yield
    assert own_threads() == before[0]
    if OPEN_FILES.is_dir():
        assert len(list(OPEN_FILES.iterdir())) <= before[1] + 2


@pytest.mark.thorough
@pytest.mark.every_loop
async def test_an_opening_that_is_cancelled_at_any_moment_leaves_nothing(address: str, domain: str) -> None:
    async with ZenohRouter(address), listening(domain, connect=address) as other:
        async with listening(domain, connect=address) as one:
            await met(one, other)
        await until(lambda: not other.present)
        with leaving_nothing():
            for tenths in range(60):
                cancelled = ZenohWire(domain, connect=address)
                with anyio.move_on_after(tenths / 10_000) as scope:
                    await cancelled.open([Hearing("*", LIVE)], lambda link, item: None, lambda error: None)  # noqa: ARG005
                    await anyio.sleep_forever()
                assert scope.cancelled_caught
                await cancelled.close()
            await until(lambda: not other.present)


@pytest.mark.thorough
async def test_a_link_closes_while_its_router_is_stopped(address: str, domain: str) -> None:
    with start_router(address) as router:
        async with listening(domain, connect=address) as one:
            await until(lambda: one.wire.is_heard(LIVE))
            router.process.send_signal(signal.SIGSTOP)
        router.process.send_signal(signal.SIGCONT)


async def test_a_link_that_closes_while_it_dials_a_router_does_not_say_that_it_goes_on_trying(domain: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        async with listening(domain, connect=f"tcp/127.0.0.1:{silent.getsockname()[1]}") as one:
            # Its first attempt takes two seconds, and the opening waited for one of them.
            await anyio.sleep(0.3)
        await until(lambda: own_threads() == 0)
    assert [str(warning) for warning in one.warnings if "goes on trying" in str(warning)] == []


# Strangers


@asynccontextmanager
async def stranger(address: str, ear: Ear) -> AsyncIterator[zenoh.Session]:
    """A session of zenoh that says what it likes, once the router knows what a link hears."""
    with open_session(session_config(None, address, None, None)) as session:
        # The token is the last thing that the link declares.
        token = session.liveliness().declare_subscriber(f"tfbus/**/@alive/{ear.id}/*", history=True)
        await anyio.to_thread.run_sync(token.recv)
        token.undeclare()
        yield session


def put(session: zenoh.Session, key: str, message: bytes, attachment: bytes | None = None) -> None:
    session.put(key, message, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)


async def heard_again(ear: Ear, session: zenoh.Session, domain: str, id: str) -> None:  # noqa: A002
    """Wait until all that a stranger has sent before has come or was refused."""
    put(session, f"tfbus/{domain}/@to/{ear.id}", b"end", bytes.fromhex(id))
    await until(lambda: (id, b"end") in ear.messages)


ID, OTHER = "0123456789abcdef" * 2, "fedcba9876543210" * 2


@pytest.mark.parametrize(
    "token",
    [
        "~/@alive/short/1",
        f"~/@alive/{ID}/0",
        f"~/@alive/{ID}/01",
        f"~/@alive/{ID}/1234567890",
        f"~/@alive/{ID}/x",
        f"~/@alive/{ID.upper()}/1",
        f"{'r' * 201}/@alive/{ID}/1",
        f"r 1/@alive/{ID}/1",
        f"é/@alive/{ID}/1",
    ],
)
async def test_a_token_that_no_link_would_make_is_ignored(token: str, address: str, domain: str) -> None:
    async with ZenohRouter(address), listening(domain, connect=address) as one:
        async with stranger(address, one) as session:
            bad = session.liveliness().declare_token(f"tfbus/{domain}/{token}")
            good = session.liveliness().declare_token(f"tfbus/{domain}/~/@alive/{OTHER}/1")
            await until(lambda: OTHER in one.present)
            assert set(one.present) == {OTHER}
            bad.undeclare()
            good.undeclare()
        await until(lambda: not one.present)


async def test_a_newer_session_of_a_link_counts_and_an_older_one_no_more(address: str, domain: str) -> None:
    async with ZenohRouter(address), listening(domain, connect=address) as one, stranger(address, one) as session:
        liveliness = session.liveliness()
        key = f"tfbus/{domain}/r/@alive/{ID}"
        second = liveliness.declare_token(f"{key}/2")
        first = liveliness.declare_token(f"{key}/1")
        third = liveliness.declare_token(f"{key}/3")
        second.undeclare()
        first.undeclare()
        await heard_again(one, session, domain, ID)
        assert one.items == [(ID, Joined("r")), (ID, Left()), (ID, Joined("r")), (ID, b"end")]
        third.undeclare()
        await until(lambda: not one.present)


async def test_what_is_published_by_no_link_that_is_present_is_ignored(address: str, domain: str) -> None:
    async with ZenohRouter(address), listening(domain, connect=address) as one:
        async with stranger(address, one) as session:
            for end in (ID, "x", one.id, ID.upper(), "é" * 100):
                put(session, f"tfbus/{domain}/~/{LIVE}/{end}", b"garbage")
            await heard_again(one, session, domain, ID)
        assert one.items == [(ID, b"end")]


@pytest.mark.parametrize("attachment", [None, b"", b"x" * 15, b"x" * 17, b"x" * 100_000])
async def test_a_message_for_one_link_without_a_sender_is_ignored(
    attachment: bytes | None, address: str, domain: str
) -> None:
    async with ZenohRouter(address), listening(domain, connect=address) as one:
        async with stranger(address, one) as session:
            put(session, f"tfbus/{domain}/@to/{one.id}", b"garbage", attachment)
            await heard_again(one, session, domain, ID)
        assert one.items == [(ID, b"end")]


async def test_a_message_that_is_too_large_is_refused_and_one_that_is_far_too_large_not_even_assembled(
    address: str, domain: str
) -> None:
    async with ZenohRouter(address), listening(domain, connect=address) as one, stranger(address, one) as session:
        key = f"tfbus/{domain}/@to/{one.id}"
        for size in (MAX_MESSAGE, MAX_MESSAGE + 1, MAX_MESSAGE + 2**18, 5 * MAX_MESSAGE):
            put(session, key, bytes(size), bytes.fromhex(ID))
        await heard_again(one, session, domain, ID)
        kinds = [len(item) if isinstance(item, bytes) else type(item) for _, item in one.items]
        assert kinds == [MAX_MESSAGE, MalformedMessageError, 3]
        assert "oversized" in str(one.items[1][1])
