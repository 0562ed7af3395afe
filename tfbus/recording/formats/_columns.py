"""Decoding many messages at once, with numpy.

Most messages of a channel differ only in their stamps and numbers: the same frames are at the same bytes. Such messages
are stacked to a matrix of bytes, and each transform of the message becomes two slices of it. What does not fit, or may
be invalid, is left to `ChannelDecoder`, which decodes one message after the other and tells what is wrong with it. Both
give the same bits.
"""

import struct
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.frames import is_frame
from tfbus.recording.formats._bounds import MAX_MESSAGE
from tfbus.recording.formats._decoder import ChannelDecoder
from tfbus.recording.formats._packed import Packed
from tfbus.recording.formats._raw_transforms import TF_TYPES
from tfbus.recording.formats._storage import Channel
from tfbus.rows import NORM_TOLERANCE, ROUNDING
from tfbus.stamps import SECOND
from tfbus.tf_message import MAX_NAME

Stamps = npt.NDArray[np.int64]

_LARGE: Final = 1e9
"""m; whether a longer translation is valid, the slow path decides."""
_MAX_LAYOUTS: Final = 10_000
_MAX_STRUCTURES: Final = 64
"""Of one channel and one size of messages."""
_SIZE: Final = struct.Struct("<I")


class Columns(NamedTuple):
    """Valid samples of one frame, from one authority and with one parent, in the order of their messages."""

    parent: str
    child: str
    authority: str
    static: bool
    order: npt.NDArray[np.intp]
    """The places of their messages."""
    received: Stamps
    """The log times, in ns."""
    stamps: Stamps
    """ns."""
    rows: npt.NDArray[np.float64]
    """Shape (n, 7): translation and unit quaternion (x, y, z, w)."""


class _Slot(NamedTuple):
    """A transform in a layout: its names, and the offsets of its stamp and of its numbers."""

    parent: str
    child: str
    stamp: int
    numbers: int


Ranges = tuple[tuple[int, int], ...]
"""Begin and end of each of some pieces of a message."""


class _Layout(NamedTuple):
    """The bytes that are the same in all messages of a layout, and the transforms between them."""

    ranges: Ranges
    """The position of those bytes."""
    fixed: npt.NDArray[np.uint64]
    slots: tuple[_Slot, ...]


