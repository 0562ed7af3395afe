import math
import random
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import pytest

pytest.importorskip("viser", reason="the live page needs viser")

import msgspec
import viser
from support.viser_pages import CAMERA, viser_page
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from tfbus._aio.web_door import WebDoor
from tfbus.view.server import MAX_MESSAGE, MAX_TEXT, Server, start_server, stop_server

CLICK = {
    "type": "SceneNodeClickMessage",
    "name": "/axes",
    "instance_index": 0,
    "ray_origin": (0, 0, 0),
    "ray_direction": (0, 0, 1),
    "screen_pos": (0.5, 0.5),
    "modifier": None,
    "owner": "",
}


@contextmanager
def browser(server: Server, origin: str | None = None) -> Iterator[ClientConnection]:
    """A connection as that of the page; what the server sends is dropped."""
    client: ClientConnection = connect(
        f"ws://127.0.0.1:{server.get_port()}",
        origin=None if origin is None else Origin(origin),
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        proxy=None,
        max_size=None,
        max_queue=None,
    )
    with client:
        yield client


def update(control: Any, value: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value}}


def test_the_page_comes_from_the_loopback_and_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    with viser_page() as server:
        assert server.get_host() == "127.0.0.1"
        assert httpx.get(f"http://127.0.0.1:{server.get_port()}", trust_env=False).status_code == 200
        assert server.request_share_url() is None
    assert capfd.readouterr() == ("", "")


def test_taken_ports_are_passed_over() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        server = start_server("127.0.0.1", taken.getsockname()[1])
        try:
            assert server.get_port() > taken.getsockname()[1]
        finally:
            stop_server(server)


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
                assert client.recv(timeout=30.0)
        for host, status in (("evil.example", 403), (f"evil.example:{port}", 403), (f"localhost:{port}", 200)):
            answer = httpx.get(f"http://127.0.0.1:{port}", headers={"Host": host}, trust_env=False)
            assert answer.status_code == status
        assert server.door.refused == 6


def test_another_site_that_the_user_names_may_use_the_page() -> None:
    server = start_server("127.0.0.1", 0, WebDoor("127.0.0.1", ["https://robot.example"]))
    try:
        with browser(server, "https://robot.example") as client:
            assert client.recv(timeout=30.0)
        with pytest.raises(InvalidStatus, match="403"), browser(server, "https://evil.example"):
            pytest.fail("connected")
    finally:
        stop_server(server)


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


class Controlled:
    """A page with one control of each kind, and what was used of them."""

    def __init__(self, server: Server) -> None:
        gui = server.gui
        self.dropdown = gui.add_dropdown("Speed", ("slow", "fast"))
        self.slider = gui.add_slider("Time [s]", 0.0, 10.0, 0.001, 5.0)
        self.text = gui.add_text("Search", "")
        self.buttons = gui.add_button_group("Mode", ("Pause", "Play"))
        self.button = gui.add_button("Trail")
        self.all = (self.dropdown, self.slider, self.text, self.buttons, self.button)
        self._last = gui.add_button("last")
        self._read = threading.Event()
        self._last.on_click(lambda _: self._read.set())

    def values(self) -> tuple[object, ...]:
        return tuple(control.value for control in self.all[:-1])

    def send(self, client: ClientConnection, *messages: Any) -> None:
        """Send messages, and wait until viser has read them."""
        self._read.clear()
        for message in (*messages, CAMERA, update(self._last, True)):
            client.send(message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message))
        assert self._read.wait(30.0)


def test_what_a_page_sends_sets_its_controls() -> None:
    with viser_page() as server:
        page = Controlled(server)
        with browser(server) as client:
            page.send(
                client, CAMERA, CLICK, update(page.dropdown, "fast"), update(page.slider, 3), update(page.text, "base")
            )
            page.send(client, update(page.buttons, "Play"), update(page.button, True))
            assert page.values() == ("fast", 3.0, "base", "Play")
            # A browser may round to a step beyond the end.
            page.send(client, update(page.slider, 10.001))
            assert page.slider.value == 10.0
        assert server.refused == 0


def test_a_value_that_a_control_cannot_have_is_refused_and_counted() -> None:
    with viser_page() as server:
        page = Controlled(server)
        before = page.values()
        bad: list[tuple[Any, list[Any]]] = [
            (page.dropdown, ["", "Fast", 1, None, True, ["fast"], math.nan]),
            (page.slider, [math.nan, math.inf, -math.inf, 1e300, "3", True, None, [3]]),
            (page.text, ["x" * (MAX_TEXT + 1), 1, None, {"a": 1}, b"bytes"]),
            (page.buttons, ["Live", 1, None]),
            (page.button, ["x", 1.5, None]),
        ]
        messages = [update(control, value) for control, values in bad for value in values]
        with browser(server) as client:
            page.send(client, *messages)
            assert (page.values(), server.refused) == (before, len(messages))


def test_no_message_reaches_more_than_the_value_of_a_control() -> None:
    with viser_page() as server:
        page = Controlled(server)
        uuid = page.dropdown._impl.uuid
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
        with browser(server) as client:
            page.send(client, *messages)
            assert (page.dropdown.value, server.refused) == ("slow", len(messages))
            page.send(client, update(page.dropdown, "fast"))
            assert page.dropdown.value == "fast"


def test_a_long_message_ends_its_own_connection_only() -> None:
    with viser_page() as server:
        page = Controlled(server)
        with browser(server) as other:
            with pytest.raises(ConnectionClosed), browser(server) as client:
                client.send(b"x" * (MAX_MESSAGE + 1))
                while True:
                    client.recv(timeout=30.0)
            page.send(other, update(page.dropdown, "fast"))
            assert page.dropdown.value == "fast"


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(10))
def test_no_changed_message_ends_a_connection_or_gives_a_control_a_value_that_it_cannot_have(seed: int) -> None:
    draw = random.Random(seed)
    values = [
        math.nan,
        math.inf,
        -1,
        2**63,
        2**64 - 1,
        "",
        "\0",
        "fast",
        "Play",
        None,
        True,
        [],
        {},
        b"\xff",
        1e308,
        "x" * 2_000,
    ]

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

    with viser_page() as server:
        page = Controlled(server)
        with browser(server) as client:
            for _ in range(20):
                sound = [CAMERA, CLICK, *(update(control, "fast") for control in page.all)]
                page.send(client, *(changed(draw.choice(sound)) for _ in range(50)))
                speed, time, text, mode = page.values()
                assert speed in ("slow", "fast")
                assert 0.0 <= time <= 10.0  # type: ignore[operator]
                assert len(text) <= MAX_TEXT  # type: ignore[arg-type]
                assert mode in ("Pause", "Play")
            page.send(client, update(page.dropdown, "slow"), update(page.dropdown, "fast"))
            assert page.dropdown.value == "fast"
