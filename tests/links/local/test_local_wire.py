"""Links of one machine at the seam below them, over real sockets."""

import errno
import gc
import os
import resource
import select
import selectors
import shutil
import signal
import socket
import struct
import sys
import tempfile
import threading
import tracemalloc
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager
from pathlib import Path
from random import Random
from time import thread_time
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.local_links import RawPeer, files_in, framed
from support.processes import OPEN_FILES, Program, on_one_loop, until
from support.wires import HEARS_ALL, LIVE, Ear, met, running

from tfbus.links.local import local_wire
from tfbus.links.local.connection import LONGEST_HELLO
from tfbus.links.local.local_wire import MOST_HEARINGS, MOST_STRANGERS, MOST_UNFINISHED, LocalWire
from tfbus.links.seams import MAX_MESSAGE, Hearing, Joined, Left

pytestmark = pytest.mark.anyio

DOMAIN = "domain"


@asynccontextmanager
async def pair(directory: str, loopback: bool = False) -> AsyncIterator[tuple[LocalWire, Ear, LocalWire, Ear]]:
    """Two links that have met."""
    one, two = (LocalWire(DOMAIN, robot, directory=directory, loopback=loopback) for robot in ("one", "two"))
    async with running(one) as ear_one, running(two) as ear_two:
        await ear_one.joined(two.id)
        await ear_two.joined(one.id)
        yield one, ear_one, two, ear_two


@asynccontextmanager
async def raw_peer(
    directory: str, *, loopback: bool = False, receive_buffer: int | None = None
) -> AsyncIterator[tuple[LocalWire, Ear, RawPeer]]:
    """A link, and a peer that has met it."""
    wire = LocalWire(DOMAIN, "robot", directory=directory, loopback=loopback)
    async with running(wire) as ear:
        peer = await RawPeer.connect(files_in(directory)[0], receive_buffer)
        async with peer.stream:
            await peer.meet()
            await ear.joined(peer.link)
            yield wire, ear, peer


# Meeting and hearing


async def test_an_id_in_use_is_not_taken_over(directory: str) -> None:
    async with pair(directory) as (one, ear_one, two, _):
        thief = await RawPeer.connect(files_in(directory)[0])
        async with thief.stream:
            with pytest.raises((anyio.EndOfStream, anyio.BrokenResourceError)):
                await thief.meet(link=two.id)
        two.send(one.id, b"still here")
        await until(lambda: ear_one.said(two.id) == [b"still here"])
        assert [item for _, item in ear_one.items].count(Left()) == 0


async def test_a_link_that_connects_twice_at_once_is_met_once(directory: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory)
    async with running(wire) as ear:
        first, second = [await RawPeer.connect(files_in(directory)[0]) for _ in range(2)]
        async with first.stream, second.stream:
            await second.meet(link=first.link)
            await ear.joined(first.link)
            await first.say(first.hello())
            assert await first.end() == []
            await second.say(b"still here")
            await until(lambda: ear.said(first.link) == [b"still here"])


async def test_the_longest_hello_is_heard_and_a_longer_one_refused_on_opening(directory: str) -> None:
    hears = [Hearing(f"{number:0200}", "c" * 32) for number in range(MOST_HEARINGS)]
    one, two = (LocalWire(DOMAIN, f"{MOST_HEARINGS - 1:0200}", directory=directory) for _ in range(2))
    async with running(one, hears) as ear_one, running(two, hears) as ear_two:
        await met(ear_one, ear_two)
    with pytest.raises(OSError, match="1000 names of robots at most, and 1001 are given"):
        await LocalWire(DOMAIN, directory=directory).open([*hears, *HEARS_ALL], ear_one.receive, print)


