"""Decoding many messages at once, with numpy.

Most messages of a channel differ only in their stamps and numbers: the same frames are at the same bytes. Such messages
are stacked to a matrix of bytes, and each transform of the message becomes two slices of it. What does not fit, or may
be invalid, is left to `ChannelDecoder`, which decodes one message after the other and tells what is wrong with it. Both
give the same bits.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.frames import is_frame
from tfbus.geometry.rows import NORM_TOLERANCE, ROUNDING
from tfbus.recording.formats._bounds import MAX_MESSAGE
from tfbus.recording.formats._decoder import ChannelDecoder
from tfbus.recording.formats._raw_transforms import TF_TYPES
from tfbus.recording.formats._storage import Channel, StoredMessage
from tfbus.stamps import SECOND
from tfbus.tf_message import MAX_NAME

Stamps = npt.NDArray[np.int64]

_LARGE: Final = 1e9
"""m; whether a longer translation is valid, the slow path decides."""
_MAX_LAYOUTS: Final = 64
_SIZE: Final = struct.Struct("<I")
_received = itemgetter(0)


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


class _Layout(NamedTuple):
    """The bytes that are the same in all messages of a layout, and the transforms between them."""

    fixed: tuple[tuple[int, int, npt.NDArray[np.uint8]], ...]
    slots: tuple[_Slot, ...]

    def matches(self, matrix: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
        """Which rows of a matrix have this layout."""
        found = np.ones(len(matrix), bool)
        for start, end, part in self.fixed:
            found &= (matrix[:, start:end] == part).all(axis=1)
        return found


class ColumnDecoder:
    """Decodes blocks of messages.

    Parameters
    ----------
    decoders : mapping of Channel to ChannelDecoder
        May grow.
    """

    def __init__(self, decoders: Mapping[Channel, ChannelDecoder]) -> None:
        self._decoders = decoders
        self._layouts: dict[tuple[Channel, int], list[_Layout]] = {}

    def decode(self, messages: Sequence[StoredMessage]) -> list[Columns] | None:
        """One `Columns` for each frame; None if the messages have to be decoded one by one."""
        groups: dict[tuple[Any, int], list[int]] = {}
        for at, (_, channel, payload) in enumerate(messages):
            key = channel, len(payload)
            if key in groups:
                groups[key].append(at)
            else:
                groups[key] = [at]
        received = np.fromiter(map(_received, messages), np.int64, len(messages))
        found: dict[str, list[Columns]] = {}
        for (channel, size), places in groups.items():
            decoder = self._decoders.get(channel)
            if decoder is None or channel.encoding not in ("cdr", "ros1") or channel.type not in TF_TYPES:
                return None
            if size > MAX_MESSAGE:
                return None
            matrix = np.frombuffer(b"".join([messages[at][2] for at in places]), np.uint8).reshape(len(places), size)
            parts = self._split(decoder, matrix, np.array(places))
            if parts is None:
                return None
            for layout, order, rows in parts:
                for place, slot in enumerate(layout.slots):
                    columns = _columns(decoder, layout, place, slot, order, received, rows)
                    if columns is None:
                        return None
                    found.setdefault(columns.child, []).append(columns)
        merged = list(map(_merge, found.values()))
        return None if None in merged else [columns for columns in merged if columns is not None]

    def _split(
        self, decoder: ChannelDecoder, matrix: npt.NDArray[np.uint8], order: npt.NDArray[np.intp]
    ) -> list[tuple[_Layout, npt.NDArray[np.intp], npt.NDArray[np.uint8]]] | None:
        """Parts of a matrix that have one layout each, with the places of their messages."""
        size = matrix.shape[1]
        known = self._layouts.setdefault((decoder.channel, size), [])
        parts = []
        for at in range(_MAX_LAYOUTS):
            if at == len(known):
                layout = _layout_of(matrix[0].tobytes(), decoder)
                if layout is None:
                    return None
                known.append(layout)
            fits = known[at].matches(matrix)
            if fits.all():
                parts.append((known[at], order, matrix))
                return parts
            if fits.any():
                parts.append((known[at], order[fits], matrix[fits]))
                matrix, order = matrix[~fits], order[~fits]
        return None


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
    content = np.frombuffer(payload, np.uint8)
    return _Layout(tuple((start, end, content[start:end]) for start, end in fixed if start < end), tuple(slots))


def _columns(
    decoder: ChannelDecoder,
    layout: _Layout,
    place: int,
    slot: _Slot,
    order: npt.NDArray[np.intp],
    received: Stamps,
    matrix: npt.NDArray[np.uint8],
) -> Columns | None:
    """The samples of one transform of a layout; None if one of them may be invalid."""
    times = np.ascontiguousarray(matrix[:, slot.stamp : slot.stamp + 8]).view("<u4")
    rows = np.ascontiguousarray(matrix[:, slot.numbers : slot.numbers + 56]).view("<f8")
    nanoseconds = times[:, 1]
    if (nanoseconds >= SECOND).any() or not (np.abs(rows[:, :3]) < _LARGE).all():
        return None
    i, j, k, w = rows[:, 3], rows[:, 4], rows[:, 5], rows[:, 6]
    # Overflow and NaN are found by the comparison.
    with np.errstate(over="ignore", invalid="ignore"):
        square = i * i + j * j + k * k + w * w
        excess = np.abs(square - 1.0)
    if not (excess <= ROUNDING).all():
        norm = np.sqrt(square)
        if not (np.abs(norm - 1.0) <= NORM_TOLERANCE).all():
            return None
        rows = rows.copy()
        uneven = excess > ROUNDING
        rows[uneven, 3:] /= norm[uneven, None]
    signed = decoder.channel.encoding == "cdr"
    seconds = times[:, 0].view(np.int32 if signed else np.uint32).astype(np.int64)
    if not signed and (seconds >= 2**31).any():
        return None
    stamps = seconds * SECOND + nanoseconds
    authority = decoder.authority_of(place, len(layout.slots))
    return Columns(slot.parent, slot.child, authority, decoder.static, order, received[order], stamps, rows)


def _merge(parts: list[Columns]) -> Columns | None:
    """Several columns of one frame as one; None if they differ in more than their samples."""
    first = parts[0]
    if len(parts) == 1:
        return first
    if any(part[:4] != first[:4] for part in parts):
        return None
    order = np.concatenate([part.order for part in parts])
    by_message = np.argsort(order, kind="stable")
    joined: Iterator[Any] = (np.concatenate([part[at] for part in parts])[by_message] for at in range(4, 8))
    return Columns(*first[:4], *joined)
