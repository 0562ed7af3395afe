"""``tfbus echo``."""

import json
import math
from collections.abc import Iterable
from typing import Annotated

from cyclopts import Parameter

from tfbus.buffer.buffer import Buffer
from tfbus.bus.bus import Bus
from tfbus.cli.domain import LOCAL, LinkOptions, UnusableError, say
from tfbus.cli.instants import seconds
from tfbus.cli.options import Duration, Rate
from tfbus.errors import MAY_COME, InvalidTransformError, TransformLookupError
from tfbus.frames import check_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.stamps import format_duration, to_seconds
from tfbus.waiting.waiting_index import blocking_frames

_SOON = 1.0


def echo(
    target: str,
    source: str,
    /,
    *,
    rate: Rate = 1.0,
    max_age: Duration = math.inf,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
    link: LinkOptions = LOCAL,
) -> None:
    """Print where SOURCE is, seen from TARGET, again and again, until Ctrl-C.

    It is the newest transform that can be told, also when nothing new has come, and where all is static. While there
    is none, standard error says what is missing.

    Example: tfbus echo map base_link --rate 10 --json

    Parameters
    ----------
    target
        The frame that the numbers are told in.
    source
        The frame that is looked for.
    rate
        How often, in Hz.
    max_age
        Count a transform that is older than this many seconds as missing.
    as_json
        Print one JSON object a line: target, source, stamp (ns), translation (x y z, m), rotation (x y z w), static,
        and age (s; null where all is static).
    """
    try:
        for name in (target, source):
            check_frame(name)
    except InvalidTransformError as error:
        raise UnusableError(str(error)) from None

    async def print_transforms(bus: Bus) -> None:
        told: object = None
        with Buffer(bus) as buffer:
            await link.first_transform(bus)
            async for _ in bus.clock.ticks(rate):
                try:
                    # What has just begun to come is given a moment before anything is called missing.
                    found = await buffer.lookup(target, source, timeout=_SOON, max_age=max_age)
                except TransformLookupError as error:
                    missing = error.__cause__ or error
                    key = type(missing), blocking_frames(missing) if isinstance(missing, MAY_COME) else None
                    if key != told:
                        say(f"waiting for {source!r} in {target!r}: {missing}")
                        told = key
                else:
                    told = None
                    print((to_json if as_json else describe)(found, bus.clock.now()), flush=True)

    link.run(print_transforms)


def to_json(found: TransformStamped, now: int) -> str:
    """An answer as one line of JSON."""
    return json.dumps(
        {
            "target": found.parent,
            "source": found.child,
            "stamp": found.stamp,
            "translation": found.transform.translation,
            "rotation": found.transform.rotation,
            "static": found.static,
            "age": None if found.static else to_seconds(now - found.stamp),
        }
    )


def describe(found: TransformStamped, now: int) -> str:
    """An answer much as ``tf2_echo`` prints it, with the two frames and the age."""
    when = "any time" if found.static else f"{seconds(found.stamp)} s, age {format_duration(now - found.stamp)}"
    angles = found.transform.as_rpy()
    return "\n".join(
        (
            f"At {when}: {found.child!r} in {found.parent!r}",
            f"- Translation: [{_join(found.transform.translation)}] m",
            f"- Rotation: in quaternion (xyzw) [{_join(found.transform.rotation)}]",
            f"            in rpy (rad)          [{_join(angles)}]",
            f"            in rpy (deg)          [{_join(map(math.degrees, angles))}]",
        )
    )


def _join(numbers: Iterable[float]) -> str:
    # There is no -0.000000.
    return ", ".join(f"{round(number, 6) + 0.0:.6f}" for number in numbers)
