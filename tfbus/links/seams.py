"""The seams below a link: a wire to buses of tfbus, or a carrier to another world. An author of either reads this page.

A link of tfbus decides what it sends to which link, and which samples are news (`tfbus.links.domain`). Its `Wire`
knows one network: it moves bytes between the links of one domain, and tells which links are present. A new network is
one class.

Another world, such as ROS, has messages of its own. A link to it (`tfbus.links.endpoint.ForeignEnd`) decides what goes
out and what is news as well; its `Carrier` writes and reads the messages of that world.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple, Protocol

from tfbus.errors import InvalidTransformError
from tfbus.links.relay import ReceivedBatch, Turn
from tfbus.tf_message import MalformedMessageError

MAX_MESSAGE: Final = 2**22 + 2**16
"""Bytes; no message is larger, and a wire refuses a larger one before it holds all of it in memory."""


# Between buses of tfbus


class Hearing(NamedTuple):
    """The channel that a link hears of each link whose robot matches a pattern.

    Attributes
    ----------
    robots : str
        The name of a robot; ``*`` stands for any letters. A link without a robot has the name ``""``, which ``*`` alone
        matches too.
    channel : str
        Letters, digits, ``-`` and ``_``, 32 at most.
    """

    robots: str
    channel: str

    def matches(self, robot: str) -> bool:
        """Whether a robot has a name of the pattern; in linear time, for strangers choose the names."""
        return fnmatchcase(robot, self.robots)


@dataclass(frozen=True, slots=True)
class Joined:
    """A peer is present; messages that were sent to it before may be lost."""

    robot: str = ""


@dataclass(frozen=True, slots=True)
class Left:
    """A peer has left. No item of it follows, unless it joins again."""


WireItem = bytes | Joined | Left | MalformedMessageError
"""An item that a wire receives from one link; the error is for a message that the wire has refused."""
Receive = Callable[[str, WireItem], object]


class Wire(Protocol):
    """Moves messages between the links of one domain over one network.

    A wire is used by one link, and opened once. The event loop calls everything here, in this order: `open`; then,
    while `run` runs as a task, `publish` and `send`; when `run` has been cancelled, these once more, and `close`.

    Attributes
    ----------
    id : str
        The name of this link for all others: 32 hexadecimal digits, drawn at random.
    rest : float
        The longest time between two signs of life of an idle link, in s. A network that may lose the last message
        before a silence needs a short one.
    """

    id: str
    rest: float = 2.0

    async def open(self, hears: Sequence[Hearing], receive: Receive, warn: Callable[[Exception], object]) -> None:
        """Join the network, or begin to: `run` meets the links that are not there yet.

        Parameters
        ----------
        hears : sequence of Hearing
            The first that matches a link's robot is for that link; a link that none matches is not announced, and
            nothing that it publishes comes to this process.
        receive : callable
            Takes the id of a link and an item of it: that it has joined or left, a message that it has published on a
            channel which this link hears, or a message that it has sent to this link. Messages that are sent to this
            link come from all links of the domain, announced or not. Any thread may call it, from now until `close`
            has returned and later; it never blocks and never raises. The published messages of one link come in
            their order, and so do the messages that it has sent to this link.
        warn : callable
            Takes an error of the network that the user should know; for the event loop only. It never raises.

        Raises
        ------
        OSError
            If there can be no network: an address is taken, or a directory is open to others. After any error, also
            when cancelled, the link calls `close` next.
        """

    async def run(self) -> None:
        """Do the work that takes time, such as connecting to other links, until cancelled."""

    def is_heard(self, channel: str) -> bool:
        """Whether any link may hear a channel of this one; it does not block and does not raise."""

    def is_behind(self) -> bool:
        """Whether received bytes wait to be read, as far as the wire knows; it does not block."""
        return False

    def publish(self, channel: str, message: bytes) -> None:
        """Send a message to all links that hear a channel of this one; it does not block and does not raise.

        While the network, or one of the links, has no room, the message is dropped for those; the links find that out
        by the numbers of messages.
        """

    def send(self, link: str, message: bytes) -> bool:
        """Send a message to one link of the domain; it does not block and does not raise.

        Where the network has an order for it, it goes before published messages that wait for room. It may be lost like
        these.

        Returns
        -------
        bool
            False if it is known not to arrive, because the link is not there or has no room.
        """

    async def close(self) -> None:
        """Disconnect, also if `open` has failed or was cancelled; all that was sent before still goes out.

        The closing begins before the first checkpoint, because asyncio's own cancellation knows no shield, and returns
        within about a second, whatever the network does.
        """


# To other worlds


@dataclass(frozen=True, slots=True)
class Received:
    """One item that has come.

    Attributes
    ----------
    sender : str
        The id of the peer; empty if it is unknown.
    content : Any
        `Joined` or `Left`; a `MalformedMessageError` for a message that was refused; or a message, which is decoded on
        the event loop.
    size : int
        Bytes that the content keeps in memory.
    moving : bool
        Whether the item may be dropped under load, because newer data will follow.
    urgent : bool
        Whether it is read before all that is not.
    follows : bool
        Whether an urgent item is read after all that waits of its sender.
    """

    sender: str
    content: Any
    size: int = 0
    moving: bool = False
    urgent: bool = False
    follows: bool = False


@dataclass(slots=True)
class ReceivedMessage:
    """One message of another world, decoded.

    Attributes
    ----------
    batches : list of ReceivedBatch
        In the order in which they were published; they have no origin.
    errors : list of InvalidTransformError
        One for each sample that was refused; `batches` have the others.
    time : int or None
        The time of the sender's clock, in ns, if it tells that.
    continues : bool
        Whether it is a later part of a message that was counted.
    """

    batches: list[ReceivedBatch]
    errors: list[InvalidTransformError] = field(default_factory=list)
    time: int | None = None
    continues: bool = False


class SendReport:
    """Counts the messages and samples that a carrier has sent or could not send; for the event loop only.

    Parameters
    ----------
    warn : callable
        Called with the error of everything that could not be sent.

    Attributes
    ----------
    messages, samples : int
        The messages and samples that were handed to the network.
    not_sent : Counter
        Samples and removals that no message can hold, by reason.
    """

    def __init__(self, warn: Callable[[Exception], object]) -> None:
        self._warn = warn
        self.messages: int = 0
        self.samples: int = 0
        self.not_sent: Counter[str] = Counter()

    def sent(self, samples: int) -> None:
        """Count one message with so many samples."""
        self.messages += 1
        self.samples += samples

    def refused(self, reason: str, error: Exception, count: int = 1) -> None:
        """Count samples and removals that the carrier's messages cannot hold."""
        self.not_sent[reason] += count
        self._warn(error)

    def failed(self, error: Exception) -> None:
        """Tell of a message that the network did not accept."""
        self._warn(error)


