"""The seam below a link of tfbus: a wire moves bytes between the links of one domain, and says which links are there.

A link of tfbus decides what is said, to whom and when, and what is news (`tfbus.links.domain`). Its wire knows one
network. A new network is one class with these methods. Links to other worlds, such as ROS, have messages of that world
and sit on `tfbus.links.carrier` instead.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from tfbus.tf_message import MalformedMessageError

MAX_MESSAGE: Final = 2**22 + 2**16
"""Bytes; no message is larger, and a wire refuses a larger one before it holds all of it in memory."""


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
        first, *others = self.robots.split("*")
        if not others:
            return robot == first
        last = others.pop()
        if len(robot) < len(first) + len(last) or not robot.startswith(first) or not robot.endswith(last):
            return False
        at, end = len(first), len(robot) - len(last)
        for part in others:
            # Each part may stand where it first occurs, so nothing is ever tried again.
            at = robot.find(part, at, end)
            if at < 0:
                return False
            at += len(part)
        return True


@dataclass(frozen=True, slots=True)
class Joined:
    """A link that this one means to hear is there; what was sent to it before may be lost."""

    robot: str


@dataclass(frozen=True, slots=True)
class Left:
    """A link is there no more. Nothing of it follows, unless it joins again."""


WireItem = bytes | Joined | Left | MalformedMessageError
"""An item that a wire brings of one link; the error is for a message that the wire has refused."""
Receive = Callable[[str, WireItem], object]


class Wire(Protocol):
    """Moves messages between the links of one domain over one network.

    A wire is used by one link, and opened once. The event loop calls everything here, in this order: `open`; then,
    while `run` runs as a task, `publish` and `send`; when `run` has been cancelled, these once more, and `close`.

    Attributes
    ----------
    id : str
        The name of this link for all others: 32 hexadecimal digits, drawn at random.
    """

    id: str

    async def open(self, hears: Sequence[Hearing], receive: Receive, warn: Callable[[Exception], object]) -> None:
        """Join the network, or begin to: where others are not there yet, `run` meets them later.

        Parameters
        ----------
        hears : sequence of Hearing
            The first that matches a link's robot is for that link; a link that none matches is not announced, and
            nothing that it publishes comes to this process.
        receive : callable
            Takes the id of a link, and what has come of it: that it has joined or left, a message that it has published
            on a channel which this link hears, or one that it has sent to this link. Messages that are sent to this
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
        """Do what takes time, such as connecting to others, until cancelled."""

    def is_heard(self, channel: str) -> bool:
        """Whether any link may hear a channel of this one; it does not block and does not raise."""

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
