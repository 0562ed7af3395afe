"""``tfbus record``."""

import math
import signal
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Annotated

import anyio
from cyclopts import Parameter

from tfbus.bus.bus import Bus
from tfbus.bus.event_stream import EventStream
from tfbus.cli.commands.info import left_out
from tfbus.cli.domain import LOCAL, LinkOptions, UnusableError, say
from tfbus.cli.options import Duration
from tfbus.events import RecordingDropped, RecordingFailed
from tfbus.recording.recorder import Recorder
from tfbus.statistics import RecorderStatistics

_FAILED = 1
_KILLED = 128


def record(
    file: Path,
    /,
    *,
    duration: Duration = math.inf,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    link: LinkOptions = LOCAL,
) -> None:
    """Record all transforms of a domain to FILE, an MCAP file as ROS 2 and Foxglove read it, until Ctrl-C.

    Example: tfbus record run.mcap --duration 60

    Parameters
    ----------
    file
        The recording that is made.
    duration
        Stop after this many seconds.
    overwrite
        Whether a file that is there already may be lost.
    """
    status = [0]

    async def record_domain(bus: Bus) -> None:
        recorder = Recorder(bus, file, overwrite=overwrite)
        async with AsyncExitStack() as stack:
            try:
                await stack.enter_async_context(recorder)
            except FileExistsError:
                raise UnusableError(f"{file} is there already: take another name, or give --overwrite") from None
            except ImportError as error:
                raise UnusableError(str(error)) from None
            except OSError as error:
                raise UnusableError(f"cannot write {file}: {error.strerror or error}") from None
            say(f"recording domain {link.domain!r} to {file}")
            status[0] = await _until_stopped(bus, link, duration)
        for line in _summary(file, recorder.statistics()):
            say(line)
        if recorder.error is not None:
            say(f"tfbus: the recording has ended early: {recorder.error}")
            status[0] = _FAILED

    link.run(record_domain)
    if status[0] == _KILLED + signal.SIGINT:
        raise KeyboardInterrupt
    sys.exit(status[0])


async def _until_stopped(bus: Bus, link: LinkOptions, duration: float) -> int:
    """Wait for a signal, the time to be up, or the disk to fail; the exit status that this is."""
    status = 0
    with bus.events(stale_after=None) as events:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(link.first_transform, bus)
            tasks.start_soon(_follow, events, tasks.cancel_scope)
            with anyio.move_on_after(duration):
                status = _KILLED + await _signal()
            tasks.cancel_scope.cancel()
    return status


async def _follow(events: EventStream, scope: anyio.CancelScope) -> None:
    async for event in events:
        if isinstance(event, RecordingFailed):
            scope.cancel()
        elif isinstance(event, RecordingDropped):
            say(f"tfbus: the disk is too slow: samples are lost, {event.dropped} so far")


async def _signal() -> int:
    """Wait to be told to stop, so that the file is finished; on Windows, Ctrl-C raises by itself."""
    if sys.platform == "win32":
        await anyio.sleep_forever()
    with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
        async for number in signals:
            return number
    return signal.SIGTERM


def _summary(file: Path, statistics: RecorderStatistics) -> list[str]:
    lines = [f"{statistics.samples:,} samples in {file}"]
    lost = statistics.queue.dropped + statistics.queue.conflated
    if lost:
        lines.append(f"tfbus: {lost:,} samples were lost, because the disk was too slow or failed")
    if statistics.refused:
        lines.append(f"tfbus: left out, as ROS cannot hold them: {left_out(statistics.refused)}")
    if statistics.unattributed:
        lines.append(
            f"tfbus: {statistics.unattributed:,} samples are recorded without their authority: too many of them"
        )
    return lines