@pytest.mark.parametrize("stops", ["older", "younger"])
async def test_a_link_that_is_stopped_while_it_meets_another_is_not_lost(
    directory: str, loopback: bool, stops: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_wire, "PATIENCE", 0.05)
    ears = older, younger = [Ear(LocalWire(DOMAIN, directory=directory, loopback=loopback)) for _ in range(2)]
    first, second = (younger, older) if stops == "older" else (older, younger)
    try:
        for ear in ears:
            await ear.wire.open(HEARS_ALL, ear.receive, ear.warnings.append)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(first.wire.run)
            # It has no reason to lose patience with the other, which goes on later.
            await anyio.sleep(1.0)
            tasks.start_soon(second.wire.run)
            await met(*ears)
            for ear, other in ((older, younger), (younger, older)):
                assert ear.wire.send(other.id, b"still here")
                await until(lambda ear=ear, other=other: other.said(ear.id) == [b"still here"])  # type: ignore[misc]
            tasks.cancel_scope.cancel()
        for ear, other in ((older, younger), (younger, older)):
            assert ear.of(other) == [Joined(), b"still here"]
    finally:
        for ear in ears:
            await ear.wire.close()


# Frames


@pytest.mark.every_loop
async def test_frames_that_come_in_pieces_are_put_together(directory: str) -> None:
    random = Random(1)
    messages = [random.randbytes(random.choice([0, 1, 3, 5, 200])) for _ in range(40)]
    stream = framed(*messages)
    async with raw_peer(directory) as (_, ear, peer):
        at = 0
        while at < len(stream):
            piece = random.choice([1, 2, 3, 7, 300])
            await peer.stream.send(stream[at : at + piece])
            await anyio.lowlevel.checkpoint()
            at += piece
        await until(lambda: len(ear.said(peer.link)) == len(messages))
        assert ear.said(peer.link) == messages


