"""The guide's page *Security*: each of its statements names the test that holds it; the tests here hold the rest."""

import inspect
import re
import socket
import sys
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trimesh", reason="the servers of all extras are looked at")
pytest.importorskip("foxglove", reason="the servers of all extras are looked at")
pytest.importorskip("zenoh", reason="the servers of all extras are looked at")
pytest.importorskip("cyclonedds", reason="the servers of all extras are looked at")
pytest.importorskip("cbor2", reason="the servers of all extras are looked at")
pytest.importorskip("cyclopts", reason="the servers of all extras are looked at")

import httpx
from anyio import create_task_group
from support.processes import free_address, free_ports, new_domain, until
from support.rosbridge import rosbridge_server

from tfbus import Buffer, Bus, LocalLink, RemoteLookupError, Transform, TransformBroadcaster
from tfbus.cli.arguments import UsageError
from tfbus.cli.commands.router import router
from tfbus.links import BufferServer
from tfbus.links.dds import DdsLink
from tfbus.links.foxglove import FoxgloveServer
from tfbus.links.local.local_wire import LocalWire
from tfbus.links.message import Kind, write_body
from tfbus.links.rmw_zenoh import RmwZenohLink
from tfbus.links.rosbridge import RosbridgeLink, RosbridgeServer
from tfbus.links.zenoh import ZenohLink, ZenohRouter, zenoh_router
from tfbus.links.zenoh.sessions import open_session, session_config
from tfbus.view import View

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "demos" / "guide" / "security.md").read_text(encoding="utf-8")

LOOPBACK = re.compile(r"\w{6}7F|0{24}01000000")
"""127.x.y.z and ::1 in the byte order of the machine."""


