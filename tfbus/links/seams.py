"""The seam below a link of tfbus: a wire. Its author reads this page.

A link of tfbus decides what it sends to which link, and which samples are news (`tfbus.links.domain`). Its `Wire`
knows one network: it moves bytes between the links of one domain, and tells which links are present. A new network is
one class. `tfbus.links.ros.foreign_end` has the seam below a link to another world, such as ROS.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple, Protocol

from tfbus.tf_message import MalformedMessageError

MAX_MESSAGE: Final = 2**22 + 2**16
"""Bytes; no message is larger, and a wire refuses a larger one before it holds all of it in memory."""


# The wire


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


def first_match(hears: Iterable[Hearing], robot: str) -> Hearing | None:
    """The first that matches a robot, and so is for its links; None if the robot is not heard."""
    return next((hearing for hearing in hears if hearing.matches(robot)), None)


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
            Takes an error of the network that the user should know. Any thread may call it; it never raises.

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


# Both kinds of links


@dataclass(eq=False, slots=True)
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
        Whether it is read before items that are not urgent.
    follows : bool
        Whether an urgent item is read after the waiting items of its sender.
    """

    sender: str
    content: Any
    size: int = 0
    moving: bool = False
    urgent: bool = False
    follows: bool = False


class Network(Protocol):
    """The wire or the carrier below an end."""

    id: str

    async def run(self) -> None:
        """Do what takes time, until cancelled."""

    async def close(self) -> None:
        """Disconnect."""


class Host(Protocol):
    """The event loop and the link, as an end needs them."""

    def receive(self, item: Received) -> None:
        """Handle an item later, on the event loop; for any thread."""

    def send_soon(self, pending: int) -> None:
        """Call `Endpoint.send` at the end of the turn of the event loop; `pending` samples wait."""

    def is_behind(self) -> bool:
        """Whether items wait to be handled."""

    def stir(self) -> None:
        """Call `Endpoint.work` earlier than at the time that it has returned."""


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