@pytest.mark.every_loop
async def test_no_frame_tears_where_the_socket_has_little_room(directory: str, loopback: bool) -> None:
    random = Random(2)
    published = [b"p" + random.randbytes(random.choice([10, 3_000, 70_000, 150_000])) for _ in range(40)]
    sent = [b"s" + random.randbytes(random.choice([10, 3_000, 70_000])) for _ in range(20)]
    async with raw_peer(directory, loopback=loopback, receive_buffer=4_096) as (wire, _, peer):
        heard: list[bytes] = []

        async def say() -> None:
            for number, message in enumerate(published):
                wire.publish("all", message)
                if number % 2:
                    assert wire.send(peer.link, sent[number // 2])
                if number % 5 == 0:
                    await anyio.lowlevel.checkpoint()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(say)
            while sum(message[:1] == b"s" for message in heard) < len(sent) or published[-1] not in heard:
                heard.append(await peer.hear())
        assert [message for message in heard if message[:1] == b"s"] == sent
        rest = [message for message in heard if message[:1] == b"p"]
        assert [message for message in published if message in set(rest)] == rest


async def test_a_connection_whose_frame_cannot_be_finished_ends_and_another_begins(
    directory: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    send, large = socket.socket.send, bytes(3_000)

    def run_out_of_memory(sock: socket.socket, data: bytes, flags: int = 0) -> int:
        if len(data) == len(framed(large)):
            return send(sock, data[:100], flags)
        if len(data) == len(framed(large)) - 100:
            raise OSError(errno.ENOBUFS, "no buffer space available")
        return send(sock, data, flags)

    async with pair(directory) as (one, ear_one, two, ear_two):
        monkeypatch.setattr(socket.socket, "send", run_out_of_memory)
        assert one.send(two.id, large)
        await until(lambda: (two.id, Left()) in ear_one.items and (one.id, Left()) in ear_two.items)
        await met(ear_one, ear_two)
        assert one.send(two.id, b"again")
        await until(lambda: ear_two.said(one.id) == [b"again"])


async def test_the_oldest_published_messages_are_dropped_for_a_link_that_does_not_read_and_sent_ones_go_first(
    directory: str,
) -> None:
    size = 100_000
    async with raw_peer(directory) as (wire, _, peer):
        for number in range(300):
            assert wire.is_heard("all")
            wire.publish("all", struct.pack("<I", number) + bytes(size))
        assert wire.send(peer.link, b"sent")
        heard: list[int] = []
        while not heard or heard[-1] != 299:
            message = await peer.hear()
            heard.append(-1 if message == b"sent" else struct.unpack_from("<I", message)[0])
        # The buffers of the system and a begun frame come before it.
        before = heard.index(-1)
        assert before < 30
        assert heard[:before] == list(range(before))
        waited = heard[before + 1 :]
        assert waited == list(range(waited[0], 300))
        assert 2**23 - 2 * size < len(waited) * size <= 2**23


async def test_sending_to_a_link_that_does_not_read_is_refused_when_too_much_waits(directory: str) -> None:
    async with raw_peer(directory) as (wire, _, peer):
        accepted = sum(wire.send(peer.link, bytes(2**20)) for _ in range(50))
        assert 15 <= accepted <= 18
        for _ in range(accepted):
            assert await peer.hear() == bytes(2**20)
        assert wire.send(peer.link, b"again")


async def test_a_message_that_is_too_long_is_not_sent(directory: str) -> None:
    async with pair(directory) as (one, ear_one, two, _):
        message = bytes(MAX_MESSAGE)
        assert not two.send(one.id, message + b"1")
        two.publish("all", message + b"1")
        assert two.send(one.id, message)
        await until(lambda: ear_one.said(two.id) == [message])


async def test_a_longer_message_ends_its_connection_and_no_other(directory: str) -> None:
    async with pair(directory) as (one, ear, two, _):
        peer = await RawPeer.connect(files_in(directory)[0])
        async with peer.stream:
            await peer.meet()
            await ear.joined(peer.link)
            await peer.stream.send(struct.pack("<I", MAX_MESSAGE + 1))
            await ear.left(peer.link)
            assert ear.refused(peer.link) == ["oversized"]
        two.send(one.id, b"still here")
        await until(lambda: ear.said(two.id) == [b"still here"])


async def test_of_messages_that_never_end_the_idlest_is_given_up_when_all_are_too_large(directory: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory)
    part = 2**22
    async with AsyncExitStack() as stack:
        ear = await stack.enter_async_context(running(wire))
        peers = []
        for _ in range(MOST_UNFINISHED // part + 1):
            peer = await RawPeer.connect(files_in(directory)[0])
            peers.append(peer)
            await stack.enter_async_context(peer.stream)
            await peer.meet()
            await ear.joined(peer.link)
        for peer in peers:
            await peer.stream.send(struct.pack("<I", MAX_MESSAGE) + bytes(part))
        await until(lambda: Left() in [item for _, item in ear.items])
        (refused,) = [peer for peer in peers if ear.refused(peer.link)]
        await peers[-1].stream.send(bytes(MAX_MESSAGE - part))
        await until(lambda: ear.said(peers[-1].link) == [bytes(MAX_MESSAGE)])
        assert refused is not peers[-1]


@pytest.mark.every_loop
async def test_a_link_that_floods_leaves_other_tasks_their_turns(directory: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory)
    most, since_turn, total = 0, 0, 0

    def receive(_: str, item: object) -> None:
        nonlocal most, since_turn, total
        if isinstance(item, bytes):
            until = thread_time() + 0.0002
            while thread_time() < until:
                pass
            since_turn, total = since_turn + 1, total + 1
            most = max(most, since_turn)

    try:
        await wire.open(HEARS_ALL, receive, lambda _: None)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wire.run)
            peer = await RawPeer.connect(files_in(directory)[0])
            async with peer.stream:
                await peer.meet()
                tasks.start_soon(peer.say, *[bytes(10_000)] * 300)
                while total < 300:
                    await anyio.lowlevel.checkpoint()
                    since_turn = 0
            tasks.cancel_scope.cancel()
    finally:
        await wire.close()
    # A turn has 1 ms and one read, and trio may let a task be the last of one round and the first of the next.
    assert most <= 20


# Strangers


@given(noise=st.lists(st.binary(max_size=200), max_size=4), framed_=st.booleans())
def test_noise_of_a_stranger_changes_nothing(noise: list[bytes], framed_: bool) -> None:
    async def main() -> None:
        with tempfile.TemporaryDirectory(prefix="tfbus-") as directory:
            wire = LocalWire(DOMAIN, directory=directory)
            async with running(wire) as ear:
                stranger = await RawPeer.connect(files_in(directory)[0])
                async with stranger.stream:
                    await stranger.stream.send(framed(*noise) if framed_ else b"".join(noise))
                peer = await RawPeer.connect(files_in(directory)[0])
                async with peer.stream:
                    await peer.meet()
                    await ear.joined(peer.link)
                    assert list(ear.present) == [peer.link]

    anyio.run(main)


async def test_of_many_strangers_the_oldest_make_room(directory: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory)
    async with AsyncExitStack() as stack:
        ear = await stack.enter_async_context(running(wire))
        strangers = []
        for _ in range(MOST_STRANGERS + 1):
            strangers.append(await RawPeer.connect(files_in(directory)[0]))
            await stack.enter_async_context(strangers[-1].stream)
            await anyio.lowlevel.checkpoint()
        assert await strangers[0].end() == []
        # The last one is among those that were kept.
        await strangers[-1].meet()
        await ear.joined(strangers[-1].link)


async def test_a_link_makes_and_takes_so_many_connections_and_no_more(
    directory: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_wire, "MOST_CONNECTIONS", 2)
    with ExitStack() as stack:
        async with running(LocalWire(DOMAIN, directory=directory)) as ear:
            (path,) = files_in(directory)
            deaf = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(3)]
            for number, each in enumerate(deaf):
                each.bind(str(path.with_name(f"{number:024x}")))
                each.listen()
            await until(lambda: bool(ear.warnings))
            assert len(select.select(deaf, [], [], 0.0)[0]) == 2
            late = await RawPeer.connect(path)
            async with late.stream:
                assert await late.end() == []
            stack.close()
            peer = await RawPeer.connect(path)
            async with peer.stream:
                await peer.meet()
                await ear.joined(peer.link)


@pytest.mark.thorough
@on_one_loop
async def test_a_stranger_that_says_nothing_is_sent_away(directory: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory)
    async with running(wire):
        stranger = await RawPeer.connect(files_in(directory)[0])
        async with stranger.stream:
            assert await stranger.end() == []


async def test_a_hello_without_end_is_cut_off(directory: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory)
    async with running(wire):
        stranger = await RawPeer.connect(files_in(directory)[0])
        async with stranger.stream:
            await stranger.stream.send(struct.pack("<I", LONGEST_HELLO + 1))
            assert await stranger.end() == []


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        (b"local 3", b"local 2"),
        (b"\n", b"\n?"),
        (b"robot", b"ro/bot"),
        (b" all", b" a/l"),
        (b" all", b""),
        (b"*", b"a b"),
    ],
    ids=["protocol", "id", "name", "channel", "no channel", "pattern"],
)
async def test_a_program_that_does_not_speak_the_protocol_is_not_heard(
    directory: str, right: bytes, wrong: bytes
) -> None:
    async with running(LocalWire(DOMAIN, directory=directory)) as ear:
        stranger = await RawPeer.connect(files_in(directory)[0])
        async with stranger.stream:
            await stranger.say(stranger.hello("robot").replace(right, wrong, 1))
            heard = await stranger.end()
        assert (heard, ear.items, len(ear.warnings)) == ([], [], 1)


