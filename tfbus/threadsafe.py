"""Publishing from other threads."""

import threading
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Any, cast

import anyio.lowlevel

from tfbus.errors import BusClosedError
from tfbus.sample_queue import SampleQueue
from tfbus.stamped import Batch, TransformStamped, as_batch


class ThreadPublisher:
    """What `Bus.threadsafe` gives: inside its ``with``, a function that any thread may call.

    Samples are queued here and published on the event loop, with one wake-up of the loop for all that has gathered.

    Parameters
    ----------
    capacity : int
        How many moving samples may be pending; beyond that the oldest batches are dropped and counted.
    attach : callable
        Called on the loop when the ``with`` begins; raises if the bus is not for this loop.
    deliver : callable
        Publishes one batch; called on the loop.
    detach : callable
        Called on the loop when the ``with`` ends.
    """

    def __init__(
        self,
        capacity: int,
        attach: Callable[["ThreadPublisher"], object],
        deliver: Callable[[Batch], object],
        detach: Callable[["ThreadPublisher"], object],
    ) -> None:
        self.queue = SampleQueue(capacity, "drop_oldest")
        self._attach = attach
        self._lock = threading.Lock()
        self._deliver = deliver
        self._detach = detach
        self._soon: Callable[[Callable[[], object]], object] | None = None
        self._armed = True
        self._ended = False

    def __enter__(self) -> "ThreadPublisher":
        # anyio has no public call for this; both loops' own one is the only thing that wakes them from a thread.
        native = cast(Any, anyio.lowlevel.current_token().native_token)
        self._attach(self)
        self._soon = getattr(native, "run_sync_soon", None) or native.call_soon_threadsafe
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.end()
        self._drain()
        self._detach(self)

    def __call__(self, samples: TransformStamped | Iterable[TransformStamped]) -> None:
        """Hand over one sample or a batch; the order within a thread is kept.

        Raises
        ------
        TypeError
            If something in it is not a `TransformStamped`.
        BusClosedError
            If the ``with`` has ended, or the bus or the event loop is closed.
        RuntimeError
            If the ``with`` has not begun.

        Notes
        -----
        What only the bus can judge, such as a loop of parents, is dropped and counted there.
        """
        batch = as_batch(samples)
        if self._soon is None:
            raise RuntimeError("enter the `with` of bus.threadsafe() on the event loop first")
        with self._lock:
            if self._ended:
                raise BusClosedError("the bus takes no more samples from this thread: its `with` has ended")
            self.queue.put(batch)
            wake, self._armed = self._armed, False
        if wake:
            try:
                self._soon(self._drain)
            except RuntimeError as error:
                self.end()
                raise BusClosedError("the event loop of the bus has ended") from error

    def end(self) -> None:
        """Take no more samples."""
        with self._lock:
            self._ended = True

    def discard(self) -> None:
        """Drop what was queued before the clock jumped back; static samples stay."""
        with self._lock:
            self.queue.discard_moving()

    def forget(self, child: str) -> None:
        """Drop what is queued of a removed frame."""
        with self._lock:
            self.queue.forget(child)

    def _drain(self) -> None:
        with self._lock:
            # Re-armed before the queue is emptied: a sample that comes right behind it wakes the loop again.
            self._armed = True
            pending = len(self.queue)
        # One by one: what is delivered may make the clock jump, and that discards the rest.
        for _ in range(pending):
            with self._lock:
                batch = self.queue.get()
            if batch is None:
                return
            self._deliver(batch)
