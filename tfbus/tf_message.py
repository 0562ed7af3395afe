"""Transforms as the bytes of a ROS 2 ``tf2_msgs/msg/TFMessage``, and back.

The message is ``geometry_msgs/msg/TransformStamped[] transforms``. The layout of one transform, with the offsets for
two empty names::

    0  header.stamp       int32 sec, uint32 nanosec
    8  header.frame_id    string: uint32 length, UTF-8, NUL
   16  child_frame_id     string
   24  transform          float64 translation x, y, z, rotation x, y, z, w

The encoding is plain CDR, version 1: a header of four bytes, whose second is the byte order and whose last two are
options (OMG DDSI-RTPS 2.5, section 10); then each number at a multiple of its own size, counted from the end of the
header, and each string with a length that counts its NUL (OMG DDS-XTYPES 1.3, section 7.4.1). Because float64 comes
last, every transform ends at a multiple of 8.

The same few names are in every message. So the bytes of two names, with lengths and padding, are cached as one piece,
and a cached piece needs no checks. A transform that may be invalid is built with `Transform` and `TransformStamped`, so
that it is refused with their errors.
"""

import math
import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import islice, repeat
from typing import Any, Final, Generic, NamedTuple, TypeVar, cast, overload

from tfbus.errors import InvalidTransformError
from tfbus.frames import is_frame
from tfbus.geometry.stamped import Fields, TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.plain import printable
from tfbus.rows import NORM_TOLERANCE, ROUNDING, Row
from tfbus.stamps import SECOND, format_stamp
from tfbus.which_kernel import decode as decode_plain
from tfbus.which_kernel import decode_whole

MAX_NAME: Final = 1_024
"""The length of the longest accepted frame name, in bytes of UTF-8."""
MIN_SIZE: Final = 80
"""The size of the shortest transform in bytes: a stamp of 8, two empty names of 5 padded to 8, and 7 numbers of 8."""

SampleT = TypeVar("SampleT", bound=TransformStamped)
Tag = tuple[str, bool]
"""The authority and the static flag of a sample, which the message does not hold."""