async def test_a_program_on_the_loopback_that_does_not_know_the_key_is_not_heard(directory: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory, loopback=True)
    async with running(wire) as ear:
        (path,) = files_in(directory)
        port = int(path.read_text().split()[0])
        stranger = RawPeer(await anyio.connect_tcp("127.0.0.1", port))
        async with stranger.stream:
            await stranger.say(stranger.hello())
            assert await stranger.end() == []
        assert ear.items == []
        assert path.stat().st_mode & 0o777 == 0o600


OF_ANOTHER_USER = """
import os, socket, sys
os.setuid(65534)
link = socket.socket(socket.AF_UNIX)
link.connect(sys.argv[1])
try:
    link.sendall(bytes(4))
    print(len(link.recv(1)), flush=True)
except OSError:
    print(0, flush=True)
"""


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() != 0, reason="needs another user")
async def test_a_process_of_another_user_cannot_talk_even_if_it_may_enter(directory: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory)
    async with running(wire) as ear:
        (path,) = files_in(directory)
        for each in (path, path.parent, path.parent.parent):
            each.chmod(0o777)
        with Program(sys.executable, "-P", "-c", OF_ANOTHER_USER, path) as program:
            await anyio.to_thread.run_sync(program.output.expect, "^0$")
        await until(lambda: bool(ear.warnings))
        assert ear.items == []
        assert isinstance(ear.warnings[0], PermissionError)


