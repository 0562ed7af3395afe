"""``tfbus monitor``."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Any

from tfbus.cli.arguments import Duration, Flag, JsonFlag, Positive, Rate, UsageError
from tfbus.cli.domain import DEFAULT_HEARING, HearingOptions
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import Column, format_span, print_now, table_lines, terminal_width, wrapped

with lazy_imports():
    import numpy as np
    from rich.text import Text

    from tfbus.analysis.arrivals import Arrival, Arrivals, sender_delays
    from tfbus.buffer.buffer import Buffer
    from tfbus.bus.bus import Bus
    from tfbus.cli.tree_display import TreeDisplay
    from tfbus.errors import TransformLookupError
    from tfbus.geometry.covariance import Covariance
    from tfbus.links.link import Link
    from tfbus.stamps import from_seconds
    from tfbus.statistics import PeerClock
    from tfbus.tree.tree import TransformTree

_CLOCK_COLUMNS = (
    Column("peer"),
    Column("senders", importance=1),
    Column("clock ahead by", right=True),
    Column("within", right=True, importance=4),
    Column("drift", right=True, importance=3),
    Column("round trip", right=True, importance=2),
)
_DELAY_COLUMNS = Column("sender"), Column("least delay", right=True), Column("its clock")
# The least important column has the lowest number.
_COLUMNS = (
    Column("frame"),
    Column("sender", importance=1),
    Column("rate", right=True),
    Column("2 sigma", right=True, importance=10),
    Column("delay least", right=True, importance=2),
    Column("mean", right=True, importance=9),
    Column("p99", right=True, importance=7),
    Column("max", right=True, importance=8),
    Column("jitter", right=True, importance=3),
    Column("longest gap", right=True, importance=6),
    Column("late", right=True, importance=4),
    Column("lost", right=True, importance=5),
)


@dataclass(frozen=True, slots=True)
class Chain:
    """The path between two frames.

    Attributes
    ----------
    frames : list of str
        From target to source; empty if they are not connected.
    slowest : str or None
        The moving frame with the lowest rate on it.
    age : float or None
        The time since the newest stamp that all moving frames on it have data for, in s.
    problem : str
        The reason why there is no transform.
    """

    frames: list[str]
    slowest: str | None
    age: float | None
    problem: str


def monitor(
    target: str | None = None,
    source: str | None = None,
    /,
    *,
    window: Positive = 10.0,
    rate: Rate = 1.0,
    once: Flag = False,
    duration: Duration = 3.0,
    as_json: JsonFlag = False,
    link: HearingOptions = DEFAULT_HEARING,
) -> None:
    """Measure the rate, the delay, the jitter and the losses of each frame and sender of a domain, until Ctrl-C.

    A delay is the time from the stamp of a sample to its arrival here; jitter is the standard deviation of the time
    between two arrivals. A late sample has an older stamp than an earlier sample. Lost samples are counted by the gaps
    between stamps, if the sender has a fixed rate. With TARGET and SOURCE, only the frames between the two are shown,
    and the slowest of them. Where samples have a covariance, "2 sigma" is twice the standard deviation of the newest
    position and rotation, each in its least sure direction. A table of peers follows: how far the clock of each is
    ahead of this one, the bound of that, its drift, and the round trip; and for senders without a measured clock, what
    their smallest delays tell.

    Example: tfbus monitor map base_link

    Parameters
    ----------
    target
        The frame in which the transform of a pair is expressed.
    source
        The frame whose transform it is.
    window
        How far back the measurements reach, in s.
    rate
        Updates per second.
    once
        Print once and end.
    duration
        With --once, how many seconds to listen first, from the first transform on.
    as_json
        Print a JSON object instead, one a line unless --once is given; durations in s, and sigmas as standard
        deviations along x, y, z in m and about x, y, z in rad.
    """
    pair = None
    if target is not None:
        if source is None:
            raise UsageError(f"a pair is TARGET and SOURCE, and {target!r} has no SOURCE")
        pair = (target, source)

    links: list[Link] = []

    async def measure(bus: Bus) -> None:
        arrivals = Arrivals(window)
        with (
            Buffer(bus) as buffer,
            bus.subscribe(lambda batch: arrivals.note(batch, bus.clock.now()), arrivals.forget),
            TreeDisplay(live=not once and not as_json) as display,
        ):

            def show() -> None:
                now = bus.clock.now()
                found = arrivals.measure(now)
                chain = None if pair is None else chain_of(buffer.tree, *pair, found, now)
                if chain is not None and chain.frames:
                    found = [arrival for arrival in found if arrival.frame in chain.frames]
                errors = errors_of(buffer.tree, found)
                clocks = [clock for each in links for clock in each.statistics().clocks]
                if as_json:
                    document = to_document(found, chain, window, clocks, errors)
                    print_now(json.dumps(document, indent=2 if once else None))
                else:
                    lines = text_lines(found, chain, terminal_width(), clocks, errors)
                    display.show_lines([Text(line) for line in lines])

            await link.first_transform(bus)
            if once:
                await bus.clock.sleep(duration)
                show()
                return
            async for _ in bus.clock.ticks(rate):
                show()

    link.run(measure, links=links)


def chain_of(tree: TransformTree, target: str, source: str, arrivals: Sequence[Arrival], now: int) -> Chain:
    """The path between two frames, with the measurements of its frames up to `now`, in ns."""
    try:
        frames = tree.chain(target, source)
        newest = tree.latest_common_stamp(target, source)
    except TransformLookupError as error:
        return Chain([], None, None, str(error))
    # The edge of the top frame is above the path.
    crossed = {child for pair in pairwise(frames) for child in pair if tree.parent(child) in pair}
    moving = [each for each in arrivals if each.frame in crossed and each.rate is not None]
    slowest = min(moving, key=lambda each: each.rate or 0.0).frame if moving else None
    return Chain(frames, slowest, None if newest is None else (now - newest) / from_seconds(1), "")


def errors_of(tree: TransformTree, arrivals: Sequence[Arrival]) -> dict[str, Covariance]:
    """The covariance of the newest sample of each frame that has one."""
    errors = {}
    for arrival in arrivals:
        with suppress(TransformLookupError):
            found = tree.lookup(arrival.parent, arrival.frame, covariance=True)
            if not found.exact:
                errors[arrival.frame] = found.covariance
    return errors


def to_document(
    arrivals: Sequence[Arrival],
    chain: Chain | None,
    window: float,
    clocks: Sequence[PeerClock],
    errors: Mapping[str, Covariance],
) -> dict[str, Any]:
    """The JSON object of one update."""
    pair = {} if chain is None else {"chain": asdict(chain)}
    sigmas = {frame: {"sigmas": error.sigmas.tolist()} for frame, error in errors.items()}
    frames = [asdict(arrival) | sigmas.get(arrival.frame, {}) for arrival in arrivals]
    senders = [asdict(one) for one in sender_delays(arrivals)]
    return {"window": window, "frames": frames, **pair, "clocks": [asdict(one) for one in clocks], "senders": senders}


def text_lines(
    arrivals: Sequence[Arrival],
    chain: Chain | None,
    width: int | None,
    clocks: Sequence[PeerClock] = (),
    errors: Mapping[str, Covariance] = MappingProxyType({}),
) -> Iterator[str]:
    """The lines of one update, which fit the width."""
    if chain is not None:
        yield from wrapped(_describe(chain), width, 2)
        yield ""
    if not arrivals:
        yield "(no frames)"
        return
    yield from table_lines(_COLUMNS, [_row(arrival, errors.get(arrival.frame)) for arrival in arrivals], width)
    if any(clock.offset is not None for clock in clocks):
        yield ""
        yield from table_lines(_CLOCK_COLUMNS, [_clock_row(clock) for clock in clocks], width)
    measured = {authority for clock in clocks if clock.offset is not None for authority in clock.authorities}
    delays = [one for one in sender_delays(arrivals) if one.remark and one.authority not in measured]
    if delays:
        yield ""
        rows = [(one.authority, format_span(one.delay), one.remark) for one in delays]
        yield from table_lines(_DELAY_COLUMNS, rows, width)


def _describe(chain: Chain) -> str:
    if not chain.frames:
        return f"no transform: {chain.problem}"
    path = " <- ".join(chain.frames)
    age = "static" if chain.age is None else f"age {format_span(chain.age)}"
    slowest = f", the slowest is {chain.slowest}" if chain.slowest else ""
    return f"{path}: {age}{slowest}"


def _clock_row(clock: PeerClock) -> tuple[str, ...]:
    unknown = "not yet measured" if clock.runs else "simulated"
    return (
        clock.peer[:8],
        ", ".join(clock.authorities),
        unknown if clock.offset is None else format_span(clock.offset),
        format_span(clock.bound),
        "" if clock.drift is None else f"{clock.drift * 1e6:.1f} us/s",
        format_span(clock.delay),
    )


def _size(error: Covariance) -> str:
    """Two standard deviations of the position and of the rotation, each in its least sure direction."""
    halves = error.matrix[:3, :3], error.matrix[3:, 3:]
    place, turn = (2.0 * math.sqrt(max(np.linalg.eigvalsh(half)[-1], 0.0)) for half in halves)
    length = f"{place * 1e3:.3g} mm" if place < 0.9995 else f"{place:.3g} m"
    return f"{length}, {math.degrees(turn):.2g} deg"


def _row(arrival: Arrival, error: Covariance | None) -> tuple[str, ...]:
    rate = "" if arrival.rate is None else f"{arrival.rate:.1f} Hz"
    state = "static" if arrival.static else "silent" if not arrival.samples else rate or "one sample"
    counted = not arrival.static
    return (
        arrival.frame,
        arrival.authority,
        state,
        "" if error is None else _size(error),
        format_span(arrival.delay_min),
        format_span(arrival.delay_mean),
        format_span(arrival.delay_p99),
        format_span(arrival.delay_max),
        format_span(arrival.jitter),
        format_span(arrival.longest_gap),
        f"{arrival.late:,}" if counted else "",
        f"{arrival.lost:,}" if counted else "",
    )
