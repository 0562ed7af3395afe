import errno
import os
import re
import signal
import socket
import sys
from collections.abc import Callable, Coroutine
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from support.commands import START, Command, check_wrong_call
from support.processes import Program, new_domain
from support.samples import static

from tfbus import Bus, SimulatedClock, from_seconds
from tfbus.cli.arguments import UsageError
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.testing import simulate

BACKENDS = ["asyncio", "trio"]


def join(options: LinkOptions) -> None:
    """Join a domain and leave it again."""

    async def stay_for_a_moment(_: Bus) -> None:
        await anyio.lowlevel.checkpoint()

    options.run(stay_for_a_moment)


def test_a_program_for_a_remote_buffer_gets_the_robot_and_the_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    from tfbus.links import zenoh

    asked: list[tuple[str, dict[str, object]]] = []

    class Client:
        def __init__(self, domain: str, **options: object) -> None:
            asked.append((domain, options))

        async def __aenter__(self) -> "Client":
            return self

        async def __aexit__(self, *_: object) -> None:
            pass

    async def program(remote: object) -> bool:
        await anyio.lowlevel.checkpoint()
        return isinstance(remote, Client)

    monkeypatch.setattr(zenoh, "BufferClient", Client)
    listen, connect = ("tcp/127.0.0.1:1",), ("tcp/127.0.0.1:2", "tcp/127.0.0.1:3")
    assert LinkOptions("yard", listen=listen, connect=connect, robots=("r1",)).run_remote(program)
    assert LinkOptions("yard").run_remote(program)
    assert asked == [
        ("yard", {"robot": "r1", "listen": listen, "connect": connect}),
        ("yard", {"robot": None, "listen": None, "connect": None}),
    ]


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_programs_of_a_domain_hear_each_other_and_return_their_results(backend: str) -> None:
    options = LinkOptions(new_domain(), backend=backend)  # type: ignore[arg-type]

    async def meet(bus: Bus) -> str:
        arrived = anyio.Event()
        with Bus() as other, bus.subscribe(lambda _: arrived.set()):
            async with options.join(other):
                other.publish(static("map", "odom"))
                await arrived.wait()
        return "met"

    assert options.run(meet) == "met"


@pytest.mark.parametrize("backend", BACKENDS)
def test_ctrl_c_ends_a_program(backend: str) -> None:
    async def interrupt(_: Bus) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        await anyio.sleep_forever()

    with pytest.raises(KeyboardInterrupt):
        LinkOptions(new_domain(), backend=backend).run(interrupt)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "address",
    [
        "",
        "7447",
        "127.0.0.1:7447",
        "foo/127.0.0.1:7447",
        "tcp",
        "tcp/",
        "tcp/:7447",
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:",
        "tcp/127.0.0.1:x",
        "tcp/127.0.0.1:7447 ",
        "tcp/127.0.0.1:65536",
        "tcp//127.0.0.1:7447",
        "tcp/::1:7447",
    ],
)
def test_an_address_that_no_program_can_have_is_a_usage_error(address: str) -> None:
    with pytest.raises(UsageError, match=f"an address is like tcp/.+, not {re.escape(repr(address))}"):
        join(LinkOptions(new_domain(), connect=(address,)))


@pytest.mark.parametrize(
    "address",
    [
        "tcp/127.0.0.1:1",
        "tcp/127.0.0.1:1?prio=1-7",
        "tcp/[::1]:1",
        "tls/localhost:1#root_ca_certificate=/nowhere/ca.pem",
        "udp/localhost:1",
        "unixsock-stream//nowhere/at/all",
        "ws/127.0.0.1:1",
    ],
)
def test_an_address_of_any_protocol_is_tried_in_the_background(address: str) -> None:
    join(LinkOptions(new_domain(), connect=(address,)))


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_address_in_use_is_a_usage_error(backend: str, tfbus: Command) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        done = tfbus("tree", "--listen", address, "--backend", backend)
    check_wrong_call(done, f"cannot listen at {address}: {os.strerror(errno.EADDRINUSE)}")


def test_a_domain_that_cannot_exist_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="a domain is made of letters"):
        join(LinkOptions("a b"))


def test_without_its_extra_joining_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tfbus.links.zenoh", None)
    with pytest.raises(UsageError, match=re.escape('needs a package more: pip install "tfbus[cli,zenoh]"')):
        join(DEFAULT_LINK)


async def publish_soon(bus: Bus) -> None:
    await bus.clock.sleep(0.9)
    bus.publish(static("map", "odom"))


async def publish_late(bus: Bus) -> None:
    await bus.clock.sleep(60.0)
    bus.publish(static("map", "odom"))


@pytest.mark.parametrize(
    ("publish", "seconds", "notice"),
    [
        (publish_soon, 0.9, ""),
        (publish_late, 60, "waiting for transforms on domain 'yard' …\n"),
    ],
)
def test_waiting_for_the_first_transform_is_announced_once_if_it_takes_more_than_a_second(
    publish: Callable[[Bus], Coroutine[Any, Any, None]], seconds: float, notice: str, capsys: pytest.CaptureFixture[str]
) -> None:
    async def wait() -> int:
        clock = SimulatedClock(START)

        async def wait_beside_publisher() -> int:
            with Bus(clock) as bus:
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(publish, bus)
                    await LinkOptions("yard").first_transform(bus)
                return clock.now()

        return await simulate(clock, wait_beside_publisher)

    assert anyio.run(wait) == START + from_seconds(seconds)
    assert capsys.readouterr() == ("", notice)


@pytest.mark.thorough
def test_leaving_a_domain_survives_being_cancelled_twice() -> None:
    # Process managers repeat a Ctrl-C that all processes have had already, and asyncio makes a cancel of each.
    script = f"""
import asyncio
from tfbus import Bus
from tfbus.cli.domain import LinkOptions

async def join(joined):
    with Bus() as bus:
        async with LinkOptions("{new_domain()}", listen=("tcp/127.0.0.1:0",)).join(bus):
            joined.set()
            await asyncio.sleep(1e9)

async def main():
    for turns in range(12):
        joined = asyncio.Event()
        task = asyncio.create_task(join(joined))
        await joined.wait()
        task.cancel()
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        await asyncio.wait([task])

asyncio.run(main())
print("done")
"""
    with Program(sys.executable, "-c", script) as program:
        assert program.wait() == 0
    assert (program.output.text, program.errors.text) == ("done\n", "")