class Carrier(Protocol):
    """Sends the messages of a link over one network, and receives those of its peers.

    The link decides which samples go out, are news, or are refused. A carrier writes them, and keeps static frames for
    late joiners as its network allows. A carrier is used by one link, and opened once.

    The event loop calls everything here, in this order: `open`; then, while `run` runs as a task, `send` and `read`;
    when `run` has been cancelled, a last `send` may have come, and `close` is called.

    Attributes
    ----------
    id : str
        The name of this end for its peers.
    """

    id: str

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        """Connect to the network.

        Parameters
        ----------
        receive : callable
            Takes an item that has come: a peer's message, that a peer has come or gone, or that a message was refused.
            Any thread may call it, from now until `close` has returned and later; it never blocks and never raises.
            Items are handled in the order of the calls, so a peer's `Left` has to be the last of its items. A
            carrier whose network tells nothing of presence leaves presence out.
        report : SendReport
            Counts sent and unsent messages; for the event loop only.

        Raises
        ------
        OSError
            If there is no connection. After any error, also when cancelled, the link calls `close` next.
        """

    def send(self, turn: Turn) -> None:
        """Send what one turn of the event loop has published and removed; a turn is never empty.

        It must not block and must not raise: entries that the carrier's messages cannot hold, and messages that the
        network does not accept, go to the report. Entries leave in order; the changes of static frames go out behind
        the entries of the same turn and may be conflated with later ones.
        """

    def split(self, content: Any) -> Iterator[Any]:
        """The content of an item in parts, for `read` one by one; an item that is small is its only part.

        It may also yield None, where other tasks may have their turn before there is a part.

        Raises
        ------
        MalformedMessageError
            If the rest of the message cannot be used; the parts before it are.
        """
        return iter((content,))

    def read(self, content: Any) -> ReceivedMessage:
        """Decode a message: the content of an item that the carrier has passed to `receive`.

        Its batches become this bus's own, and go out by the other links of the bus and never by this one. Samples that
        cannot be decoded are in the message's errors.

        Raises
        ------
        MalformedMessageError
            If nothing of it can be used; it is counted by its reason.
        """

    async def run(self) -> None:
        """Do the work that takes time, such as declaring static frames, until cancelled; may return early.

        An error that it raises ends the link's body, as that of any task does.
        """

    async def close(self) -> None:
        """Disconnect, also if `open` has failed or was cancelled; all that was sent before still goes out.

        The closing has to begin before the first checkpoint, because asyncio's own cancellation knows no shield, and
        has to return within about a second, whatever the network does.
        """
