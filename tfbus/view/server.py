"""The web server of the page: viser's server, silent on standard output, and behind a door.

viser answers every web page, sets any attribute of a control that a message names, and serves any number of
connections. Here a `WebDoor` judges the head of each request before viser sees it. `_Messages` lets only those messages
pass that the page itself sends. `Controls` keeps the changes that people make until the page is drawn.
"""

import asyncio
import logging
import math
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Annotated, Any

import msgspec
import rich
import viser
import viser.infra

from tfbus._aio.loops import LoopWaker
from tfbus._aio.web_door import HEAD_END, HEAD_TIME, MAX_HEAD, WebDoor
from tfbus.statistics import QueueStatistics

_PORTS_TRIED = 100
MAX_MESSAGE = 65_536
"""The greatest length in bytes of a message of a browser."""
MAX_TEXT = 1_000
"""The greatest length of a typed text."""
MAX_CONNECTIONS = 100
"""The greatest number of connections; a browser has one for the page, and more while it loads the page."""
_MOST = 1e12
_NEAR = 1e-6
_console_lock = threading.Lock()
_connection_log = logging.getLogger("tfbus.view.connections")
# A port check, or a browser that leaves early, ends before its handshake does; websockets would log a traceback.
_connection_log.addFilter(lambda record: record.msg != "opening handshake failed")

_Number = Annotated[float, msgspec.Meta(ge=-_MOST, le=_MOST)]
_Size = Annotated[int, msgspec.Meta(ge=0, le=1_000_000)]
_Name = Annotated[str, msgspec.Meta(max_length=MAX_TEXT)]
_Vector = tuple[_Number, _Number, _Number]


