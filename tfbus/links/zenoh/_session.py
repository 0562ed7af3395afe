"""One zenoh session of a link: its keys, and what zenoh's threads receive."""

import re
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Any

import zenoh

from tfbus.links._message import MAX_BYTES, Message
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.zenoh._settings import without_source_location
from tfbus.links.zenoh._statics import StaticKeys, subscribe_statics
from tfbus.tf_message import MalformedMessageError

_ID = re.compile("[0-9a-f]{32}")
_LONGEST_SHOWN_KEY = 200


class ZenohSession:
    """A session and its keys: `open`, `resubscribe_statics` and `statics` block; `put` and `close` do not.

    Parameters
    ----------
    config : zenoh.Config
    prefix : str
        The beginning of all keys of the domain.
    id : str
        The link's name, a part of all its keys.
    receive : callable
        Called in zenoh's threads with each `Received` item; a message's content is a payload and its attachment.

    Attributes
    ----------
    statics : StaticKeys
        Exists once the session is open.
    """

    def __init__(
        self,
        config: zenoh.Config,
        prefix: str,
        id: str,  # noqa: A002 - the wire calls it so
        receive: Callable[[Received], object],
    ) -> None:
        self._config = config
        self._prefix = prefix
        self._id = id
        self._receive = receive
        self._lock = threading.Lock()
        self._closed = False
        self._session: zenoh.Session | None = None
        self._declared: tuple[object, ...] = ()
        self._static_subscriber: Any = None
        self._close_at_exit: weakref.finalize[..., ZenohSession] | None = None

    def open(self) -> None:
        """Open the session and announce the link.

        Raises
        ------
        OSError
            If it cannot listen where it should, or as a client reaches nobody; with its `errno`, if there is one.
        """
        opened: Future[None] = Future()

        def complete() -> None:
            try:
                self._open()
            except BaseException as error:  # noqa: BLE001 - the waiting thread raises it
                opened.set_exception(error)
            else:
                opened.set_result(None)

        # A worker thread of trio is a daemon: the interpreter would end without it, and zenoh then aborts the process.
        threading.Thread(target=complete, daemon=False).start()
        opened.result()

    def _open(self) -> None:
        try:
            session = zenoh.open(self._config)
        except zenoh.ZError as error:
            raise _as_os_error(error) from error
        with self._lock:
            self._session = session
            abandoned = self._closed
        if abandoned:
            _close(session)
            return
        # A program may exit without the end of its link. A callback of zenoh while the interpreter ends is an abort.
        self._close_at_exit = weakref.finalize(self, _close, session)
        self.statics = StaticKeys(session, f"{self._prefix}/static/{self._id}")
        self._live = session.declare_publisher(
            f"{self._prefix}/live/{self._id}", congestion_control=zenoh.CongestionControl.DROP
        )
        self.resubscribe_statics()
        remote, alive = zenoh.Locality.REMOTE, session.liveliness()
        # zenoh undeclares what nobody refers to.
        self._declared = (
            session.declare_subscriber(f"{self._prefix}/live/*", _directly(self._receive_live), allowed_origin=remote),
            alive.declare_subscriber(f"{self._prefix}/@alive/*", _directly(self._receive_presence), history=True),
            alive.declare_token(f"{self._prefix}/@alive/{self._id}"),
        )

    def resubscribe_statics(self) -> None:
        """Have all existing static frames delivered, also those that were delivered before; for a worker thread.

        Raises
        ------
        zenoh.ZError
            If the session is closed.
        """
        assert self._session is not None
        before, receive = self._static_subscriber, _directly(self._receive_static)
        self._static_subscriber = subscribe_statics(self._session, f"{self._prefix}/static/*/*", receive)
        if before is not None:
            before.undeclare()

    def put(self, message: Message) -> None:
        """Send a live message, or drop it while the network is congested."""
        self._live.put(message.payload, attachment=message.attachment)

    def close(self) -> threading.Thread:
        """Begin to close the session, also one that is still being opened.

        Returns
        -------
        threading.Thread
            Ends when the session is closed: within milliseconds, or after 10 s if a peer is frozen.
        """
        with self._lock:
            self._closed = True
            session = self._session
        if self._close_at_exit is not None:
            self._close_at_exit.detach()
        closing = threading.Thread(target=_close, args=(session,), daemon=False)
        closing.start()
        return closing

    def _receive_live(self, sample: zenoh.Sample) -> None:
        self._receive_message(sample, "live", moving=True)

    def _receive_static(self, sample: zenoh.Sample) -> None:
        self._receive_message(sample, "static", moving=False)

    def _receive_message(self, sample: zenoh.Sample, kind: str, moving: bool) -> None:
        sender = self._sender(sample, kind)
        if sender is None or sample.kind != zenoh.SampleKind.PUT:
            return
        size = len(sample.payload) + (0 if sample.attachment is None else len(sample.attachment))
        if size > MAX_BYTES:
            self._refuse(sender, "oversized", f"{size} bytes, more than {MAX_BYTES}")
        else:
            # Copies, for the sample would keep the whole buffer in which it came.
            attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
            message = sample.payload.to_bytes(), attachment
            self._receive(Received(sender, message, size, moving))

    def _receive_presence(self, sample: zenoh.Sample) -> None:
        sender = self._sender(sample, "@alive")
        if sender is not None:
            present = sample.kind == zenoh.SampleKind.PUT
            self._receive(Received(sender, Presence.JOINED if present else Presence.LEFT))

    def _sender(self, sample: zenoh.Sample, kind: str) -> str | None:
        """The peer that a sample is from; None for this link's own, and for a key without an id, which is refused."""
        key = str(sample.key_expr)
        sender = key.removeprefix(f"{self._prefix}/{kind}/").partition("/")[0]
        if not _ID.fullmatch(sender):
            self._refuse("", "key", f"there is no link's id in its key {key[:_LONGEST_SHOWN_KEY]!r}")
            return None
        return None if sender == self._id else sender

    def _refuse(self, sender: str, reason: str, detail: str) -> None:
        self._receive(Received(sender, MalformedMessageError(reason, detail)))


def _close(session: zenoh.Session | None) -> None:
    """Close a session, if there is one; a second call does nothing."""
    if session is not None:
        # zenoh may give up waiting for a peer; that peer notices the end by itself.
        with suppress(zenoh.ZError):
            session.close()


def _directly(callback: Callable[[zenoh.Sample], object]) -> Any:
    # Otherwise each subscriber has a thread of its own, and one overtakes the other.
    return zenoh.handlers.Callback(callback, indirect=False)


def _as_os_error(error: zenoh.ZError) -> OSError:
    text = f"zenoh cannot open a session: {without_source_location(error)}"
    number = re.search(r"\(os error (\d+)\)", text)
    return OSError(int(number[1]), text) if number else OSError(text)
