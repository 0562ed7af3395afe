import json
import math
import shutil
import subprocess
from contextlib import AsyncExitStack
from inspect import signature
from pathlib import Path
from typing import Any

import anyio
import pytest
from support.processes import crowd, free_ports, new_domain, until
from support.samples import moving, static

from tfbus import Buffer, Bus
from tfbus.links._message import MAX_BYTES
from tfbus.links.zenoh import BufferClient, BufferServer, ZenohLink, ZenohRouter, _settings
from tfbus.links.zenoh._settings import MEETING_POINT, Addresses, identity, patch_settings, settings

LISTEN, CONNECT = "listen/endpoints", "connect/endpoints"
LOOPBACK = "tcp/127.0.0.1:0"


def read(
    path: str,
    listen: Addresses | None = None,
    connect: Addresses | None = None,
    config: dict[str, Any] | None = None,
    lease: float | None = 2.0,
) -> Any:
    """The value of one of zenoh's settings."""
    return json.loads(settings(listen, connect, config, lease).get_json(path))


def test_without_an_address_links_meet_on_the_loopback_only() -> None:
    assert read(LISTEN) == [MEETING_POINT, LOOPBACK]
    assert read(CONNECT) == [MEETING_POINT]
    assert MEETING_POINT.startswith("tcp/127.0.0.1:")
    assert read("scouting/multicast/enabled") is False
    assert read("mode") == "peer"
    # It would leave a file open for each link that has ended.
    assert read("transport/shared_memory/enabled") is False


@pytest.mark.parametrize("addresses", ["tcp/192.168.1.5:7447", ["tcp/192.168.1.5:7447"], ("tcp/192.168.1.5:7447",)])
def test_one_address_may_be_given_as_text_or_in_a_list(addresses: Addresses) -> None:
    assert read(LISTEN, listen=addresses) == ["tcp/192.168.1.5:7447"]
    assert read(CONNECT, connect=addresses) == ["tcp/192.168.1.5:7447"]


def test_a_link_with_an_address_does_not_use_the_meeting_point() -> None:
    assert read(CONNECT, listen="tcp/127.0.0.1:7000") == []
    assert read(LISTEN, connect="tcp/127.0.0.1:7000") == [LOOPBACK]
    config = {LISTEN: ["tcp/127.0.0.1:7000"]}
    assert (read(LISTEN, config=config), read(CONNECT, config=config)) == (["tcp/127.0.0.1:7000"], [])
    config = {CONNECT: ["tcp/127.0.0.1:7000"]}
    assert (read(LISTEN, config=config), read(CONNECT, config=config)) == ([LOOPBACK], ["tcp/127.0.0.1:7000"])
    assert read(CONNECT, config={"connect": {"endpoints": ["tcp/127.0.0.1:7000"]}}) == ["tcp/127.0.0.1:7000"]


@pytest.mark.parametrize("address", ["tls/192.168.1.5:7447", "quic/192.168.1.5:7447"])
def test_a_link_that_connects_with_a_certificate_opens_no_port_without_one(address: str) -> None:
    assert read(LISTEN, connect=address) == []
    assert read(LISTEN, connect=[address, "tcp/127.0.0.1:7000"]) == [LOOPBACK]
    assert read(LISTEN, connect=address, listen="tcp/127.0.0.1:7000") == ["tcp/127.0.0.1:7000"]


def test_options_of_connecting_are_no_address() -> None:
    config = {"connect/retry": {"period_max_ms": 5_000}, "listen/timeout_ms": 100}
    assert read(LISTEN, config=config) == [MEETING_POINT, LOOPBACK]
    assert read(CONNECT, config=config) == [MEETING_POINT]


def test_only_a_link_with_a_listening_address_of_its_own_fails_if_it_cannot_listen() -> None:
    assert read("listen/exit_on_failure") is False
    assert read("listen/exit_on_failure", connect="tcp/127.0.0.1:7000") is False
    assert read("listen/exit_on_failure", listen="tcp/127.0.0.1:7000") is not False
    assert read("listen/exit_on_failure", config={LISTEN: ["tcp/127.0.0.1:7000"]}) is not False


def test_a_peer_waits_for_others_for_ever_and_a_client_or_for_an_address_that_is_taken_nobody_does() -> None:
    # For zenoh -1 is for ever.
    assert read("connect/timeout_ms") == {"peer": -1, "router": -1, "client": 0}
    assert read("connect/exit_on_failure") is False
    assert read("listen/timeout_ms") == 0


def test_messages_that_no_link_takes_are_not_even_assembled() -> None:
    assert MAX_BYTES < read("transport/link/rx/max_message_size") <= 2 * MAX_BYTES


