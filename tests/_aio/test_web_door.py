"""The requests that a web server of ours answers, and those that it refuses."""

import socket
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tfbus._aio.web_door import MAX_HEAD, WebDoor

OWN = socket.gethostname()


def head(host: str | None = "127.0.0.1:8080", origin: str | None = None, *more: str) -> bytes:
    lines = ["GET / HTTP/1.1"]
    lines += [f"Host: {host}"] if host is not None else []
    lines += [f"Origin: {origin}"] if origin is not None else []
    return ("\r\n".join([*lines, *more]) + "\r\n\r\n").encode("latin-1")


def status(door: WebDoor, request: bytes) -> int:
    answer = door.answer(request)
    return 200 if answer is None else int(answer.split()[1])


@pytest.mark.parametrize(
    "host",
    [
        *("127.0.0.1", "127.0.0.1:8080", "localhost:8080", "LOCALHOST:8080", "localhost.:1", "[::1]:8080", "[::1]"),
        # An address leads nowhere else, be it reached through another port or another machine.
        *("192.168.1.7:80", "[2001:db8::1]:8080", OWN, f"{OWN.upper()}:8080", "robot.local:9"),
    ],
)
def test_addresses_and_own_names_are_hosts(host: str) -> None:
    assert status(WebDoor("robot.local"), head(host)) == 200


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:80", "evillocalhost", "2130706433", "127.1"],
)
def test_a_name_that_was_made_to_lead_here_is_none(host: str) -> None:
    assert status(WebDoor("127.0.0.1"), head(host)) == 403


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1:8080", None),
        ("127.0.0.1:8080", "http://127.0.0.1:8080"),
        ("127.0.0.1:8080", "http://localhost:8080"),
        ("localhost:8080", "http://[::1]:8080"),
        ("[::1]:8080", "http://[0:0:0:0:0:0:0:1]:8080"),
        # A proxy with TLS, or one that listens at another port.
        ("192.168.1.7", "https://192.168.1.7"),
        ("192.168.1.7:80", "http://192.168.1.7"),
        ("192.168.1.7:9000", "http://192.168.1.7:9000"),
    ],
)
def test_a_page_of_the_server_itself_may_use_it_and_so_may_a_program(host: str, origin: str | None) -> None:
    assert status(WebDoor("0.0.0.0"), head(host, origin)) == 200


@pytest.mark.parametrize(
    "origin",
    [
        *("http://evil.example", "https://evil.example:8080", "null", "NULL", "", "file://", "http://127.0.0.1:8081"),
        *("http://192.168.1.66:8080", "http://127.0.0.1", "http://127.0.0.1:8080@evil.example", "chrome-extension://x"),
        *("http://127.0.0.1:8080/", "http://127.0.0.1:8080 http://evil.example", "http://127.0.0.1:8080.evil.example"),
    ],
)
def test_every_other_page_is_refused(origin: str) -> None:
    door = WebDoor("127.0.0.1")
    assert status(door, head(origin=origin)) == 403
    assert door.refused == 1


def test_other_origins_are_allowed_with_their_hosts_and_nothing_else() -> None:
    door = WebDoor("127.0.0.1", ["https://robot.example:8443"])
    assert status(door, head("robot.example:8443", "https://robot.example:8443")) == 200
    assert status(door, head(origin="https://ROBOT.example:8443")) == 200
    for origin in ("http://robot.example:8443", "https://robot.example", "https://a.robot.example:8443", "null"):
        assert status(door, head(origin=origin)) == 403
    assert status(WebDoor("127.0.0.1", ["file://"]), head(origin="file://")) == 200
    assert status(WebDoor("127.0.0.1", ["*"]), head("evil.example", "http://evil.example")) == 200


@pytest.mark.parametrize(
    "request_", [head(None), head("a", "http://a", "Host: b"), head("a", "null", "Origin: http://a"), head("a b")]
)
def test_a_head_that_two_servers_would_read_in_two_ways_is_refused(request_: bytes) -> None:
    assert status(WebDoor("127.0.0.1"), request_) == 400


def test_the_first_refusal_is_logged_and_no_letter_of_it_is_raw(caplog: pytest.LogCaptureFixture) -> None:
    door = WebDoor("127.0.0.1")
    for _ in range(2):
        status(door, head(origin="http://\x1b[31m\u202e".encode().decode("latin-1")))
    [record] = caplog.records
    assert "\\x1b[31m" in record.getMessage()
    assert record.getMessage().isascii()


@pytest.mark.parametrize(
    ("origins", "error"),
    [("http://a", TypeError), (["robot"], ValueError), (["http://a/"], ValueError), ([""], ValueError)],
)
def test_what_is_no_origin_is_an_error_at_once(origins: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        WebDoor("127.0.0.1", origins)


_NAMES = st.from_regex(r"[a-z0-9.:@\[\]/_-]{1,20}", fullmatch=True)


@given(host=_NAMES, origin=_NAMES)
def test_a_name_that_is_no_address_and_not_ours_never_gets_in(host: str, origin: str) -> None:
    assert status(WebDoor("127.0.0.1"), head(f"{host}.example")) in (400, 403)
    assert status(WebDoor("127.0.0.1"), head(origin=f"http://{origin}.example")) == 403
    assert status(WebDoor("127.0.0.1"), head(origin=f"{origin}://127.0.0.1:8080")) == 403


@given(st.binary(max_size=200))
def test_no_bytes_are_an_error_of_the_door(data: bytes) -> None:
    for request_ in (data, data + b"\r\n\r\n", b"GET / HTTP/1.1\r\nHost: " + data + b"\r\n\r\n"):
        assert status(WebDoor("127.0.0.1"), request_) in (200, 400, 403)


def test_a_head_has_a_bound() -> None:
    assert status(WebDoor("127.0.0.1"), b"x" * (MAX_HEAD + 1)) == 400
