"""``tfbus echo``."""

import json
import math
from collections.abc import Iterable

from tfbus.buffer.buffer import Buffer
from tfbus.bus.bus import Bus
from tfbus.cli._replay_clock import ReplayClock
from tfbus.cli.arguments import Duration, JsonFlag, Rate, UsageError
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.output import format_seconds, print_now, say
from tfbus.errors import MAY_COME, ClockResetError, InvalidTransformError, TransformLookupError
from tfbus.frames import check_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.stamps import format_duration, to_seconds
from tfbus.waiting.waiting_index import blocking_frames

_Cause = tuple[type[BaseException], tuple[str, ...]]

_TIMEOUT = 1.0
"""s; a transform that is only late is not reported as missing."""


def echo(
    target: str,
    source: str,
    /,
    *,
    rate: Rate = 1.0,
    max_age: Duration = math.inf,
    as_json: JsonFlag = False,
    link: LinkOptions = DEFAULT_LINK,
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
    """
    try:
        for frame in (target, source):
            check_frame(frame)
    except InvalidTransformError as error:
        raise UsageError(str(error)) from None

    async def print_transforms(bus: Bus) -> None:
        with Buffer(bus) as buffer:
            await link.first_transform(bus)
            reported: _Cause | None = None
            async for _ in bus.clock.ticks(rate):
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
                    print_now((to_json if as_json else describe)(transform, bus.clock.now()))

    link.run(print_transforms, clock=ReplayClock())


def to_json(sample: TransformStamped, now: int) -> str:
    """The sample as one line of JSON; its age is counted from `now`, in ns."""
    return json.dumps(
        {
            "target": sample.parent,
            "source": sample.child,
            "stamp": sample.stamp,
            "translation": sample.transform.translation,
            "rotation": sample.transform.rotation,
            "static": sample.static,
            "age": None if sample.static else to_seconds(now - sample.stamp),
        }
    )


def describe(sample: TransformStamped, now: int) -> str:
    """The sample in the format of ``tf2_echo``, with both frames and the age at `now`, in ns."""
    when = (
        "any time" if sample.static else f"{format_seconds(sample.stamp)} s, age {format_duration(now - sample.stamp)}"
    )
    angles = sample.transform.as_rpy()
    return "\n".join(
        (
            f"At {when}: {sample.child!r} in {sample.parent!r}",
            f"- Translation: [{_join(sample.transform.translation)}] m",
            f"- Rotation: in quaternion (xyzw) [{_join(sample.transform.rotation)}]",
            f"            in rpy (rad)          [{_join(angles)}]",
            f"            in rpy (deg)          [{_join(map(math.degrees, angles))}]",
        )
    )


def _join(numbers: Iterable[float]) -> str:
    return ", ".join(f"{number:z.6f}" for number in numbers)


def _cause(error: BaseException) -> _Cause:
    """The kind of an error and the frames that it is about; its message differs from one lookup to the next."""
    return type(error), blocking_frames(error) if isinstance(error, MAY_COME) else ()