@pytest.mark.parametrize(
    ("where", "one_dials"),
    [
        ({}, True),
        ({"listen": "tcp/127.0.0.1:7000"}, True),
        ({"connect": ["tcp/[::1]:7000", "udp/localhost:7000"]}, True),
        # Whoever is greater might not reach the other one.
        ({"listen": "tcp/192.168.1.5:7000"}, False),
        ({"connect": "tcp/192.168.1.5:7000"}, False),
        ({"connect": ["tcp/127.0.0.1:7000", "tcp/localhost.example:7000"]}, False),
        ({"listen": "unixpipe//tmp/pipe"}, False),
        ({"listen": []}, False),
        ({"config": {"listen": {"endpoints": ["tcp/192.168.1.5:7000"]}}}, False),
        ({"config": {"connect/endpoints": ["tcp/192.168.1.5:7000"]}}, False),
        ({"config": {"id": "a"}}, False),
        ({"config": {"transport/link/tx/keep_alive": 4}}, True),
    ],
)
def test_a_link_on_the_loopback_dials_smaller_ids_only_and_has_a_greater_one_than_those_on_a_network(
    where: dict[str, Any], one_dials: bool
) -> None:
    for _ in range(20):
        own = identity(where.get("listen"), where.get("connect"), where.get("config"))
        id = own["id"]  # noqa: A001
        found = read("scouting/gossip/autoconnect_strategy", config=own)
        assert found == ({"peer": {"to_router": "always", "to_peer": "greater-zid"}} if one_dials else None)
        assert read("id", config=own) == id
        assert len(id) == 32
        for byte in (id[:2], id[-2:]):
            assert ("c0" <= byte <= "ff") if one_dials else ("80" <= byte <= "bf")
    assert identity(None, None, None)["id"] != identity(None, None, None)["id"]


@pytest.mark.anyio
@pytest.mark.parametrize("attempt", range(4))
async def test_links_on_the_loopback_dial_those_on_a_network_that_cannot_dial_them(attempt: int) -> None:
    domain, (port, other) = new_domain(), free_ports(2)
    meeting = f"tcp/127.0.0.1:{port}"
    on_network = {"listen": f"tcp/0.0.0.0:{other}", "config": {"scouting/gossip/autoconnect": {"peer": []}}}
    async with AsyncExitStack() as stack:
        links = [ZenohLink(stack.enter_context(Bus()), domain, listen=meeting)]
        for number in range(4):
            side: dict[str, Any] = on_network if number == attempt else {}
            links.append(ZenohLink(stack.enter_context(Bus()), domain, connect=meeting, **side))
        for link in links:
            await stack.enter_async_context(link)
        await until(lambda: [len(link.peers) for link in links] == [4] * 5)


def test_settings_of_zenoh_win_over_those_of_the_link() -> None:
    config = {"scouting/multicast/enabled": True, "transport/link/tx/lease": 7_000, "mode": "client", LISTEN: []}
    assert read("scouting/multicast/enabled", config=config) is True
    assert read("transport/link/tx/lease", config=config) == 7_000
    assert read("mode", config=config) == "client"
    assert read(LISTEN, listen="tcp/127.0.0.1:7000", config=config) == []


def test_a_patch_connects_to_one_address_and_takes_nothing_else_of_where_the_link_is() -> None:
    address = "tcp/10.0.0.1:7"
    given = {
        "id": "ab",
        "mode": "router",
        "listen/endpoints": ["tcp/127.0.0.1:8"],
        "connect/endpoints": ["tcp/127.0.0.1:9"],
        "scouting/multicast/enabled": True,
        "transport/link/tx/batch_size": 4_096,
    }
    patch = patch_settings(address, given, 3.0)
    plain = patch_settings(address, None, 3.0)

    def value(config: Any, path: str) -> Any:
        return json.loads(config.get_json(path))

    assert value(patch, "connect/endpoints") == [address]
    assert value(patch, "transport/link/tx/batch_size") == 4_096
    assert value(patch, "transport/link/tx/lease") == 3_000
    assert value(patch, "scouting/gossip/enabled") is False
    for path in ("id", "mode", "listen/endpoints", "scouting/multicast/enabled"):
        assert value(patch, path) == value(plain, path), path


def test_the_lease_is_in_milliseconds() -> None:
    assert read("transport/link/tx/lease", lease=1.5) == 1_500
    assert read("transport/link/tx/lease", lease=1) == 1_000
    assert read("transport/link/tx/lease", lease=1e-9) == 1


