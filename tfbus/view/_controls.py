"""The queue of what people do in the browser; the callbacks come in other threads."""

import threading
from collections import deque
from collections.abc import Callable

from tfbus._aio.loop_waker import LoopWaker
from tfbus.statistics import QueueStatistics

CAPACITY = 1_000


class Controls:
    """Calls functions on the event loop that other threads hand over, in their order, one in each turn of the loop.

    When more than `CAPACITY` are pending, the oldest is dropped and counted.

    Parameters
    ----------
    called : callable
        Called on the loop after a function was called.
    """

    def __init__(self, called: Callable[[], object]) -> None:
        self.dropped = 0
        self._called = called
        self._pending: deque[Callable[[], object]] = deque()
        self._lock = threading.Lock()
        self._waker = LoopWaker(self._drain)
        self._ended = False

    def bind(self) -> None:
        """Use the running event loop."""
        self._waker.bind()

    def put(self, control: Callable[[], object]) -> None:
        """Hand a function over, from any thread; after `end`, or without the loop, nothing happens."""
        with self._lock:
            if self._ended:
                return
            if len(self._pending) == CAPACITY:
                self._pending.popleft()
                self.dropped += 1
            self._pending.append(control)
        try:
            self._waker.wake()
        except RuntimeError:
            # The event loop has ended before the server.
            self.end()

    def end(self) -> None:
        """Drop what is pending, and take no more."""
        with self._lock:
            self._ended = True
            self._pending.clear()

    def statistics(self) -> QueueStatistics:
        """The queue's counters."""
        return QueueStatistics("controls", "drop_oldest", CAPACITY, len(self._pending), self.dropped)

    def _drain(self) -> None:
        with self._lock:
            if not self._pending:
                return
            control = self._pending.popleft()
            more = bool(self._pending)
        if more:
            # A flood of clicks must not hold the program up.
            self._waker.wake()
        control()
        self._called()
