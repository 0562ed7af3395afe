"""`header_stamps`, the stamps of the messages on any topic of a recording."""

import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.errors import RecordingError
from tfbus.recording.formats.copies import MessageTypes, types_with_header
from tfbus.recording.formats.storage import Channel, UnfoldError
from tfbus.recording.formats.transforms import decompressed
from tfbus.recording.recording import open_storage
from tfbus.stamps import SECOND, format_stamp
from tfbus.tree.rendering import counted

_HEADER_TYPES = ("Header", "std_msgs/Header", "std_msgs/msg/Header")


class HeaderStamps(NamedTuple):
    """The stamps of the messages on a topic.

    Examples
    --------
    >>> from tfbus.recording import HeaderStamps
    >>> HeaderStamps(np.array([0, SECOND]), from_headers=True, unreadable=0)
    <HeaderStamps of 2 messages, 0.000 s .. 1.000 s, from headers>
    """

    stamps: npt.NDArray[np.int64]
    """ns, in the order of the log times."""
    from_headers: bool
    """Whether the stamps are from headers. If not, the messages have no header, and the stamps are their log times."""
    unreadable: int
    """The number of messages that are too short, and of damaged places of the file; both are left out."""

    def __repr__(self) -> str:
        origin = "headers" if self.from_headers else "log times"
        span = (
            f", {format_stamp(int(self.stamps[0]))} .. {format_stamp(int(self.stamps[-1]))}" if len(self.stamps) else ""
        )
        unreadable = f", {self.unreadable:,} unreadable" if self.unreadable else ""
        return f"<HeaderStamps of {counted(len(self.stamps), 'message')}{span}, from {origin}{unreadable}>"


def header_stamps(path: str | os.PathLike[str], topic: str) -> HeaderStamps:
    """Read the stamps of all messages of any type on a topic.

    Parameters
    ----------
    path : str or path-like
        As `open_recording`.
    topic : str

    Raises
    ------
    RecordingError
        If the recording cannot be read, or nothing is on the topic.

    Examples
    --------
    >>> from tfbus.recording import header_stamps
    >>> header_stamps("small.bag", "/tf")
    <HeaderStamps of 786 messages, 100.002 s .. 109.982 s, from log times>
    """
    name = topic.removeprefix("/")
    stamps: list[int] = []
    unreadable = 0
    from_headers = True
    storage = open_storage(Path(path))
    try:
        for received, channel, payload in storage.messages(lambda each: each.topic.removeprefix("/") == name):
            if not isinstance(channel, Channel):
                # The report of a file without its end stands for no message.
                unreadable += channel.reason != "unfinished"
            elif not begins_with_header(channel):
                from_headers = False
                stamps.append(received)
            else:
                try:
                    stamps.append(_stamp(channel, payload))
                except (struct.error, UnfoldError):
                    unreadable += 1
        known = sorted({channel.topic for channel in storage.channels})
    finally:
        storage.close()
    if not stamps:
        raise RecordingError(
            f"nothing is on topic {topic!r}; there are {', '.join(known) or 'no topics'}",
            path=os.fspath(path),
            reason="no such topic",
        )
    return HeaderStamps(np.array(stamps, np.int64), from_headers, unreadable)


def begins_with_header(channel: Channel) -> bool:
    """Whether the messages of a channel of ROS begin with a header, by the definition in the file, or in ROS 2."""
    if channel.encoding not in ("cdr", "ros1"):
        return False
    if channel.schema and channel.schema_encoding in ("ros1msg", "ros2msg"):
        for line in channel.schema.decode(errors="replace").splitlines():
            field = line.partition("#")[0].split()
            if line.startswith("==="):
                return False
            # A constant is not a field.
            if field and "=" not in line.partition("#")[0]:
                return field[0] in _HEADER_TYPES
        return False
    return MessageTypes.name(channel.type) in types_with_header() if "/" in channel.type else False


def _stamp(channel: Channel, payload: bytes) -> int:
    payload = decompressed(channel, payload)
    if channel.encoding == "ros1":
        # Behind the number that counts the messages.
        seconds, nanoseconds = struct.unpack_from("<II", payload, 4)
    else:
        seconds, nanoseconds = struct.unpack_from("<iI" if payload[1:2] == b"\1" else ">iI", payload, 4)
    return int(seconds * SECOND + nanoseconds)