def test_two_signs_of_life_go_out_in_a_lease_unless_zenoh_is_told_otherwise() -> None:
    assert read("transport/link/tx/keep_alive") == 2
    assert read("transport/link/tx/keep_alive", config={"transport/link/tx/keep_alive": 4}) == 4


def test_links_routers_and_lookups_have_by_default_the_lease_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds: list[Any] = [ZenohLink, ZenohRouter, BufferServer, BufferClient]
    assert [signature(kind).parameters["lease"].default for kind in kinds] == [None] * 4
    for lease in (4.0, 10.0):
        monkeypatch.setattr(_settings, "default_lease", lambda lease=lease: lease)
        assert read("transport/link/tx/lease", lease=None) == lease * 1_000
        patch = patch_settings("tcp/127.0.0.1:7000", None, None)
        assert json.loads(patch.get_json("transport/link/tx/lease")) == lease * 1_000
        assert read("transport/link/tx/lease", lease=3.0) == 3_000


@pytest.mark.parametrize("lease", [0.0, -1.0, math.nan, math.inf])
def test_a_lease_is_a_time_that_passes(lease: float) -> None:
    with pytest.raises(ValueError, match="lease"):
        settings(None, None, None, lease)


@pytest.mark.parametrize(
    "address",
    [
        "",
        "garbage",
        "127.0.0.1:7447",
        "tcp/",
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:",
        "tcp/127.0.0.1:65536",
        "xyz/1.2.3.4:5",
    ],
)
def test_an_error_names_a_malformed_address(address: str) -> None:
    for listen, connect in ((address, None), (None, address), (None, ["tcp/127.0.0.1:7000", address])):
        with pytest.raises(ValueError, match=f"not {address!r}"):
            settings(listen, connect, None, 2.0)


@pytest.mark.parametrize(
    "address",
    [
        "tcp/[::1]:7447",
        "tls/robot.local:0",
        "udp/0.0.0.0:7447",
        "quic/robot:1#iface=eth0",
        "unixsock-stream//tmp/robot",
    ],
)
def test_addresses_of_all_kinds_go_through(address: str) -> None:
    assert read(LISTEN, listen=address) == [address]


@pytest.mark.parametrize(
    ("path", "value"),
    [("no/such/setting", 1), ("mode", "nonsense"), ("mode", math.nan), ("transport/link/tx/lease", "long"), ("", 1)],
)
def test_a_setting_that_zenoh_does_not_take_is_named_with_its_value(path: str, value: object) -> None:
    with pytest.raises(ValueError, match="zenoh does not take") as caught:
        settings(None, None, {path: value}, 2.0)
    assert repr(path) in str(caught.value)
    assert repr(value) in str(caught.value)
    assert ".rs:" not in str(caught.value)


def test_a_setting_that_is_not_json_is_named() -> None:
    with pytest.raises(ValueError, match="'mode'"):
        settings(None, None, {"mode": object()}, 2.0)


