"""A client of the websocket of a page, which sees and sends what a browser does."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import unescape
from typing import Any, Self

import anyio.to_thread
import msgspec
import numpy as np
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
PATIENCE = 30.0
"""s."""


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
            # What it asks about has not come yet.
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