class _Structure:
    """Layouts whose names are equally long, so that all have their fixed bytes and their numbers at the same places.

    Parameters
    ----------
    ranges : tuple of (int, int)
    """

    def __init__(self, ranges: Ranges) -> None:
        self.ranges = ranges
        self.layouts: dict[int, _Layout] = {}
        words = _words_in(ranges)
        # Odd numbers without a pattern; messages with the same sum are compared byte by byte as well.
        self._weights = np.random.default_rng(words).integers(2**62, size=words, dtype=np.uint64) * 2 + 1

    def hashes(self, fixed: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
        """A number for the fixed bytes of each message."""
        sums: npt.NDArray[np.uint64] = fixed @ self._weights
        return sums


class _Values(NamedTuple):
    """The contents of one transform of each message of a structure."""

    stamps: Stamps
    """ns."""
    rows: npt.NDArray[np.float64]
    """Shape (n, 7): translation and unit quaternion (x, y, z, w)."""
    sound: npt.NDArray[np.bool_]
    """Whether it is valid for certain."""


class ColumnDecoder:
    """Decodes blocks of messages.

    Parameters
    ----------
    decoders : mapping of Channel to ChannelDecoder
        May grow.
    """

    def __init__(self, decoders: Mapping[Channel, ChannelDecoder]) -> None:
        self._decoders = decoders
        self._structures: dict[tuple[Channel, int], list[_Structure]] = {}
        self._layouts = 0

    def decode(self, messages: Packed) -> list[Columns] | None:
        """One `Columns` for each frame and authority; None if the messages have to be decoded one by one."""
        sizes = messages.ends - messages.starts
        if not messages.size:
            return []
        if sizes.max() > MAX_MESSAGE:
            return None
        found: dict[tuple[str, str], list[Columns]] = {}
        for order in _groups((messages.numbers << 32) | sizes):
            channel = messages.channels[messages.numbers[order[0]]]
            decoder = self._decoders.get(channel)
            if decoder is None or channel.encoding not in ("cdr", "ros1") or channel.type not in TF_TYPES:
                return None
            size = int(sizes[order[0]])
            if not size:
                return None
            everywhere = np.ndarray((len(messages.data) - size + 1,), f"V{size}", messages.data, strides=(1,))
            matrix = everywhere[messages.starts[order]].view(np.uint8).reshape(-1, size)
            if not self._add(decoder, matrix, order, messages.received, found):
                return None
        edges: dict[str, tuple[str, bool]] = {}
        for parts_of_one in found.values():
            for each in parts_of_one:
                if edges.setdefault(each.child, (each.parent, each.static)) != (each.parent, each.static):
                    return None
        return list(map(_merge, found.values()))

    def _add(
        self,
        decoder: ChannelDecoder,
        matrix: npt.NDArray[np.uint8],
        order: npt.NDArray[np.intp],
        received: Stamps,
        found: dict[tuple[str, str], list[Columns]],
    ) -> bool:
        """Decode messages of one channel and one size, in a matrix; returns whether all could be.

        Parameters
        ----------
        decoder : ChannelDecoder
        matrix : array of uint8, shape (n, size)
        order : array of int, shape (n,)
            The places of the messages.
        received : array of int
            The log times of the messages at all places.
        found : dict
            Gets the samples, by child and authority.
        """
        known = self._structures.setdefault((decoder.channel, matrix.shape[1]), [])
        at = 0
        while len(matrix):
            if at == len(known):
                layout = _layout_of(matrix[0].tobytes(), decoder)
                if layout is None or at == _MAX_STRUCTURES:
                    return False
                known.append(_Structure(layout.ranges))
            structure = known[at]
            at += 1
            parts = self._parts(structure, decoder, matrix)
            if parts is None:
                return False
            if not parts:
                continue
            rest = np.ones(len(matrix), bool)
            for _, places in parts:
                rest[places] = False
            for place, slot in enumerate(parts[0][0].slots):
                values = _values(matrix, slot, decoder.channel.encoding == "cdr")
                if not (values.sound | rest).all():
                    return False
                for layout, places in parts:
                    frame = layout.slots[place]
                    authority = decoder.authority_of(place, len(layout.slots))
                    its_order = order[places]
                    found.setdefault((frame.child, authority), []).append(
                        Columns(
                            frame.parent,
                            frame.child,
                            authority,
                            decoder.static,
                            its_order,
                            received[its_order],
                            values.stamps[places],
                            values.rows[places],
                        )
                    )
            matrix, order = matrix[rest], order[rest]
        return True

    def _parts(
        self, structure: _Structure, decoder: ChannelDecoder, matrix: npt.NDArray[np.uint8]
    ) -> list[tuple[_Layout, npt.NDArray[np.intp]]] | None:
        """The layouts of the messages that have the structure, with their places; None if one has no layout."""
        fixed = _fixed(matrix, structure.ranges)
        hashes = structure.hashes(fixed)
        parts = []
        for places in _groups(hashes):
            number = int(hashes[places[0]])
            layout = structure.layouts.get(number)
            if layout is None:
                layout = _layout_of(matrix[places[0]].tobytes(), decoder)
                if layout is None or self._layouts == _MAX_LAYOUTS:
                    return None
                if layout.ranges != structure.ranges:
                    continue
                structure.layouts[number] = layout
                self._layouts += 1
            same = (fixed[places] == layout.fixed).all(axis=1)
            if same.any():
                parts.append((layout, places[same]))
        return parts


def _groups(keys: npt.NDArray[Any]) -> list[npt.NDArray[np.intp]]:
    """The places of equal keys, one array for each key; they ascend."""
    order = np.argsort(keys, kind="stable")
    ascending = keys[order]
    bounds = [0, *(np.flatnonzero(ascending[1:] != ascending[:-1]) + 1).tolist(), len(order)]
    return [order[begin:end] for begin, end in pairwise(bounds)]


def _words_in(ranges: Ranges) -> int:
    return -(-sum(end - begin for begin, end in ranges) // 8)


def _fixed(matrix: npt.NDArray[np.uint8], ranges: Ranges) -> npt.NDArray[np.uint64]:
    """The bytes of each message in some ranges, in words of 8; the last one is filled with zeros."""
    found = np.zeros((len(matrix), 8 * _words_in(ranges)), np.uint8)
    at = 0
    for begin, end in ranges:
        found[:, at : at + end - begin] = matrix[:, begin:end]
        at += end - begin
    return found.view(np.uint64)


def _layout_of(payload: bytes, decoder: ChannelDecoder) -> _Layout | None:
    """The layout of a message; None if it has none of the usual ones."""
    ros1 = decoder.channel.encoding == "ros1"
    if not ros1 and payload[:2] != b"\0\1":
        return None
    # In CDR, alignment counts from the end of the header.
    base = 0 if ros1 else 4
    slots = []
    fixed = []
    try:
        (count,) = _SIZE.unpack_from(payload, base)
        at = begin = base + 4
        begin = 0
        for _ in range(count):
            # A header of ROS 1 begins with a number that counts the messages.
            stamp = at + 4 if ros1 else at
            fixed.append((begin, at))
            at = begin = stamp + 8
            names = []
            for _ in range(2):
                at += 0 if ros1 else -(at - base) % 4
                (length,) = _SIZE.unpack_from(payload, at)
                text = payload[at + 4 : at + 4 + length]
                if len(text) != length or length > MAX_NAME or not (ros1 or text.endswith(b"\0")):
                    return None
                names.append(decoder.prefix + (text if ros1 else text[:-1]).decode().lstrip("/"))
                at += 4 + length
            at += 0 if ros1 else -(at - base) % 8
            parent, child = names
            if not (is_frame(parent) and is_frame(child)) or parent == child:
                return None
            slots.append(_Slot(parent, child, stamp, at))
            fixed.append((begin, at))
            at = begin = at + 56
    except (struct.error, UnicodeDecodeError):
        return None
    if at != len(payload):
        return None
    ranges = tuple(fixed)
    return _Layout(ranges, _fixed(np.frombuffer(payload, np.uint8)[None], ranges)[0], tuple(slots))


def _values(matrix: npt.NDArray[np.uint8], slot: _Slot, signed: bool) -> _Values:
    """One transform of each message; in those of another structure, it is any bytes."""
    times = np.ascontiguousarray(matrix[:, slot.stamp : slot.stamp + 8]).view("<u4")
    rows = np.ascontiguousarray(matrix[:, slot.numbers : slot.numbers + 56]).view("<f8")
    nanoseconds = times[:, 1]
    sound = nanoseconds < SECOND
    for axis in range(3):
        sound &= np.abs(rows[:, axis]) < _LARGE
    i, j, k, w = rows[:, 3], rows[:, 4], rows[:, 5], rows[:, 6]
    # Overflow and NaN are found by the comparison.
    with np.errstate(over="ignore", invalid="ignore"):
        square = i * i + j * j + k * k + w * w
        even = np.abs(square - 1.0) <= ROUNDING
        if not even.all():
            norm = np.sqrt(square)
            sound &= np.abs(norm - 1.0) <= NORM_TOLERANCE
            rows = rows.copy()
            uneven = sound & ~even
            rows[uneven, 3:] /= norm[uneven, None]
    seconds = times[:, 0].view(np.int32 if signed else np.uint32).astype(np.int64)
    if not signed:
        sound &= seconds < 2**31
    return _Values(seconds * SECOND + nanoseconds, rows, sound)


def _merge(parts: list[Columns]) -> Columns:
    """Several columns of one frame as one; they differ only in their samples."""
    first = parts[0]
    if len(parts) == 1:
        return first
    order = np.concatenate([part.order for part in parts])
    by_message = np.argsort(order, kind="stable")
    joined: Iterator[Any] = (np.concatenate([part[at] for part in parts])[by_message] for at in range(4, 8))
    return Columns(*first[:4], *joined)
