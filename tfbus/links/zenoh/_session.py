"""One zenoh session of a link: its keys, and what zenoh's threads bring."""

import re
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Any

import zenoh

from tfbus.links.outbox import MAX_BYTES, Message
from tfbus.links.receive_queue import Arrival
from tfbus.links.zenoh._settings import without_source
from tfbus.links.zenoh._statics import StaticKeys, hear_statics
from tfbus.tf_message import MalformedMessageError

_ID = re.compile("[0-9a-f]{32}")
_SHOWN = 200


class ZenohSession:
    """What blocks, for worker threads (`open`, `hear_again`, `statics`), and what does not (`put`, `close`).

    Parameters
    ----------
    config : zenoh.Config
    prefix : str
        What all keys of the domain begin with.
    id : str
        The link's own name, a part of all its keys.
    receive : callable
        Called in zenoh's threads with each `Arrival`; the content of one is a payload and an attachment, a bool, or a
        `MalformedMessageError`.

    Attributes
    ----------
    statics : StaticKeys
        Once it is open.
    """

    def __init__(
        self,
        config: zenoh.Config,
        prefix: str,
        id: str,  # noqa: A002 - it is called so on the wire
        receive: Callable[[Arrival], object],
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

    def open(self) -> None:
        """Open the session and tell the others.

        Raises
        ------
        OSError
            If it cannot listen where it should, or as a client reaches nobody; with its `errno`, if there is one.
        """
        opened: Future[None] = Future()

        def complete() -> None:
            try:
                self._open()
            except BaseException as error:  # noqa: BLE001 - whoever waits gets it
                opened.set_exception(error)
            else:
                opened.set_result(None)

        # A worker of trio is a daemon. The interpreter ends without waiting for those, and what zenoh does in one at
        # that moment aborts the process.
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
        self.statics = StaticKeys(session, f"{self._prefix}/static/{self._id}")
        self._live = session.declare_publisher(
            f"{self._prefix}/live/{self._id}", congestion_control=zenoh.CongestionControl.DROP
        )
        self.hear_again()
        remote, alive = zenoh.Locality.REMOTE, session.liveliness()
        # zenoh takes back what nobody refers to.
        self._declared = (
            session.declare_subscriber(f"{self._prefix}/live/*", _directly(self._live_came), allowed_origin=remote),
            alive.declare_subscriber(f"{self._prefix}/@alive/*", _directly(self._presence_changed), history=True),
            alive.declare_token(f"{self._prefix}/@alive/{self._id}"),
        )

    def hear_again(self) -> None:
        """Have all static frames come that there are, also those that came before; for a worker thread.

        Raises
        ------
        zenoh.ZError
            If the session is closed.
        """
        assert self._session is not None
        before, came = self._static_subscriber, _directly(self._static_came)
        self._static_subscriber = hear_statics(self._session, f"{self._prefix}/static/*/*", came)
        if before is not None:
            before.undeclare()

    def put(self, message: Message) -> None:
        """Send a live message, or drop it while the network is congested."""
        self._live.put(message.payload, attachment=message.attachment)

    def close(self) -> threading.Thread:
        """Begin to close the session, also one that is only about to be opened.

        Returns
        -------
        threading.Thread
            It ends when that is done: within milliseconds, or after 10 s if a peer is frozen.
        """
        with self._lock:
            self._closed = True
            session = self._session
        closing = threading.Thread(target=_close, args=(session,), daemon=False)
        closing.start()
        return closing

    def _live_came(self, sample: zenoh.Sample) -> None:
        self._came(sample, "live", moving=True)

    def _static_came(self, sample: zenoh.Sample) -> None:
        self._came(sample, "static", moving=False)

    def _came(self, sample: zenoh.Sample, kind: str, moving: bool) -> None:
        sender = self._sender(sample, kind)
        if sender is None or sample.kind != zenoh.SampleKind.PUT:
            return
        size = len(sample.payload) + (0 if sample.attachment is None else len(sample.attachment))
        if size > MAX_BYTES:
            self._refuse(sender, "oversized", f"{size} bytes, more than {MAX_BYTES}")
        else:
            # A sample would keep all of the buffer that it came in.
            attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
            message = sample.payload.to_bytes(), attachment
            self._receive(Arrival(sender, message, size, moving))

    def _presence_changed(self, sample: zenoh.Sample) -> None:
        sender = self._sender(sample, "@alive")
        if sender is not None:
            self._receive(Arrival(sender, sample.kind == zenoh.SampleKind.PUT))

    def _sender(self, sample: zenoh.Sample, kind: str) -> str | None:
        """Which peer a sample is from; None if it is from here, or if its key has none, for anybody can use any key."""
        key = str(sample.key_expr)
        sender = key.removeprefix(f"{self._prefix}/{kind}/").partition("/")[0]
        if not _ID.fullmatch(sender):
            self._refuse("", "key", f"there is no link's id in its key {key[:_SHOWN]!r}")
            return None
        return None if sender == self._id else sender

    def _refuse(self, sender: str, reason: str, detail: str) -> None:
        self._receive(Arrival(sender, MalformedMessageError(reason, detail)))


def _close(session: zenoh.Session | None) -> None:
    if session is not None:
        # It may give up waiting for a peer, who will notice by himself.
        with suppress(zenoh.ZError):
            session.close()


def _directly(callback: Callable[[zenoh.Sample], object]) -> Any:
    # Else each has a thread of its own, and what comes by one overtakes what came by another.
    return zenoh.handlers.Callback(callback, indirect=False)


def _as_os_error(error: zenoh.ZError) -> OSError:
    text = f"zenoh cannot open a session: {without_source(error)}"
    number = re.search(r"\(os error (\d+)\)", text)
    return OSError(int(number[1]), text) if number else OSError(text)