# Faults

PEER = """
import os, signal, sys
import anyio
from tfbus.links.local.local_wire import LocalWire
from tfbus.links.seams import Hearing

async def main():
    wire = LocalWire("domain", "peer", directory=sys.argv[1], loopback=bool(sys.argv[4]))
    heard = lambda link, item: print(link, item if isinstance(item, bytes) else type(item).__name__, flush=True)
    await wire.open([Hearing("*", "all")], heard, lambda error: print(error, file=sys.stderr, flush=True))
    child, said = 0, b"-"
    if sys.argv[2] == "fork":
        ours, childs = os.pipe()
        child = os.fork()
        if not child:
            os.write(childs, str(wire.is_heard("all")).encode())
            signal.pause()
        said = os.read(ours, 10)
    print("open", wire.id, child, said.decode(), flush=True)
    await wire.run()

anyio.run(main, backend=sys.argv[3])
"""


def start_peer(directory: str, what: str = "run", backend: str = "asyncio", loopback: bool = False) -> Program:
    return Program(sys.executable, "-P", "-c", PEER, directory, what, backend, "loopback" * loopback)


async def expect(program: Program, pattern: str) -> str:
    return await anyio.to_thread.run_sync(program.output.expect, pattern)


@pytest.mark.parametrize(
    ("loopback", "younger"),
    [
        (False, False),
        *(pytest.param(*case, marks=pytest.mark.thorough) for case in ((False, True), (True, False), (True, True))),
    ],
)
async def test_the_end_of_a_killed_process_is_seen_and_its_name_removed(
    directory: str, loopback: bool, younger: bool
) -> None:
    wire = LocalWire(DOMAIN, directory=directory, loopback=loopback)
    async with AsyncExitStack() as stack:
        if not younger:
            program = stack.enter_context(start_peer(directory, loopback=loopback))
        ear = await stack.enter_async_context(running(wire))
        if younger:
            program = stack.enter_context(start_peer(directory, loopback=loopback))
        peer = (await expect(program, "^open")).split()[1]
        await ear.joined(peer)
        assert len(files_in(directory)) == 2
        program.process.kill()
        await ear.left(peer)
        await only_one_name(directory)


async def only_one_name(directory: str) -> None:
    with anyio.fail_after(20):
        while len(files_in(directory)) > 1:  # noqa: ASYNC110 - nothing tells
            await anyio.sleep(0.01)


