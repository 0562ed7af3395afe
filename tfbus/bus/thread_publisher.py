"""Publishing from other threads."""

import threading
from collections.abc import Callable, Iterable
from types import TracebackType

from tfbus._aio.loop_waker import LoopWaker
from tfbus.bus.sample_queue import SampleQueue
from tfbus.errors import BusClosedError
from tfbus.geometry.stamped import Batch, TransformStamped, as_batch


class ThreadPublisher:
    """The result of `Bus.threadsafe`: inside its ``with``, a function that any thread may call.

    Samples are queued here and published on the event loop, with one wake-up of the loop for all that has gathered.

    Parameters
    ----------
    capacity : int
        How many moving samples may be pending; beyond that the oldest batches are dropped and counted.
    attach : callable
        Called on the loop when the ``with`` begins; raises if the bus is not for this loop.
    check : callable
        Called with each batch in the thread that hands it over; raises for a sample that is wrong in itself.
    deliver : callable
        Publishes one batch; called on the loop.
    detach : callable
        Called on the loop when the ``with`` ends.
    """

    def __init__(
        self,
        capacity: int,
        attach: Callable[["ThreadPublisher"], object],
        check: Callable[[Batch], object],
        deliver: Callable[[Batch], object],
        detach: Callable[["ThreadPublisher"], object],
    ) -> None:
        self.queue = SampleQueue(capacity, "drop_oldest")
        self._attach = attach
        self._lock = threading.Lock()
        self._check = check
        self._deliver = deliver
        self._detach = detach
        self._waker = LoopWaker(self._drain)
        self._ended = False

    def __enter__(self) -> "ThreadPublisher":
        self._waker.bind()
        try:
            self._attach(self)
        except BaseException:
            self.end()
            raise
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
        InvalidTransformError
            If a translation is not finite, or longer than the `max_translation` of the bus.
        BusClosedError
            If the ``with`` has ended, or the bus or the event loop is closed.
        RuntimeError
            If the ``with`` has not begun.

        Notes
        -----
        A sample that only the bus can judge, such as one that closes a loop of parents or is ahead of the clock, is
        dropped and counted there.
        """
        batch = as_batch(samples)
        self._check(batch)
        if not self._waker.bound:
            raise RuntimeError("enter the `with` of bus.threadsafe() on the event loop first")
        with self._lock:
            if self._ended:
                raise BusClosedError("the bus takes no more samples from this thread: its `with` has ended")
            self.queue.put(batch)
        try:
            self._waker.wake()
        except RuntimeError as error:
            self.end()
            raise BusClosedError("the event loop of the bus has ended") from error

    def end(self) -> None:
        """Take no more samples."""
        with self._lock:
            self._ended = True

    def discard(self) -> None:
        """Drop the moving samples that were queued before the clock jumped back."""
        with self._lock:
            self.queue.discard_moving()

    def forget(self, child: str) -> None:
        """Drop the queued samples of a removed frame."""
        with self._lock:
            self.queue.forget(child)

    def _drain(self) -> None:
        with self._lock:
            pending = len(self.queue)
        # One by one: a batch may make the clock jump, and that discards the rest.
        for _ in range(pending):
            with self._lock:
                batch = self.queue.get()
            if batch is None:
                return
            self._deliver(batch)
