"""``tfbus record``."""

import logging
import math
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import AbstractContextManager, AsyncExitStack
from pathlib import Path

from tfbus.cli.arguments import Duration, Flag, UsageError
from tfbus.cli.domain import DEFAULT_HEARING, HearingOptions
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import format_counts, say, warn
from tfbus.cli.statuses import ENDED_BY_SIGNAL, FAILED

with lazy_imports():
    import anyio

    from tfbus.bus.bus import Bus
    from tfbus.bus.event_stream import EventStream
    from tfbus.events import RecordingDropped, RecordingFailed
    from tfbus.recording.recorder import Recorder
    from tfbus.statistics import RecorderStatistics


def record(
    file: Path,
    /,
    *,
    duration: Duration = math.inf,
    overwrite: Flag = False,
    link: HearingOptions = DEFAULT_HEARING,
) -> int:
    """Record all transforms of a domain to FILE, in MCAP as ROS 2 and Foxglove read it, until Ctrl-C.

    Example: tfbus record run.mcap --duration 60

    Parameters
    ----------
    file
        The MCAP file to write.
    duration
        Stop after this many seconds.
    overwrite
        Replace FILE if it exists.
    """

    async def record_domain(bus: Bus) -> int:
        recorder = Recorder(bus, file, overwrite=overwrite)
        async with AsyncExitStack() as stack:
            # From before the recorder can fail.
            events = stack.enter_context(bus.events(stale_after=None))
            # Until the file is finished, so that a second signal does not kill the program meanwhile.
            signals = None if sys.platform == "win32" else stack.enter_context(_open_signals())
            try:
                await stack.enter_async_context(recorder)
            except FileExistsError:
                raise UsageError(f"{file} is there already: take another name, or give --overwrite") from None
            except ImportError as error:
                raise UsageError(str(error)) from None
            except OSError as error:
                raise UsageError(f"cannot write {file}: {error.strerror or error}") from None
            say(f"recording {link.place} to {file}")
            status = await _wait_for_end(bus, link, duration, events, signals)
        print_summary(file, recorder.statistics())
        if recorder.error is None:
            return status
        warn(f"the recording has ended early: {recorder.error}")
        return FAILED

    recorder_log = logging.getLogger("tfbus.recording")
    # The lines of this command say the same.
    recorder_log.propagate = False
    try:
        return link.run(record_domain)
    finally:
        recorder_log.propagate = True


def _open_signals() -> AbstractContextManager[AsyncIterator[signal.Signals]]:
    return anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM)


async def _wait_for_end(
    bus: Bus,
    link: HearingOptions,
    duration: float,
    events: EventStream,
    signals: AsyncIterator[signal.Signals] | None,
) -> int:
    """Wait until a signal comes, the duration is over, or the disk fails; return the exit status for it."""
    status = 0
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(link.first_transform, bus)
        tasks.start_soon(_watch_recorder, events, tasks.cancel_scope)
        with bus.clock.move_on_after(duration):
            status = ENDED_BY_SIGNAL + await _wait_for_signal(signals)
        tasks.cancel_scope.cancel()
    return status


async def _watch_recorder(events: EventStream, scope: anyio.CancelScope) -> None:
    """Warn of lost samples, and cancel a scope when the recording fails."""
    async for event in events:
        if isinstance(event, RecordingFailed):
            scope.cancel()
        elif isinstance(event, RecordingDropped):
            warn(f"the disk is too slow: samples are lost, {event.dropped} so far")


async def _wait_for_signal(signals: AsyncIterator[signal.Signals] | None) -> int:
    """Wait for Ctrl-C or a termination and return its number, so that the file is finished before the program ends."""
    if signals is None:
        # On Windows, Ctrl-C raises by itself.
        await anyio.sleep_forever()
    else:
        async for number in signals:
            return number
    return signal.SIGTERM


def print_summary(file: Path, statistics: RecorderStatistics) -> None:
    """Print how many samples were recorded, lost and left out."""
    say(f"{statistics.samples:,} samples in {file}")
    lost = statistics.queue.dropped + statistics.queue.conflated
    if lost > 0:
        warn(f"{lost:,} samples were lost, because the disk was too slow or failed")
    if statistics.refused:
        warn(f"left out, as ROS cannot hold them: {format_counts(statistics.refused)}")
    if statistics.unattributed > 0:
        warn(f"{statistics.unattributed:,} samples are recorded without their authority: too many of them")