async def test_a_process_that_is_stopped_is_present_and_hears_afterwards_what_was_said(directory: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory)
    with start_peer(directory) as program:
        peer = (await expect(program, "^open")).split()[1]
        async with running(wire) as ear:
            await ear.joined(peer)
            await expect(program, "Joined")
            program.process.send_signal(signal.SIGSTOP)
            late = LocalWire(DOMAIN, directory=directory)
            async with running(late) as late_ear:
                await late_ear.joined(wire.id)
                for number in range(2_000):
                    assert wire.is_heard("all")
                    wire.publish("all", f"message {number}".encode())
                assert peer in ear.present
                program.process.send_signal(signal.SIGCONT)
                await expect(program, f"^{wire.id} b'message 1999'")
                await late_ear.joined(peer)
            assert (peer, Left()) not in ear.items


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
@pytest.mark.parametrize("backend", ["asyncio", pytest.param("trio", marks=pytest.mark.thorough)])
async def test_a_child_process_holds_no_connection_open(directory: str, backend: str) -> None:
    wire = LocalWire(DOMAIN, directory=directory)
    with start_peer(directory, "fork", backend) as program:
        _, peer, child, published = (await expect(program, "^open")).split()
        try:
            assert published == "False"
            async with running(wire) as ear:
                await ear.joined(peer)
                program.process.kill()
                await ear.left(peer)
        finally:
            os.kill(int(child), signal.SIGKILL)


async def test_a_file_at_which_nobody_listens_is_removed(directory: str, loopback: bool) -> None:
    elder = LocalWire(DOMAIN, directory=directory, loopback=loopback)
    async with running(elder):
        (path,) = files_in(directory)
        # A name of before the elder, and one of after both.
        for name in ("0" * 24, "f" * 24):
            if loopback:
                with socket.create_server(("127.0.0.1", 0)) as server:
                    port = server.getsockname()[1]
                path.with_name(name).write_text(f"{port} {'00' * 32}")
            else:
                with socket.socket(socket.AF_UNIX) as dead:
                    dead.bind(str(path.with_name(name)))
        path.with_name("0" * 23 + "1").write_text("no socket, no port")
        path.with_name("0" * 23 + "2").write_text(f"65536 {'00' * 32}")
        younger = LocalWire(DOMAIN, directory=directory, loopback=loopback)
        async with running(younger) as ear:
            await ear.joined(elder.id)
        await only_one_name(directory)


@pytest.mark.every_loop
async def test_links_meet_although_the_directory_has_vanished(directory: str, loopback: bool) -> None:
    async with pair(directory, loopback) as (one, ear_one, two, _):
        shutil.rmtree(directory)
        third = LocalWire(DOMAIN, directory=directory, loopback=loopback)
        async with running(third) as ear:
            await ear.joined(one.id)
            await ear.joined(two.id)
            await ear_one.joined(third.id)
        assert two.send(one.id, b"still here")
        await until(lambda: ear_one.said(two.id) == [b"still here"])


def is_private(path: Path) -> bool:
    return path.stat().st_mode & 0o777 == 0o700


