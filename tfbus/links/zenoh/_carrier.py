"""The carrier of links over zenoh."""

import math
from collections.abc import Callable
from contextlib import suppress
from itertools import islice

import anyio
import anyio.to_thread
import zenoh

from tfbus.links._carrier import SendReport
from tfbus.links._inbox import ReceivedMessage
from tfbus.links._message import Message, MessageWriter, message_to_keep, read_message
from tfbus.links._outbox import OutgoingBatch, RemovedFrame, Turn
from tfbus.links._receive_queue import Received
from tfbus.links.zenoh._session import ZenohSession

_STATICS_PER_CALL = 100
_TOMBSTONE_LIFETIME = 5.0
_CLOSING_TIME = 1.0


class ZenohCarrier:
    """Carries the messages of one link over a zenoh session; see `tfbus.links._carrier.Carrier`.

    Static frames are kept in zenoh's caches. Declaring a key there may take a while, so a worker thread does it.

    Parameters
    ----------
    config : zenoh.Config
    prefix : str
        The beginning of all keys of the domain.
    id : str
        The link's name, a part of all its keys.
    """

    def __init__(self, config: zenoh.Config, prefix: str, id: str) -> None:  # noqa: A002 - the wire calls it so
        self.id = id
        self._config = config
        self._prefix = prefix
        self._changes: dict[str, OutgoingBatch | RemovedFrame | None] = {}
        self._must_resubscribe = False
        self._woken = anyio.Event()

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        """Open the session; raises `OSError` if it cannot listen where it should, or as a client reaches nobody."""
        self._report = report
        self._writer = MessageWriter(report)
        self._session = ZenohSession(self._config, self._prefix, self.id, receive)
        # The session closes itself if it is abandoned before it is open.
        await anyio.to_thread.run_sync(self._session.open, abandon_on_cancel=True)

    def send(self, turn: Turn) -> None:
        """Send live messages at once; while the network is congested, zenoh drops them."""
        for message in self._writer.write(turn.entries):
            try:
                self._session.put(message)
            except zenoh.ZError as error:
                self._report.failed(error)
            else:
                self._report.sent(message.samples)
        if turn.statics:
            self._changes.update(turn.statics)
            self._woken.set()

    def read(self, content: tuple[bytes, bytes]) -> ReceivedMessage:
        """Decode a payload and its attachment."""
        return read_message(*content)

    def peer_joined(self, peer: str, again: bool) -> None:  # noqa: ARG002 - part of the protocol
        """Have static frames come again after a loss, for zenoh does not deliver again what it has delivered before."""
        if again:
            self._must_resubscribe = True
            self._woken.set()

    async def run(self) -> None:
        """Keep zenoh's caches as the changes of static frames say."""
        session = self._session
        while True:
            self._woken = anyio.Event()
            if self._must_resubscribe:
                self._must_resubscribe = False
                with suppress(zenoh.ZError):
                    await anyio.to_thread.run_sync(session.resubscribe_statics)
            if self._changes:
                for error in await anyio.to_thread.run_sync(session.statics.publish, self._next_changes()):
                    self._report.failed(error)
                continue
            with anyio.move_on_after(_TOMBSTONE_LIFETIME if session.statics.has_tombstones else math.inf):
                await self._woken.wait()
                continue
            await anyio.to_thread.run_sync(session.statics.drop_tombstones)

    async def close(self) -> None:
        """Close the session, or give up waiting for it."""
        closing = self._session.close()
        with anyio.move_on_after(_CLOSING_TIME, shield=True):
            await anyio.to_thread.run_sync(closing.join, abandon_on_cancel=True)

    def _next_changes(self) -> dict[str, Message | None]:
        changes: dict[str, Message | None] = {}
        for frame in list(islice(self._changes, _STATICS_PER_CALL)):
            entry = self._changes.pop(frame)
            message = None if entry is None else message_to_keep(entry)
            if entry is None or message is not None:
                changes[frame] = message
        return changes
