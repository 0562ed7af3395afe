import math
import random
import socket
import threading
from contextlib import suppress
from typing import Any, Self

import httpx
import pytest

pytest.importorskip("viser", reason="the live page needs viser")

import msgspec
from support.viser_pages import CAMERA, CLICK, PageClient, viser_page
from websockets.exceptions import InvalidMessage, InvalidStatus

from tfbus.view.server import MAX_CONNECTIONS, MAX_MESSAGE, MAX_TEXT, Server, start_server


def browser(server: Server, origin: str | None = None) -> PageClient:
    return PageClient(f"http://127.0.0.1:{server.get_port()}", origin)


def test_the_port_after_the_last_one_is_not_tried() -> None:
    try:
        taken = socket.create_server(("127.0.0.1", 65_535))
    except OSError:
        pytest.skip("the last port is taken by another program")
    with taken, pytest.raises(OSError, match="in use"):
        start_server("127.0.0.1", 65_535)


# Strangers


def test_pages_of_other_sites_and_other_names_get_nothing() -> None:
    with viser_page() as server:
        port = server.get_port()
        for origin in ("http://evil.example", "null", f"http://127.0.0.1:{port + 1}", f"http://192.0.2.1:{port}"):
            with pytest.raises(InvalidStatus, match="403"), browser(server, origin):
                pytest.fail("connected")
        for own in (None, f"http://127.0.0.1:{port}", f"http://localhost:{port}"):
            with browser(server, own) as client:
                assert client.socket.recv(timeout=30.0)
        for host, status in (("evil.example", 403), (f"evil.example:{port}", 403), (f"localhost:{port}", 200)):
            answer = httpx.get(f"http://127.0.0.1:{port}", headers={"Host": host}, trust_env=False)
            assert answer.status_code == status
        assert server.door.refused == 6
        assert server.request_share_url() is None


def test_a_head_that_comes_in_pieces_is_judged_and_one_without_an_end_is_refused() -> None:
    with viser_page() as server:
        for origin, status in ((b"http://evil.example", b"403"), (b"", b"200")):
            with socket.create_connection(("127.0.0.1", server.get_port())) as client:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
                head = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
                for byte in head + (b"Origin: " + origin + b"\r\n" if origin else b"") + b"\r\n":
                    client.send(bytes([byte]))
                assert client.recv(1_000).split()[1] == status
        with socket.create_connection(("127.0.0.1", server.get_port())) as client:
            client.sendall(b"x" * 20_000)
            assert client.recv(1_000).split()[1] == b"400"


def test_a_check_of_the_port_leaves_no_traceback(caplog: pytest.LogCaptureFixture) -> None:
    # The first connections to a server of their own: viser mends the log itself when it answers its first request.
    upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\n"
    key = "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    with viser_page() as server:
        for first in ("", "\r\n\r\n", "HEAD / HTTP/1.1\r\n", f"GET / HTTP/1.1\r\n{upgrade}{key}"):
            for patient in (False, True):
                with socket.create_connection(("127.0.0.1", server.get_port())) as client:
                    client.sendall(first.encode() and f"{first}Host: localhost\r\n\r\n".encode())
                    if patient and first:
                        with suppress(ConnectionResetError):
                            client.recv(1)
        assert httpx.get(f"http://127.0.0.1:{server.get_port()}", trust_env=False).status_code == 200
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


def test_connections_have_a_bound_and_those_that_say_nothing_count(caplog: pytest.LogCaptureFixture) -> None:
    with viser_page() as server:
        address = ("127.0.0.1", server.get_port())
        page = browser(server)
        page.wait_until(lambda: page.nodes)
        idle = [socket.create_connection(address) for _ in range(MAX_CONNECTIONS - 1)]
        for _ in range(3):
            with socket.create_connection(address) as client:
                assert client.recv(1) == b""
        assert server.refused_connections == 3
        assert caplog.text.count("a connection to the page was refused") == 1
        page.send(CAMERA)
        page.socket.close()
        for each in idle:
            each.close()
        while True:
            try:
                with browser(server) as other:
                    other.wait_until(lambda: other.nodes)
                    break
            except (OSError, EOFError, InvalidMessage):
                # The server has not read yet that others have left.
                continue


