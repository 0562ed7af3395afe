"""`Storage`, the interface of all formats: channels, and messages in the order of their log times."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Protocol

from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tf_message import MalformedMessageError

AUTHORITIES = "tfbus.authorities"
"""The key in a channel's metadata for the authorities: JSON pairs of an authority and a count.

They describe the transforms of every message on the channel, in order: ``[["odometry", 1]]``.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """A stream of messages of one topic and type. Channels are equal only to themselves.

    Parameters
    ----------
    topic, type : str
    encoding : str
        Of the messages: ``"cdr"``, ``"ros1"``, ``"json"``, ``"protobuf"``.
    schema_encoding : str
        Of the definition: ``"ros2msg"``, ``"ros1msg"``, ``"jsonschema"``, ``"protobuf"``; empty without a definition.
    schema : bytes
        The definition of the type; empty if the file has none.
    metadata : mapping of str to str
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = field(default=b"", repr=False)
    metadata: Mapping[str, str] = field(default_factory=dict, repr=False)


StoredMessage = tuple[int, Channel | MalformedMessageError, bytes]
"""Log time in ns, channel and payload of a message; an error in place of the channel says what was lost there."""
Wanted = Callable[[Channel], bool]
"""Whether the messages of a channel are read."""


def lost_message(received: int, detail: str) -> StoredMessage:
    """A message in place of those that cannot be read."""
    return received, MalformedMessageError("damaged", detail), b""


FINISHED_ONCE = "it was finished once and is cut or damaged: its index is missing"
NEVER_FINISHED = "it is cut, or its writer did not finish it: its index is missing"


def unfinished(received: int, read: Counter[Channel], why: str) -> StoredMessage:
    """The report of a file without the end that its writer gives it.

    Parameters
    ----------
    received : int
        The log time of the report, in ns.
    read : Counter of Channel
        The number of messages that were read of each channel.
    why : str
        What shows it.
    """
    count = sum(number for channel, number in read.items() if isinstance(channel, Channel))
    return received, MalformedMessageError("unfinished", f"{count:,} messages were read of the file; {why}"), b""


def in_words(error: Exception) -> str:
    """The fault that an error of a parser tells: what Python and others word for programmers is told in other words."""
    if isinstance(error, UnicodeDecodeError):
        return "a text in it is no text"
    # `struct.error`, `KeyError` and the like have no words for people.
    return str(error) if isinstance(error, ValueError) else "it ends inside of a record, or a record is damaged"


_log_time = itemgetter(0)
_channel = itemgetter(1)


def select(
    blocks: Iterable[list[StoredMessage]], since: int | None, until: int | None, read: Counter[Channel]
) -> Iterator[StoredMessage]:
    """Iterate over the messages from one log time to another, inclusive, and count them by channel.

    A message whose log time is no stamp becomes a lost one.
    """
    low = STAMP_MIN if since is None else since
    high = STAMP_MAX if until is None else until
    now = 0 if since is None else since
    for block in filter(None, blocks):
        times = list(map(_log_time, block))
        if max(times) > STAMP_MAX:
            for at, time in enumerate(times):
                if time > STAMP_MAX:
                    block[at] = lost_message(now, f"a message has the log time {time} ns")
                now = max(now, block[at][0])
        if min(times) < low or max(times) > high:
            block = [stored for stored in block if low <= stored[0] <= high]
            if not block:
                continue
        now = max(now, block[-1][0])
        # Lost ones are counted as well, and not asked for.
        read.update(map(_channel, block))
        yield from block


def shortfalls(received: int, promised: Mapping[Channel, int], read: Counter[Channel]) -> Iterator[StoredMessage]:
    """A lost message for each topic with fewer or more messages than the file promises.

    Parameters
    ----------
    received : int
        The log time of the reports, in ns.
    promised : mapping of Channel to int
        The number of messages of each channel, as an index or the metadata have it.
    read : Counter of Channel
    """
    # By topic, because a damaged number may turn a message into one of another channel.
    expected: Counter[str] = Counter()
    found: Counter[str] = Counter()
    for channel, count in promised.items():
        expected[channel.topic] += count
        found[channel.topic] += read[channel]
    for topic, count in expected.items():
        if found[topic] != count:
            detail = f"the file promises {count:,} messages on {topic!r}, and {found[topic]:,} were found"
            yield lost_message(received, detail)


class Storage(Protocol):
    """An open file, or several, with messages on channels.

    Attributes
    ----------
    finished : bool
        Whether the writer finished the file; if not, the last messages may be missing.
    start, end : int or None
        The log times of the first and the last message on any channel, in ns; None if there is none.
    channels : mapping of Channel to int or None
        All channels that are known so far, with the number of their messages, as far as it is known.
    complete : bool
        Whether `channels` has all channels and all counts; if not, only reading the whole file would tell.
    remarks : sequence of str
        What a user should know about the choice of files, such as those that were ignored.
    """

    @property
    def finished(self) -> bool: ...

    @property
    def start(self) -> int | None: ...

    @property
    def end(self) -> int | None: ...

    @property
    def channels(self) -> Mapping[Channel, int | None]: ...

    @property
    def complete(self) -> bool: ...

    @property
    def remarks(self) -> Sequence[str]: ...

    def messages(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[StoredMessage]:
        """Iterate over the messages of some channels from one log time to another, inclusive, in their order.

        An iteration without limits ends with a report of what the file promises and does not have. One that reaches the
        end of a file without its index ends with `unfinished`.
        """
        ...

    def close(self) -> None:
        """Release files and memory."""
        ...
