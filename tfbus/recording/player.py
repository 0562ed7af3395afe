"""`Player`, which publishes a recording on a bus."""

import math
import os
from collections import Counter, deque
from collections.abc import Generator, Iterator
from contextlib import suppress
from itertools import islice
from types import TracebackType
from typing import Any

import anyio
import anyio.abc
import anyio.lowlevel
import anyio.streams.memory
import anyio.to_thread

from tfbus._aio.task_groups import close_task_group
from tfbus._aio.turn_budget import TurnBudget
from tfbus.bus.bus import Bus
from tfbus.clock import SimulatedClock
from tfbus.errors import UnknownFrameError
from tfbus.geometry.stamped import shifted
from tfbus.recording.recording import OdometryTopics, RecordedMessage, Recording, Selection, Topics, open_recording
from tfbus.stamps import SECOND, as_offset, as_stamp, from_seconds, is_real, to_seconds

_BLOCK = 256

Block = list[RecordedMessage]


class ReadAhead:
    """Reads messages in a worker thread: ``async with ReadAhead(...) as blocks: async for block in blocks``.

    Parameters
    ----------
    messages : iterator of RecordedMessage
        The messages of a recording, which must stay open until the ``async with`` has ended. A generator is closed at
        that end.
    ahead : int
        How many blocks the thread reads before they are requested. With 0 it only reads while the iterating task waits.

    Notes
    -----
    An error of reading, such as an `OSError`, is raised by the iteration after the last block that could be read.
    """

    def __init__(self, messages: Iterator[RecordedMessage], ahead: int) -> None:
        self._messages = messages
        self._wanted = anyio.Semaphore(ahead)
        self._error: Exception | None = None
        self._tasks: anyio.abc.TaskGroup
        self._receive: anyio.streams.memory.MemoryObjectReceiveStream[Block]

    async def __aenter__(self) -> "ReadAhead":
        # The semaphore bounds how far it reads ahead.
        send, self._receive = anyio.create_memory_object_stream[Block](math.inf)
        self._tasks = await anyio.create_task_group().__aenter__()
        self._tasks.start_soon(self._read, send)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._tasks.cancel_scope.cancel()
        try:
            await close_task_group(self._tasks)
        finally:
            self._receive.close()

    def __aiter__(self) -> "ReadAhead":
        return self

    async def __anext__(self) -> Block:
        self._wanted.release()
        try:
            return await self._receive.receive()
        except anyio.EndOfStream:
            if self._error is not None:
                raise self._error from None
            raise StopAsyncIteration from None

    async def _read(self, send: anyio.streams.memory.MemoryObjectSendStream[Block]) -> None:
        thread = anyio.CapacityLimiter(1)
        try:
            while self._error is None:
                await self._wanted.acquire()
                block: Block = []
                try:
                    await anyio.to_thread.run_sync(block.extend, islice(self._messages, _BLOCK), limiter=thread)
                except Exception as error:  # noqa: BLE001 - the iteration raises it
                    self._error = error
                if not block:
                    return
                send.send_nowait(block)
        finally:
            send.close()
            if isinstance(self._messages, Generator):
                self._messages.close()


_BLOCKS_AHEAD = 2
_STEP = 0.02
_MIN_STEP = 1e-9
_MAX_STEP = 1e9
_SAMPLES_AT_ONCE = 1_000
_STRETCH = SECOND
"""In ns of the log: far less than buffers usually keep."""


