"""`FoxgloveServer`, which shows a bus to the Foxglove application."""

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

import anyio
import anyio.to_thread

from tfbus._aio.loop_waker import LoopWaker
from tfbus.bus.bus import Bus
from tfbus.errors import BusClosedError, pip_install
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.links.link import warn_unless_entered
from tfbus.registration import Registration
from tfbus.stamps import SECOND

try:
    import foxglove
    from foxglove.channels import FrameTransformsChannel
    from foxglove.messages import FrameTransform, FrameTransforms, Quaternion, Timestamp, Vector3
    from foxglove.websocket import ChannelView, Client, ServerListener, WebSocketServer
except ImportError as error:
    raise ImportError(f"to serve Foxglove, tfbus needs a package more: {pip_install('foxglove')} ({error})") from error

_STAMP_END = 2**32 * SECOND
"""ns; Foxglove counts the seconds of a stamp in 32 bits, from zero."""


class FoxgloveServer:
    """Sends everything that a bus publishes to the Foxglove application: ``async with FoxgloveServer(bus) as server``.

    The transforms are messages of the type ``foxglove.FrameTransforms``; who subscribes later gets the static ones at
    once. While nobody has subscribed, nothing is converted. A slow application loses its oldest messages, a thousand
    behind the newest.

    Parameters
    ----------
    bus : Bus
    port : int
        The port to listen at; 0 for any.
    host : str
        The address to listen at; by default, only programs on this machine can connect.
    topic : str
        The name of the channel.

    Attributes
    ----------
    address : str
        What to enter in Foxglove under *Open connection*: ``ws://127.0.0.1:8765``; empty outside of the ``async with``.
    sent : int
        Samples that were sent to the applications that had subscribed.
    not_sent : int
        Samples whose stamp Foxglove cannot hold: before 1970, or after 2106.

    Raises
    ------
    ValueError
        If the port is out of range.
    OSError
        On entering, if the address cannot be listened at.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the server was entered before.
    """

    def __init__(self, bus: Bus, port: int = 8765, *, host: str = "127.0.0.1", topic: str = "/tf") -> None:
        if isinstance(port, bool) or not isinstance(port, int):
            raise TypeError(f"a port must be an int, not {port!r}")
        if not 0 <= port <= 65_535:
            raise ValueError(f"a port must be from 0 to 65535, got {port}")
        self.bus = bus
        self.address = ""
        self.sent = 0
        self.not_sent = 0
        self._host, self._port, self._topic = host, port, topic
        self._entered = False
        self._listener = _Listener(self._wake)
        self._waker = LoopWaker(self._follow_subscriptions)
        self._served: frozenset[int] = frozenset()
        self._statics: dict[str, TransformStamped] = {}
        self._subscription: Registration | None = None
        self._context: foxglove.Context
        self._channel: FrameTransformsChannel
        self._server: WebSocketServer | None = None
        self._never_entered = warn_unless_entered(self)

    async def __aenter__(self) -> Self:
        if self._entered:
            raise RuntimeError("a server is entered once: make another one")
        self.bus._check_thread()
        if self.bus.closed:
            raise BusClosedError
        self._entered = True
        self.bus._entered.add(self)
        self._never_entered.detach()
        self._waker.bind()
        with anyio.CancelScope(shield=True):
            server = self._server = await anyio.to_thread.run_sync(self._start)
        self.address = f"ws://{f'[{self._host}]' if ':' in self._host else self._host}:{server.port}"
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.address = ""
        self.bus._entered.discard(self)
        server, self._server = self._server, None
        self._unsubscribe()
        if server is not None:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(server.stop)

    def _start(self) -> WebSocketServer:
        # The channel and the server do not keep it alive.
        context = self._context = foxglove.Context()
        self._channel = FrameTransformsChannel(self._topic, context=context)
        try:
            return foxglove.start_server(
                name="tfbus", host=self._host, port=self._port, server_listener=self._listener, context=context
            )
        except RuntimeError as error:
            # What the library raises for whatever the system says.
            raise OSError(f"cannot listen at {self._host}:{self._port}: {error}") from error

    def _wake(self) -> None:
        try:
            self._waker.wake()
        except RuntimeError:
            # The event loop has ended before the server.
            return

    def _follow_subscriptions(self) -> None:
        """Listen to the bus while somebody has subscribed, and send the static frames to who has not got them yet."""
        if self._server is None:
            return
        subscribers = self._listener.subscribers
        new, self._served = subscribers - self._served, subscribers
        if not subscribers:
            self._unsubscribe()
        elif self._subscription is None:
            if not self.bus.closed:
                # `_send` is called with the latched samples at once.
                self._subscription = self.bus.subscribe(self._send, self._forget)
        elif new and self._statics:
            # The library cannot send to one of them only; for the others, nothing changes.
            self._log(tuple(self._statics.values()))

    def _unsubscribe(self) -> None:
        if self._subscription is not None:
            self._subscription.close()
            self._subscription = None
            self._statics.clear()

    def _send(self, batch: Batch) -> None:
        for sample in batch:
            if sample.static:
                self._statics[sample.child] = sample
            else:
                self._statics.pop(sample.child, None)
        self._log(batch)

    def _forget(self, frame: str) -> None:
        # Foxglove has no message that removes a frame.
        self._statics.pop(frame, None)

    def _log(self, batch: Batch) -> None:
        transforms = [_convert(sample) for sample in batch if 0 <= sample.stamp < _STAMP_END]
        self.not_sent += len(batch) - len(transforms)
        if transforms:
            self._channel.log(FrameTransforms(transforms=transforms), log_time=max(0, self.bus.clock.now()))
            self.sent += len(transforms)


class _Listener(ServerListener):
    """Notes who has subscribed; the library calls it in its own threads."""

    def __init__(self, changed: Callable[[], object]) -> None:
        self._changed = changed
        self.subscribers: frozenset[int] = frozenset()
        self._lock = threading.Lock()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002 - there is one channel
        """Note a subscriber."""
        with self._lock:
            self.subscribers |= {client.id}
        self._changed()

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002 - there is one channel
        """Forget a subscriber that has unsubscribed or gone."""
        with self._lock:
            self.subscribers -= {client.id}
        self._changed()


def _convert(sample: TransformStamped) -> FrameTransform:
    parent, child, stamp, (x, y, z, qx, qy, qz, qw), _, _ = sample._fields
    return FrameTransform(
        timestamp=Timestamp(*divmod(stamp, SECOND)),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
    )
