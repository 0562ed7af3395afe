"""Writing what goes over a bus to a file.

The subscriber only appends to a queue. One task hands what has gathered to a worker thread, in slices so short that the
event loop never waits long for the interpreter. That task cannot be cancelled: it ends when the recorder is left, after
the last sample and the index.
"""

import logging
import math
import os
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import TypeVar

import anyio
import anyio.abc
import anyio.lowlevel
import anyio.to_thread

from tfbus._aio.task_groups import close_task_group
from tfbus.bus.bus import Bus
from tfbus.events import RecordingDropped, RecordingFailed
from tfbus.geometry.stamped import Batch
from tfbus.recording._write_queue import Backlog
from tfbus.recording.formats.mcap_output import McapOutput
from tfbus.registration import Registration
from tfbus.statistics import RecorderStatistics

ResultT = TypeVar("ResultT")

_GATHERING = 0.05
_FLUSH_PERIOD = 0.5
_SLICE = 4_096


class Recorder:
    """Records a bus: ``async with Recorder(bus, "run.mcap")``, from the static samples that are latched until the end.

    The file is MCAP as ROS 2 writes it, with the topics ``/tf`` and ``/tf_static``, so any tool that knows these can
    read it; `tfbus.recording.load` and `Player` also find the authorities in it. Writing goes on in a worker thread and
    never holds up who publishes. What is older than about half a second can be read even if the process is killed.

    Parameters
    ----------
    bus : Bus
    path : str or path
    capacity : int
        How many moving samples may wait for the disk. If there are more, the oldest are dropped, which is a
        `RecordingDropped` event whenever it begins; static samples are not.
    overwrite : bool
        Whether a file that is there already may be lost.

    Attributes
    ----------
    bus : Bus
    path : str
    error : Exception or None
        What ended the recording early.

    Raises
    ------
    ValueError, TypeError
        If `capacity` is less than one or no integer.

    Notes
    -----
    To enter it raises the `OSError` of a file that cannot be made, `FileExistsError` for one that is there already,
    `ImportError` if the extra is missing, and `BusClosedError` if the bus is closed. From then on a disk that is full
    or fails is a `RecordingFailed` event, kept in `error` and logged, and raised nowhere: the body goes on, and the
    file holds what was written until then.

    To leave it waits for the disk, also when the body is cancelled. A batch is recorded under the time at which it was
    published, on the bus's clock. The format has nothing for a frame that is removed, nor for a clock that jumps back:
    programs that sort a recording by its times mix what was before the jump with what came after.
    """

    def __init__(
        self, bus: Bus, path: str | os.PathLike[str], *, capacity: int = 100_000, overwrite: bool = False
    ) -> None:
        self.bus = bus
        self.path = os.fspath(path)
        self.error: Exception | None = None
        self._overwrite = overwrite
        self._backlog = Backlog(capacity)
        self._registration: Registration | None = None
        self._tasks: anyio.abc.TaskGroup
        self._output: McapOutput | None = None
        self._handed = 0
        self._behind = False
        self._ended = False
        self._flushes: list[anyio.Event] = []
        self._arrived: anyio.Event
        self._hurry: anyio.Event
        self._threads: anyio.CapacityLimiter

    def statistics(self) -> RecorderStatistics:
        """All counters, as they are now."""
        output = self._output
        samples, messages, unattributed, refused = 0, 0, 0, {}
        if output is not None:
            samples, messages, unattributed = output.samples, output.messages, output.unattributed
            refused = dict(output.refused)
        in_hand = self._handed - samples - sum(refused.values())
        failed = self.error is not None
        queue = self._backlog.statistics(0 if failed else in_hand, in_hand if failed else 0)
        return RecorderStatistics(samples, messages, unattributed, refused, queue)

    async def flush(self) -> None:
        """Wait until what has been published so far is in the file, or the recording has ended.

        A program that publishes as fast as it can, such as a simulation, gives the disk time with this.
        """
        self._check_entered()
        if self.error is not None or self._ended:
            await anyio.lowlevel.checkpoint()
            return
        flushed = anyio.Event()
        self._flushes.append(flushed)
        self._arrived.set()
        self._hurry.set()
        await flushed.wait()

    async def __aenter__(self) -> "Recorder":
        if self._registration is not None:
            raise RuntimeError("a recorder is entered once: make another one")
        self._arrived = anyio.Event()
        self._hurry = anyio.Event()
        self._registration = self.bus.subscribe(self._take)
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
        self._ended = True
        self._arrived.set()
        self._hurry.set()
        await close_task_group(self._tasks)

    def _check_entered(self) -> None:
        if self._registration is None:
            raise RuntimeError("enter the recorder first: async with Recorder(...) as recorder")

    def _take(self, batch: Batch) -> None:
        now = self.bus.clock.now()
        lost = self._backlog.put(now, batch)
        if lost and not self._behind:
            self._behind = True
            self.bus._announce(RecordingDropped(now, self.path, self._backlog.dropped))
        self._arrived.set()

    async def _work(self, opened: anyio.Event, failures: list[Exception]) -> None:
        with anyio.CancelScope(shield=True):
            self._threads = anyio.CapacityLimiter(1)
            try:
                output = self._output = await self._in_thread(lambda: McapOutput(self.path, self._overwrite))
            except Exception as error:  # noqa: BLE001 - it is raised where the recorder is entered
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
                # Also when Ctrl-C has hit this very task, as it can on trio.
                await self._finish(output)

    async def _finish(self, output: McapOutput) -> None:
        try:
            await self._in_thread(output.close if self.error is not None else output.finish)
        except Exception as error:  # noqa: BLE001 - a disk that fails must not end the program
            self._fail(error)

    async def _write(self, output: McapOutput) -> None:
        """Write what comes, until the recorder is left and nothing is pending."""
        flush_due = 0.0
        while self._backlog or not self._ended:
            if not (self._backlog or self._flushes or self._ended):
                self._behind = False
                self._arrived = anyio.Event()
                with anyio.move_on_after(_FLUSH_PERIOD if output.buffered else math.inf):
                    await self._arrived.wait()
            with anyio.move_on_after(0.0 if self._flushes or self._ended else _GATHERING):
                self._hurry = anyio.Event()
                await self._hurry.wait()
            flushes, self._flushes = self._flushes, []
            flush = bool(flushes) or anyio.current_time() >= flush_due
            try:
                await self._write_pending(output, flush)
            finally:
                _set_all(flushes)
            if flush:
                flush_due = anyio.current_time() + _FLUSH_PERIOD

    async def _write_pending(self, output: McapOutput, flush: bool) -> None:
        # What comes meanwhile is for the next time, lest whoever waits for a flush waits for ever.
        pending = len(self._backlog)
        while True:
            entries = self._backlog.take(_SLICE)
            size = sum(len(batch) for _, batch in entries)
            pending -= size
            self._handed += size
            done = pending <= 0 or not entries
            await self._in_thread(partial(output.write, entries, flush and done))
            if done:
                return

    async def _in_thread(self, function: Callable[[], ResultT]) -> ResultT:
        return await anyio.to_thread.run_sync(function, limiter=self._threads)

    def _fail(self, error: Exception) -> None:
        self.error = error
        if self._registration is not None:
            self._registration.close()
        self._backlog.clear()
        logging.getLogger("tfbus").warning("the recording %s has ended early", self.path, exc_info=error)
        self.bus._announce(RecordingFailed(self.bus.clock.now(), self.path, error))


def _set_all(events: list[anyio.Event]) -> None:
    for event in events:
        event.set()