class Player:
    """Publishes the samples of a recording at the recorded pace or another: ``await player.play()``.

    Stamps and authorities are the recorded ones; leading slashes are removed from frame names. The bus counts the
    samples that it refuses, such as a loop of parents. It does not compare their stamps with its clock: `max_ahead` is
    for samples that are not recorded.

    On a bus with a `SimulatedClock` the player drives that clock: the clock jumps to the beginning of the recording and
    then advances from the log time of one message to the next log time, so timed tasks run as they did during the
    recording, at any rate. No other task may advance the clock meanwhile. Beginning again and seeking back are jumps
    back of the clock.

    On any other clock the stamps lie in the past, so ``max_age=`` refuses them. There, beginning again and seeking back
    remove the moving frames that were played, because the buffers would refuse samples older than those they have.

    Parameters
    ----------
    bus : Bus
    path : str or path
        A recording of ROS 1 (``.bag``), of ROS 2 (``.db3``, ``.mcap``) or of a `Recorder`, finished or not.
    rate : float
        The pace, as a multiple of the recorded one; `math.inf` plays as fast as possible.
    loop : bool
        Whether to begin again at the end, for ever.
    since, until : int, optional
        The first and the last log time, in ns. The static transforms from before are played first.
    topics, prefix, namespaces, odometry, invert
        As `open_recording`.
    offset : float
        Added to each stamp of a moving sample, in s; the pace and the log times stay.

    Attributes
    ----------
    bus : Bus
    path : str
    start, end : int or None
        The first and the last log time of the played part, in ns; None until `play` has opened the recording, and for
        an empty recording.
    position : int or None
        The log time of the last message that was played, in ns.
    messages : int
        Messages that were played.
    played : int
        Samples that were passed to the bus.
    passes : int
        How many times the end has been reached.
    bad : Counter
        Invalid transforms and damaged messages met so far, by reason.

    Raises
    ------
    TypeError, ValueError
        If `rate` is not greater than zero, `until` is before `since`, or the topics are wrong.

    Examples
    --------
    >>> from tfbus.recording import Player
    >>> bus = Bus(SimulatedClock())
    >>> await Player(bus, "small.bag", rate=1000.0).play()
    >>> bus.statistics().samples > 900
    True
    """

    def __init__(
        self,
        bus: Bus,
        path: str | os.PathLike[str],
        *,
        rate: float = 1.0,
        loop: bool = False,
        since: int | None = None,
        until: int | None = None,
        topics: Topics = None,
        prefix: str = "",
        namespaces: bool = False,
        odometry: OdometryTopics = None,
        invert: bool = False,
        offset: float = 0.0,
    ) -> None:
        # Wrong topics raise here, and not in `play`.
        Selection(topics, prefix, namespaces, odometry, invert)
        self._chosen: dict[str, Any] = {
            "topics": topics,
            "prefix": prefix,
            "namespaces": namespaces,
            "odometry": odometry,
            "invert": invert,
        }
        self._offset = as_offset(offset)
        _check_rate(rate)
        self._since = None if since is None else as_stamp(since)
        self._until = None if until is None else as_stamp(until)
        if self._since is not None and self._until is not None and self._until < self._since:
            raise ValueError(f"the range must not end before it begins, at {since}, got {until}")
        self.bus = bus
        self.path: str = os.fspath(path)
        self._rate = float(rate)
        self.loop = loop
        self.start: int | None = None
        self.end: int | None = None
        self.position: int | None = None
        self.played: int = 0
        self.messages: int = 0
        self.passes: int = 0
        self.bad: Counter[str] = Counter()
        self._simulated = bus.clock if isinstance(bus.clock, SimulatedClock) else None
        self._playing = False
        self._seek_target: int | None = None
        self._paused = False
        self._steps = 0
        self._waiting: anyio.CancelScope | None = None
        self._playhead: int | None = None
        self._moving_frames: dict[str, None] = {}
        self._origin = 0
        self._origin_time = 0.0

    async def play(self) -> None:
        """Play to the end, or for ever; to stop it, cancel it.

        Damaged parts of the recording are left out and counted in `bad`.

        Raises
        ------
        RecordingError
            If the recording cannot be read at all.
        OSError
            If the recording cannot be read any further.
        BusClosedError
            If the bus is closed.
        RuntimeError
            If this player is playing already, or another task advances the simulated clock.

        Examples
        --------
        >>> from tfbus.recording import Player
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer:
        ...     await Player(bus, "small.bag", rate=1000.0, until=from_seconds(101.0)).play()
        ...     print("gripper" in buffer.tree)
        True
        """
        if self._playing:
            raise RuntimeError("the recording is being played already")
        self._playing = True
        opened: list[Recording] = []
        try:
            tasks = await anyio.create_task_group().__aenter__()
            tasks.start_soon(self._open_into, opened)
            await close_task_group(tasks)
            await self._play(opened[0])
        finally:
            for recording in opened:
                recording.close()
            self._playing = False

    def seek(self, stamp: int) -> None:
        """Continue from another log time, in ns; a player that does not play will begin there.

        The static transforms from before that time are played first.

        Examples
        --------
        >>> from tfbus.recording import Player
        >>> player = Player(Bus(SimulatedClock()), "small.bag", rate=1000.0)
        >>> player.seek(from_seconds(109.0))
        >>> await player.play()
        >>> player.messages < 100
        True
        """
        self._seek_target = as_stamp(stamp)
        self._stir()

    @property
    def rate(self) -> float:
        """The pace, as a multiple of the recorded one; it may be changed while the recording is played.

        Raises
        ------
        TypeError, ValueError
            On setting, if it is not greater than zero.
        """
        return self._rate

    @rate.setter
    def rate(self, rate: float) -> None:
        _check_rate(rate)
        self._anchor()
        self._rate = float(rate)
        self._stir()

    @property
    def paused(self) -> bool:
        """Whether the player is paused."""
        return self._paused

    def pause(self) -> None:
        """Stand still until `resume` or `step`; on a `SimulatedClock`, time stands still as well.

        Examples
        --------
        >>> from tfbus.recording import Player
        >>> player = Player(Bus(SimulatedClock()), "small.bag")
        >>> player.pause()
        >>> player.paused
        True
        """
        if not self._paused:
            self._anchor()
            self._paused = True

    def resume(self) -> None:
        """Go on after a pause.

        Examples
        --------
        >>> from tfbus.recording import Player
        >>> player = Player(Bus(SimulatedClock()), "small.bag", rate=1000.0)
        >>> player.pause()
        >>> player.resume()
        >>> await player.play()
        >>> player.paused, player.messages > 100
        (False, True)
        """
        if self._paused:
            self._paused = False
            self._steps = 0
            if self._playing:
                self._origin_time = anyio.current_time()
            self._stir()

    def step(self) -> None:
        """Pause, and play the next message at once; each call plays one more message.

        Examples
        --------
        >>> from tfbus.recording import Player
        >>> player = Player(Bus(SimulatedClock()), "small.bag", rate=1000.0)
        >>> player.step()
        >>> async with anyio.create_task_group() as tasks:
        ...     _ = tasks.start_soon(player.play)
        ...     while player.messages < 1:
        ...         await anyio.sleep(0.01)
        ...     tasks.cancel_scope.cancel()
        >>> player.messages, player.paused
        (1, True)
        """
        self.pause()
        self._steps += 1
        self._stir()

    def _stir(self) -> None:
        """Interrupt the wait for the next message: its time may have changed."""
        if self._waiting is not None:
            self._waiting.cancel()

    def _anchor(self) -> None:
        """Count the pace from this moment on."""
        if not self._playing or self._paused or self._playhead is None:
            return
        now = anyio.current_time()
        if self._rate != math.inf:
            passed = from_seconds(min((now - self._origin_time) * self._rate, _MAX_STEP))
            # Never before the last message, and never behind the next one.
            self._origin = max(self._origin, min(self._origin + passed, self._playhead))
        else:
            self._origin = self._playhead
        self._origin_time = now

    async def _open_into(self, opened: list[Recording]) -> None:
        # A task of its own: `Task.cancel` of asyncio would end the wait for the thread and lose the opened file.
        opened.append(await anyio.to_thread.run_sync(self._open))

    def _open(self) -> Recording:
        recording = open_recording(self.path, **self._chosen)
        try:
            # In the worker thread: without an index, these read the whole file.
            self.start = recording.start if self._since is None else self._since
            self.end = recording.end if self._until is None else self._until
        except BaseException:
            recording.close()
            raise
        return recording

    async def _play(self, recording: Recording) -> None:
        while True:
            seek_target, self._seek_target = self._seek_target, None
            since = self._since if seek_target is None else seek_target
            played_before = self.played
            # Simulated time may only advance while no thread is reading.
            ahead = _BLOCKS_AHEAD if self._simulated is None else 0
            async with ReadAhead(recording.messages(since, self._until), ahead) as blocks:
                await self._play_once(blocks, since)
            if self._simulated is not None:
                # Lookups that waited for the last samples get them before the clock jumps.
                await self._simulated.advance(0.0)
            if self._seek_target is not None:
                continue
            self.passes += 1
            # Looping over an empty range would never wait, and block the event loop.
            if not self.loop or (seek_target is None and self.played == played_before):
                return

    async def _play_once(self, blocks: ReadAhead, since: int | None) -> None:
        started = False
        async for block in blocks:
            ahead = deque(block)
            while ahead:
                due = ahead[0].received
                if not started:
                    started = True
                    self._begin(due if since is None else since)
                self._playhead = due
                await self._wait_for(due)
                if self._seek_target is not None:
                    return
                with self.bus._recorded_time():
                    self._publish(ahead.popleft())
                    self._publish_at_once(ahead, due)
                if self._paused:
                    # A step was taken.
                    self._steps = max(0, self._steps - 1)
                    self._origin = self._playhead

    def _publish_at_once(self, ahead: deque[RecordedMessage], due: int) -> None:
        """Publish the next messages too, where nothing but a checkpoint would separate them from the last.

        A checkpoint takes longer than a message. In simulated time these are the messages of the same log time (ns),
        up to a number of samples, so that tasks see the same in each run. At an infinite rate they are the messages of
        one turn of the event loop and of some time of the log: otherwise samples that other tasks wait for could leave
        the windows of buffers before these tasks have their turn.
        """
        rate, simulated = self._rate, self._simulated is not None
        if not simulated and rate < math.inf:
            return
        budget, until, samples = TurnBudget(), due if simulated else due + _STRETCH, 0
        while ahead and ahead[0].received <= until:
            # A subscriber may have said so.
            if self._paused or self._rate != rate or self._seek_target is not None:
                return
            if samples >= _SAMPLES_AT_ONCE if simulated else budget.spent:
                return
            message = ahead.popleft()
            samples += len(message.batch)
            self._playhead = message.received
            self._publish(message)

    def _begin(self, stamp: int) -> None:
        self._origin = self._playhead = stamp
        self._origin_time = anyio.current_time()
        if self._simulated is not None:
            if stamp != self._simulated.now():
                self._simulated.set(stamp)
        elif self.position is not None and stamp < self.position:
            for frame in self._moving_frames:
                with suppress(UnknownFrameError):
                    self.bus.remove_frame(frame)
            self._moving_frames.clear()

    async def _wait_for(self, stamp: int) -> None:
        """Wait until a log time is due, or until `seek` is called."""
        clock = self._simulated
        if clock is None:
            await self._sleep_until_due(stamp)
            return
        while True:
            # In steps, so that timed tasks also run between two messages.
            longest = from_seconds(min(max(_STEP * self.rate, _MIN_STEP), _MAX_STEP))
            step = max(0, min(stamp - clock.now(), longest))
            if self.rate != math.inf or self._paused:
                await self._sleep_until_due(clock.now() + step)
            if self._seek_target is not None:
                return
            if self._paused:
                # `step` was called: go up to the message.
                step = max(0, min(stamp - clock.now(), from_seconds(_MAX_STEP)))
            await clock.advance(to_seconds(step))
            if self._seek_target is not None or clock.now() >= stamp:
                return

    async def _sleep_until_due(self, stamp: int) -> None:
        await anyio.lowlevel.checkpoint()
        # Look at the state after each wait: a pause may come between the end of a wait and this task's next turn.
        while self._seek_target is None:
            if self._paused:
                if self._steps:
                    return
                due = math.inf
            else:
                due = self._origin_time + to_seconds(stamp - self._origin) / self.rate
                if due <= anyio.current_time():
                    return
            with anyio.CancelScope() as self._waiting:
                await anyio.sleep_until(due)
            self._waiting = None

    def _publish(self, message: RecordedMessage) -> None:
        received, batch, errors = message
        self.position = received
        self.messages += not (errors and message.is_report)
        if errors:
            self.bad.update(error.reason for error in errors)
        if not batch:
            return
        if self._offset:
            batch = tuple(shifted(sample, self._offset) for sample in batch)
        self.bus.publish(batch, "drop")
        self.played += len(batch)
        if self._simulated is None:
            for sample in batch:
                if sample.static:
                    self._moving_frames.pop(sample.child, None)
                else:
                    self._moving_frames[sample.child] = None


def _check_rate(rate: float) -> None:
    if not is_real(rate):
        raise TypeError(f"a rate must be a number, not {rate!r}")
    if not rate > 0:
        raise ValueError(f"a rate must be greater than zero, got {rate!r}")
