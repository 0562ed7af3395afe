"""What all commands that join a domain have in common."""

import errno
import os
import socket
import subprocess
import sys
from collections.abc import Callable

import anyio
import pytest
from support.processes import new_domain
from support.programs import Program

from tfbus import Bus
from tfbus.cli import main
from tfbus.cli.domain import LinkOptions, UnusableError

COMMANDS = {"broadcast": (), "listen": (), "static": ("map", "odom"), "echo": ("map", "odom"), "tree": ()}

Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """The command, in this process: its status, output and errors."""

    def call_it(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["tfbus", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return ended.value.code, *capsys.readouterr()

    return call_it


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_and_says_how_others_are_reached(command: str, call: Call) -> None:
    status, output, errors = call(command, "--help")
    assert (status, errors) == (0, "")
    assert f"Example: tfbus {command}" in output
    for option in ("--domain", "--listen", "--connect", "--backend"):
        assert option in output
    assert "--empty" not in output


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--listen", "rubbish"), "an address is like tcp/192.168.1.5:7447, not 'rubbish'"),
        (("--domain", "a b"), "a domain is made of letters"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_status_2(
    command: str, options: tuple[str, ...], why: str, call: Call
) -> None:
    status, output, errors = call(command, *COMMANDS[command], *options)
    assert (status, output) == (2, "")
    (line,) = errors.splitlines()
    assert line.startswith(f"tfbus: {why}")


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
def test_an_address_that_can_never_be_reached_is_refused_and_not_tried_for_ever(address: str) -> None:
    async def join() -> None:
        with Bus() as bus:
            async with LinkOptions(new_domain(), connect=(address,)).open(bus):
                raise AssertionError("joined")

    with pytest.raises(UnusableError, match="an address is like"):
        anyio.run(join)


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
def test_an_address_of_any_protocol_may_be_given_with_its_settings(address: str) -> None:
    entered = []

    async def join() -> None:
        with Bus() as bus:
            async with LinkOptions(new_domain(), connect=(address,)).open(bus):
                entered.append(True)

    anyio.run(join)
    assert entered


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_an_address_in_use_is_one_line(backend: str, call: Call) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        asked = call("tree", "--listen", address, "--backend", backend)
    assert asked == (2, "", f"tfbus: cannot listen at {address}: {os.strerror(errno.EADDRINUSE)}\n")


def test_a_program_ends_although_it_was_interrupted_twice() -> None:
    # Process managers pass on a Ctrl-C that has come to all already, and asyncio makes a cancel of each.
    script = """
import asyncio
from tfbus import Bus
from tfbus.cli.link import LinkOptions

async def join(joined):
    with Bus() as bus:
        async with LinkOptions("%s", listen=("tcp/127.0.0.1:0",)).open(bus):
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
    with Program(sys.executable, "-c", script % new_domain()) as program:
        assert program.wait() == 0
    assert (program.output.text, program.errors.text) == ("done\n", "")


@pytest.mark.parametrize("command", COMMANDS)
def test_without_its_extra_a_command_names_it(command: str) -> None:
    hidden = "import sys; sys.modules['zenoh'] = None; from tfbus.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", hidden, command, *COMMANDS[command]],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stderr == 'tfbus: joining a domain needs a package more: pip install "tfbus[cli,zenoh]"\n'
    assert (done.returncode, done.stdout) == (2, "")


def test_nothing_is_imported_before_a_command_needs_it() -> None:
    script = "import sys, tfbus.cli; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert "tfbus" in loaded
    assert set(loaded) & {"zenoh", "rich", "trio", "mcap", "rosbags", "lxml"} == set()
