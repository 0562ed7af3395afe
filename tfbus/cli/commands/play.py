"""``tfbus play``."""

import sys
from collections import Counter
from pathlib import Path
from typing import Annotated

import anyio
from cyclopts import Parameter
from cyclopts.validators import Number

from tfbus.bus.bus import Bus
from tfbus.cli.commands.info import left_out
from tfbus.cli.domain import LOCAL, LinkOptions, UnusableError, say
from tfbus.cli.instants import Instant
from tfbus.events import PeerJoined
from tfbus.recording.player import Player
from tfbus.recording.recording import open_recording
from tfbus.stamps import to_seconds

_MEETING = 1.0
_REDRAWING = 0.1

PlayRate = Annotated[float, Parameter(validator=Number(gt=0))]


def play(
    file: Path,
    /,
    *,
    rate: PlayRate = 1.0,
    loop: Annotated[bool, Parameter(negative="")] = False,
    since: Annotated[Instant | None, Parameter(name="--from")] = None,
    until: Annotated[Instant | None, Parameter(name="--to")] = None,
    link: LinkOptions = LOCAL,
) -> None:
    """Publish what is in a recording on a domain, with the stamps and at the pace of then, and what was static first.

    Example: tfbus play run.mcap --rate 2 --from 30 --to 60

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, or a folder of ROS 2.
    rate
        How many times as fast as it was recorded; inf for as fast as can be.
    loop
        Begin again at the end, until Ctrl-C.
    since
        Where to begin, in seconds from the beginning of the recording.
    until
        Where to end, in seconds from the beginning of the recording.
    """
    start, end = _range(file, since, until)

    async def play_to_domain(bus: Bus) -> None:
        player = Player(bus, file, rate=rate, loop=loop, since=start, until=end)
        # Who is there needs a moment to be found, and would else miss the beginning.
        with bus.events(stale_after=None) as events, anyio.move_on_after(_MEETING):
            async for event in events:
                if isinstance(event, PeerJoined):
                    break
        say(f"playing {file} on domain {link.domain!r}")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_show, player)
            await player.play()
            tasks.cancel_scope.cancel()
        say(f"{player.played:,} samples played")
        if wrong := player.bad + Counter(bus.statistics().rejected):
            say(f"tfbus: left out: {left_out(wrong)}")

    link.run(play_to_domain)


def _range(file: Path, since: int | None, until: int | None) -> tuple[int | None, int | None]:
    """The log times that the offsets are."""
    if since is not None and since < 0:
        raise UnusableError("--from must not be negative")
    if until is not None and until < (since or 0):
        raise UnusableError("--to must not be before --from")
    with open_recording(file) as recording:
        if not recording.finished:
            say(f"tfbus: {file} was not finished by its writer: this is what can be read")
        start, end = recording.start, recording.end
    if start is None or end is None:
        return None, None
    if since is not None and start + since > end:
        raise UnusableError(f"--from is behind the end: {file} is {to_seconds(end - start):.3f} s long")
    return (None if since is None else start + since), (None if until is None else start + until)


async def _show(player: Player) -> None:
    """A bar on standard error, if that is a terminal; until it is cancelled."""
    if not sys.stderr.isatty():
        return
    from rich.console import Console
    from rich.progress import Progress

    bar = Progress(console=Console(stderr=True), transient=True, redirect_stdout=False, redirect_stderr=False)
    with bar:
        task = bar.add_task("playing", total=None)
        while True:
            if player.start is not None and player.end is not None and player.position is not None:
                total, done = to_seconds(player.end - player.start), to_seconds(player.position - player.start)
                bar.update(task, total=total, completed=done)
            await anyio.sleep(_REDRAWING)