def test_each_statement_of_the_page_names_a_test_that_there_is() -> None:
    prose = PAGE.split("\n## ", 1)[1]
    statements = re.findall(r"^\* .*?(?=^\* |^\n|\Z)", prose, re.MULTILINE | re.DOTALL)
    assert len(statements) > 20
    for statement in statements:
        held_by = re.findall(r"<!-- (tests/\S+)::(\w+) -->", statement)
        assert held_by, f"no test holds: {statement}"
        for file, test in held_by:
            assert re.search(rf"^(async )?def {test}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), test


def sockets() -> set[str]:
    """The sockets of this process that others can send to: kind and address."""
    own = set()
    for entry in Path("/proc/self/fd").iterdir():
        # The descriptor that read this list is closed by now.
        with suppress(FileNotFoundError):
            own.add(str(entry.readlink()))
    found = set()
    for kind in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/self/net/{kind}").read_text(encoding="ascii").splitlines()[1:]:
            fields = line.split()
            # State 0A is LISTEN; a socket of UDP is always open.
            if f"socket:[{fields[9]}]" in own and (kind.startswith("udp") or fields[3] == "0A"):
                found.add(f"{kind} {fields[1]}")
    return found


Made = Callable[[Bus, Buffer], AbstractAsyncContextManager[Any]]
SERVERS: dict[str, Made] = {
    "View": lambda bus, buffer: View(bus, buffer, 0),
    "FoxgloveServer": lambda bus, _: FoxgloveServer(bus, 0),
    "RosbridgeServer": lambda bus, buffer: RosbridgeServer(bus, 0, buffer=buffer),
}


async def opened_by(made: AbstractAsyncContextManager[Any]) -> set[str]:
    before = sockets()
    async with made:
        return sockets() - before


def is_of_this_machine(place: str) -> bool:
    return LOOPBACK.fullmatch(place.split()[1].partition(":")[0]) is not None


on_linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells what listens in a file")


@pytest.mark.anyio
@on_linux
@pytest.mark.parametrize("name", SERVERS)
async def test_by_default_only_this_machine_reaches(name: str) -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        opened = await opened_by(SERVERS[name](bus, buffer))
    assert opened
    assert all(map(is_of_this_machine, opened)), opened


@pytest.mark.anyio
@on_linux
@pytest.mark.parametrize("name", ["LocalLink", "ZenohLink", "BufferServer", "RosbridgeLink", "RmwZenohLink"])
async def test_a_link_that_connects_listens_nowhere(name: str) -> None:
    address = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    with Bus() as bus, Buffer(bus) as buffer:
        if name == "LocalLink":
            opened = await opened_by(LocalLink(bus, new_domain()))
        elif name == "BufferServer":
            async with LocalLink(bus, new_domain()) as link:
                opened = await opened_by(BufferServer(buffer, link))
        elif name == "RosbridgeLink":
            async with rosbridge_server() as server:
                opened = await opened_by(RosbridgeLink(bus, server.url))
        else:
            made = (
                ZenohLink(bus, new_domain(), connect=address) if name == "ZenohLink" else RmwZenohLink(bus, address, 87)
            )
            async with ZenohRouter(address):
                opened = await opened_by(made)
    assert opened == set()


@pytest.mark.anyio
async def test_a_peer_of_a_link_cannot_fill_the_bus() -> None:
    domain = new_domain()
    with Bus() as bus, Buffer(bus) as buffer, Bus() as stranger:
        async with LocalLink(bus, domain, max_frames=3) as link, LocalLink(stranger, domain):
            for number in range(10):
                TransformBroadcaster(stranger).send_static("map", f"frame {number}", Transform())
            await until(lambda: link.statistics().rejected.get("too many frames", 0) >= 7)
            assert len(buffer.tree.frames()) == 4


@pytest.mark.anyio
async def test_a_buffer_server_takes_no_more_lookups_than_may_wait_and_garbage_harms_nobody() -> None:
    domain = new_domain()
    stranger = LocalWire(domain)
    with Bus() as bus, Buffer(bus) as buffer, Bus() as other:
        async with LocalLink(bus, domain) as link, LocalLink(other, domain) as asker, create_task_group() as tasks:
            await stranger.open([], lambda *_: None, print)
            tasks.start_soon(stranger.run)
            async with BufferServer(buffer, link, capacity=2) as server:

                async def ask(frame: str) -> None:
                    with suppress(RemoteLookupError):
                        await asker.lookup("map", frame, timeout=60.0)

                for number in range(3):
                    tasks.start_soon(ask, f"frame {number}")
                await until(lambda: server.statistics().refused == {"busy": 1})
                for garbage in (b"{", b"[" * 10_000, b'{"target": 1}', b"\xff" * 99):
                    await until(lambda said=garbage: stranger.send(link.id, write_body(Kind.LOOKUP, bytes(8) + said)))  # type: ignore[misc]
                await until(lambda: server.statistics().refused == {"busy": 1, "malformed": 4})
                TransformBroadcaster(bus).send_static("map", "dock", Transform((4.0, 1.0, 0.0)))
                found = await asker.lookup("map", "dock", timeout=5.0)
                assert found.transform.translation == (4.0, 1.0, 0.0)
                tasks.cancel_scope.cancel()
    await stranger.close()


@pytest.mark.anyio
async def test_a_guest_that_may_not_publish_cannot_speak_for_another_link(tmp_path: Path) -> None:
    domain, at_guests, at_friends = new_domain(), free_address(), f"unixsock-stream/{tmp_path}/router"
    rule = {
        "id": "publishing",
        "messages": ["put", "delete"],
        "flows": ["ingress"],
        "permission": "deny",
        "key_exprs": ["tfbus/**", "tfbus/**/@to/*"],
    }
    rules = {
        "enabled": True,
        "default_permission": "allow",
        "rules": [rule],
        "subjects": [{"id": "guests", "link_protocols": ["tcp"]}],
        "policies": [{"rules": ["publishing"], "subjects": ["guests"]}],
    }
    with Bus() as bus, Bus() as guest, Buffer(guest) as buffer:
        async with (
            ZenohRouter([at_guests, at_friends], config={"access_control": rules}),
            ZenohLink(bus, domain, connect=at_friends) as robot,
            ZenohLink(Bus(), domain, connect=at_friends) as friend,
            ZenohLink(guest, domain, connect=at_guests),
        ):
            await until(lambda: friend.id in robot.peers)
            TransformBroadcaster(bus).send_static("base_link", "laser", Transform())
            await until(lambda: "laser" in buffer.tree.frames())
            for address in (at_guests, at_friends):
                session = open_session(session_config(None, address, None, None))
                session.put(f"tfbus/{domain}/@to/{robot.id}", b"noise", attachment=bytes.fromhex(friend.id))
                session.close()
            await until(lambda: robot.statistics().rejected != {})
            assert robot.statistics().rejected == {"version": 1}


@pytest.mark.anyio
@on_linux
async def test_dds_has_ports_open_at_all_addresses_although_it_looks_for_this_machine_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for variable in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "CYCLONEDDS_URI"):
        monkeypatch.delenv(variable, raising=False)
    with Bus() as bus:
        opened = await opened_by(DdsLink(bus, 87))
    assert {place.split()[0] for place in opened} == {"udp"}
    assert not all(map(is_of_this_machine, opened))


def test_a_router_listens_at_the_loopback_unless_it_is_told_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    default = inspect.signature(ZenohRouter).parameters["listen"].default
    assert default == zenoh_router.ROUTER
    assert re.fullmatch(r"tcp/127\.0\.0\.1:\d+", default)
    # Where the default cannot be listened at, the command says where it would have been.
    with socket.create_server(("127.0.0.1", 0)) as taken:
        monkeypatch.setattr(zenoh_router, "ROUTER", f"tcp/127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(UsageError, match=f"cannot listen at {zenoh_router.ROUTER}"):
            router()


@pytest.mark.anyio
async def test_a_page_that_is_opened_to_the_network_still_asks_which_site_uses_it() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        async with View(bus, buffer, 0, host="0.0.0.0") as view:
            address = f"http://127.0.0.1:{view.address.rpartition(':')[2]}"
            for host, status in (("192.0.2.7", 200), ("evil.example", 403)):
                async with httpx.AsyncClient(trust_env=False) as client:
                    assert (await client.get(address, headers={"Host": host})).status_code == status
