"""``tfbus play``."""

import os
import signal
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Annotated, Any, Final

from cyclopts import Parameter

from tfbus.cli.arguments import Flag, Instant, Speed, Time, UsageError
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import format_counts, progress_bar, say, warn
from tfbus.cli.recordings import DEFAULT_TOPICS, TopicOptions
from tfbus.cli.statuses import ENDED_BY_SIGNAL

with lazy_imports():
    import anyio

    from tfbus.bus.bus import Bus
    from tfbus.clock import SimulatedClock
    from tfbus.events import PeerJoined
    from tfbus.recording.player import Player
    from tfbus.stamps import to_seconds

try:
    import termios
except ImportError:
    # On Windows.
    termios = None  # type: ignore[assignment]

_DISCOVERY = 1.0
"""The time in s in which other programs are found, if there are any."""
_REDRAW_PERIOD = 0.1
_RATES: Final = tuple(factor * 10.0**power for power in range(-2, 3) for factor in (1, 2, 5))
_KEYS = "space pauses, s or the right arrow plays the next message, + and - change the rate"
_ESCAPED: Final = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[C": "right", b"\x1b[D": "left"}
_LONGEST: Final = 64


def play(
    file: Path,
    /,
    *,
    rate: Speed = 1.0,
    loop: Flag = False,
    since: Annotated[Instant | None, Parameter(name="--from")] = None,
    until: Annotated[Instant | None, Parameter(name="--to")] = None,
    clock: Flag = False,
    offset: float = 0.0,
    topics: TopicOptions = DEFAULT_TOPICS,
    link: LinkOptions = DEFAULT_LINK,
) -> int:
    """Publish a recording on a domain with its original stamps and timing, static transforms first.

    On a terminal, the space bar pauses and goes on, s or the right arrow plays the next message, and + and -, or the
    arrows up and down, change the rate.

    Example: tfbus play run.mcap --clock --rate 2 --from 30 --to 60

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, a folder of ROS 2, or a trajectory of TUM, KITTI or EuRoC.
    rate
        How many times as fast as it was recorded; inf for as fast as possible.
    loop
        Start again at the end, until Ctrl-C.
    since
        The start: seconds from the beginning of the recording, a stamp in seconds, or a date.
    until
        The end, in the same ways.
    clock
        Publish the time of the recording as well; echo, tree and listen follow it, and count ages by it.
    offset
        Seconds that are added to each stamp of a moving frame.
    """
    start, end = _log_times(file, topics, since, until)

    async def play_to_domain(bus: Bus) -> int:
        # The status of a termination, which cancels the tasks before the player has ended.
        status = ENDED_BY_SIGNAL + signal.SIGTERM
        player = Player(bus, file, rate=rate, loop=loop, since=start, until=end, offset=offset, **topics.arguments())
        await _wait_for_peer(bus)
        say(f"playing {file} on {link.place}")
        began = time.monotonic()
        try:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(_show_progress, player)
                keys = keyboard()
                if keys is not None:
                    say(_KEYS)
                    tasks.start_soon(_steer, keys, player, tasks.cancel_scope)
                await player.play()
                status = 0
                tasks.cancel_scope.cancel()
        finally:
            _print_summary(player, bus, time.monotonic() - began)
        return status

    return link.run(play_to_domain, clock=SimulatedClock() if clock else None)


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


class Keyboard:
    """The keys that are pressed, for the body of a ``with``: ``async for key in keyboard.keys()``.

    A key is its letter, or ``"up"``, ``"down"``, ``"left"``, ``"right"``. Ctrl-C and Ctrl-Z work as usual.

    Parameters
    ----------
    terminal : int
        A file descriptor.
    """

    def __init__(self, terminal: int) -> None:
        self._terminal = terminal
        self._before: list[Any] | None = None

    def __enter__(self) -> "Keyboard":
        self.take()
        return self

    def __exit__(self, *_: object) -> None:
        self.give_back()

    def take(self) -> None:
        """Make the terminal pass on each key at once, without an echo; does nothing in the background."""
        with suppress(OSError, termios.error):
            # To change the terminal from the background would stop the program.
            if os.tcgetpgrp(self._terminal) != os.getpgrp():
                return
            found = termios.tcgetattr(self._terminal)
            if self._before is None:
                self._before = found
            flags = [*found]
            flags[3] &= ~(termios.ICANON | termios.ECHO)
            termios.tcsetattr(self._terminal, termios.TCSADRAIN, flags)

    def give_back(self) -> None:
        """Restore the settings of the terminal."""
        before, self._before = self._before, None
        if before is not None:
            with suppress(OSError, termios.error):
                termios.tcsetattr(self._terminal, termios.TCSADRAIN, before)

    async def keys(self) -> AsyncIterator[str]:
        """The keys, until the terminal is closed."""
        while True:
            await anyio.wait_readable(self._terminal)
            try:
                typed = os.read(self._terminal, _LONGEST)
            except OSError:
                return
            if not typed:
                return
            for key in _split(typed):
                yield key


def _split(typed: bytes) -> Iterator[str]:
    while typed:
        if typed[:3] in _ESCAPED:
            yield _ESCAPED[typed[:3]]
            typed = typed[3:]
        else:
            yield typed[:1].decode("latin-1")
            typed = typed[1:]


def keyboard() -> Keyboard | None:
    """The keyboard, if standard input is a terminal in whose foreground this program runs."""
    if termios is None or not sys.stdin or not sys.stdin.isatty():
        return None
    terminal = sys.stdin.fileno()
    with suppress(OSError):
        if os.tcgetpgrp(terminal) == os.getpgrp():
            return Keyboard(terminal)
    return None


def job_signals() -> AbstractContextManager[AsyncIterator[signal.Signals]]:
    """The signals that stop, continue and end a program."""
    return anyio.open_signal_receiver(signal.SIGTSTP, signal.SIGCONT, signal.SIGTERM)


async def _steer(keys: Keyboard, player: Player, everything: anyio.CancelScope) -> None:
    """Pause, step and change the rate by the keys; give the terminal back while stopped; end everything at SIGTERM."""

    async def read() -> None:
        async for key in keys.keys():
            press(player, key)
            if not sys.stderr.isatty():
                # There the bar shows it.
                say(_state(player))

    with job_signals() as signals, keys:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(read)
            async for number in signals:
                if number == signal.SIGTERM:
                    break
                if number == signal.SIGTSTP:
                    was_paused = player.paused
                    player.pause()
                    keys.give_back()
                    os.kill(os.getpid(), signal.SIGSTOP)
                    if not was_paused:
                        player.resume()
                # The shell may have changed the terminal meanwhile.
                keys.take()
            everything.cancel()


def press(player: Player, key: str) -> None:
    """Act on a key; unknown keys do nothing."""
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
            warn(f"{file} is cut, or its writer did not finish it: playing its readable part")
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
    with progress_bar() as bar:
        task = bar.add_task("playing", total=None)
        while True:
            if player.start is not None and player.end is not None and player.position is not None:
                total, done = to_seconds(player.end - player.start), to_seconds(player.position - player.start)
                bar.update(task, total=total, completed=done)
            bar.update(task, description=_state(player))
            await anyio.sleep(_REDRAW_PERIOD)
