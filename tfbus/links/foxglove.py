"""`FoxgloveServer`, which shows a bus to the Foxglove application.

The library answers any web page. So it listens at an address of the loopback that no page can guess, and
connections to the address of the server go through a `WebDoor` first.
"""

import secrets
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress

import anyio
import anyio.abc
import anyio.to_thread

from tfbus._aio.loops import LoopWaker
from tfbus.bus.bus import Bus
from tfbus.errors import pip_install
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.links.bus_server import BusServer
from tfbus.registration import Registration
from tfbus.stamps import SECOND

try:
    import foxglove
    from foxglove.channels import FrameTransformsChannel
    from foxglove.messages import FrameTransform, FrameTransforms, Quaternion, Timestamp, Vector3
    from foxglove.websocket import ChannelView, Client, ServerListener, WebSocketServer
except ImportError as error:
    raise ImportError(f"serving Foxglove needs one more package: {pip_install('foxglove')} ({error})") from error

APPLICATION = ("https://app.foxglove.dev", "https://studio.foxglove.dev", "file://")
"""The origins of the Foxglove application: in a browser, and on the desktop."""
_CHUNK = 65_536
"""Bytes that are passed on at once."""
_STAMP_END = 2**32 * SECOND
"""ns; Foxglove counts the seconds of a stamp in 32 bits, from zero."""


class FoxgloveServer(BusServer):
    """Sends everything that a bus publishes to the Foxglove application: ``async with FoxgloveServer(bus) as server``.

    The transforms are messages of the type ``foxglove.FrameTransforms``; a later subscriber gets the static ones at
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
    origins : iterable of str
        The web pages that may connect, such as ``https://robot.example:8443``; by default those of the Foxglove
        application, ``APPLICATION``. ``*`` is for all. A program that is no browser sends no origin, and may connect.

    Attributes
    ----------
    address : str
        The address to enter in Foxglove under *Open connection*: ``ws://127.0.0.1:8765``; empty outside of the ``async
        with``.
    sent : int
        Samples that were sent to the applications that had subscribed.
    not_sent : int
        Samples that Foxglove cannot hold: stamped before 1970 or after 2106, or with a name that has no UTF-8.
    refused : int
        Connections that were refused: of other pages, or beyond the 100th.

    Raises
    ------
    ValueError
        If the port is out of range, or an origin has not the form of one.
    OSError
        On entering, if the address cannot be listened at.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the server was entered before.
    """

    def __init__(
        self,
        bus: Bus,
        port: int = 8765,
        *,
        host: str = "127.0.0.1",
        topic: str = "/tf",
        origins: Iterable[str] = APPLICATION,
    ) -> None:
        super().__init__(bus, host, port, origins, self._pass_in)
        self.sent: int = 0
        self.not_sent: int = 0
        self._topic = topic
        self._listener = _Listener(self._wake)
        self._waker = LoopWaker(self._follow_subscriptions)
        self._served: frozenset[int] = frozenset()
        self._statics: dict[str, TransformStamped] = {}
        self._subscription: Registration | None = None
        self._context: foxglove.Context
        self._channel: FrameTransformsChannel
        self._server: WebSocketServer | None = None
        self._inside = ("", 0)

    async def _open(self) -> None:
        self._waker.bind()
        # It takes less than a millisecond. A thread would go on when asyncio cancels this task, and its server be lost.
        self._server = self._start()

    async def _close(self) -> None:
        server, self._server = self._server, None
        self._unsubscribe()
        if server is not None:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(server.stop)

    def _start(self) -> WebSocketServer:
        # The channel and the server do not keep it alive.
        context = self._context = foxglove.Context()
        self._channel = FrameTransformsChannel(self._topic, context=context)
        # Pages can try all ports of an address, but not all of the 16 million addresses of the loopback. A system
        # that has only the first of them refuses the others.
        hidden = f"127.{secrets.randbelow(256)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
        for host in (hidden, "127.0.0.1"):
            try:
                server = foxglove.start_server(
                    name="tfbus", host=host, port=0, server_listener=self._listener, context=context
                )
            except RuntimeError as error:
                # The library raises this for any error of the system.
                failure = error
            else:
                self._inside = host, server.port
                return server
        raise OSError(f"cannot listen at the loopback: {failure}") from failure

    async def _pass_in(self, outside: anyio.abc.SocketStream, head: bytes) -> None:
        """Pass on a connection to the library's server, in both directions."""
        async with await anyio.connect_tcp(*self._inside) as inside:
            await inside.send(head)
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(_pass_on, outside, inside, tasks.cancel_scope)
                tasks.start_soon(_pass_on, inside, outside, tasks.cancel_scope)

    def _wake(self) -> None:
        try:
            self._waker.wake()
        except RuntimeError:
            # The event loop has ended before the server.
            return

    def _follow_subscriptions(self) -> None:
        """Listen to the bus while somebody has subscribed, and send the static frames to new subscribers."""
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
        transforms = [transform for transform in map(_convert, batch) if transform is not None]
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


async def _pass_on(
    source: anyio.abc.ByteReceiveStream, target: anyio.abc.ByteSendStream, scope: anyio.CancelScope
) -> None:
    """Pass on what a stream sends until one of the two has ended, then end the other direction too."""
    with suppress(anyio.EndOfStream, anyio.BrokenResourceError, anyio.ClosedResourceError):
        while True:
            await target.send(await source.receive(_CHUNK))
    scope.cancel()


def _convert(sample: TransformStamped) -> FrameTransform | None:
    """A sample as Foxglove has it; None if Foxglove cannot hold its stamp or a name."""
    parent, child, stamp, (x, y, z, qx, qy, qz, qw), _, _ = sample._fields
    if not 0 <= stamp < _STAMP_END:
        return None
    try:
        return FrameTransform(
            timestamp=Timestamp(*divmod(stamp, SECOND)),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=Vector3(x=x, y=y, z=z),
            rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
        )
    except UnicodeEncodeError:
        return None
