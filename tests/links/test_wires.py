"""The promises of `tfbus.links.seams.Wire`, held by every wire: of one machine in two ways, by a router, of tests."""

import re
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.memory_wire import MemoryNetwork
from support.processes import free_address, new_domain, until
from support.wires import LIVE, met, running

from tfbus.links.local.local_wire import LocalWire
from tfbus.links.seams import MAX_MESSAGE, Hearing, Joined, Left, Wire

pytestmark = pytest.mark.anyio

Make = Callable[..., Wire]
"""Makes a wire of a robot, by default of none, in a domain."""


@asynccontextmanager
async def network(kind: str) -> AsyncIterator[Make]:
    if kind == "memory":
        domains: dict[str, MemoryNetwork] = {}
        yield lambda robot="", domain="d": domains.setdefault(domain, MemoryNetwork()).wire(robot)
    elif kind == "router":
        zenoh = pytest.importorskip("tfbus.links.zenoh", reason='pip install "tfbus[zenoh]"')
        wire = pytest.importorskip("tfbus.links.zenoh.wire")
        address, unique = free_address(), new_domain()
        async with zenoh.ZenohRouter(address):
            yield lambda robot="", domain="d": wire.ZenohWire(f"{unique}/{domain}", robot, connect=address)
    else:
        # Addresses of Unix sockets need a short path.
        with tempfile.TemporaryDirectory(prefix="tfbus-", ignore_cleanup_errors=True) as directory:
            yield lambda robot="", domain="d": LocalWire(
                domain, robot, directory=directory, loopback=kind == "loopback"
            )


@pytest.fixture(params=["memory", "unix", "loopback", "router"])
async def make(request: pytest.FixtureRequest) -> AsyncIterator[Make]:
    async with network(request.param) as made:
        yield made


@pytest.mark.every_loop
async def test_links_meet_and_what_they_publish_comes_to_all_others_and_what_they_send_to_one(make: Make) -> None:
    async with running(make("r1")) as one, running(make("r2")) as two, running(make()) as three:
        await met(one, two, three)
        assert three.present == {one.id: "r1", two.id: "r2"}
        assert one.present == {two.id: "r2", three.id: ""}
        assert one.wire.is_heard(LIVE)
        one.wire.publish(LIVE, b"to all")
        assert two.wire.send(three.id, b"to three")
        await until(lambda: len(three.messages) == 2 and bool(two.messages))
    assert three.of(one) == [Joined("r1"), b"to all"]
    assert three.of(two)[:2] == [Joined("r2"), b"to three"]
    assert (two.messages, one.messages) == ([(one.id, b"to all")], [])
    assert (one.wire.is_heard(LIVE), one.wire.send(two.id, b"")) == (False, False), "it is closed"


async def test_links_of_other_domains_are_not_there(make: Make) -> None:
    async with (
        running(make()) as one,
        running(make(domain="more")) as more,
        running(make(domain="d/more")) as below,
        running(make()) as two,
    ):
        await met(one, two)
        for ear in (one, more, below):
            ear.wire.publish(LIVE, b"for my domain")
        one.wire.send(two.id, b"end")
        await until(lambda: (one.id, b"end") in two.messages)
        assert set(two.present) == {one.id}
    assert sorted(two.said(one.id)) == [b"end", b"for my domain"]
    assert more.items == below.items == []


