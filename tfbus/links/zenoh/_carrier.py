"""The carrier of links over zenoh."""

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from functools import partial
from typing import Any

import anyio
import anyio.to_thread
import zenoh

from tfbus._aio.task_groups import close_task_group
from tfbus.geometry.stamped import TransformStamped
from tfbus.links._carrier import SendReport
from tfbus.links._inbox import ReceivedMessage
from tfbus.links._message import (
    Message,
    MessageWriter,
    can_hold,
    is_large,
    read_message,
    read_message_in_parts,
    write_answer,
)
from tfbus.links._outbox import Turn
from tfbus.links._part_writer import PartWriter
from tfbus.links._receive_queue import HistoryQuestion, Question, Received
from tfbus.links._state import StateEntry, StateStep
from tfbus.links.zenoh._closing import wait_until_closed
from tfbus.links.zenoh._keys import Keys
from tfbus.links.zenoh._newest import NewestSamples
from tfbus.links.zenoh._sessions import ZenohSessions


class ZenohCarrier:
    """Carries the messages of one link over zenoh; see `tfbus.links._carrier.AskableCarrier`.

    Parameters
    ----------
    config : zenoh.Config
    patch_config : callable
        The configuration of a session that connects to one address only.
    keys : Keys
    slow_rate : float
        How many times a second the newest samples go out by the slow key, while somebody subscribes to it.
    """

    def __init__(
        self,
        config: zenoh.Config,
        patch_config: Callable[[str], zenoh.Config],
        keys: Keys,
        slow_rate: float = 1.0,
    ) -> None:
        self.id = keys.link
        self._slow_period = 1 / slow_rate
        self._newest = NewestSamples()
        self._config = config
        self._patch_config = patch_config
        self._keys = keys

    @property
    def session(self) -> zenoh.Session:
        """The session of zenoh, while the carrier is open."""
        return self._sessions.session

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        """Open the session; raises `OSError` if it cannot listen where it should, or as a client reaches nobody."""
        self._report = report
        self._writer = MessageWriter(report)
        self._parts = PartWriter(report)
        self._filters: Mapping[str, Set[str]] = {}
        self._sessions = ZenohSessions(self._config, self._patch_config, self._keys, receive)
        # The session closes itself if it is abandoned before it is open.
        await anyio.to_thread.run_sync(self._sessions.open, abandon_on_cancel=True)

    def send(self, turn: Turn) -> None:
        """Send live messages at once, if anybody hears them; while the network is congested, zenoh drops them."""
        self._newest.note(turn)
        self._serve_filters()
        for name, message in self._parts.write(turn):
            if self._put_part(name, message):
                self._report.sent(message.samples)
        if not self._is_heard():
            self._writer.skip(turn.time)
            return
        for message in self._writer.write(turn.entries, turn.step, turn.time):
            if self._put(message) and message.number:
                self._report.sent(message.samples)

    def split(self, content: Any) -> Iterator[Any]:
        """The parts of a large message, none of which is half a batch; anything else is its only part."""
        return read_message_in_parts(*content) if type(content) is tuple and is_large(*content) else iter((content,))

    def read(self, content: tuple[bytes, bytes] | ReceivedMessage) -> ReceivedMessage:
        """Decode a payload and its attachment, unless `split` has done so."""
        return content if isinstance(content, ReceivedMessage) else read_message(*content)

    def can_hold(self, sample: TransformStamped) -> bool:
        """Whether a message can hold a sample."""
        return can_hold(sample)

    def claim(self, step: StateStep) -> None:
        """Tell all peers the state of this link."""
        self._newest.claim(step)
        self._serve_filters()
        for name, message in self._parts.claim(step):
            self._put_part(name, message)
        self._put(self._writer.claim(step))

    def ask(self, peer: str, since: int) -> None:
        """Ask a peer for the changes of its state behind a number."""
        self._sessions.ask(peer, since)

    def ask_history(self, peer: str, seconds: float, after: str) -> None:
        """Ask a peer for the last seconds of the moving frames whose names come after `after`."""
        self._sessions.ask_history(peer, seconds, after)

    def write_answer(self, entries: Sequence[StateEntry], step: StateStep) -> Message:
        """A message for `answer`; raises `ValueError` if one message cannot hold so many entries."""
        return write_answer(entries, step)

    def answer(self, question: Question | HistoryQuestion, message: Message) -> None:
        """Answer a question."""
        self._sessions.answer(question.handle, message)

    async def run(self) -> None:
        """Dial peers that were lost, and send by the slow key."""
        tasks = anyio.create_task_group()
        await tasks.__aenter__()
        for task in (self._sessions.keep_connected, self._send_slowly):
            tasks.start_soon(task)
        # Ctrl-C comes to one of them, and leaves without a group.
        await close_task_group(tasks)

    async def _send_slowly(self) -> None:
        while True:
            await anyio.sleep(self._slow_period)
            try:
                if self._newest.untold and self._sessions.is_heard_slowly():
                    self._sessions.put_slowly(self._newest.take())
            except zenoh.ZError as error:
                self._report.failed(error)

    async def close(self) -> None:
        """Close the sessions, or give up waiting for them."""
        late = await wait_until_closed(self._sessions.close())
        if late is not None:
            self._report.failed(late)

    def _is_heard(self) -> bool:
        try:
            return self._sessions.is_heard()
        except zenoh.ZError:
            # Sending fails as well, and that is reported.
            return True

    def _serve_filters(self) -> None:
        filters = self._sessions.filters
        if filters is not self._filters:
            self._filters = filters
            self._parts.serve(filters)
            self._sessions.serve(filters)

    def _put(self, message: Message) -> bool:
        return self._try(partial(self._sessions.put, message))

    def _put_part(self, name: str, message: Message) -> bool:
        return self._try(partial(self._sessions.put_part, name, message))

    def _try(self, put: Callable[[], object]) -> bool:
        try:
            put()
        except zenoh.ZError as error:
            self._report.failed(error)
            return False
        return True