class MalformedMessageError(ValueError):
    """A payload that is not a valid message of transforms; none of its transforms was accepted.

    Attributes
    ----------
    reason : str
        One word to count by: ``"truncated"``, ``"oversized"``, ``"encoding"``, ``"text"`` (a string without its NUL) or
        ``"tags"``; links have further reasons for the data that they send along with a message.
    detail : str
        The fault in the payload.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(reason, detail)
        self.reason = reason
        self.detail = detail

    def __str__(self) -> str:
        return printable(f"no message of transforms ({self.reason}): {self.detail}")


class Decoded(NamedTuple, Generic[SampleT]):
    """The samples and errors of a message."""

    samples: list[SampleT | None]
    """A sample for each transform, in order; None for a refused one."""
    errors: list[InvalidTransformError]
    """An error for each refused transform, in order; with its authority, and with its frames if they are readable."""


class _Layout:
    """The structs of a message in one byte order."""

    def __init__(self, order: str) -> None:
        self.size = struct.Struct(f"{order}I")
        self.head = struct.Struct(f"{order}iII")
        self.numbers = struct.Struct(f"{order}7d")


_LITTLE_ENDIAN = _Layout("<")
_LAYOUTS = {b"\x00\x00": _Layout(">"), b"\x00\x01": _LITTLE_ENDIAN}
_HEADER = b"\x00\x01\x00\x00"
_STAMP = struct.Struct("<iI")
_FIRST: Final = 4
"""The offset of the first transform in the body, behind their number."""

_SHOWN = 40
_MAX_CACHED = 2_048
_MAX_CACHED_SIZE = 256
_pieces: dict[tuple[str, str, bool], bytes] = {}
_names: dict[bytes, tuple[str, str]] = {}
_bare_names: dict[bytes, tuple[str, str]] = {}


def _cache(cache: dict[Any, Any], key: object, value: object, size: int) -> None:
    # Peers choose the names: long ones are not cached, and a full cache is emptied.
    if size <= _MAX_CACHED_SIZE:
        if len(cache) >= _MAX_CACHED:
            cache.clear()
        cache[key] = value


def encode(samples: Sequence[TransformStamped]) -> bytes:
    """Encode samples as a little endian CDR message with its header, without authorities and static flags.

    Raises
    ------
    InvalidTransformError
        If a message cannot hold a sample; it is the `refusal` of the first such sample.
    """
    pack_stamp, pack_numbers, piece_of = _STAMP.pack, _LITTLE_ENDIAN.numbers.pack, _pieces.get
    parts = [_HEADER, _LITTLE_ENDIAN.size.pack(len(samples))]
    add = parts.append
    first = True
    try:
        for sample in samples:
            parent, child, stamp, row, _, _ = sample._fields
            add(pack_stamp(stamp // SECOND, stamp % SECOND))
            add(piece_of((parent, child, first)) or _piece(parent, child, first))
            add(pack_numbers(*row))
            first = False
    except (struct.error, ValueError):
        for refused in filter(None, map(refusal, samples)):
            raise refused from None
        raise
    return b"".join(parts)


def _piece(parent: str, child: str, first: bool) -> bytes:
    piece = b""
    for name in (parent, child):
        text = name.encode()
        if len(text) > MAX_NAME:
            raise ValueError
        piece += bytes(-len(piece) % 4) + _LITTLE_ENDIAN.size.pack(len(text) + 1) + text + b"\0"
    # The count in front of the first transform shifts its alignment by 4.
    piece += bytes(-(len(piece) + 4 * first) % 8)
    _cache(_pieces, (parent, child, first), piece, len(piece))
    return piece


def refusal(sample: TransformStamped) -> InvalidTransformError | None:
    """The error for a sample that a message cannot hold; None if it can.

    The reason is ``"stamp"`` before December 1901 and after January 2038, because ROS has 32 bits for the seconds, and
    ``"frame name"`` for a name that is longer than `MAX_NAME` or has no UTF-8, such as half of a surrogate pair.
    """
    parent, child, stamp, _, authority, _ = sample._fields
    reason, why = "frame name", ""
    for name in (parent, child):
        try:
            size = len(name.encode())
        except UnicodeEncodeError:
            why = f"frame name {name!r} cannot be written in UTF-8"
        else:
            if size > MAX_NAME:
                why = f"a frame name in a message has at most {MAX_NAME} bytes, got {size}"
    if not why and not -(2**31) <= stamp // SECOND < 2**31:
        reason, why = "stamp", f"a message cannot be stamped {format_stamp(stamp)}: its seconds have 32 bits"
    if not why:
        return None
    return InvalidTransformError(why, reason=reason, parent=parent, child=child, authority=authority)


@overload
def decode(
    payload: bytes | memoryview, tags: Iterable[Tag] | None = ..., *, bare_names: bool = ...
) -> Decoded[TransformStamped]: ...
@overload
def decode(
    payload: bytes | memoryview,
    tags: Iterable[Tag] | None = ...,
    kind: type[SampleT] = ...,
    bare_names: bool = ...,
) -> Decoded[SampleT]: ...
def decode(
    payload: bytes | memoryview,
    tags: Iterable[Tag] | None = None,
    kind: type[Any] = TransformStamped,
    bare_names: bool = False,
) -> Decoded[Any]:
    """Decode the samples of a message in either byte order.

    Parameters
    ----------
    payload : bytes or memoryview
        The message with its header. Up to three zeros after it are padding.
    tags : iterable of (str, bool), optional
        Authority and static flag of each transform, which the message does not hold; by default ``("", False)``.
    kind : type, optional
        The type of the samples: `TransformStamped`, or a subclass whose further slots the caller fills.
    bare_names : bool, optional
        Remove leading slashes from the names, as for recordings of ROS 1.

    Raises
    ------
    MalformedMessageError
        If the payload is not such a message, or there is not one tag for each transform. No payload raises another
        error. The memory used is proportional to the size of the payload, even if its counts and lengths are false.

    Notes
    -----
    A single transform is refused for anything that `Transform` and `TransformStamped` refuse, for a name that is longer
    than `MAX_NAME` or not UTF-8 (``"frame name"``), and for a stamp with a second or more of nanoseconds (``"stamp"``).
    """
    body, layout, count = _open(payload)
    decoded, end = _transforms(body, layout, _as_tags(tags, count), kind, bare_names)
    _check_end(body, end)
    return decoded


def plain_decoder(tag: Tag, most: int) -> Callable[[bytes], tuple[TransformStamped, ...] | None]:
    """A faster `decode` with bare names for messages of at most `most` bytes whose transforms have all one tag.

    It gives None for a message that is not plain, such as one with a new name, which then has to be decoded.
    """
    if sys.byteorder != "little":
        return lambda payload: None  # noqa: ARG005
    return partial(decode_whole, (tag,), _bare_names, TransformStamped, most)


def decode_in_parts(
    payload: bytes, most: int, kind: type[SampleT], bare_names: bool = False, tags: Iterable[Tag] | None = None
) -> Iterator[Decoded[SampleT]]:
    """Decode the samples of a message, a limited number at a time; the other parameters are as in `decode`.

    Raises
    ------
    MalformedMessageError
        After the valid samples before the fault.
    """
    body, layout, count = _open(payload)
    end, rest = _FIRST, iter(_as_tags(tags, count))
    for _ in range(0, count, most):
        decoded, end = _transforms(body, layout, islice(rest, most), kind, bare_names, end)
        yield decoded
    _check_end(body, end)


def _open(payload: bytes | memoryview) -> tuple[bytes, _Layout, int]:
    """The body of a message, its byte order, and the number of its transforms."""
    body = bytes(payload)
    layout = _LAYOUTS.get(body[:2])
    if len(body) < 8:
        raise MalformedMessageError("truncated", f"{len(body)} bytes")
    if layout is None:
        raise MalformedMessageError("encoding", f"it is not plain CDR, its header is {body[:4].hex(' ')}")
    body = body[4:]
    (count,) = layout.size.unpack_from(body)
    if count and 8 + count * MIN_SIZE > len(body):
        raise MalformedMessageError("truncated", f"{len(body)} bytes cannot hold {count} transforms")
    return body, layout, count


def _check_end(body: bytes, end: int) -> None:
    if body[end : end + 4] not in (b"", b"\0", b"\0\0", b"\0\0\0"):
        raise MalformedMessageError("oversized", f"{len(body) - end} bytes behind the last transform")


def _as_tags(tags: Iterable[Tag] | None, count: int) -> Iterable[Tag]:
    if tags is None:
        return repeat(("", False), count)
    known = tuple(islice(tags, count + 1))
    if len(known) != count:
        raise MalformedMessageError("tags", f"there is not one tag for each of the {count} transforms")
    return known


def _transforms(
    body: bytes, layout: _Layout, tags: Iterable[Tag], kind: type[Any], bare_names: bool, at: int = _FIRST
) -> tuple[Decoded[Any], int]:
    """The transforms of a message from an offset on, one for each tag, and the offset behind the last."""
    try:
        return _transforms_of(body, layout, tags, kind, bare_names, at)
    except struct.error:
        raise MalformedMessageError("truncated", f"{len(body)} bytes end inside of a transform") from None


def _transforms_of(
    body: bytes, layout: _Layout, tags: Iterable[Tag], kind: type[Any], bare_names: bool, at: int
) -> tuple[Decoded[Any], int]:
    head, size, numbers = layout.head.unpack_from, layout.size.unpack_from, layout.numbers.unpack_from
    cache = _bare_names if bare_names else _names
    names_of, make = cache.get, cast(Any, kind.__new__)
    samples: list[Any] = []
    errors: list[InvalidTransformError] = []
    rest = tuple(tags)
    if layout is _LITTLE_ENDIAN and sys.byteorder == "little":
        samples, at = decode_plain(body, at, rest, cache, kind)
    for tag in rest[len(samples) :]:
        seconds, nanoseconds, length = head(body, at)
        middle = at + 12 + length + 3 & -4
        (length,) = size(body, middle)
        end = middle + 4 + length + 7 & -8
        # Before the names are sliced, because this fails if a length is wrong.
        row = x, y, z, i, j, k, w = numbers(body, end)
        piece = body[at + 8 : end]
        at = end + 56
        names = names_of(piece)
        if names is None:
            names = _new_names(piece, layout, bare_names)
            if names is not None:
                _cache(cache, piece, names, len(piece))
        unit: Row | None = row
        if not -ROUNDING <= i * i + j * j + k * k + w * w - 1.0 <= ROUNDING:
            unit = _normalised(row)
        # Zero times a number that is not finite is NaN.
        if names is not None and nanoseconds < SECOND and unit is not None and (x + y + z) * 0.0 == 0.0:
            fields = *names, seconds * SECOND + nanoseconds, unit, *tag
        else:
            parent, child = (_name(text, bare_names) for text in _split_names(piece, layout))
            try:
                fields = _checked(parent, child, seconds, nanoseconds, row, tag)
            except InvalidTransformError as error:
                error.parent, error.child, error.authority = parent, child, tag[0]
                errors.append(error.with_traceback(None))
                samples.append(None)
                continue
        sample = make(kind)
        sample._fields = fields
        samples.append(sample)
    return Decoded(samples, errors), at


def _normalised(row: Row) -> Row | None:
    """The row with a unit quaternion, in the arithmetic of `as_rotation`; None if its norm is off by too much."""
    x, y, z, i, j, k, w = row
    norm = math.sqrt(i * i + j * j + k * k + w * w)
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        return None
    return x, y, z, i / norm, j / norm, k / norm, w / norm


def _new_names(piece: bytes, layout: _Layout, bare: bool) -> tuple[str, str] | None:
    """The two names of a piece; None if they cannot be the frames of a sample."""
    texts = _split_names(piece, layout)
    parent, child = _name(texts[0], bare), _name(texts[1], bare)
    if parent is None or child is None or parent == child or not (is_frame(parent) and is_frame(child)):
        return None
    return parent, child


def _split_names(piece: bytes, layout: _Layout) -> tuple[bytes, bytes]:
    """The two strings of a piece without the NUL at their ends."""
    (length,) = layout.size.unpack_from(piece)
    middle = 4 + length + 3 & -4
    (second,) = layout.size.unpack_from(piece, middle)
    parent, child = piece[4 : 4 + length], piece[middle + 4 : middle + 4 + second]
    if parent.endswith(b"\0") and child.endswith(b"\0"):
        return parent[:-1], child[:-1]
    wrong = child if parent.endswith(b"\0") else parent
    raise MalformedMessageError("text", f"the string {wrong[:_SHOWN]!r} does not end with NUL")


def _name(text: bytes, bare: bool) -> str | None:
    """Decode a frame name; None if it is too long or not UTF-8."""
    if len(text) > MAX_NAME:
        return None
    try:
        name = text.decode()
    except UnicodeDecodeError:
        return None
    return name.lstrip("/") if bare else name


def _checked(parent: str | None, child: str | None, seconds: int, nanoseconds: int, row: Row, tag: Tag) -> Fields:
    """The fields of a valid sample; raises `InvalidTransformError` for an invalid one."""
    if parent is None or child is None:
        raise InvalidTransformError(f"a frame name must be UTF-8 of at most {MAX_NAME} bytes", reason="frame name")
    if nanoseconds >= SECOND:
        raise InvalidTransformError(f"a stamp has less than 1e9 nanosec, got {nanoseconds}", reason="stamp")
    stamp = seconds * SECOND + nanoseconds
    return TransformStamped(parent, child, stamp, Transform(row[:3], row[3:]), *tag)._fields


class FieldReader:
    """Reads the fields of another message with a header, one after another; `struct.error` if it ends too early.

    Parameters
    ----------
    payload : bytes
    ros1 : bool
        Whether it is in the format of ROS 1, rather than CDR.
    """

    def __init__(self, payload: bytes, ros1: bool) -> None:
        # CDR counts its alignment from the end of its header; a header of ROS 1 begins with the number of the message.
        self._body = payload if ros1 else payload[4:]
        self._ros1 = ros1
        self._order = "<" if ros1 or payload[1:2] == b"\1" else ">"
        self._at = 4 if ros1 else 0

    def header(self) -> tuple[int, bytes]:
        """The stamp in ns, and the name of the frame in UTF-8."""
        seconds, nanoseconds = self._take(f"{'I' if self._ros1 else 'i'}I")
        return seconds * SECOND + nanoseconds, self.text()

    def count(self) -> int:
        """A length."""
        self._align(4)
        (value,) = self._take("I")
        return int(value)

    def text(self) -> bytes:
        """A text in UTF-8."""
        length = self.count()
        part = self._body[self._at : self._at + length]
        if len(part) < length:
            raise struct.error("the message ends inside of a text")
        self._at += length
        return part.rstrip(b"\0")

    def doubles(self, count: int) -> tuple[float, ...]:
        """So many float64."""
        if count:
            self._align(8)
        return self._take(f"{count}d")

    def _align(self, unit: int) -> None:
        self._at += 0 if self._ros1 else -self._at % unit

    def _take(self, layout: str) -> tuple[Any, ...]:
        form = self._order + layout
        values = struct.unpack_from(form, self._body, self._at)
        self._at += struct.calcsize(form)
        return values
