"""One zenoh session of a link: its keys, and what zenoh's threads bring."""

import threading
from collections.abc import Callable

import zenoh

from tfbus.links.arrivals import Arrival
from tfbus.links.outbox import Message
from tfbus.links.zenoh_statics import StaticKeys, hear_statics
from tfbus.tf_message import MalformedMessageError

MAX_BYTES = 2**24
"""The largest message that is taken."""


class ZenohSession:
    """What blocks, for worker threads (`open` and `close`), and what does not, for the event loop (`put`).

    Parameters
    ----------
    config : zenoh.Config
    prefix : str
        What all keys of the domain begin with.
    id : str
        The link's own name, the last part of its keys.
    receive : callable
        Called in zenoh's threads with each `Arrival`; the content of one is a `zenoh.Sample`, a bool or an `Exception`.

    Attributes
    ----------
    statics : StaticKeys
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

    def open(self) -> None:
        """Open the session and tell the others."""
        session = zenoh.open(self._config)
        with self._lock:
            self._session = session
            abandoned = self._closed
        if abandoned:
            session.close()
            return
        self.statics = StaticKeys(session, f"{self._prefix}/static/{self._id}")
        self._live = session.declare_publisher(
            f"{self._prefix}/live/{self._id}", congestion_control=zenoh.CongestionControl.DROP
        )
        remote, alive = zenoh.Locality.REMOTE, session.liveliness()
        # zenoh takes back what nobody refers to.
        self._declared = (
            session.declare_subscriber(f"{self._prefix}/live/*", self._live_came, allowed_origin=remote),
            hear_statics(session, f"{self._prefix}/static/*/*", self._static_came),
            alive.declare_subscriber(f"{self._prefix}/@alive/*", self._presence_changed, history=True),
            alive.declare_token(f"{self._prefix}/@alive/{self._id}"),
        )

    def put(self, message: Message) -> None:
        """Send a live message, or drop it while the network is congested."""
        self._live.put(message.payload, attachment=message.attachment)

    def close(self) -> None:
        """Close the session, also one that is only about to be opened."""
        with self._lock:
            self._closed = True
            session = self._session
        if session is not None:
            session.close()

    def _live_came(self, sample: zenoh.Sample) -> None:
        self._came(str(sample.key_expr).rsplit("/", 1)[1], sample, moving=True)

    def _static_came(self, sample: zenoh.Sample) -> None:
        self._came(str(sample.key_expr).rsplit("/", 2)[1], sample, moving=False)

    def _came(self, sender: str, sample: zenoh.Sample, moving: bool) -> None:
        if sender == self._id or sample.kind != zenoh.SampleKind.PUT:
            return
        size = len(sample.payload) + (0 if sample.attachment is None else len(sample.attachment))
        if size > MAX_BYTES:
            error = MalformedMessageError("oversized", f"{size} bytes, more than {MAX_BYTES}")
            self._receive(Arrival(sender, error))
        else:
            self._receive(Arrival(sender, sample, size, moving))

    def _presence_changed(self, sample: zenoh.Sample) -> None:
        peer = str(sample.key_expr).rsplit("/", 1)[1]
        if peer != self._id:
            self._receive(Arrival(peer, sample.kind == zenoh.SampleKind.PUT))
