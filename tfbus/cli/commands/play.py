"""``tfbus play``."""

import sys
from collections import Counter
from pathlib import Path
from typing import Annotated

import anyio
from cyclopts import Parameter

from tfbus.bus.bus import Bus
from tfbus.cli.arguments import DEFAULT_TOPICS, Flag, Instant, Speed, Time, TopicOptions, UsageError
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.output import format_counts, say, warn
from tfbus.events import PeerJoined
from tfbus.recording.player import Player
from tfbus.stamps import to_seconds

_DISCOVERY = 1.0
"""s; other programs are found within, or are not there."""
_REDRAW_PERIOD = 0.1


def play(
    file: Path,
    /,
    *,
    rate: Speed = 1.0,
    loop: Flag = False,
    since: Annotated[Instant | None, Parameter(name="--from")] = None,
    until: Annotated[Instant | None, Parameter(name="--to")] = None,
    topics: TopicOptions = DEFAULT_TOPICS,
    link: LinkOptions = DEFAULT_LINK,
) -> None:
    """Publish a recording on a domain with its original stamps and timing, static transforms first.

    Example: tfbus play run.mcap --rate 2 --from 30 --to 60

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, or a folder of ROS 2.
    rate
        How many times as fast as it was recorded; inf for as fast as possible.
    loop
        Start again at the end, until Ctrl-C.
    since
        Where to start: seconds from the beginning of the recording, a stamp in seconds, or a date.
    until
        Where to stop, in the same ways.
    """
    start, end = _log_times(file, topics, since, until)

    async def play_to_domain(bus: Bus) -> None:
        player = Player(bus, file, rate=rate, loop=loop, since=start, until=end, **topics.arguments())
        await _wait_for_peer(bus)
        say(f"playing {file} on {link.place}")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_show_progress, player)
            await player.play()
            tasks.cancel_scope.cancel()
        say(f"{player.played:,} samples played")
        rejected = player.bad + Counter(bus.statistics().rejected)
        if rejected:
            warn(f"left out: {format_counts(rejected)}")

    link.run(play_to_domain)


def _log_times(
    file: Path, topics: TopicOptions, since: Time | None, until: Time | None
) -> tuple[int | None, int | None]:
    """The log times, in ns, of the first and the last instant to play."""
    with topics.open(file) as recording:
        if not recording.finished:
            warn(f"{file} was not finished by its writer: this is what can be read")
        start, end = recording.start, recording.end
        for remark in recording.remarks:
            warn(remark)
    if start is None or end is None:
        return None, None
    first = None if since is None else since.stamp(start)
    last = None if until is None else until.stamp(start)
    if last is not None and last < (start if first is None else first):
        raise UsageError("--to must not be before --from, or before the beginning")
    if first is not None and first > end:
        raise UsageError(f"--from is behind the end: {file} is {to_seconds(end - start):.3f} s long")
    return first, last


async def _wait_for_peer(bus: Bus) -> None:
    """Give the link time to find other programs, which would otherwise miss the beginning."""
    with bus.events(stale_after=None) as events, bus.clock.move_on_after(_DISCOVERY):
        async for event in events:
            if isinstance(event, PeerJoined):
                return


async def _show_progress(player: Player) -> None:
    """Show a progress bar until cancelled, if standard error is a terminal."""
    if not sys.stderr.isatty():
        return
    from tfbus.cli._progress_bar import progress_bar

    with progress_bar() as bar:
        task = bar.add_task("playing", total=None)
        while True:
            if player.start is not None and player.end is not None and player.position is not None:
                total, done = to_seconds(player.end - player.start), to_seconds(player.position - player.start)
                bar.update(task, total=total, completed=done)
            await anyio.sleep(_REDRAW_PERIOD)
