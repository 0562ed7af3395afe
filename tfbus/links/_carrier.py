"""The protocol between a link and the carrier below it."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

from tfbus.geometry.stamped import TransformStamped
from tfbus.links._inbox import ReceivedMessage
from tfbus.links._outbox import Turn
from tfbus.links._receive_queue import HistoryQuestion, Question, Received
from tfbus.links._state import StateEntry, StateStep


class SendReport:
    """Counts what a carrier has sent, and what it could not send; for the event loop only.

    Parameters
    ----------
    warn : callable
        Called with the error of everything that could not be sent.

    Attributes
    ----------
    messages, samples : int
        What was handed to the network.
    not_sent : Counter
        Samples and removals that no message can hold, by reason.
    """

    def __init__(self, warn: Callable[[Exception], object]) -> None:
        self._warn = warn
        self.messages = 0
        self.samples = 0
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
    """Carries what a link sends over one network, and brings what comes from there.

    The link decides what goes out, what is news and what is refused; a carrier decides how it is written, and keeps
    static frames for late joiners as its network allows. A carrier is used by one link, and opened once.

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
            Items are handled in the order of the calls, so a peer's `Presence.LEFT` has to be the last of its items. A
            carrier whose network tells nothing of presence leaves presence out.
        report : SendReport
            Counts what was sent and what could not be; for the event loop only.

        Raises
        ------
        OSError
            If there is no connection. Whatever it raises, also when it is cancelled, the link calls `close` next.
        """

    def send(self, turn: Turn) -> None:
        """Send what one turn of the event loop has published and removed; a turn is never empty.

        It must not block and must not raise: entries that the carrier's messages cannot hold, and messages that the
        network does not accept, go to the report. Entries leave in order; the changes of static frames go out behind
        the entries of the same turn and may be conflated with later ones.
        """

    def read(self, content: Any) -> ReceivedMessage:
        """Decode a message: the content of an item that the carrier has passed to `receive`.

        A batch without an origin is for a sender that knows no buses: it becomes this bus's own, and goes out by the
        other links of the bus and never by this one. Samples that cannot be decoded are in the message's errors.

        Raises
        ------
        MalformedMessageError
            If nothing of it can be used; it is counted by its reason.
        """

    async def run(self) -> None:
        """Do what takes time, such as declaring what is kept for late joiners, until cancelled; may return early.

        An error that it raises ends the link's body, as that of any task does.
        """

    async def close(self) -> None:
        """Disconnect, also if `open` has failed or was cancelled; all that was sent before still goes out.

        The closing has to begin before the first checkpoint, because asyncio's own cancellation knows no shield, and
        has to return within about a second, whatever the network does.
        """


@runtime_checkable
class SplittingCarrier(Carrier, Protocol):
    """A carrier with messages that may be too large for one turn of the event loop."""

    def split(self, content: Any) -> Iterator[Any]:
        """The content of an item in parts, for `read` one by one; an item that is small is its only part.

        It may also yield None, where other tasks may have their turn before there is a part.

        Raises
        ------
        MalformedMessageError
            If the rest of the message cannot be used; the parts before it are.
        """


@runtime_checkable
class AskableCarrier(Carrier, Protocol):
    """A carrier whose peers tell of their presence, number their state, and can be asked for it.

    A link over it converges: whatever was lost on the way, each peer that claims a state which the link does not hold
    is asked for it, until both agree. Every message that ends a turn carries the turn's `step`.
    """

    def can_hold(self, sample: TransformStamped) -> bool:
        """Whether a message can hold a sample."""

    def claim(self, step: StateStep) -> None:
        """Tell all peers the state of this link, while there is nothing else to send; must not block or raise."""

    def ask(self, peer: str, since: int) -> None:
        """Ask a peer for the changes of its state behind a number; must not block or raise.

        Then `receive` is called with an `Answer` from that peer, one without a message if there is none in a while.
        """

    def write_answer(self, entries: Sequence[StateEntry], step: StateStep) -> Any:
        """A message that tells changes of a state, or samples of the past, for `answer`.

        Raises
        ------
        ValueError
            If one message cannot hold so many entries; fewer may do.
        """

    def answer(self, question: Question | HistoryQuestion, message: Any) -> None:
        """Answer a question that came as an item, with what `write_answer` has written; must not block or raise.

        The same message may answer several questions.
        """


@runtime_checkable
class HistoryCarrier(AskableCarrier, Protocol):
    """A carrier whose peers can also be asked for the last seconds of their moving frames."""

    def ask_history(self, peer: str, seconds: float, after: str) -> None:
        """Ask a peer for the frames whose names come after `after`; must not block or raise.

        Then `receive` is called with a `HistoryAnswer` from that peer, one without a message if there is none.
        """
