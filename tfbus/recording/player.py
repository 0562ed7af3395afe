"""Playing a recording into a bus."""

import math
import os
from collections import Counter
from contextlib import suppress

import anyio
import anyio.lowlevel
import anyio.to_thread

from tfbus.bus.bus import Bus
from tfbus.clock import SimulatedClock
from tfbus.errors import UnknownFrameError
from tfbus.recording._read_ahead import ReadAhead
from tfbus.recording.recording import RecordedMessage, Recording, open_recording
from tfbus.stamps import as_stamp, from_seconds, is_real, to_seconds

_BLOCKS_AHEAD = 2
_STEP = 0.02
_LEAST_STEP = 1e-9
_MOST_STEP = 1e9


class Player:
    """Publishes what a recording holds, at the pace at which it was recorded or another: ``await player.play()``.

    Stamps and authorities are as they were recorded, frame names without leading slashes. What the bus refuses, such as
    a loop of parents, it counts.

    On a bus with a `SimulatedClock` the recording drives that clock: it jumps to the beginning, and then goes from the
    log time of one message to that of the next, so timed tasks run as they did while it was recorded, at whatever
    rate. Nobody else may advance it meanwhile. To begin again or to seek back is a jump back of the clock.

    On any other clock the stamps lie in the past, so ``max_age=`` refuses them. There, to begin again or to seek back
    removes the moving frames that were played, because the buffers would take nothing older than what they have.

    Parameters
    ----------
    bus : Bus
    path : str or path
        A recording of ROS 1 (``.bag``) or ROS 2 (``.db3``, ``.mcap``), or our own; one that was never finished, too.
    rate : float
        How many times as fast as it was recorded; `math.inf` for as fast as can be.
    loop : bool
        Whether to begin again at the end, for ever.
    since, until : int, optional
        The first and the last log time, in ns. What was static before comes first.

    Attributes
    ----------
    bus : Bus
    path : str
    start, end : int or None
        The log times, in ns, from which to which it plays; None until `play` has opened the recording, or if it is
        empty.
    position : int or None
        The log time of the last message that was played, in ns.
    played : int
        Samples that were handed to the bus.
    passes : int
        How many times the end has been reached.
    bad : Counter
        What is wrong in the recording, by reason, as far as it was played.

    Raises
    ------
    TypeError, ValueError
        If `rate` is not greater than zero, or `until` is before `since`.
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
    ) -> None:
        if not is_real(rate):
            raise TypeError(f"a rate must be a number, not {rate!r}")
        if not rate > 0:
            raise ValueError(f"a rate must be greater than zero, got {rate!r}")
        self._since = None if since is None else as_stamp(since)
        self._until = None if until is None else as_stamp(until)
        if self._since is not None and self._until is not None and self._until < self._since:
            raise ValueError(f"the range must not end before it begins, at {since}, got {until}")
        self.bus = bus
        self.path = os.fspath(path)
        self.rate = float(rate)
        self.loop = loop
        self.start: int | None = None
        self.end: int | None = None
        self.position: int | None = None
        self.played = 0
        self.passes = 0
        self.bad: Counter[str] = Counter()
        self._simulated = bus.clock if isinstance(bus.clock, SimulatedClock) else None
        self._playing = False
        self._sought: int | None = None
        self._pause: anyio.CancelScope | None = None
        self._moving: dict[str, None] = {}
        self._origin = 0
        self._origin_time = 0.0

    async def play(self) -> None:
        """Play to the end, or for ever; to stop it, cancel it.

        What of the recording is damaged is left out and counted in `bad`.

        Raises
        ------
        RecordingError
            If it cannot be read at all.
        OSError
            If it cannot be read any further.
        BusClosedError
            If the bus is closed.
        RuntimeError
            If it is playing already, or somebody else advances the simulated clock.
        """
        if self._playing:
            raise RuntimeError("the recording is being played already")
        self._playing = True
        try:
            with await anyio.to_thread.run_sync(self._open) as recording:
                await self._play(recording)
        finally:
            self._playing = False

    def seek(self, stamp: int) -> None:
        """Go on from another log time, in ns; if it does not play, begin there. What was static by then comes first."""
        self._sought = as_stamp(stamp)
        if self._pause is not None:
            self._pause.cancel()

    def _open(self) -> Recording:
        recording = open_recording(self.path)
        try:
            # Where there is no index, only reading all of the file tells these.
            self.start = recording.start if self._since is None else self._since
            self.end = recording.end if self._until is None else self._until
        except BaseException:
            recording.close()
            raise
        return recording

    async def _play(self, recording: Recording) -> None:
        while True:
            sought, self._sought = self._sought, None
            since = self._since if sought is None else sought
            before = self.played
            # Time stands still for a thread only if nothing else goes on meanwhile.
            ahead = _BLOCKS_AHEAD if self._simulated is None else 0
            async with ReadAhead(recording.messages(since, self._until), ahead) as blocks:
                await self._play_once(blocks, since)
            if self._simulated is not None:
                # Whoever waited for the last samples has them before the clock jumps.
                await self._simulated.advance(0.0)
            if self._sought is not None:
                continue
            self.passes += 1
            # What is empty from its beginning would be played over and over without ever waiting.
            if not self.loop or (sought is None and self.played == before):
                return

    async def _play_once(self, blocks: ReadAhead, since: int | None) -> None:
        begun = False
        async for block in blocks:
            for message in block:
                if not begun:
                    begun = True
                    self._begin(message.received if since is None else since)
                await self._reach(message.received)
                if self._sought is not None:
                    return
                self._publish(message)

    def _begin(self, stamp: int) -> None:
        self._origin = stamp
        self._origin_time = anyio.current_time()
        if self._simulated is not None:
            if stamp != self._simulated.now():
                self._simulated.set(stamp)
        elif self.position is not None and stamp < self.position:
            for frame in self._moving:
                with suppress(UnknownFrameError):
                    self.bus.remove_frame(frame)
            self._moving.clear()

    async def _reach(self, stamp: int) -> None:
        """Wait until a log time is due, or somebody seeks."""
        clock = self._simulated
        if clock is None:
            await self._sleep_until_due(stamp)
            return
        # In steps, or a clock that is watched would stand still between two messages.
        longest = from_seconds(min(max(_STEP * self.rate, _LEAST_STEP), _MOST_STEP))
        while True:
            step = max(0, min(stamp - clock.now(), longest))
            if self.rate != math.inf:
                await self._sleep_until_due(clock.now() + step)
            if self._sought is not None:
                return
            await clock.advance(to_seconds(step))
            if self._sought is not None or clock.now() >= stamp:
                return

    async def _sleep_until_due(self, stamp: int) -> None:
        due = self._origin_time + to_seconds(stamp - self._origin) / self.rate
        with anyio.CancelScope() as self._pause:
            await anyio.sleep_until(due)
        self._pause = None

    def _publish(self, message: RecordedMessage) -> None:
        self.position = message.received
        self.bad.update(error.reason for error in message.errors)
        if not message.batch:
            return
        self.bus.publish(message.batch, invalid="drop")
        self.played += len(message.batch)
        if self._simulated is None:
            for sample in message.batch:
                if sample.static:
                    self._moving.pop(sample.child, None)
                else:
                    self._moving[sample.child] = None
