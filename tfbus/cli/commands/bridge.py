"""``tfbus bridge``."""

from dataclasses import replace
from typing import Annotated

from cyclopts import Parameter

from tfbus.cli.arguments import Backend, Flag, UsageError
from tfbus.cli.domain import LinkOptions, is_ros
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import say

with lazy_imports():
    import anyio

    from tfbus.bus.bus import Bus


def bridge(
    first: str,
    second: str,
    /,
    *,
    listen: tuple[str, ...] = (),
    connect: Annotated[tuple[str, ...], Parameter(env_var="TFBUS_CONNECT")] = (),
    odometry: tuple[str, ...] = (),
    invert: Flag = False,
    backend: Backend = "asyncio",
) -> None:
    """Pass on all frames between FIRST and SECOND, both ways, until Ctrl-C.

    Each of them is ROS or a domain of tfbus: dds, dds:42 for ROS 2 with ROS_DOMAIN_ID 42, zenoh:host:7447 for a router
    of rmw_zenoh, ws://host:9090 for a rosbridge server of ROS 1 or ROS 2, or the name of a domain; domain:dds is a
    domain of that name. Several bridges in a ring pass each sample on once.

    Without --listen and --connect, a domain is the one on this machine; with them, the one behind the router. To bridge
    these two, name the domain twice.

    Example: tfbus bridge tf dds

    Example: tfbus bridge tf tf --connect tcp/192.168.1.5:7447

    Parameters
    ----------
    first
        ROS, or the name of a domain.
    second
        Another place of ROS, or domain.
    listen
        Run a router in this program that listens at this address; may be given several times.
    connect
        Connect to the router at this address; may be given several times, for routers that are tried in turn.
    odometry
        Pass on the poses of this topic of nav_msgs/Odometry of ROS as transforms, too; may be given several times.
    invert
        Make the child of the odometry the parent, because it has a parent already.
    backend
        The event loop to run on.
    """
    if odometry and not (is_ros(first) or is_ros(second)):
        raise UsageError(f"--odometry is for ROS, and neither {first!r} nor {second!r} is there")
    of_ros = LinkOptions(odometry=odometry, invert=invert, backend=backend)
    one, other = (
        replace(of_ros, ros=(place,))
        if is_ros(place)
        else LinkOptions(place.removeprefix("domain:"), listen, connect, backend=backend)
        for place in (first, second)
    )
    names = one.place, other.place
    if one == other:
        if one.ros or not (listen or connect):
            raise UsageError(f"a bridge needs two places, not {first!r} twice")
        one = LinkOptions(one.domain, backend=backend)
        names = f"{one.place} {one.route}", f"the same {other.route}"
    elif one.listen and other.listen:
        # Its router is in this program already.
        one = replace(one, listen=(), connect=tuple(map(_reachable, listen)))

    async def pass_on(bus: Bus) -> None:
        async with one.join(bus):
            say(f"passing on between {' and '.join(names)}, until Ctrl-C")
            await anyio.sleep_forever()

    other.run(pass_on)


def _reachable(address: str) -> str:
    """The address at which this program reaches its own router."""
    return address.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