async def test_a_directory_that_vanishes_while_a_link_opens_is_made_again_for_its_user_alone(
    directory: str, loopback: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, bind = Path(directory, "run"), socket.socket.bind
    # Somebody removes all of it, and a link that leaves only the folder of the domain.
    vanishes = ["folder", "all", "folder"]

    def vanish_and_bind(sock: socket.socket, address: Any) -> None:
        if vanishes:
            (folder,) = root.iterdir()
            shutil.rmtree(root if vanishes.pop() == "all" else folder)
        bind(sock, address)

    monkeypatch.setattr(socket.socket, "bind", vanish_and_bind)
    async with pair(str(root), loopback):
        assert not vanishes
        assert is_private(root)
    assert files_in(str(root.parent)) == []


async def test_a_directory_that_vanishes_before_its_folder_is_made_is_private_again(
    directory: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, mkdir = Path(directory, "run"), os.mkdir

    def vanish_and_make(path: Path, *options: Any) -> None:
        if Path(path).parent == root and not is_remade:
            is_remade.append(True)
            shutil.rmtree(root)
        mkdir(path, *options)

    is_remade: list[bool] = []
    monkeypatch.setattr(os, "mkdir", vanish_and_make)
    async with pair(str(root)):
        assert is_remade
        assert is_private(root)


@pytest.mark.every_loop
async def test_links_work_where_the_system_has_no_poll_object_that_is_a_file(
    directory: str, loopback: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As on Windows.
    monkeypatch.setattr(selectors, "DefaultSelector", selectors.SelectSelector)
    large = bytes(1_000_000)
    one = LocalWire(DOMAIN, directory=directory, loopback=loopback)
    async with running(one) as ear:
        async with pair(directory, loopback) as (two, ear_two, three, ear_three):
            await ear_two.joined(one.id)
            await ear_three.joined(one.id)
            assert two.send(one.id, large)
            assert three.is_heard("all")
            three.publish("all", b"to all")
            await until(lambda: (ear.said(two.id), ear.said(three.id)) == ([large], [b"to all"]))
        await ear.left(two.id)
        await ear.left(three.id)


async def test_a_socket_that_is_closed_while_a_thread_waits_for_it_ends_no_link(
    directory: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Windows(selectors.SelectSelector):
        """Fails as there, where a wait ends with an error if one of its sockets is closed."""

        def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
            before = set(self.get_map())
            ready = super().select(timeout)
            if threading.current_thread() is not threading.main_thread() and before - set(self.get_map() or before):
                failed.append(True)
                raise OSError(errno.EBADF, "not a socket")
            return ready

    failed: list[bool] = []
    monkeypatch.setattr(selectors, "DefaultSelector", Windows)
    monkeypatch.setattr(local_wire, "PATIENCE", 0.1)
    async with pair(directory, loopback=True) as (one, _, two, ear_two):
        strangers = [await RawPeer.connect(path) for path in files_in(directory) for _ in range(5)]
        await until(lambda: bool(failed))
        for stranger in strangers:
            await stranger.stream.aclose()
        assert one.send(two.id, b"still here")
        await until(lambda: ear_two.said(one.id) == [b"still here"])


@pytest.mark.every_loop
async def test_a_link_without_free_files_goes_on_and_meets_others_when_there_are_some(directory: str) -> None:
    async with pair(directory) as (one, ear, two, _):
        path = files_in(directory)[0]
        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        with socket.socket(socket.AF_UNIX) as late:
            lowest = os.dup(0)
            os.close(lowest)
            resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, limits[1]))
            try:
                late.connect(str(path))
                await until(lambda: bool(ear.warnings))
                assert two.send(one.id, b"still here")
                await until(lambda: ear.said(two.id) == [b"still here"])
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, limits)
            peer = RawPeer(await anyio.abc.SocketStream.from_socket(late.dup()))
            async with peer.stream:
                await peer.meet()
                await ear.joined(peer.link)


async def test_a_link_at_the_loopback_whose_folder_is_closed_for_a_moment_is_met_afterwards(
    directory: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[str] = []
    scandir = os.scandir

    def refuse_once(path: str) -> Any:
        looks.append(path)
        if len(looks) == 2:
            raise PermissionError("closed for a moment")
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse_once)
    wire = LocalWire(DOMAIN, directory=directory, loopback=True)
    async with running(wire) as ear:
        await until(lambda: len(looks) >= 3)
        assert len(ear.warnings) == 1
        async with running(LocalWire(DOMAIN, directory=directory, loopback=True)) as other:
            await met(ear, other)


# Opening and closing


def folder_of(directory: str, folder: str, mode: int) -> Path:
    place = Path(directory, folder)
    place.mkdir(exist_ok=True)
    place.chmod(mode)
    return place


def file_and_link(directory: str) -> tuple[Path, Path]:
    file, link = Path(directory, "file"), Path(directory, "link")
    file.touch()
    link.symlink_to(directory)
    return file, link


@pytest.mark.parametrize("folder", ["", "sub"])
async def test_a_directory_that_others_may_enter_is_refused_with_what_to_do(directory: str, folder: str) -> None:
    place = folder_of(directory, folder, 0o755)
    wire = LocalWire(DOMAIN, directory=str(place))
    with pytest.raises(PermissionError, match=rf"{place} has the mode 755, .*: run chmod 700 {place}, or set TFBUS"):
        async with running(wire):
            pass


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() != 0, reason="needs another user")
async def test_a_directory_of_another_user_is_refused(directory: str) -> None:
    os.chown(directory, 65534, -1)
    with pytest.raises(PermissionError, match="belongs to the user 65534, and this process is of 0: remove it, or set"):
        async with running(LocalWire(DOMAIN, directory=directory)):
            pass