class Controlled:
    """A page with one control of each kind, and a browser of it."""

    labels = ("Speed", "Time [s]", "Search", "Mode", "Trail")

    def __init__(self, server: Server) -> None:
        gui = server.gui
        self.dropdown = gui.add_dropdown("Speed", ("slow", "fast"))
        self.slider = gui.add_slider("Time [s]", 0.0, 10.0, 0.001, 5.0)
        self.text = gui.add_text("Search", "")
        self.buttons = gui.add_button_group("Mode", ("Pause", "Play"))
        gui.add_button("Trail")
        self._read = threading.Event()
        gui.add_button("last").on_click(lambda _: self._read.set())
        self.browser = browser(server)
        self.browser.wait_until(lambda: self.browser.controls["last"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.browser.socket.close()

    def values(self) -> tuple[object, ...]:
        return tuple(control.value for control in (self.dropdown, self.slider, self.text, self.buttons))

    def send(self, *messages: Any) -> None:
        """Send messages, and wait until viser has read them."""
        self._read.clear()
        self.browser.send(*messages, CAMERA, self.browser.update("last", True))
        assert self._read.wait(30.0)

    def use(self, *values: tuple[str, Any]) -> None:
        self.send(*(self.browser.update(label, value) for label, value in values))


def test_what_a_page_sends_sets_its_controls() -> None:
    with viser_page() as server, Controlled(server) as page:
        page.send(CAMERA, CLICK)
        page.use(("Speed", "fast"), ("Time [s]", 3), ("Search", "base"), ("Mode", "Play"), ("Trail", True))
        assert page.values() == ("fast", 3.0, "base", "Play")
        # A browser may round to a step beyond the end.
        page.use(("Time [s]", 10.001))
        assert page.slider.value == 10.0
        assert server.refused == 0


def test_a_value_that_a_control_cannot_have_is_refused_and_counted() -> None:
    with viser_page() as server, Controlled(server) as page:
        before = page.values()
        bad: list[tuple[str, list[Any]]] = [
            ("Speed", ["", "Fast", 1, None, True, ["fast"], math.nan]),
            ("Time [s]", [math.nan, math.inf, -math.inf, 1e300, "3", True, None, [3]]),
            ("Search", ["x" * (MAX_TEXT + 1), 1, None, {"a": 1}, b"bytes"]),
            ("Mode", ["Live", 1, None]),
            ("Trail", ["x", 1.5, None]),
        ]
        sent = [(label, value) for label, values in bad for value in values]
        page.use(*sent)
        assert (page.values(), server.refused) == (before, len(sent))


def test_no_message_reaches_more_than_the_value_of_a_control() -> None:
    with viser_page() as server, Controlled(server) as page:
        uuid = page.browser.controls["Speed"]["uuid"]
        messages: list[Any] = [
            {"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates}
            for updates in (
                {},
                {"update_cb": "x"},
                {"sync_cb": 1.0},
                {"removed": True},
                {"value": "fast", "removed": True},
            )
        ]
        messages += [
            {"type": "GuiUpdateMessage", "uuid": "unknown", "updates": {"value": 1}},
            {"type": "FileTransferStartUpload", "source_component_uuid": uuid, "transfer_uuid": "a", "filename": "a"}
            | {"mime_type": "a", "part_count": 2**40, "size_bytes": 2**40},
            {"type": "ShareUrlRequest"},
            {"type": "RunJavascriptMessage", "source": "alert(1)"},
            CAMERA | {"position": (math.nan, 0, 0)},
            CAMERA | {"position": (0, 0)},
            CAMERA | {"position": CAMERA["look_at"]},
            CAMERA | {"image_height": -1},
            CLICK | {"instance_index": -1},
            CLICK | {"more": 1},
            *(b"", b"\xc1", "text", b"\x91" * 60_000, [], 1),
        ]
        page.send(*messages)
        assert (page.dropdown.value, server.refused) == ("slow", len(messages))
        page.use(("Speed", "fast"))
        assert page.dropdown.value == "fast"


def test_a_long_message_ends_its_own_connection_only() -> None:
    with viser_page() as server, Controlled(server) as page:
        with browser(server) as client:
            client.send(b"x" * (MAX_MESSAGE + 1))
            client.wait_for_end()
        page.use(("Speed", "fast"))
        assert page.dropdown.value == "fast"


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(10))
def test_no_changed_message_ends_a_connection_or_gives_a_control_a_value_that_it_cannot_have(seed: int) -> None:
    draw = random.Random(seed)
    values = [math.nan, math.inf, -1, 2**63, 2**64 - 1, "", "\0", "fast", "Play", None, True, [], {}, b"\xff", 1e308]
    values.append("x" * 2_000)

    def changed(message: Any) -> Any:
        message = dict(message)
        key = draw.choice(list(message))
        message[key] = draw.choice(values)
        if "updates" in message and draw.random() < 0.7:
            message["updates"] = {draw.choice(["value", "removed", "order", "uuid"]): draw.choice(values)}
        encoded = bytearray(msgspec.msgpack.encode(message))
        for _ in range(draw.choice([0, 0, 1, 3])):
            encoded[draw.randrange(len(encoded))] = draw.randrange(256)
        return bytes(encoded[: draw.randrange(1, len(encoded) + 1)] if draw.random() < 0.2 else encoded)

    with viser_page() as server, Controlled(server) as page:
        for _ in range(20):
            sound = [CAMERA, CLICK, *(page.browser.update(label, "fast") for label in page.labels)]
            page.send(*(changed(draw.choice(sound)) for _ in range(50)))
            speed, time, text, mode = page.values()
            assert speed in ("slow", "fast")
            assert 0.0 <= time <= 10.0  # type: ignore[operator]
            assert len(text) <= MAX_TEXT  # type: ignore[arg-type]
            assert mode in ("Pause", "Play")
        page.use(("Speed", "slow"), ("Speed", "fast"))
        assert page.dropdown.value == "fast"