def listening(pid: int, kind: str) -> set[str]:
    """The local addresses, in hex, at which a process can be reached."""
    own = {fd.readlink().name for fd in Path(f"/proc/{pid}/fd").iterdir() if fd.is_symlink()}
    found = set()
    for line in Path(f"/proc/{pid}/net/{kind}").read_text(encoding="ascii").splitlines()[1:]:
        fields = line.split()
        # State 0A is LISTEN; a socket of UDP is always open.
        if f"socket:[{fields[9]}]" in own and (kind.startswith("udp") or fields[3] == "0A"):
            found.add(fields[1].partition(":")[0])
    return found


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs /proc/net")
def test_without_an_address_a_process_can_be_reached_over_the_loopback_only() -> None:
    with crowd() as processes:
        first, second = processes.add({"domain": (domain := new_domain())}), processes.add({"domain": domain})
        first.ask("until", peers=1)
        for process in (first, second):
            # 127.0.0.1, in the byte order of the machine.
            assert listening(process.pid, "tcp") == {"0100007F"}
            assert listening(process.pid, "tcp6") == set()
            assert listening(process.pid, "udp") | listening(process.pid, "udp6") == set()


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a certificate authority's own certificate, and those that it gave to a robot and to a guest."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs the program openssl")
    folder = tmp_path_factory.mktemp("certificates")
    new = [openssl, "req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]

    def call(*arguments: str) -> None:
        subprocess.run(arguments, cwd=folder, check=True, capture_output=True, timeout=60)

    call(*new, "-x509", "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=ca", "-days", "2")
    for name in ("robot", "guest"):
        (folder / f"{name}.ext").write_text(
            "subjectAltName=IP:127.0.0.1\nbasicConstraints=CA:FALSE\n", encoding="ascii"
        )
        call(*new, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        signed = ("-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-extfile", f"{name}.ext", "-days", "2")
        call(openssl, "x509", "-req", "-in", f"{name}.csr", *signed, "-out", f"{name}.pem")
    return folder


def tls(folder: Path, name: str) -> dict[str, Any]:
    return {
        "transport/link/tls": {
            "root_ca_certificate": str(folder / "ca.pem"),
            "listen_certificate": str(folder / f"{name}.pem"),
            "listen_private_key": str(folder / f"{name}.key"),
            "connect_certificate": str(folder / f"{name}.pem"),
            "connect_private_key": str(folder / f"{name}.key"),
            "enable_mtls": True,
        }
    }


@pytest.mark.anyio
async def test_two_links_talk_over_tls(certificates: Path) -> None:
    address = f"tls/127.0.0.1:{free_ports(1)[0]}"
    domain = new_domain()
    with Bus() as robot, Bus() as guest, Buffer(guest) as buffer:
        robot.publish(static("map", "base", 1.0))
        async with (
            ZenohLink(robot, domain, listen=address, config=tls(certificates, "robot")),
            ZenohLink(guest, domain, connect=address, config=tls(certificates, "guest")),
        ):
            with anyio.fail_after(30):
                assert (await buffer.lookup("map", "base")).transform.translation[0] == 1.0


@pytest.mark.anyio
async def test_nobody_joins_over_tls_without_a_certificate(certificates: Path) -> None:
    address = f"tls/127.0.0.1:{free_ports(1)[0]}"
    domain = new_domain()
    stranger = {"transport/link/tls/root_ca_certificate": str(certificates / "ca.pem")}
    with Bus() as robot, Bus() as guest, Bus() as other:
        async with (
            ZenohLink(robot, domain, listen=address, config=tls(certificates, "robot")) as link,
            ZenohLink(other, domain, listen=[], connect=address, config=stranger) as refused,
            # It comes behind the other and gets in.
            ZenohLink(guest, domain, connect=address, config=tls(certificates, "guest")) as welcome,
        ):
            await until(lambda: welcome.peers == (link.id,) and link.peers != ())
            assert refused.peers == ()
            assert link.peers == (welcome.id,)


def denied_to_guests(*messages: str) -> dict[str, Any]:
    """The setting by which guests may not send some kinds of messages of zenoh."""
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "allow",
            "rules": [
                {
                    "id": "publishing",
                    "messages": messages,
                    "flows": ["ingress"],
                    "permission": "deny",
                    "key_exprs": ["tfbus/**"],
                }
            ],
            "subjects": [{"id": "guests", "cert_common_names": ["guest"]}],
            "policies": [{"rules": ["publishing"], "subjects": ["guests"]}],
        }
    }


@pytest.mark.anyio
async def test_a_guest_whose_answers_are_not_denied_brings_static_frames(certificates: Path) -> None:
    address, domain = f"tls/127.0.0.1:{free_ports(1)[0]}", new_domain()
    control = tls(certificates, "robot") | denied_to_guests("put", "delete")
    with Bus() as robot, Bus() as guest, Buffer(robot) as own:
        guest.publish(static("map", "too early"))
        async with (
            ZenohLink(robot, domain, listen=address, config=control),
            ZenohLink(guest, domain, connect=address, config=tls(certificates, "guest")),
        ):
            with anyio.fail_after(30):
                await own.lookup("map", "too early")


@pytest.mark.anyio
async def test_access_control_lets_a_guest_listen_and_not_publish(certificates: Path) -> None:
    address = f"tls/127.0.0.1:{free_ports(1)[0]}"
    domain = new_domain()
    read_only = denied_to_guests("put", "delete", "reply")
    with Bus() as robot, Bus() as guest, Buffer(robot) as own, Buffer(guest) as buffer:
        guest.publish(static("map", "too early"))
        async with ZenohLink(robot, domain, listen=address, config=tls(certificates, "robot") | read_only) as link:
            async with ZenohLink(guest, domain, connect=address, config=tls(certificates, "guest")) as other:
                await until(lambda: link.peers == (other.id,) and other.peers == (link.id,))
                guest.publish([static("map", "a fake"), moving("map", "another", 1)])
                robot.publish([static("map", "base", 1.0), moving("base", "arm", 1)])
                with anyio.fail_after(30):
                    await buffer.lookup("map", "arm")
            # That the guest has gone comes behind all that it has sent.
            await until(lambda: link.peers == ())
            assert own.tree.frames() == ["arm", "base", "map"]
            assert link.statistics().received_messages == 0
