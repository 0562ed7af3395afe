"""``tfbus play``."""

import signal
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Final

import anyio
from cyclopts import Parameter

from tfbus.bus.bus import Bus
from tfbus.cli._keyboard import Keyboard, follow_job, job_signals, keyboard
from tfbus.cli.arguments import DEFAULT_TOPICS, Flag, Instant, Speed, Time, TopicOptions, UsageError
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.output import format_counts, say, warn
from tfbus.clock import SimulatedClock
from tfbus.events import PeerJoined
from tfbus.recording.player import Player
from tfbus.stamps import to_seconds

_DISCOVERY = 1.0
"""s; other programs are found within, or are not there."""
_REDRAW_PERIOD = 0.1
_RATES: Final = tuple(factor * 10.0**power for power in range(-2, 3) for factor in (1, 2, 5))
_ENDED_BY_SIGNAL = 128
_KEYS = "space pauses, s or the right arrow plays the next message, + and - change the rate"


def play(
    file: Path,
    /,
    *,
    rate: Speed = 1.0,
    loop: Flag = False,
    since: Annotated[Instant | None, Parameter(name="--from")] = None,
    until: Annotated[Instant | None, Parameter(name="--to")] = None,
    clock: Flag = False,
    topics: TopicOptions = DEFAULT_TOPICS,
    link: LinkOptions = DEFAULT_LINK,
) -> None:
    """Publish a recording on a domain with its original stamps and timing, static transforms first.

    On a terminal, the space bar pauses and goes on, s or the right arrow plays the next message, and + and -, or the
    arrows up and down, change the rate.

    Example: tfbus play run.mcap --clock --rate 2 --from 30 --to 60

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
    clock
        Tell the time of the recording as well: echo, tree and listen follow it, so their ages are ages of then.
    """
    start, end = _log_times(file, topics, since, until)
    ended_by: list[int] = []

    async def play_to_domain(bus: Bus) -> None:
        player = Player(bus, file, rate=rate, loop=loop, since=start, until=end, **topics.arguments())
        await _wait_for_peer(bus)
        say(f"playing {file} on {link.place}")
        began = time.monotonic()
        try:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(_show_progress, player)
                keys = keyboard()
                if keys is not None:
                    say(_KEYS)
                    tasks.start_soon(_steer, keys, player, tasks.cancel_scope, ended_by)
                await player.play()
                tasks.cancel_scope.cancel()
        finally:
            _print_summary(player, bus, time.monotonic() - began)

    link.run(play_to_domain, clock=SimulatedClock() if clock else None)
    if ended_by:
        sys.exit(_ENDED_BY_SIGNAL + ended_by[0])


def _print_summary(player: Player, bus: Bus, seconds: float) -> None:
    played = f"{player.played:,} samples in {player.messages:,} messages played in {seconds:.1f} s"
    if player.passes > 1:
        played += f", {player.passes} times to the end"
    elif player.position is not None and player.start is not None:
        played += f", {to_seconds(player.position - player.start):.1f} s of the recording"
    say(played)
    rejected = player.bad + Counter(bus.statistics().rejected)
    if rejected:
        warn(f"left out: {format_counts(rejected)}")


async def _steer(keys: Keyboard, player: Player, everything: anyio.CancelScope, ended_by: list[int]) -> None:
    """Pause, step and change the rate by the keys; end everything at SIGTERM."""
    was_paused = False

    def stopped() -> None:
        nonlocal was_paused
        was_paused = player.paused
        player.pause()

    def continued() -> None:
        if not was_paused:
            player.resume()

    async def read() -> None:
        async for key in keys.keys():
            press(player, key)
            if not sys.stderr.isatty():
                # There the bar shows it.
                say(_state(player))

    with job_signals() as signals, keys:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(read)
            await follow_job(keys, signals, stopped, continued)
            ended_by.append(signal.SIGTERM)
            everything.cancel()


def press(player: Player, key: str) -> None:
    """Do what a key says; other keys do nothing."""
    if key == " ":
        if player.paused:
            player.resume()
        else:
            player.pause()
    elif key in ("s", "right"):
        player.step()
    elif key in ("+", "=", "up", "-", "down"):
        quicker = key not in ("-", "down")
        others = [each for each in _RATES if (each > player.rate if quicker else each < player.rate)]
        if others:
            player.rate = others[0] if quicker else others[-1]


def _state(player: Player) -> str:
    return ("paused" if player.paused else "playing") + (f" at {player.rate:g} x" if player.rate != 1.0 else "")


def _log_times(
    file: Path, topics: TopicOptions, since: Time | None, until: Time | None
) -> tuple[int | None, int | None]:
    """The log times, in ns, of the first and the last instant to play."""
    with topics.open(file) as recording:
        if not recording.finished:
            warn(f"{file} is cut, or its writer did not finish it: this is what can be read")
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
    # Not on the clock of the bus, which may stand still.
    with bus.events(stale_after=None) as events, anyio.move_on_after(_DISCOVERY):
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
            bar.update(task, description=_state(player))
            await anyio.sleep(_REDRAW_PERIOD)
