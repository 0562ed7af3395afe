"""What the formats of recordings have in common: channels of stored messages, in the order of their log times."""

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
"""Where a channel of our own recordings tells who sent: runs of an authority and a count, as JSON.

They describe the transforms of every message on the channel, in order: ``[["odometry", 1]]``.
"""

_MOST_TRANSFORMS: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class Channel:
    """Where messages of transforms come from.

    Parameters
    ----------
    static : bool
        Whether all of its transforms hold at every stamp.
    authorities : tuple of str
        Who sent each transform of a message; a single one sent all of them, however many there are.
    ros1 : bool
        Whether its messages are in the encoding of ROS 1, not in CDR.
    """

    static: bool
    authorities: tuple[str, ...] = ("",)
    ros1: bool = False
    _tags: tuple[Tag, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tags", tuple((authority, self.static) for authority in self.authorities))

    def tags(self, count: int) -> "tuple[Tag, ...] | repeat[Tag]":
        """Authority and static flag of each of some transforms; without an authority if it is not known which."""
        if len(self._tags) == count:
            return self._tags
        return repeat(self._tags[0] if len(self._tags) == 1 else ("", self.static), count)


Stored = tuple[int, Channel | MalformedMessageError, bytes]
"""Log time in ns, channel and payload of a message; instead of the channel, an error that says what is lost there."""


def lost(received: int, what: str) -> Stored:
    """What a storage gives in the place of what it cannot read."""
    return received, MalformedMessageError("damaged", what), b""


class Storage(Protocol):
    """A file, or several, with messages on channels.

    Attributes
    ----------
    finished : bool
        Whether its writer came to an end; what it wrote last may be missing if not.
    start, end : int or None
        The log times of the first and the last message on any channel, in ns; None if there is none.
    count : int or None
        How many messages of transforms there are; None if only reading all of it would tell.
    """

    @property
    def finished(self) -> bool: ...

    @property
    def start(self) -> int | None: ...

    @property
    def end(self) -> int | None: ...

    @property
    def count(self) -> int | None: ...

    def messages(self, since: int | None, until: int | None, only_static: bool = False) -> Iterator[Stored]:
        """The messages of transforms from one log time to another, both included, in their order."""
        ...

    def close(self) -> None:
        """Give back what it holds."""
        ...


def channel_of(topic: str, kind: str, metadata: dict[str, str], ros1: bool = False) -> Channel | None:
    """The channel of a topic, if transforms are sent there: with a leading slash or without, in no namespace."""
    name = topic.removeprefix("/")
    if name not in (MOVING_TOPIC, STATIC_TOPIC) or kind not in TYPES:
        return None
    sender = metadata.get("callerid", "").removeprefix("/")
    authorities = _authorities(metadata[AUTHORITIES]) if AUTHORITIES in metadata else (sender,)
    return Channel(name == STATIC_TOPIC, authorities, ros1)


def _authorities(text: str) -> tuple[str, ...]:
    """What our own metadata tell; nobody, if somebody else wrote them."""
    try:
        runs = [(str(authority), int(count)) for authority, count in json.loads(text)]
    except (ValueError, TypeError, RecursionError):
        return ("",)
    if not 0 < sum(count for _, count in runs) <= _MOST_TRANSFORMS or any(count < 0 for _, count in runs):
        return ("",)
    return tuple(authority for authority, count in runs for _ in range(count))
