"""The queue of what people do in the browser; the callbacks come in other threads."""

import asyncio
import math
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Annotated, Any

import msgspec
import rich
import viser
import viser.infra

from tfbus._aio.loops import LoopWaker
from tfbus._aio.web_door import HEAD_END, HEAD_TIME, MAX_HEAD, WebDoor
from tfbus.statistics import QueueStatistics

# The web server of the page: viser's, for this machine only and without a word on standard output.
#
# viser answers any page, and sets whatever attribute of a control a message names. Here its server is given a door: the
# head of each request goes through a `WebDoor` before viser sees it, and each message through `_Messages`, which lets
# pass what the page itself sends.


_PORTS_TRIED = 100
MAX_MESSAGE = 65_536
"""Bytes of a message of a browser."""
MAX_TEXT = 1_000
"""Letters that somebody can type."""
_MOST = 1e12
_NEAR = 1e-6
_console_lock = threading.Lock()

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
    """Reads the messages of browsers, in viser's thread; those that the page does not send become nothing."""

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
                # viser would refuse to move such a camera, and with it the picture of all others.
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
                raise ValueError("this is no number")
            # Browsers round to the step.
            return min(max(float(value), control.min), control.max)
        if isinstance(control, viser.GuiDropdownHandle | viser.GuiButtonGroupHandle):
            if value not in control.options:
                raise ValueError("this is no option")
        elif not isinstance(value, bool if isinstance(control, viser.GuiButtonHandle) else str):
            raise TypeError("this is no value of such a control")
        return value


class _AtTheDoor(asyncio.Protocol):
    """A connection whose head is judged before the protocol that serves it is made."""

    def __init__(self, door: WebDoor, make: Callable[[], Any]) -> None:
        self._door = door
        self._make = make
        self._head = bytearray()
        self._transport: Any = None
        self._timer: asyncio.TimerHandle

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the head."""
        self._transport = transport
        self._timer = asyncio.get_running_loop().call_later(HEAD_TIME, self._transport.abort)

    def connection_lost(self, error: Exception | None) -> None:  # noqa: ARG002 - asyncio's signature
        """Forget it."""
        self._timer.cancel()

    def data_received(self, data: bytes) -> None:
        """Judge the head as soon as it is there."""
        searched = max(0, len(self._head) - len(HEAD_END))
        self._head += data
        end = self._head.find(HEAD_END, searched)
        if end < 0 and len(self._head) <= MAX_HEAD:
            return
        self._timer.cancel()
        answer = self._door.answer(bytes(self._head))
        if answer is not None:
            self._transport.write(answer)
            self._transport.close()
            return
        served = self._make()
        served.protocol.max_message_size = MAX_MESSAGE
        # Texts come as bytes too; viser takes them for an error of its own.
        served.recv = partial(served.recv, decode=False)
        self._transport.set_protocol(served)
        served.connection_made(self._transport)
        served.data_received(bytes(self._head))


class _Guarded(viser.infra.WebsockServer):
    """viser's server for websockets, with a door."""

    door: WebDoor
    guarded = False

    @property
    def _background_event_loop(self) -> Any:
        return self.__dict__.get("_loop")

    @_background_event_loop.setter
    def _background_event_loop(self, loop: Any) -> None:
        self.__dict__["_loop"] = loop
        listen = loop.create_server

        def create_server(make: Callable[[], Any], *args: Any, **options: Any) -> Any:
            self.guarded = True
            return listen(lambda: _AtTheDoor(self.door, make), *args, **options)

        loop.create_server = create_server


class Server(viser.ViserServer):
    """viser's server, which no browser can make share the page with the world.

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
        server._message_class = _Messages(self, server._message_class)
        self.__dict__["_websockets"] = server

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
        By default, one that lets no other pages in.

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
    # viser's picture of a sky takes long to load, and to light a scene with where there is no graphics card.
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


CAPACITY = 1_000


class Controls:
    """Calls functions on the event loop that other threads hand over, in their order, one in each turn of the loop.

    When more than `CAPACITY` are pending, the oldest is dropped and counted.

    Parameters
    ----------
    called : callable
        Called on the loop after a function was called.
    """

    def __init__(self, called: Callable[[], object]) -> None:
        self.dropped = 0
        self._called = called
        self._pending: deque[Callable[[], object]] = deque()
        self._lock = threading.Lock()
        self._waker = LoopWaker(self._drain)
        self._ended = False

    def bind(self) -> None:
        """Use the running event loop."""
        self._waker.bind()

    def put(self, control: Callable[[], object]) -> None:
        """Hand a function over, from any thread; after `end`, or without the loop, nothing happens."""
        with self._lock:
            if self._ended:
                return
            if len(self._pending) == CAPACITY:
                self._pending.popleft()
                self.dropped += 1
            self._pending.append(control)
        try:
            self._waker.wake()
        except RuntimeError:
            # The event loop has ended before the server.
            self.end()

    def end(self) -> None:
        """Drop what is pending, and take no more."""
        with self._lock:
            self._ended = True
            self._pending.clear()

    def statistics(self) -> QueueStatistics:
        """The queue's counters."""
        return QueueStatistics("controls", "drop_oldest", CAPACITY, len(self._pending), self.dropped)

    def _drain(self) -> None:
        with self._lock:
            if not self._pending:
                return
            control = self._pending.popleft()
            more = bool(self._pending)
        if more:
            # A flood of clicks must not hold the program up.
            self._waker.wake()
        control()
        self._called()
