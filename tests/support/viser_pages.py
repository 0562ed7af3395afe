"""A client of the websocket of a page, which sees and sends what a browser does, and a real browser."""

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import unescape
from typing import Any, Self, TypeVar

import anyio.to_thread
import msgspec
import numpy as np
import pytest
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from tfbus.view import View
from tfbus.view.server import Server, start_server, stop_server

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1, 0, 0, 0),
    "position": (1.0, 2, 3),
    "fov": 1.0,
    "near": 0.1,
    "far": 10,
    "image_height": 100,
    "image_width": 100,
    "look_at": (0, 0, 0),
    "up_direction": (0, 0, 1),
}
"""The first message of a browser."""
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
T = TypeVar("T")
PATIENCE = 60.0
"""Seconds; drawing without a graphics card is slow."""


@contextmanager
def viser_page() -> Iterator[Server]:
    """A server on a free port of the loopback."""
    server = start_server("127.0.0.1", 0)
    try:
        yield server
    finally:
        stop_server(server)


class PageClient:
    """A connection as that of a browser.

    Attributes
    ----------
    nodes : dict of str to dict
        The objects of the scene by name, with their properties, arrays in rows.
    controls : dict of str to dict
        The controls by label, with their properties, `value` and `uuid`.
    camera : dict
        Where new browsers look from, and at.
    """

    def __init__(self, address: str, origin: str | None = None) -> None:
        self.socket: ClientConnection = connect(
            address.replace("http", "ws"),
            origin=None if origin is None else Origin(origin),
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            proxy=None,
            max_size=None,
            max_queue=None,
        )
        self.nodes: dict[str, dict[str, Any]] = {}
        self.controls: dict[str, dict[str, Any]] = {}
        self.camera: dict[str, Any] = {}
        self._by_uuid: dict[str, dict[str, Any]] = {}
        self._texts: list[dict[str, Any]] = []
        self.send(CAMERA)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    @property
    def texts(self) -> str:
        """All texts of the panel, as HTML without its escapes."""
        return unescape("\n".join(text["content"] for text in self._texts))

    def send(self, *messages: Any) -> None:
        """Send messages, or bytes as they are."""
        for message in messages:
            self.socket.send(message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message))

    def update(self, label: str, value: Any) -> dict[str, Any]:
        """The message of a control that somebody has used; the page does not tell it back."""
        self.controls[label]["value"] = value
        return {"type": "GuiUpdateMessage", "uuid": self.controls[label]["uuid"], "updates": {"value": value}}

    def use(self, label: str, value: Any, *texts: str) -> None:
        """Use a control, and wait for texts that follow from it."""
        self.send(self.update(label, value))
        self.wait(*texts)

    def wait(self, *texts: str) -> None:
        """Wait until the panel has all of some texts."""
        self.wait_until(lambda: all(text in self.texts for text in texts))

    def wait_until(self, condition: Callable[[], object]) -> None:
        """Read what the page sends until a condition holds."""
        while not self._holds(condition):
            self._take(self.socket.recv(timeout=PATIENCE))

    def wait_for_end(self) -> None:
        """Read until the page ends the connection."""
        try:
            while True:
                self.socket.recv(timeout=PATIENCE)
        except ConnectionClosed:
            pass

    def _holds(self, condition: Callable[[], object]) -> bool:
        try:
            return bool(condition())
        except KeyError:
            # The item of the condition has not come yet.
            return False

    def _take(self, window: Any) -> None:
        end = 16 + int.from_bytes(window[8:16], "little")
        content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(window[16:end]))
        arrays = []
        for length in content["binaryBufferLengths"]:
            begin = end + -end % 8
            end = begin + length
            arrays.append(window[begin:end])

        def plain(properties: dict[str, Any]) -> dict[str, Any]:
            found = {}
            for name, value in properties.items():
                if isinstance(value, dict) and "__binary_index" in value:
                    width = 4 if "wxyz" in name else 1 if "opacit" in name else 3
                    value = np.frombuffer(arrays[value["__binary_index"]], value["dtype"]).reshape(-1, width)
                found[name] = value
            return found

        for message in content["messages"]:
            kind, name, uuid = message["type"], message.get("name"), message.get("uuid")
            if kind == "RemoveSceneNodeMessage":
                self.nodes.pop(name, None)
            elif kind == "SceneNodeUpdateMessage":
                self.nodes[name].update(plain(message["updates"]))
            elif kind in ("SetPositionMessage", "SetOrientationMessage", "SetSceneNodeVisibilityMessage"):
                self.nodes.setdefault(name, {}).update(message)
            elif kind == "GuiUpdateMessage":
                self._by_uuid[uuid].update(message["updates"])
            elif kind.startswith("SetCamera"):
                self.camera.update(message)
            elif uuid is not None and "props" in message:
                control = self._by_uuid[uuid] = message["props"] | {"value": message.get("value"), "uuid": uuid}
                if kind == "GuiHtmlMessage":
                    self._texts.append(control)
                else:
                    self.controls[control.get("label", uuid)] = control
            elif name is not None and "props" in message:
                self.nodes[name] = plain(message["props"]) | {"position": (0.0, 0.0, 0.0), "visible": True}


