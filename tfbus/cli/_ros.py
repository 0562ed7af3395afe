"""The places at which a command finds ROS, and the links to them."""

import re
from contextlib import AbstractAsyncContextManager
from typing import Any

from tfbus.bus.bus import Bus
from tfbus.cli.arguments import UsageError

_DDS = re.compile(r"dds(?::(\d{1,3}))?")
_ZENOH = re.compile(r"zenoh:(.+:\d+)")
_WEBSOCKET = re.compile(r"wss?://.*")


def is_ros(place: str) -> bool:
    """Whether a place is one of ROS rather than a domain."""
    return any(kind.fullmatch(place) for kind in (_DDS, _ZENOH, _WEBSOCKET))


def ros_link(bus: Bus, place: str, **options: Any) -> AbstractAsyncContextManager[object]:
    """The link to a place: ``dds``, ``dds:42``, ``zenoh:host:7447`` or ``ws://host:9090``.

    Parameters
    ----------
    bus : Bus
    place : str
    **options
        Those that all links to ROS share.

    Raises
    ------
    UsageError
        If it is none of these, or an extra is missing.
    """
    try:
        if found := _DDS.fullmatch(place):
            from tfbus.links.dds import DdsLink

            return DdsLink(bus, None if found[1] is None else int(found[1]), **options)
        if found := _ZENOH.fullmatch(place):
            from tfbus.links.rmw_zenoh import RmwZenohLink

            return RmwZenohLink(bus, f"tcp/{found[1]}", **options)
        if _WEBSOCKET.fullmatch(place):
            from tfbus.links.rosbridge import RosbridgeLink

            return RosbridgeLink(bus, place, **options)
    except (ImportError, ValueError) as error:
        raise UsageError(str(error)) from None
    raise UsageError(
        f"{place!r} is no place of ROS: write dds, dds:42 for ROS_DOMAIN_ID 42, zenoh:host:7447, or ws://host:9090"
    )
