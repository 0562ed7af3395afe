"""Decoding the messages of one channel into samples."""

import json
from collections.abc import Iterable
from itertools import chain, repeat
from typing import Literal

from tfbus.geometry.stamped import TransformStamped, renamed
from tfbus.recording.formats._raw_transforms import bounded, parser_of, write_cdr
from tfbus.recording.formats._storage import AUTHORITIES, Channel
from tfbus.tf_message import Decoded, Tag, decode

Run = tuple[str, int]


class ChannelDecoder:
    """Gives the samples of the messages of a channel.

    Parameters
    ----------
    channel : Channel
        Its messages hold transforms.
    static : bool
        Whether its transforms are static.
    prefix : str
        Put before the names of all frames, after leading slashes are removed.

    Attributes
    ----------
    channel, static, prefix
    authorities : tuple of (str, int)
        The authorities of successive transforms of a message, each with their number; a single one stands for all
        transforms.
    """

    def __init__(self, channel: Channel, static: bool, prefix: str = "") -> None:
        self.channel = channel
        self.static = static
        self.prefix = prefix
        self.authorities = _authorities(channel)
        self._count = sum(count for _, count in self.authorities)
        self._plain = channel.encoding == "cdr" and not channel.type.endswith("FrameTransform")
        self._parse = parser_of(channel)
        self._names: dict[tuple[str, str], tuple[str, str]] = {}

    def decode(self, payload: bytes) -> Decoded[TransformStamped]:
        """Decode the samples of a message, with authorities and the prefix, and without leading slashes.

        Raises
        ------
        MalformedMessageError
        """
        payload = bounded(payload)
        if not self._plain:
            payload = write_cdr(self._parse(payload))
        order: Literal["little", "big"] = "little" if payload[1:2] == b"\1" else "big"
        count = int.from_bytes(payload[4:8], order)
        decoded = decode(payload, self._tags(count), bare_names=True)
        if self.prefix:
            decoded.samples[:] = map(self._prefixed, decoded.samples)
        return decoded

    def authority_of(self, place: int, count: int) -> str:
        """The authority of a transform of a message with `count` transforms; empty if their number does not fit."""
        if len(self.authorities) == 1:
            return self.authorities[0][0]
        if self._count == count:
            for authority, run in self.authorities:
                if place < run:
                    return authority
                place -= run
        return ""

    def _tags(self, count: int) -> Iterable[Tag]:
        """Authority and static flag of each transform, as many as the message can hold."""
        if len(self.authorities) == 1:
            return repeat((self.authorities[0][0], self.static), count)
        if self._count != count:
            return repeat(("", self.static), count)
        return chain.from_iterable(repeat((authority, self.static), run) for authority, run in self.authorities)

    def _prefixed(self, sample: TransformStamped | None) -> TransformStamped | None:
        if sample is None:
            return None
        return renamed(sample, self.prefix + sample.parent, self.prefix + sample.child)


def _authorities(channel: Channel) -> tuple[Run, ...]:
    """The authorities in the metadata of a channel; the node that sent it, in ROS 1."""
    text = channel.metadata.get(AUTHORITIES)
    if text is None:
        return ((channel.metadata.get("callerid", "").removeprefix("/"), 1),)
    try:
        runs = tuple((str(authority), int(count)) for authority, count in json.loads(text))
    except (ValueError, TypeError, RecursionError):
        # Another program wrote something else there.
        return (("", 1),)
    if not runs or any(count < 1 for _, count in runs):
        return (("", 1),)
    return runs