async def on_page(view: View, steps: Callable[[PageClient], object]) -> None:
    """Do some steps as a browser that shows a page, in a worker thread, once the page is complete."""

    def run() -> None:
        with PageClient(view.address) as page:
            page.wait_until(lambda: page.controls and page.texts.strip())
            steps(page)

    await anyio.to_thread.run_sync(run)


# A real browser that opens a page; tests that use it are skipped where there is none


_ARGUMENTS = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    # The page must not load anything from elsewhere.
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)


class Browser:
    """An open page.

    Attributes
    ----------
    requests : list of str
        The addresses of everything that the page has asked for.
    """

    def __init__(self, page) -> None:  # type: ignore[no-untyped-def]
        self.page = page
        self.requests: list[str] = []
        page.on("request", lambda request: self.requests.append(request.url))
        page.set_default_timeout(PATIENCE * 1_000)

    def open(self, address: str) -> None:
        """Open a page, and wait until it shows frames."""
        self.page.goto(address)
        self.page.wait_for_selector("text=are connected with")

    def wait_for(self, text: str) -> None:
        """Wait for a text, given as a regular expression."""
        self.page.get_by_text(re.compile(text)).first.wait_for()

    def enter(self, name: str, text: str) -> None:
        """Enter a text into the control of a name."""
        control = self.page.locator(
            f"xpath=//label[normalize-space()='{name}']/ancestor::div[2]//input[not(@type='hidden')]"
        )
        control.fill(text)
        control.press("Enter")

    def click_in_the_middle(self) -> None:
        """Click in the middle of the 3D part."""
        box = self.page.locator("canvas").first.bounding_box()
        assert box is not None
        self.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def facts(self) -> dict[str, str]:
        """The facts about the selected frame; empty if none is selected."""
        rows = self.page.locator("table tr").all_inner_texts()
        return dict(row.split("\t", 1) for row in rows)

    def wait_for_fact(self, name: str, pattern: str) -> dict[str, str]:
        """Wait until a fact about the selected frame matches a regular expression; all facts."""
        cells = self.page.locator("tr", has=self.page.get_by_text(re.compile(f"^{name}$")))
        cells.filter(has_text=re.compile(pattern)).first.wait_for()
        return self.facts()


@contextmanager
def browser() -> Iterator[Browser]:
    """A browser, for a thread without an event loop."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="a real browser needs playwright")
    with sync_api.sync_playwright() as player:
        path = chromium(player.chromium.executable_path)
        found = player.chromium.launch(executable_path=path, args=_ARGUMENTS)
        try:
            yield Browser(found.new_page(viewport={"width": 1200, "height": 800}))
        finally:
            found.close()


def chromium(own: str) -> str:
    """The path of a chromium: the system's, or playwright's own."""
    for path in (shutil.which("chromium"), shutil.which("chromium-browser"), shutil.which("google-chrome"), own):
        if path is not None and os.path.exists(path):  # noqa: PTH110
            return path
    pytest.skip("there is no chromium: apt install chromium, or playwright install chromium")


async def in_browser(steps: Callable[[Browser], T]) -> T:
    """Do some steps in a new browser, in a worker thread."""

    def run() -> T:
        with browser() as opened:
            return steps(opened)

    return await anyio.to_thread.run_sync(run)
