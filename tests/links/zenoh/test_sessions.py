import json
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import zenoh
from support.processes import free_address, until
from support.wires import LIVE, met
from support.zenoh_wires import listening, talk

from tfbus.links.seams import Joined
from tfbus.links.zenoh.sessions import LEASE, open_session, session_config
from tfbus.links.zenoh.zenoh_router import ZenohRouter

ROUTER = "tcp/127.0.0.1:7447"


def read(config: zenoh.Config, path: str) -> Any:
    return json.loads(config.get_json(path))


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
    for listen, connect in (([ROUTER, address], ()), (None, [ROUTER, address])):
        with pytest.raises(ValueError, match=f"not {address!r}"):
            session_config(listen, connect, None, None)


@pytest.mark.parametrize("address", ["tcp/host:7447#", "tcp/host:7447?", "tcp/host:7447?#"])
def test_an_address_that_zenoh_alone_finds_malformed_is_refused_at_once(address: str) -> None:
    with pytest.raises(ValueError, match="zenoh does not take") as client:
        session_config(None, [ROUTER, address], None, None)
    with pytest.raises(ValueError, match="zenoh does not take") as router:
        session_config(ROUTER, address, None, None)
    assert address in str(client.value)
    assert address in str(router.value)


@pytest.mark.anyio
async def test_an_address_at_which_zenoh_panics_is_passed_over(
    address: str, domain: str, capfd: pytest.CaptureFixture[str]
) -> None:
    bad = f"{address}?rel=3"
    async with (
        ZenohRouter(address),
        listening(domain, connect=[bad, address]) as one,
        listening(domain, connect=address) as two,
    ):
        await met(one, two)
    with pytest.raises(OSError, match="Reliability"):
        async with ZenohRouter(bad):
            raise AssertionError("it has opened")
    capfd.readouterr()


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
def test_addresses_of_all_kinds_go_through_alone_and_in_any_iterable(address: str) -> None:
    config = session_config(address, iter([address]), None, None)
    assert read(config, "listen/endpoints") == read(config, "connect/endpoints") == [address]


def test_each_end_announces_its_lease_and_says_more_often_that_it_lives() -> None:
    for config, lease in (
        (session_config(None, ROUTER, None, None), LEASE),
        (session_config("tcp/127.0.0.1:0", (), None, 1.5), 1.5),
    ):
        assert read(config, "transport/link/tx/lease") == lease * 1_000
        assert read(config, "transport/link/tx/keep_alive") == 4


def test_settings_of_zenoh_win_over_those_of_the_link() -> None:
    config = session_config(
        None, ROUTER, {"transport/link/tx/lease": 7_000, "transport/link/tx/queue/size/data": 4}, 2.0
    )
    assert read(config, "transport/link/tx/lease") == 7_000
    assert read(config, "transport/link/tx/queue/size/data") == 4


def test_nobody_is_looked_for() -> None:
    for config in (session_config(None, ROUTER, None, None), session_config("tcp/127.0.0.1:0", (), None, None)):
        assert read(config, "scouting/multicast/enabled") is False


@pytest.mark.parametrize("lease", [0.0, -1.0, math.nan, math.inf])
def test_a_lease_is_a_time_that_passes(lease: float) -> None:
    with pytest.raises(ValueError, match="lease"):
        session_config(None, ROUTER, None, lease)


@pytest.mark.parametrize(
    ("path", "value"),
    [("no/such/setting", 1), ("transport/link/tx/lease", "long"), ("", 1), ("metadata", object())],
    ids=["unknown", "value", "empty", "not JSON"],
)
def test_a_setting_that_zenoh_does_not_take_is_named_with_its_value(path: str, value: object) -> None:
    with pytest.raises(ValueError, match="zenoh does not take") as caught:
        session_config(None, ROUTER, {path: value}, None)
    assert repr(path) in str(caught.value)
    assert repr(value) in str(caught.value)
    assert ".rs:" not in str(caught.value)


@pytest.mark.parametrize("path", ["id", "mode", "listen", "listen/endpoints", "connect", "connect/endpoints/client"])
def test_who_a_session_is_and_where_it_goes_are_no_settings(path: str) -> None:
    with pytest.raises(ValueError, match=f"{path!r} is not for config: give addresses by connect and listen"):
        session_config(None, ROUTER, {path: "x"}, None)


def test_an_os_error_that_only_zenoh_has_found_has_no_number() -> None:
    with pytest.raises(OSError, match="private key") as caught:
        open_session(session_config("tls/127.0.0.1:0", (), None, None))
    assert caught.value.errno is None


# TLS and access control


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
async def test_nobody_joins_over_tls_without_a_certificate(certificates: Path, domain: str) -> None:
    address = free_address().replace("tcp", "tls")
    stranger = {"transport/link/tls/root_ca_certificate": str(certificates / "ca.pem")}
    async with (
        listening(domain, listen=address, config=tls(certificates, "robot")) as robot,
        listening(domain, connect=address, config=stranger) as refused,
        # It comes behind the other and gets in.
        listening(domain, connect=address, config=tls(certificates, "guest")) as guest,
    ):
        await met(robot, guest)
        await talk(robot, guest)
    assert refused.items == []
    assert robot.of(refused) == guest.of(refused) == []


def listen_only(name: str) -> dict[str, Any]:
    """The setting by which those with a certificate of one name are not announced, and publish nothing."""
    rule = {
        "id": "saying",
        "messages": ["put", "delete", "liveliness_token"],
        "flows": ["ingress"],
        "permission": "deny",
        "key_exprs": ["tfbus/**", "tfbus/**/@alive/**"],
    }
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "allow",
            "rules": [rule],
            "subjects": [{"id": "guests", "cert_common_names": [name]}],
            "policies": [{"rules": ["saying"], "subjects": ["guests"]}],
        }
    }


@pytest.mark.anyio
async def test_access_control_lets_a_guest_hear_and_ask_and_not_publish(certificates: Path, domain: str) -> None:
    address = free_address().replace("tcp", "tls")
    async with (
        ZenohRouter(address, config=tls(certificates, "robot") | listen_only("guest")),
        listening(domain, connect=address, config=tls(certificates, "robot")) as robot,
        listening(domain, connect=address, config=tls(certificates, "guest")) as guest,
    ):
        await until(lambda: robot.id in guest.present)
        guest.wire.publish(LIVE, b"fake")
        assert guest.wire.send(robot.id, b"question")
        await until(lambda: robot.messages == [(guest.id, b"question")])
        robot.wire.send(guest.id, b"answer")
        robot.wire.publish(LIVE, b"published")
        await until(lambda: len(guest.messages) == 2)
        assert guest.of(robot) == [Joined(""), b"answer", b"published"]
    assert robot.items == [(guest.id, b"question")]
