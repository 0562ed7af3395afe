"""``tfbus echo``."""

import json
import math
from collections.abc import Callable, Iterable
from typing import Annotated

from cyclopts import Parameter

from tfbus.cli.arguments import Duration, Flag, JsonFlag, Rate, UsageError, is_number, usage_errors
from tfbus.cli.domain import DEFAULT_HEARING, HearingOptions, RemoteLookups
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import cells, print_now, say, terminal_width, wrapped

with lazy_imports():
    from tfbus.buffer.buffer import Buffer
    from tfbus.bus.bus import Bus
    from tfbus.cli.replay_clock import ReplayClock
    from tfbus.clock import Clock, SystemClock
    from tfbus.errors import MAY_COME, ClockResetError, TransformLookupError
    from tfbus.frames import check_frame
    from tfbus.geometry.stamped import TransformStamped
    from tfbus.stamps import format_age, format_seconds, likely_cause, to_seconds
    from tfbus.waiting.live_tree import blocking_frames

_Cause = tuple[type[BaseException], tuple[str, ...]]

_TIMEOUT = 1.0
"""In s: how late a transform may be before it is reported as missing."""


def echo(
    target: str,
    source: str,
    /,
    *further: Annotated[str, Parameter(show=False)],
    rate: Rate = 1.0,
    max_age: Duration = math.inf,
    as_json: JsonFlag = False,
    remote: Flag = False,
    link: HearingOptions = DEFAULT_HEARING,
) -> None:
    """Print the transform of SOURCE in TARGET again and again, until Ctrl-C.

    Each time it is the newest transform, even if it is static or has not changed. While there is none, standard error
    says what is missing.

    Example: tfbus echo map base_link --rate 10 --json

    Parameters
    ----------
    target
        The frame in which the transform is expressed.
    source
        The frame whose position and orientation are printed.
    rate
        Lookups per second.
    max_age
        Treat a transform that is older than this many seconds as missing.
    as_json
        Print one JSON object a line: target, source, stamp (ns), translation (x y z, m), rotation (x y z w), static,
        and age (s; null if static).
    remote
        Ask the buffer that a program of the robot in --robots offers to others, instead of receiving all transforms.
    """
    if further:
        habit = f"tf2_echo's rate is an option: type tfbus echo {target} {source} --rate {further[0]}"
        raise UsageError(habit if is_number(further[0]) else f"expected TARGET and SOURCE, not {further[0]!r} as well")
    with usage_errors():
        for frame in (target, source):
            check_frame(frame)

    def show(transform: TransformStamped, now: int | None) -> str:
        return to_json(transform, now) if as_json else describe(transform, now, terminal_width())

    async def print_transforms(bus: Bus) -> None:
        with Buffer(bus) as buffer:
            await link.first_transform(bus)
            await _print_from(buffer, bus.clock, target, source, rate, max_age, show)

    async def print_remote(buffer: RemoteLookups) -> None:
        await _print_from(buffer, SystemClock(), target, source, rate, max_age, show)

    if remote:
        link.run_remote(print_remote)
    else:
        link.run(print_transforms, clock=ReplayClock())


async def _print_from(
    buffer: RemoteLookups,
    clock: Clock,
    target: str,
    source: str,
    rate: float,
    max_age: float,
    show: Callable[[TransformStamped, int | None], str],
) -> None:
    reported: _Cause | None = None
    async for _ in clock.ticks(rate):
        try:
            transform = await buffer.lookup(target, source, timeout=_TIMEOUT, max_age=max_age)
        except TransformLookupError as error:
            missing = error.__cause__ or error
            cause = _cause(missing)
            if cause != reported:
                say(f"waiting for {source!r} in {target!r}: {missing}")
                reported = cause
        except ClockResetError:
            # A replay has begun, or has begun again.
            continue
        else:
            reported = None
            print_now(show(transform, _now_for(transform.stamp, clock)))


def _now_for(stamp: int, clock: Clock) -> int | None:
    """The time (ns) from which the age of a stamp is counted; None while a simulated time may still arrive."""
    now = clock.now()
    return None if isinstance(clock, ReplayClock) and not clock.is_set and likely_cause(stamp, now) else now


def to_json(sample: TransformStamped, now: int | None) -> str:
    """The sample as one line of JSON; its age is counted from `now`, in ns, if that is known."""
    return json.dumps(
        {
            "target": sample.parent,
            "source": sample.child,
            "stamp": sample.stamp,
            "translation": sample.transform.translation,
            "rotation": sample.transform.rotation,
            "static": sample.static,
            "age": None if sample.static or now is None else to_seconds(now - sample.stamp),
        }
    )


def describe(sample: TransformStamped, now: int | None, width: int | None = None) -> str:
    """The sample in the format of ``tf2_echo``, with both frames and the age at `now`, in ns; lines fit the width."""
    age = "age not known" if now is None else format_age(sample.stamp, now)
    when = "any time" if sample.static else f"{format_seconds(sample.stamp)} s, {age}"
    angles = sample.transform.as_rpy()
    facts = (
        (f"At {when}:", f"{sample.child!r} in {sample.parent!r}"),
        ("- Translation:", f"[{_join(sample.transform.translation)}] m"),
        ("- Rotation: in quaternion (xyzw)", f"[{_join(sample.transform.rotation)}]"),
        ("            in rpy (rad)         ", f"[{_join(angles)}]"),
        ("            in rpy (deg)         ", f"[{_join(map(math.degrees, angles))}]"),
    )
    return "\n".join(line for what, values in facts for line in _fitted(what, values, width))


def _fitted(what: str, values: str, width: int | None) -> list[str]:
    """A fact in one line, or with its values in a line of their own."""
    line = f"{what} {values}"
    if width is None or cells(line) <= width:
        return [line]
    return [what.rstrip(), *("  " + part for part in wrapped(values, width - 2, 0))]


def _join(numbers: Iterable[float]) -> str:
    return ", ".join(f"{number:z.6f}" for number in numbers)


def _cause(error: BaseException) -> _Cause:
    """The kind of an error and the frames that it is about; its message differs from one lookup to the next."""
    return type(error), blocking_frames(error) if isinstance(error, MAY_COME) else ()
