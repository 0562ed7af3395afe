"""`Storage`, the interface of all formats: channels, and messages in the order of their log times."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import repeat
from typing import Final, Protocol

from tfbus.tf_message import MalformedMessageError, Tag

MOVING_TOPIC: Final = "tf"
STATIC_TOPIC: Final = "tf_static"
TYPES: Final = ("tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage", "tf/msg/tfMessage", "tf/tfMessage")
AUTHORITIES: Final = "tfbus.authorities"
"""The key in a channel's metadata for the authorities: JSON pairs of an authority and a count.

They describe the transforms of every message on the channel, in order: ``[["odometry", 1]]``.
"""

_MAX_TRANSFORMS: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel of messages with transforms.

    Parameters
    ----------
    static : bool
        Whether its transforms are static.
    authorities : tuple of str
        The authority of each transform of a message; a single one stands for all transforms.
    ros1 : bool
        Whether its messages are encoded as in ROS 1, not in CDR.
    """

    static: bool
    authorities: tuple[str, ...] = ("",)
    ros1: bool = False
    _tags: tuple[Tag, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tags", tuple((authority, self.static) for authority in self.authorities))

    def tags(self, count: int) -> "tuple[Tag, ...] | repeat[Tag]":
        """Authority and static flag of each of `count` transforms; no authority if their number does not fit."""
        if len(self._tags) == count:
            return self._tags
        return repeat(self._tags[0] if len(self._tags) == 1 else ("", self.static), count)


StoredMessage = tuple[int, Channel | MalformedMessageError, bytes]
"""Log time in ns, channel and payload of a message; an error in place of the channel says what was lost there."""


def lost_message(received: int, detail: str) -> StoredMessage:
    """A message in place of those that cannot be read."""
    return received, MalformedMessageError("damaged", detail), b""


class Storage(Protocol):
    """An open file, or several, with messages on channels.

    Attributes
    ----------
    finished : bool
        Whether the writer finished the file; if not, the last messages may be missing.
    start, end : int or None
        The log times of the first and the last message on any channel, in ns; None if there is none.
    count : int or None
        The number of messages with transforms; None if only reading the whole file would tell.
    """

    @property
    def finished(self) -> bool: ...

    @property
    def start(self) -> int | None: ...

    @property
    def end(self) -> int | None: ...

    @property
    def count(self) -> int | None: ...

    def messages(self, since: int | None, until: int | None, only_static: bool = False) -> Iterator[StoredMessage]:
        """Iterate over the messages with transforms from one log time to another, inclusive, in their order."""
        ...

    def close(self) -> None:
        """Release files and memory."""
        ...


def channel_of(topic: str, kind: str, metadata: dict[str, str], ros1: bool = False) -> Channel | None:
    """The channel of a topic; None unless it is ``tf`` or ``tf_static``, with or without a slash, and its type fits."""
    name = topic.removeprefix("/")
    if name not in (MOVING_TOPIC, STATIC_TOPIC) or kind not in TYPES:
        return None
    sender = metadata.get("callerid", "").removeprefix("/")
    authorities = _authorities(metadata[AUTHORITIES]) if AUTHORITIES in metadata else (sender,)
    return Channel(name == STATIC_TOPIC, authorities, ros1)


def _authorities(text: str) -> tuple[str, ...]:
    """Decode the authorities in metadata; the empty authority if another program wrote something else there."""
    try:
        runs = [(str(authority), int(count)) for authority, count in json.loads(text)]
    except (ValueError, TypeError, RecursionError):
        return ("",)
    if not 0 < sum(count for _, count in runs) <= _MAX_TRANSFORMS or any(count < 0 for _, count in runs):
        return ("",)
    return tuple(authority for authority, count in runs for _ in range(count))