async def test_the_first_hearing_that_matches_a_robot_says_which_channel_is_heard(make: Make) -> None:
    hears = (Hearing("arm-1", "few"), Hearing("a*", LIVE), Hearing("", "few"))
    async with AsyncExitStack() as stack:
        robots = ("arm-1", "ant", "", "bee")
        ears = {robot: await stack.enter_async_context(running(make(robot), ())) for robot in robots}
        hearer = await stack.enter_async_context(running(make("hearer"), hears))
        await until(lambda: len(hearer.present) == 3)
        for ear in ears.values():
            await until(lambda ear=ear: ear.wire.send(hearer.id, b"met"))  # type: ignore[misc]
        for ear, channel in product(ears.values(), ("few", LIVE)):
            ear.wire.publish(channel, channel.encode())
        for ear in ears.values():
            assert ear.wire.send(hearer.id, b"end")
        await until(lambda: all(b"end" in hearer.said(ear.id) for ear in ears.values()))
        heard = {robot: set(hearer.said(ear.id)) - {b"met", b"end"} for robot, ear in ears.items()}
        assert heard == {"arm-1": {b"few"}, "ant": {b"all"}, "": {b"few"}, "bee": set()}
        assert set(hearer.present.values()) == {"arm-1", "ant", ""}, "the other one is not announced"
        assert [ear.items for ear in ears.values()] == [[]] * 4, "they hear nobody"


async def test_a_message_for_one_link_also_comes_to_one_that_does_not_hear_the_sender(make: Make) -> None:
    async with running(make("r1")) as one, running(make("r2"), [Hearing("r3", LIVE)]) as deaf, running(make()) as other:
        await until(lambda: set(one.present) == {deaf.id, other.id})
        assert one.wire.send(deaf.id, b"question")
        await until(lambda: deaf.messages == [(one.id, b"question")])
        assert deaf.wire.send(one.id, b"answer")
        await until(lambda: one.messages == [(deaf.id, b"answer")])
        assert (deaf.present, other.messages) == ({}, [])


@pytest.mark.every_loop
async def test_messages_of_each_kind_come_whole_in_their_order_and_all_before_the_end(make: Make) -> None:
    published = [b"p" * (1 + number % 50 * 40) + b"%d" % number for number in range(100)]
    sent = [b"s" * (1 + number % 50 * 40) + b"%d" % number for number in range(100)]
    async with running(make()) as stays:
        async with running(make()) as ends:
            await met(stays, ends)
            for number, (one, other) in enumerate(zip(published, sent, strict=True)):
                ends.wire.publish(LIVE, one)
                assert ends.wire.send(stays.id, other)
                if number % 20 == 19:
                    # A network without room may drop published messages.
                    await until(lambda: len(stays.messages) == 2 * number + 2)  # noqa: B023
        await stays.left(ends.id)
    said = stays.said(ends.id)
    assert [message for message in said if message.startswith(b"p")] == published
    assert [message for message in said if message.startswith(b"s")] == sent
    assert stays.of(ends)[-1] == Left()


async def test_a_message_may_be_as_long_as_any(make: Make) -> None:
    async with running(make()) as one, running(make()) as two:
        await met(one, two)
        message = bytes(range(256)) * (MAX_MESSAGE // 256)

        def arrived() -> bool:
            # The network may have no room for so much at once.
            two.wire.publish(LIVE, message)
            return (two.id, message) in one.messages

        await until(arrived)


@pytest.mark.every_loop
async def test_a_wire_may_be_closed_twice_and_without_being_opened(make: Make) -> None:
    wire = make()
    await wire.close()
    async with running(wire := make()):
        pass
    await wire.close()
    assert (wire.is_heard(LIVE), wire.send("0" * 32, b"")) == (False, False)


@given(st.text("ab*", min_size=1, max_size=8), st.text("ab", max_size=8))
def test_a_pattern_matches_as_a_plain_regular_expression_does(pattern: str, robot: str) -> None:
    plain = re.compile(".*".join(map(re.escape, pattern.split("*"))))
    assert Hearing(pattern, "all").matches(robot) == bool(plain.fullmatch(robot))


def test_a_name_that_almost_matches_a_pattern_of_many_stars_takes_no_time() -> None:
    assert not Hearing("*a" * 100 + "*b", "all").matches("a" * 199 + "c")
    assert [Hearing(pattern, "all").matches("") for pattern in ("", "*", "a*")] == [True, True, False]