class _Sent(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """A message of a browser."""


class _Value(_Sent, tag="GuiUpdateMessage"):
    uuid: _Name
    updates: dict[_Name, _Name | bool | _Number]


class _Click(_Sent, tag="SceneNodeClickMessage"):
    name: _Name
    instance_index: _Size | None
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: tuple[_Number, _Number]
    modifier: _Name | None
    owner: _Name = ""


class _Camera(_Sent, tag="ViewerCameraMessage"):
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Size
    image_width: _Size
    look_at: _Vector
    up_direction: _Vector


class _Messages:
    """Reads the messages of browsers, in viser's thread; a message that the page does not send becomes nothing."""

    def __init__(self, server: "Server", reader: Any) -> None:
        self._server = server
        self._reader = reader

    def deserialize(self, raw: bytes) -> object:
        """The message as viser knows it, or an object for which viser has no function."""
        try:
            if len(raw) > MAX_MESSAGE:
                raise ValueError("it is too long")
            sent = msgspec.msgpack.decode(raw, type=_Value | _Click | _Camera)
            if isinstance(sent, _Camera) and math.dist(sent.position, sent.look_at) < _NEAR:
                # Such a camera would make viser fail, and stop the picture in all browsers.
                raise ValueError("it looks nowhere")
            message = self._reader.deserialize(raw)
            if isinstance(sent, _Value):
                # All attributes of a control can be set by their names; the page sets this one.
                (value,) = (sent.updates[name] for name in ("value",) if len(sent.updates) == 1)
                message.updates = {"value": self._checked(sent.uuid, value)}
        except Exception:  # noqa: BLE001 - whatever bytes bring about
            self._server.refused += 1
            return None
        return message

    def _checked(self, uuid: str, value: Any) -> Any:
        """A value that a control can have."""
        control: Any = self._server.gui._gui_input_handle_from_uuid[uuid]
        if isinstance(control, viser.GuiSliderHandle):
            if isinstance(value, bool) or not math.isfinite(value):
                raise ValueError("this is not a number")
            # Browsers round to the step.
            return min(max(float(value), control.min), control.max)
        if isinstance(control, viser.GuiDropdownHandle | viser.GuiButtonGroupHandle):
            if value not in control.options:
                raise ValueError("this is not an option")
        elif not isinstance(value, bool if isinstance(control, viser.GuiButtonHandle) else str):
            raise TypeError("this is not a value of such a control")
        return value


class _AtTheDoor(asyncio.Protocol):
    """A connection that judges the head of a request, and only then makes the protocol that serves it."""

    def __init__(self, guarded: "_Guarded", make: Callable[[], Any]) -> None:
        self._guarded = guarded
        self._make = make
        self._head = bytearray()
        self._transport: Any = None
        self._timer: asyncio.TimerHandle

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the head, if there is room for one more connection."""
        self._transport = transport
        self._timer = asyncio.get_running_loop().call_later(HEAD_TIME, self.end)
        self._guarded.connections.add(self)
        if len(self._guarded.connections) > MAX_CONNECTIONS:
            self._guarded.refuse_connection()
            self.end()

    def connection_lost(self, error: Exception | None) -> None:  # noqa: ARG002 - asyncio's signature
        """Make room for another connection."""
        self._timer.cancel()
        self._guarded.connections.discard(self)

    def end(self) -> None:
        """End the connection at once."""
        self._transport.abort()

    def data_received(self, data: bytes) -> None:
        """Judge the head as soon as it is there."""
        searched = max(0, len(self._head) - len(HEAD_END))
        self._head += data
        end = self._head.find(HEAD_END, searched)
        if end < 0 and len(self._head) <= MAX_HEAD:
            return
        self._timer.cancel()
        answer = self._guarded.door.answer(bytes(self._head))
        if answer is not None:
            self._transport.write(answer)
            self._transport.close()
            return
        served = self._make()
        served.protocol.max_message_size = MAX_MESSAGE
        served.logger = logging.LoggerAdapter(_connection_log)
        # viser would raise an error for text messages, so they are passed on as bytes.
        served.recv = partial(served.recv, decode=False)
        lost = served.connection_lost

        def connection_lost(error: Exception | None) -> None:
            self.connection_lost(error)
            lost(error)

        served.connection_lost = connection_lost
        self._transport.set_protocol(served)
        served.connection_made(self._transport)
        served.data_received(bytes(self._head))


class _Guarded(viser.infra.WebsockServer):
    """viser's server for websockets, with a door."""

    door: WebDoor
    guarded = False
    connections: set[_AtTheDoor]
    refused_connections = 0

    def end_connections(self) -> None:
        """End all connections, also those that viser does not serve yet; in viser's thread."""
        for connection in self.connections:
            connection.end()

    def refuse_connection(self) -> None:
        """Count a connection for which there is no room; the first one is logged."""
        self.refused_connections += 1
        if self.refused_connections == 1:
            logging.getLogger("tfbus").warning(
                "a connection to the page was refused, because it has %d; later ones are only counted", MAX_CONNECTIONS
            )

    @property
    def _background_event_loop(self) -> Any:
        return self.__dict__.get("_loop")

    @_background_event_loop.setter
    def _background_event_loop(self, loop: Any) -> None:
        self.__dict__["_loop"] = loop
        listen = loop.create_server

        def create_server(make: Callable[[], Any], *args: Any, **options: Any) -> Any:
            self.guarded = True
            return listen(lambda: _AtTheDoor(self, make), *args, **options)

        loop.create_server = create_server


class Server(viser.ViserServer):
    """viser's server; no browser can make it share the page on the internet.

    Attributes
    ----------
    door : WebDoor
    refused : int
        Messages of browsers that were refused.
    """

    def __init__(self, host: str, port: int, door: WebDoor) -> None:
        self.door = door
        self.refused = 0
        super().__init__(host, port, verbose=False)
        if not self._websock_server.guarded:
            self.stop()
            raise RuntimeError("this version of viser cannot be guarded from foreign pages")

    # viser makes it and starts it in one function.
    @property
    def _websock_server(self) -> Any:
        return self.__dict__["_websockets"]

    @_websock_server.setter
    def _websock_server(self, server: Any) -> None:
        server.__class__ = _Guarded
        server.door = self.door
        server.connections = set()
        server._message_class = _Messages(self, server._message_class)
        self.__dict__["_websockets"] = server

    @property
    def refused_connections(self) -> int:
        """Connections for which there was no room."""
        found: int = self._websock_server.refused_connections
        return found

    def stop(self) -> None:
        """Stop serving; it waits for viser's thread."""
        with suppress(RuntimeError):
            self.get_event_loop().call_soon_threadsafe(self._websock_server.end_connections)
        super().stop()

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002 - viser's signature
        """Refuse: viser would pass the page on through a server on the internet."""
        return None


def start_server(host: str, port: int, door: WebDoor | None = None) -> Server:
    """Start serving an empty page. It takes some tenths of a second, so call it in a worker thread.

    Parameters
    ----------
    host : str
        The address to listen at.
    port : int
        The first port to try; 0 for any that is free.
    door : WebDoor, optional
        By default, a door that lets no other pages in.

    Raises
    ------
    OSError
        If the address cannot be listened at, or the port and the hundred after it are taken.
    """
    free = _free_port(host, port)
    with _silent():
        server = Server(host, free, door or WebDoor(host))
    try:
        _furnish(server)
    except BaseException:
        stop_server(server)
        raise
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop serving; in a worker thread, because it waits for viser's thread."""
    with _silent():
        server.stop()


def _furnish(server: viser.ViserServer) -> None:
    """Set up the empty page."""
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    server.gui.main_panel.dock_right()
    server.gui.set_panel_label("tfbus")
    scene = server.scene
    # viser's picture of a sky takes long to load, and without a graphics card, lighting by it is slow.
    scene.configure_environment_map(None)
    scene.configure_default_lights(cast_shadow=False)
    scene.add_light_ambient("/light", intensity=1.5)
    scene.add_grid("/grid", infinite_grid=True, fade_distance=60.0, cell_size=1.0, section_size=5.0)


def _free_port(host: str, port: int) -> int:
    """The first port that can be listened at. viser would try for ever at an address that is not of this machine."""
    last = port if port == 0 else min(port + _PORTS_TRIED, 65_535)
    for candidate in range(port, last + 1):
        try:
            with socket.create_server((host, candidate), family=_family(host)) as free:
                found: int = free.getsockname()[1]
                return found
        except OSError:
            if candidate == last:
                raise
    raise AssertionError("unreachable")


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


@contextmanager
def _silent() -> Iterator[None]:
    """Keep viser from printing through rich's common console."""
    with _console_lock:
        console = rich.get_console()
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before


CAPACITY = 12
"""Controls of the page, with a click on a frame."""


class Controls:
    """The changes that people made on the page since it was drawn last; of each control, the newest value counts.

    It belongs to viser's thread: viser calls `use` there, and drawing applies the changes there. So even a flood of
    messages costs the program's event loop only one wake-up a picture.

    Parameters
    ----------
    called : callable
        Called on the event loop soon after a control was used.
    """

    def __init__(self, called: Callable[[], object]) -> None:
        self._waker = LoopWaker(called)
        self._waiting: dict[object, Callable[[], object]] = {}
        self._conflated = 0

    def bind(self) -> None:
        """Wake the running event loop from now on."""
        self._waker.bind()

    def use(self, control: object, change: Callable[[], object]) -> None:
        """Keep a change for the next drawing of the page; it replaces an earlier one by the same control."""
        self._conflated += self._waiting.pop(control, None) is not None
        self._waiting[control] = change
        self.wake()

    def wake(self) -> None:
        """Request a drawing of the page; for any thread."""
        # The event loop may have ended before the server.
        with suppress(RuntimeError):
            self._waker.wake()

    def apply(self) -> bool:
        """Make the changes in the order in which they came; return whether there were any."""
        waiting, self._waiting = self._waiting, {}
        for change in waiting.values():
            try:
                change()
            except Exception:
                logging.getLogger("tfbus").exception("a control of the page failed")
        return bool(waiting)

    def statistics(self) -> QueueStatistics:
        """The counters of the changes that wait for the next picture."""
        return QueueStatistics("controls", "conflate", CAPACITY, len(self._waiting), 0, self._conflated)
