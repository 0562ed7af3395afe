"""The channels of an MCAP file, one for each topic and authority.

A transform of ROS has no authority. So each authority has a channel of its own, and so has each sequence of authorities
within one message. The metadata of the channel hold them, under a key that other tools ignore.
"""

import json
from collections.abc import Callable, Sequence

from tfbus.recording.formats._storage import AUTHORITIES

MAX_CHANNELS = 1_000
MAX_SHARED_CHANNELS = 500
_MAX_RUNS = 32

Runs = Sequence[tuple[str, int]]
"""Pairs of an authority and the number of successive samples that it sent."""

TYPE_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
"""The type hash of ``tf2_msgs/msg/TFMessage`` in ROS 2 (REP 2016)."""


class Channels:
    """A bounded number of channels by topic and authorities, registered at their first use.

    Parameters
    ----------
    register : callable
        Adds a channel with a topic and metadata to the file, and returns its number.
    """

    def __init__(self, register: Callable[[str, dict[str, str]], int]) -> None:
        self._register_in_file = register
        self._known: dict[tuple[str, tuple[tuple[str, int], ...]], int] = {}

    def find(self, topic: str, runs: Runs) -> int | None:
        """The channel of a message; None if the limit of channels is reached."""
        # A single authority stands for a message of any length.
        key = tuple(runs) if len(runs) > 1 else ((runs[0][0], 1),)
        if not any(authority for authority, _ in key):
            key = ()
        known = self._known.get((topic, key))
        if known is None and self._has_room_for(key):
            known = self._register(topic, key)
        return known

    def anonymous(self, topic: str) -> int:
        """The channel of messages without an authority."""
        known = self._known.get((topic, ()))
        return self._register(topic, ()) if known is None else known

    def _has_room_for(self, key: tuple[tuple[str, int], ...]) -> bool:
        limit = MAX_CHANNELS if len(key) <= 1 else MAX_SHARED_CHANNELS
        return not key or (len(key) <= _MAX_RUNS and len(self._known) < limit)

    def _register(self, topic: str, key: tuple[tuple[str, int], ...]) -> int:
        metadata = {
            "offered_qos_profiles": _quality_of_service(static=topic == "/tf_static"),
            "topic_type_hash": TYPE_HASH,
        }
        if key:
            metadata[AUTHORITIES] = json.dumps(key)
        channel = self._register_in_file(topic, metadata)
        self._known[topic, key] = channel
        return channel


def _quality_of_service(static: bool) -> str:
    """The profile of tf2's broadcasters: reliable with a depth of 100, or latched for static transforms."""
    infinite = "{sec: 9223372036, nsec: 854775807}"
    keep_last, reliable, automatic = 1, 1, 1
    depth, durability = (1, 1) if static else (100, 2)
    return (
        f"- history: {keep_last}\n  depth: {depth}\n  reliability: {reliable}\n  durability: {durability}\n"
        f"  deadline: {infinite}\n  lifespan: {infinite}\n"
        f"  liveliness: {automatic}\n  liveliness_lease_duration: {infinite}\n"
        "  avoid_ros_namespace_conventions: false"
    )
