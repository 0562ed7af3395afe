"""``tfbus bridge``."""

from typing import Annotated

import anyio
from cyclopts import Parameter

from tfbus.bus.bus import Bus
from tfbus.cli.arguments import Backend, UsageError
from tfbus.cli.domain import LinkOptions, is_ros
from tfbus.cli.output import say


def bridge(
    first: str,
    second: str,
    /,
    *,
    listen: tuple[str, ...] = (),
    connect: Annotated[tuple[str, ...], Parameter(env_var="TFBUS_CONNECT")] = (),
    backend: Backend = "asyncio",
) -> None:
    """Pass on all frames between FIRST and SECOND, both ways, until Ctrl-C.

    Each of them is ROS or a domain of tfbus: dds, dds:42 for ROS 2 with ROS_DOMAIN_ID 42, zenoh:host:7447 for a router
    of rmw_zenoh, ws://host:9090 for a rosbridge server of ROS 1 or ROS 2, or the name of a domain; domain:dds is a
    domain of that name. Several bridges in a ring pass each sample on once.

    Example: tfbus bridge tf dds

    Parameters
    ----------
    first
    second
    listen
        Listen at this address for programs of a domain; may be given several times.
    connect
        Connect to a program or a router of a domain that listens at this address; may be given several times.
    backend
        The event loop to run on.
    """
    if first == second:
        raise UsageError(f"a bridge needs two places, not {first!r} twice")
    ends = [_options(place, listen, connect, backend) for place in (first, second)]

    async def pass_on(bus: Bus) -> None:
        async with ends[1].join(bus):
            say(f"passing on between {ends[0].place} and {ends[1].place}, until Ctrl-C")
            await anyio.sleep_forever()

    ends[0].run(pass_on)


def _options(place: str, listen: tuple[str, ...], connect: tuple[str, ...], backend: Backend) -> LinkOptions:
    if is_ros(place):
        return LinkOptions(ros=(place,), backend=backend)
    return LinkOptions(place.removeprefix("domain:"), listen, connect, backend=backend)
