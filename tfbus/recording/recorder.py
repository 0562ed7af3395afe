"""`Recorder`, which writes the samples of a bus to a file.

The subscriber only appends to a queue. One task passes the queued batches to a worker thread, in slices so short that
the event loop never waits long for the interpreter. That task cannot be cancelled: it ends when the ``async with`` of
the recorder ends, after the last sample and the index are written.
"""

import logging
import math
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import TracebackType
from typing import TypeVar

import anyio
import anyio.abc
import anyio.lowlevel
import anyio.to_thread

from tfbus._aio.task_groups import close_task_group
from tfbus.bus.bus import Bus
from tfbus.bus.queues import SampleQueue, TimedBatch
from tfbus.events import RecordingDropped, RecordingFailed
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.plain import printable
from tfbus.recording.formats.mcap_output import McapOutput
from tfbus.registration import AsyncOnly, Registration
from tfbus.statistics import RecorderStatistics


class WriteQueue(SampleQueue):
    """A `SampleQueue` that drops the oldest batches, and gives each batch with its time.

    Parameters
    ----------
    capacity : int
        The greatest number of pending moving samples, and of pending batches; the newest batch always stays. Of dropped
        batches, the newest static sample of each child is kept in addition.

    Attributes
    ----------
    dropped : int
        Moving samples lost to the capacity, and all samples that `clear` removed.
    conflated : int
        Static samples that were kept, and then replaced by a newer one of the same child.
    """

    def __init__(self, capacity: int) -> None:
        super().__init__(capacity, "drop_oldest")

    def get_slice(self, size: int) -> list[TimedBatch]:
        """Remove and return the oldest batches: at least one, and then as many as fit in `size` samples."""
        batches: list[TimedBatch] = [(published, (sample,)) for published, sample in self._kept.values()]
        self._kept.clear()
        count = len(batches)
        while self._batches and (not batches or count + len(self._batches[0][1]) <= size):
            published, batch = self._pop_batch()
            batches.append((published, batch))
            count += len(batch)
        return batches

    def clear(self) -> None:
        """Remove all samples, and count them as dropped."""
        self.dropped += len(self)
        self._kept.clear()
        self._batches.clear()
        self._size = self._moving = 0

    def _keep_static(self, published: int, sample: TransformStamped) -> None:
        self.conflated += sample.child in self._kept
        super()._keep_static(published, sample)


ResultT = TypeVar("ResultT")

_WRITE_PERIOD = 0.05
_FLUSH_PERIOD = 0.5
_SLICE = 4_096


