"""The transforms in the recorded bags, read with PyPI's `rosbags` or, where that is missing, Debian's python3-rosbag.

The bags are no part of this repository: the environment variable ``RECORDINGS`` names the folder that has them.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from steps import SECOND

FOLDER = Path(os.environ.get("RECORDINGS", "/nowhere"))

Recorded = tuple[bool, str, str, int, list[float], list[float]]
"""Whether it is static, parent, child, stamp in ns, translation, rotation."""


def is_there(name: str) -> bool:
    """Whether a bag can be read here."""
    return (FOLDER / name).is_file()


def transforms_in(name: str) -> Iterator[Recorded]:
    """Every transform, in the order in which they were recorded."""
    for topic, message in _messages(FOLDER / name):
        for stamped in message.transforms:
            stamp = stamped.header.stamp
            place, turn = stamped.transform.translation, stamped.transform.rotation
            yield (
                topic == "tf_static",
                stamped.header.frame_id,
                stamped.child_frame_id,
                # Debian's messages have `nsecs` where those of PyPI have `nanosec`.
                (stamp.sec * SECOND + stamp.nanosec) if hasattr(stamp, "nanosec") else stamp.to_nsec(),
                [place.x, place.y, place.z],
                [turn.x, turn.y, turn.z, turn.w],
            )


def _messages(path: Path) -> Iterator[tuple[str, Any]]:
    """Topic without its slash, and message."""
    try:
        from rosbags.highlevel import AnyReader
    except ImportError:
        import rosbag  # type: ignore[import-not-found]

        with rosbag.Bag(str(path)) as debians:
            for topic, message, _ in debians.read_messages(("/tf", "/tf_static")):
                yield topic.strip("/"), message
        return
    with AnyReader([path]) as reader:
        connections = [link for link in reader.connections if link.topic in ("/tf", "/tf_static")]
        for link, _, raw in reader.messages(connections):
            yield link.topic.strip("/"), reader.deserialize(raw, link.msgtype)