async def test_a_file_or_a_symbolic_link_in_place_of_the_directory_is_refused(directory: str) -> None:
    for place in file_and_link(directory):
        with pytest.raises(PermissionError, match="director"):
            async with running(LocalWire(DOMAIN, directory=str(place))):
                pass


async def test_a_relative_directory_stays_where_it_was(
    directory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(directory)
    async with running(LocalWire(DOMAIN, directory="run")) as ear:
        monkeypatch.chdir(tmp_path)
        for _ in range(2):
            async with running(LocalWire(DOMAIN, directory=str(Path(directory, "run")))) as other:
                await met(ear, other)
            await anyio.sleep(0.2)
        assert files_in(str(tmp_path)) == []


async def test_a_path_that_is_too_long_for_a_socket_is_told(directory: str) -> None:
    # The last one is too long for the name of a directory, too.
    for length in (20, 100):
        with pytest.raises(OSError, match=r"may have 100 bytes, and /.* too long: set TFBUS_RUNTIME_DIR"):
            async with running(LocalWire(DOMAIN, directory=str(Path(directory, "long" * length)))):
                pass
    async with running(LocalWire(DOMAIN, directory=str(Path(directory, "long" * 20)), loopback=True)):
        pass


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"TFBUS_RUNTIME_DIR": "{}/own", "XDG_RUNTIME_DIR": "{}/users"}, "own"),
        ({"TFBUS_RUNTIME_DIR": "", "XDG_RUNTIME_DIR": "{}/users"}, "users/tfbus"),
    ],
)
async def test_the_environment_names_the_directory(
    variables: dict[str, str], expected: str, directory: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value.format(directory))
    async with running(LocalWire(DOMAIN)):
        assert len(files_in(str(Path(directory, expected)))) == 1


@pytest.mark.every_loop
@pytest.mark.parametrize("loopback", [False, True])
async def test_all_that_waits_goes_out_when_a_link_closes(directory: str, loopback: bool) -> None:
    messages = [bytes(1_000_000) + str(number).encode() for number in range(5)]
    async with running(LocalWire(DOMAIN, directory=directory, loopback=loopback)) as stays:
        async with running(LocalWire(DOMAIN, directory=directory, loopback=loopback)) as ends:
            await met(stays, ends)
            for message in messages:
                assert ends.wire.send(stays.id, message)
            # This one comes too late to be read.
            stays.wire.publish(LIVE, b"goodbye")
        await stays.left(ends.id)
        assert stays.said(ends.id) == messages


@pytest.mark.thorough
async def test_a_link_closes_although_another_does_not_read(directory: str) -> None:
    async with AsyncExitStack() as stack:
        with anyio.fail_after(10):
            wire = LocalWire(DOMAIN, directory=directory)
            async with running(wire) as ear:
                peer = await RawPeer.connect(files_in(directory)[0])
                await stack.enter_async_context(peer.stream)
                await peer.meet()
                await ear.joined(peer.link)
                for _ in range(10):
                    assert wire.send(peer.link, bytes(1_000_000))


@pytest.mark.thorough
async def test_a_link_opened_and_closed_often_leaves_no_memory_no_files_and_no_threads(directory: str) -> None:
    async def once() -> None:
        async with pair(directory):
            pass

    for _ in range(20):
        await once()
    files, threads = len(list(OPEN_FILES.iterdir())), threading.active_count()
    tracemalloc.start()
    try:
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(250):
            await once()
        gc.collect()
        left = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert left / 500 < 2_000
    assert len(list(OPEN_FILES.iterdir())) <= files
    assert threading.active_count() <= threads