class Recorder(AsyncOnly):
    """Records all samples of a bus: ``async with Recorder(bus, "run.mcap")``. The latched static samples come first.

    The file is MCAP as ROS 2 writes it, with the topics ``/tf`` and ``/tf_static``, so any tool that knows these can
    read it; `tfbus.recording.load` and `Player` also find the authorities in it, and the covariances of samples that
    have one. A worker thread writes, and publishers never wait for it. If the process is killed, only the last half
    second or so is lost.

    Parameters
    ----------
    bus : Bus
    path : str or path
    capacity : int
        How many moving samples may wait for the disk. Beyond that the oldest are dropped, and a `RecordingDropped`
        event says so each time that dropping begins; static samples are never dropped.
    overwrite : bool
        Whether to replace an existing file.

    Attributes
    ----------
    bus : Bus
    path : str
    error : Exception or None
        The error that ended the recording early.

    Raises
    ------
    ValueError, TypeError
        If `capacity` is less than one, or not an integer.

    Notes
    -----
    Entering raises the `OSError` of a file that cannot be created, `FileExistsError` for a file that exists,
    `ImportError` if the extra is missing, and `BusClosedError` if the bus is closed. After that, a disk that is full or
    fails, and a file that somebody removes, replaces or cuts, cause a `RecordingFailed` event; the error is kept in
    `error` and logged, but never raised: the body goes on. `statistics` tells how many samples the file still holds:
    none if it was removed or cut. All later samples count as dropped. If the file is moved, recording continues to the
    end, and is then reported in the same way.

    Leaving waits for the disk, also when the body is cancelled. The log time of a batch is the time of its publication
    on the bus's clock. The format cannot express that a frame was removed, nor that the clock jumped back: programs
    that sort a recording by its log times mix the samples from before the jump with those from after it.

    Examples
    --------
    >>> import tempfile
    >>> from tfbus.recording import Recorder, load
    >>> folder, bus = tempfile.mkdtemp(), Bus(SimulatedClock())
    >>> async with Recorder(bus, f"{folder}/run.mcap"):
    ...     TransformBroadcaster(bus).send("map", "cart", Transform(), at=0)
    >>> load(f"{folder}/run.mcap").frames()
    ['cart', 'map']
    """

    def __init__(
        self, bus: Bus, path: str | os.PathLike[str], *, capacity: int = 100_000, overwrite: bool = False
    ) -> None:
        self.bus = bus
        self.path: str = os.fspath(path)
        self.error: Exception | None = None
        self._overwrite = overwrite
        self._queue = WriteQueue(capacity)
        self._registration: Registration | None = None
        self._tasks: anyio.abc.TaskGroup
        self._output: McapOutput | None = None
        self._submitted = 0
        self._dropping = False
        self._ended = False
        self._flushes: list[anyio.Event] = []
        self._warn_unless_entered()
        self._arrived: anyio.Event
        self._urgent: anyio.Event
        self._threads: anyio.CapacityLimiter

    def __repr__(self) -> str:
        state = f", ended early: {printable(str(self.error))}" if self.error is not None else ""
        return f"<Recorder of {self.path!r}: {self.statistics().samples:,} samples{state}>"

    def statistics(self) -> RecorderStatistics:
        """All counters, as they are now.

        Examples
        --------
        >>> import tempfile
        >>> from tfbus.recording import Recorder
        >>> bus = Bus(SimulatedClock())
        >>> async with Recorder(bus, tempfile.mkdtemp() + "/run.mcap") as recorder:
        ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
        ...     await recorder.flush()
        ...     print(recorder.statistics().samples)
        1
        """
        output = self._output
        samples, messages, unattributed, refused = 0, 0, 0, {}
        if output is not None:
            samples, messages, unattributed = output.samples, output.messages, output.unattributed
            refused = dict(output.refused)
        unwritten = self._submitted - samples - sum(refused.values())
        queue = self._queue.statistics("recording")
        if self.error is None:
            queue = replace(queue, pending=queue.pending + unwritten)
        else:
            queue = replace(queue, dropped=queue.dropped + unwritten)
        return RecorderStatistics(samples, messages, unattributed, refused, queue)

    async def flush(self) -> None:
        """Wait until all samples published so far are in the file, or until the recording has ended.

        A program that publishes as fast as it can, such as a simulation, calls this to let the disk keep up.

        Examples
        --------
        >>> import tempfile
        >>> from tfbus.recording import Recorder, load
        >>> bus, path = Bus(SimulatedClock()), tempfile.mkdtemp() + "/run.mcap"
        >>> async with Recorder(bus, path) as recorder:
        ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
        ...     await recorder.flush()
        """
        self._check_entered()
        if self.error is not None or self._ended:
            await anyio.lowlevel.checkpoint()
            return
        flushed = anyio.Event()
        self._flushes.append(flushed)
        self._arrived.set()
        self._urgent.set()
        await flushed.wait()

    async def __aenter__(self) -> "Recorder":
        self._enter_once()
        self._arrived = anyio.Event()
        self._urgent = anyio.Event()
        self._registration = self.bus.subscribe(self._enqueue)
        self.bus._entered.add(self)
        self._tasks = await anyio.create_task_group().__aenter__()
        opened = anyio.Event()
        failures: list[Exception] = []
        self._tasks.start_soon(self._work, opened, failures)
        try:
            await opened.wait()
        except BaseException:
            await self._end()
            raise
        if failures:
            await self._end()
            raise failures.pop()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self._end()

    async def _end(self) -> None:
        assert self._registration is not None
        self._registration.close()
        self.bus._entered.discard(self)
        self._ended = True
        self._arrived.set()
        self._urgent.set()
        await close_task_group(self._tasks)

    def _check_entered(self) -> None:
        if self._registration is None:
            raise RuntimeError("enter the recorder first: async with Recorder(...) as recorder")

    def _enqueue(self, batch: Batch) -> None:
        if self.error is not None:
            self._queue.dropped += len(batch)
            return
        now = self.bus.clock.now()
        dropped_before = self._queue.dropped
        self._queue.put(batch, now)
        if self._queue.dropped > dropped_before and not self._dropping:
            self._dropping = True
            self.bus._announce(RecordingDropped(now, self.path, self._queue.dropped))
        self._arrived.set()

    async def _work(self, opened: anyio.Event, failures: list[Exception]) -> None:
        with anyio.CancelScope(shield=True):
            self._threads = anyio.CapacityLimiter(1)
            try:
                output = self._output = await self._in_thread(lambda: McapOutput(self.path, self._overwrite))
            except Exception as error:  # noqa: BLE001 - `__aenter__` raises it
                failures.append(error)
                return
            finally:
                opened.set()
            try:
                await self._write(output)
            except Exception as error:  # noqa: BLE001 - a disk that fails must not end the program
                self._fail(error)
            finally:
                _set_all(self._flushes)
                # Also when KeyboardInterrupt was raised in this very task, as trio may do.
                await self._finish(output)

    async def _finish(self, output: McapOutput) -> None:
        try:
            await self._in_thread(output.close if self.error is not None else output.finish)
        except Exception as error:  # noqa: BLE001 - a disk that fails must not end the program
            self._fail(error)

    async def _write(self, output: McapOutput) -> None:
        """Write queued batches until the recorder has ended and nothing is pending."""
        flush_due = 0.0
        while len(self._queue) or not self._ended:
            if not (len(self._queue) or self._flushes or self._ended):
                self._dropping = False
                self._arrived = anyio.Event()
                with anyio.move_on_after(_FLUSH_PERIOD if output.buffered else math.inf):
                    await self._arrived.wait()
            with anyio.move_on_after(0.0 if self._flushes or self._ended else _WRITE_PERIOD):
                self._urgent = anyio.Event()
                await self._urgent.wait()
            flushes, self._flushes = self._flushes, []
            flush = bool(flushes) or anyio.current_time() >= flush_due
            try:
                await self._write_pending(output, flush)
            finally:
                _set_all(flushes)
            if flush:
                flush_due = anyio.current_time() + _FLUSH_PERIOD

    async def _write_pending(self, output: McapOutput, flush: bool) -> None:
        # Only the samples that are pending now: on a busy bus, a flush could last for ever.
        pending = len(self._queue)
        while True:
            batches = self._queue.get_slice(_SLICE)
            size = sum(len(batch) for _, batch in batches)
            pending -= size
            self._submitted += size
            done = pending <= 0 or not batches
            await self._in_thread(partial(output.write, batches, flush and done))
            if done:
                return

    async def _in_thread(self, function: Callable[[], ResultT]) -> ResultT:
        return await anyio.to_thread.run_sync(function, limiter=self._threads)

    def _fail(self, error: Exception) -> None:
        self.error = error
        # Samples that are published from now on count as dropped.
        self._queue.clear()
        logging.getLogger("tfbus.recording").warning(
            "the recording %s has ended early, with %d samples in it: %s",
            printable(self.path),
            self.statistics().samples,
            printable(str(error)),
        )
        self.bus._announce(RecordingFailed(self.bus.clock.now(), self.path, error))


def _set_all(events: list[anyio.Event]) -> None:
    for event in events:
        event.set()
