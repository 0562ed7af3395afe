"""The carrier of links over zenoh."""

from collections import deque
from collections.abc import Callable

import anyio
import anyio.to_thread
import zenoh

from tfbus.geometry.stamped import TransformStamped
from tfbus.links._carrier import SendReport
from tfbus.links._inbox import ReceivedMessage
from tfbus.links._message import Message, MessageWriter, can_hold, read_message, write_answer
from tfbus.links._outbox import Turn
from tfbus.links._receive_queue import Question, Received
from tfbus.links._state import StateEntry, StateStep
from tfbus.links.zenoh._keys import Keys
from tfbus.links.zenoh._session import ZenohSession

_CLOSING_TIME = 1.0


class ZenohCarrier:
    """Carries the messages of one link over a zenoh session; see `tfbus.links._carrier.AskableCarrier`.

    Parameters
    ----------
    config : zenoh.Config
    keys : Keys
    """

    def __init__(self, config: zenoh.Config, keys: Keys) -> None:
        self.id = keys.link
        self._config = config
        self._keys = keys
        self._answers: deque[tuple[zenoh.Query, Message]] = deque()
        self._woken = anyio.Event()

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        """Open the session; raises `OSError` if it cannot listen where it should, or as a client reaches nobody."""
        self._report = report
        self._writer = MessageWriter(report)
        self._session = ZenohSession(self._config, self._keys, receive)
        # The session closes itself if it is abandoned before it is open.
        await anyio.to_thread.run_sync(self._session.open, abandon_on_cancel=True)

    def send(self, turn: Turn) -> None:
        """Send live messages at once; while the network is congested, zenoh drops them."""
        for message in self._writer.write(turn.entries, turn.step):
            if self._put(message) and message.number:
                self._report.sent(message.samples)

    def read(self, content: tuple[bytes, bytes]) -> ReceivedMessage:
        """Decode a payload and its attachment."""
        return read_message(*content)

    def can_hold(self, sample: TransformStamped) -> bool:
        """Whether a message can hold a sample."""
        return can_hold(sample)

    def claim(self, step: StateStep) -> None:
        """Tell all peers the state of this link."""
        self._put(self._writer.claim(step))

    def ask(self, peer: str, since: int) -> None:
        """Ask a peer for the changes of its state behind a number."""
        self._session.ask(peer, since)

    def answer(self, question: Question, entries: list[StateEntry], step: StateStep) -> None:
        """Answer a question; a worker thread sends the answers, because zenoh may wait for a peer that is frozen."""
        self._answers.append((question.handle, write_answer(entries, step)))
        self._woken.set()

    async def run(self) -> None:
        """Send answers."""
        while True:
            self._woken = anyio.Event()
            while self._answers:
                batch = list(self._answers)
                self._answers.clear()
                await anyio.to_thread.run_sync(self._session.answer, batch)
            await self._woken.wait()

    async def close(self) -> None:
        """Close the session, or give up waiting for it."""
        closing = self._session.close()
        with anyio.move_on_after(_CLOSING_TIME, shield=True):
            await anyio.to_thread.run_sync(closing.join, abandon_on_cancel=True)

    def _put(self, message: Message) -> bool:
        try:
            self._session.put(message)
        except zenoh.ZError as error:
            self._report.failed(error)
            return False
        return True
