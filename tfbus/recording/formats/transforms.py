"""From the payloads of messages to transforms, in three ways.

* `RawTransform`, `parser_of` and the writers keep the numbers of a transform as bytes: nothing is checked or
  normalised, so a transform passes from one format to another without a change of any bit. The layout of a ROS message
  is a sequence of numbers and strings; in CDR each is aligned to its size (see `tfbus.tf_message`); in ROS 1 nothing is
  aligned, strings have no NUL, and a header begins with a sequence number.
* `ChannelDecoder` decodes one message to samples, with an error for each bad transform. It converts payloads to CDR
  first.
* `ColumnDecoder` decodes many messages at once, with numpy. Most messages of a channel differ only in their stamps and
  numbers: the same frames are at the same bytes. So messages of one size are stacked to a matrix of bytes, and each
  transform of the message becomes two slices of it. It gives the same bits as `ChannelDecoder`. For a block with
  anything unusual or possibly invalid it gives None, and `ChannelDecoder` decodes that block.
"""

import json
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import chain, pairwise, repeat
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.errors import pip_install
from tfbus.frames import is_frame
from tfbus.geometry.covariance import Covariance
from tfbus.geometry.stamped import TransformStamped, renamed
from tfbus.geometry.uncertain import Belief, with_belief
from tfbus.recording.formats.storage import (
    AUTHORITIES,
    MAX_MESSAGE,
    MAX_OTHER_MESSAGE,
    Channel,
    Packed,
    UnfoldError,
    unfold,
)
from tfbus.rows import NORM_TOLERANCE, ROUNDING
from tfbus.stamps import SECOND
from tfbus.tf_message import MAX_NAME, Decoded, MalformedMessageError, Tag, decode, plain_decoder

TF_TYPES: Final = frozenset(("tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage", "tf/msg/tfMessage", "tf/tfMessage"))
FOXGLOVE_TYPES: Final = frozenset(
    f"{package}{name}"
    for package in ("foxglove.", "foxglove_msgs/msg/", "foxglove_msgs/")
    for name in ("FrameTransform", "FrameTransforms")
)
COMPRESSED: Final = b"\x28\xb5\x2f\xfd"
"""The first bytes of Zstandard data (RFC 8878, section 3.1.1); a message in CDR begins with a zero."""

_MAX_SHAPES: Final = 2_048
_MAX_SHAPE: Final = 256
_NUMBERS: Final = struct.Struct("<7d")
_HEADER: Final = b"\x00\x01\x00\x00"


class RawTransform(NamedTuple):
    """One transform of a message."""

    seconds: int
    nanoseconds: int
    parent: bytes
    """The name in UTF-8, as it is in the message."""
    child: bytes
    numbers: bytes
    """Seven little endian float64: x, y, z in m, and the quaternion (x, y, z, w)."""


def holds_transforms(channel: Channel) -> bool:
    """Whether the messages of a channel hold transforms, and can be read."""
    if channel.type in TF_TYPES:
        return channel.encoding in ("cdr", "ros1")
    return channel.type in FOXGLOVE_TYPES and channel.encoding in ("cdr", "ros1", "protobuf", "json")


# The bytes behind the seven numbers of the pose: 36 of a covariance, and for odometry a twist and its covariance.
_ODOMETRY: Final = {f"nav_msgs/{kind}Odometry": 8 * (36 + 6 + 36) for kind in ("msg/", "")}
_POSES: Final = {
    f"geometry_msgs/{kind}{name}": size
    for kind in ("msg/", "")
    for name, size in (("PoseStamped", 0), ("PoseWithCovarianceStamped", 8 * 36))
}


def needs_child(channel: Channel) -> bool | None:
    """Whether the messages of a channel are poses without the name of a child; None if they are not odometry either."""
    if channel.encoding not in ("cdr", "ros1"):
        return None
    return True if channel.type in _POSES else False if channel.type in _ODOMETRY else None


def _pose_parser(channel: Channel, child: str | None) -> Callable[[bytes], list[RawTransform]]:
    """The parser of odometry and poses: up to their numbers they are laid out as one transform."""
    is_cdr = channel.encoding == "cdr"
    behind = _ODOMETRY.get(channel.type) or _POSES.get(channel.type, 0)

    def parse(payload: bytes) -> list[RawTransform]:
        end = len(payload) - behind
        if end < 16:
            raise MalformedMessageError("truncated", f"{len(payload)} bytes are too few")
        message = payload[:end]
        if child is not None:
            order = ">" if is_cdr and payload[1:2] == b"\0" else "<"
            (length,) = struct.unpack_from(f"{order}I", message, 12)
            at = 16 + length
            start = at + (4 - at) % 8 if is_cdr else at
            if start + 56 != end:
                raise MalformedMessageError("truncated", f"{len(payload)} bytes do not hold one pose")
            name = child.encode() + bytes(is_cdr)
            head = message[:at] + bytes(-at % 4 if is_cdr else 0) + struct.pack(f"{order}I", len(name)) + name
            message = head + bytes((4 - len(head)) % 8 if is_cdr else 0) + message[start:]
        return _parse_cdr(message, True) if is_cdr else _parse_ros1(message, True, True)

    return parse


def parser_of(channel: Channel, child: str | None = None) -> Callable[[bytes], list[RawTransform]]:
    """The function that parses the messages of a channel, poses with a `child`; it raises `MalformedMessageError`."""
    if needs_child(channel) is not None:
        return _pose_parser(channel, child)
    single = channel.type.endswith("FrameTransform")
    if channel.encoding == "json":
        return lambda payload: _parse_json(payload, single)
    if channel.encoding == "protobuf":
        return _protobuf_parser(channel, single)
    if channel.encoding == "ros1":
        return lambda payload: _parse_ros1(payload, single, channel.type in TF_TYPES)
    return lambda payload: _parse_cdr(payload, single)


def bounded(payload: bytes) -> bytes:
    """The payload, decompressed if the recorder has compressed it.

    Raises
    ------
    MalformedMessageError
        If it is larger than `MAX_MESSAGE`, compressed or not, or cannot be decompressed.
    """
    try:
        return unfold(payload, "zstd" if payload[:4] == COMPRESSED else "", MAX_MESSAGE)
    except UnfoldError as error:
        raise MalformedMessageError("oversized" if "bound" in str(error) else "encoding", str(error)) from None


def decompressed(channel: Channel, payload: bytes) -> bytes:
    """A payload of any type, decompressed if the recorder has compressed it; raises `UnfoldError`."""
    if channel.encoding == "cdr" and payload[:4] == COMPRESSED:
        return unfold(payload, "zstd", MAX_OTHER_MESSAGE)
    return payload


def write_cdr(transforms: Sequence[RawTransform]) -> bytes:
    """A little endian ``tf2_msgs/msg/TFMessage`` in CDR; raises `MalformedMessageError` if a stamp does not fit."""
    parts = [_HEADER, struct.pack("<I", len(transforms))]
    at = 4
    for seconds, nanoseconds, parent, child, numbers in transforms:
        names = b"".join(_cdr_string(name) for name in (parent, child))
        # Behind the strings, which end at multiples of 4, the numbers begin at a multiple of 8.
        padding = bytes(-(at + 8 + len(names)) % 8)
        stamp = _pack_stamp("<iI", seconds, nanoseconds)
        parts += (stamp, names, padding, numbers)
        at += 8 + len(names) + len(padding) + 56
    return b"".join(parts)


def _cdr_string(text: bytes) -> bytes:
    # The next one is aligned to 4.
    return struct.pack("<I", len(text) + 1) + text + bytes(1 + -(len(text) + 1) % 4)


def write_ros1(transforms: Sequence[RawTransform]) -> bytes:
    """A ``tf2_msgs/TFMessage`` of ROS 1; raises `MalformedMessageError` if a stamp does not fit."""
    parts = [struct.pack("<I", len(transforms))]
    for seconds, nanoseconds, parent, child, numbers in transforms:
        parts += (bytes(4), _pack_stamp("<II", seconds, nanoseconds))
        for name in (parent, child):
            parts += (struct.pack("<I", len(name)), name)
        parts.append(numbers)
    return b"".join(parts)


def _pack_stamp(layout: str, seconds: int, nanoseconds: int) -> bytes:
    try:
        return struct.pack(layout, seconds, nanoseconds)
    except struct.error:
        raise MalformedMessageError("stamp", f"{seconds} s does not fit the stamp of a message") from None


def _parse_cdr(payload: bytes, single: bool) -> list[RawTransform]:
    order = {b"\0\0": ">", b"\0\1": "<"}.get(payload[:2])
    if order is None:
        raise MalformedMessageError("encoding", f"it is not plain CDR, its header is {payload[:4].hex(' ')}")
    body = payload[4:]
    stamp, size, numbers = struct.Struct(f"{order}iI"), struct.Struct(f"{order}I"), struct.Struct(f"{order}7d")
    found = []
    try:
        (count,) = (1,) if single else size.unpack_from(body)
        at = 0 if single else 4
        for _ in range(count):
            seconds, nanoseconds = stamp.unpack_from(body, at)
            at += 8
            names = []
            for _ in range(2):
                at = at + 3 & -4
                (length,) = size.unpack_from(body, at)
                text = body[at + 4 : at + 4 + length]
                if len(text) < length or not text.endswith(b"\0"):
                    raise MalformedMessageError("text", f"the string {text[:40]!r} does not end with NUL")
                names.append(text[:-1])
                at += 4 + length
            at = at + 7 & -8
            # Only another byte order is unpacked: that may change the bits of a NaN.
            values = body[at : at + 56] if order == "<" else _NUMBERS.pack(*numbers.unpack_from(body, at))
            at += 56
            if at > len(body):
                raise MalformedMessageError("truncated", f"{len(body)} bytes end inside of a transform")
            found.append(RawTransform(seconds, nanoseconds, names[0], names[1], values))
    except struct.error:
        raise MalformedMessageError("truncated", f"{len(body)} bytes end inside of a transform") from None
    if body[at:] not in (b"", b"\0", b"\0\0", b"\0\0\0"):
        raise MalformedMessageError("oversized", f"{len(body) - at} bytes behind the last transform")
    return found


def _parse_ros1(payload: bytes, single: bool, header: bool) -> list[RawTransform]:
    stamp, size = struct.Struct("<II"), struct.Struct("<I")
    found = []
    try:
        (count,) = (1,) if single else size.unpack_from(payload)
        at = 0 if single else 4
        for _ in range(count):
            at += 4 * header
            seconds, nanoseconds = stamp.unpack_from(payload, at)
            at += 8
            names = []
            for _ in range(2):
                (length,) = size.unpack_from(payload, at)
                names.append(payload[at + 4 : at + 4 + length])
                at += 4 + length
            numbers = payload[at : at + 56]
            at += 56
            if at > len(payload):
                raise MalformedMessageError("truncated", f"{len(payload)} bytes end inside of a transform")
            found.append(RawTransform(seconds, nanoseconds, names[0], names[1], numbers))
    except struct.error:
        raise MalformedMessageError("truncated", f"{len(payload)} bytes end inside of a transform") from None
    if at != len(payload):
        raise MalformedMessageError("oversized", f"{len(payload) - at} bytes behind the last transform")
    return found


def _parse_json(payload: bytes, single: bool) -> list[RawTransform]:
    try:
        content = json.loads(payload)
        transforms: list[dict[str, Any]] = [content] if single else content["transforms"]
        return [
            _raw(
                each["timestamp"]["sec"],
                each["timestamp"]["nsec"],
                each["parent_frame_id"],
                each["child_frame_id"],
                [each["translation"][axis] for axis in "xyz"] + [each["rotation"][axis] for axis in "xyzw"],
            )
            for each in transforms
        ]
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, struct.error, OverflowError) as error:
        raise MalformedMessageError("encoding", f"it is no JSON of Foxglove's schema: {error!r}"[:200]) from None


def _protobuf_parser(channel: Channel, single: bool) -> Callable[[bytes], list[RawTransform]]:
    def parse(payload: bytes) -> list[RawTransform]:
        try:
            message = _protobuf_decoder(channel)(payload)
            transforms: Iterable[Any] = [message] if single else message.transforms
            return [
                _raw(
                    each.timestamp.seconds,
                    each.timestamp.nanos,
                    each.parent_frame_id,
                    each.child_frame_id,
                    [getattr(each.translation, axis) for axis in "xyz"]
                    + [getattr(each.rotation, axis) for axis in "xyzw"],
                )
                for each in transforms
            ]
        except ImportError as error:
            raise MalformedMessageError(
                "missing extra", f"to read it, tfbus needs one more package: {pip_install('foxglove')} ({error})"
            ) from None
        # The schema is in the file: a damaged one raises anything.
        except Exception as error:  # noqa: BLE001
            raise MalformedMessageError("encoding", f"it is not a message of its schema: {error!r}"[:200]) from None

    return parse


@lru_cache(maxsize=64)
def _protobuf_decoder(channel: Channel) -> Callable[[bytes], Any]:
    from mcap.records import Schema
    from mcap_protobuf.decoder import DecoderFactory

    schema = Schema(id=1, name=channel.type, encoding="protobuf", data=channel.schema)
    decoder: Callable[[bytes], Any] | None = DecoderFactory().decoder_for("protobuf", schema)
    if decoder is None:
        raise ValueError("its schema is not protobuf")
    return decoder


def _raw(seconds: int, nanoseconds: int, parent: str, child: str, numbers: Sequence[float]) -> RawTransform:
    if not all(isinstance(number, int) for number in (seconds, nanoseconds)):
        raise TypeError("a stamp is not an integer")
    return RawTransform(seconds, nanoseconds, parent.encode(), child.encode(), _NUMBERS.pack(*numbers))


def _inverted(sample: TransformStamped | None) -> TransformStamped | None:
    return None if sample is None else (~sample).replace(authority=sample.authority)


Run = tuple[str, int]
"""An authority, and the number of successive transforms that it sent."""


class ChannelDecoder:
    """Gives the samples of the messages of a channel.

    Parameters
    ----------
    channel : Channel
        Its messages hold transforms.
    static : bool
        Whether its transforms are static.
    prefix : str
        A prefix for the names of all frames, after leading slashes are removed.
    child : str, optional
        The frame that is at the poses of a channel without it.
    invert : bool
        Whether the child of odometry becomes the parent.

    Attributes
    ----------
    channel, static, prefix
    authorities : tuple of (str, int)
        The authorities of successive transforms of a message, each with their number; a single one stands for all
        transforms.
    parse : callable
        Gives the transforms of a message with their bytes: see `parser_of`.
    decode_plain : callable or None
        Gives the samples of a message that `decode` would give without an error, as a tuple, or None: see
        `tfbus.tf_message.plain_decoder`. None where no message is plain.
    """

    def __init__(
        self, channel: Channel, static: bool, prefix: str = "", child: str | None = None, invert: bool = False
    ) -> None:
        self.channel = channel
        self.static = static
        self.prefix = prefix
        self.authorities: tuple[Run, ...] = _authorities(channel)
        self._count = sum(count for _, count in self.authorities)
        is_pose = needs_child(channel) is not None
        self._invert = invert and is_pose
        self._is_cdr = channel.encoding == "cdr" and not channel.type.endswith("FrameTransform") and not is_pose
        # The usual case, and several times as fast.
        self.decode_plain: Callable[[bytes], tuple[TransformStamped, ...] | None] | None = None
        if self._is_cdr and not prefix and len(self.authorities) == 1:
            self.decode_plain = plain_decoder((self.authorities[0][0], static), MAX_MESSAGE)
        self.parse: Callable[[bytes], list[RawTransform]] = parser_of(channel, child)
        self._single: set[bytes] = set()
        self._names: dict[tuple[str, str], tuple[str, str]] = {}

    def decode(self, payload: bytes) -> Decoded[TransformStamped]:
        """Decode the samples of a message, with authorities and the prefix, and without leading slashes.

        Raises
        ------
        MalformedMessageError
        """
        payload = bounded(payload)
        covariance = self._covariance(payload)
        if not self._is_cdr:
            payload = write_cdr(self.parse(payload))
        order: Literal["little", "big"] = "little" if payload[1:2] == b"\1" else "big"
        count = int.from_bytes(payload[4:8], order)
        decoded = decode(payload, self._tags(count), bare_names=True)
        if self.prefix:
            decoded.samples[:] = map(self._prefixed, decoded.samples)
        if covariance is not None:
            belief = Belief(covariance, "drift" if self.channel.type in _ODOMETRY else "independent")
            decoded.samples[:] = [sample and with_belief(sample, belief) for sample in decoded.samples]
        if self._invert:
            decoded.samples[:] = map(_inverted, decoded.samples)
        return decoded

    def _covariance(self, payload: bytes) -> Covariance | None:
        """The covariance of a pose, if its message has one that is known."""
        behind = _ODOMETRY.get(self.channel.type) or _POSES.get(self.channel.type, 0)
        if not behind or len(payload) < behind:
            return None
        order = ">" if self.channel.encoding == "cdr" and payload[1:2] == b"\0" else "<"
        return Covariance.from_ros(np.frombuffer(payload, f"{order}f8", 36, len(payload) - behind))

    def count(self, payload: bytes) -> int:
        """The number of transforms in a message; raises `MalformedMessageError` as `parse`."""
        # Messages with one transform of the same frames differ in the stamp and the numbers only.
        shape = payload[:8] + payload[16:-56]
        if shape in self._single:
            return 1
        count = len(self.parse(payload))
        # Behind the numbers there may be padding, which is not part of the shape.
        if count == 1 and self._is_cdr and len(payload) % 8 == 4 and len(shape) <= _MAX_SHAPE:
            if len(self._single) >= _MAX_SHAPES:
                self._single.clear()
            self._single.add(shape)
        return count

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
    """The authorities in the metadata of a channel; in ROS 1, the sending node."""
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


Stamps = npt.NDArray[np.int64]

_LARGE: Final = 1e9
"""m; `ChannelDecoder` decides whether a longer translation is valid."""
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
    valid: npt.NDArray[np.bool_]
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
                if not (values.valid | rest).all():
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
    """The layout of a message; None if it is unusual."""
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
    """One transform of each message; meaningless for messages of another structure."""
    times = np.ascontiguousarray(matrix[:, slot.stamp : slot.stamp + 8]).view("<u4")
    rows = np.ascontiguousarray(matrix[:, slot.numbers : slot.numbers + 56]).view("<f8")
    nanoseconds = times[:, 1]
    valid = nanoseconds < SECOND
    for axis in range(3):
        valid &= np.abs(rows[:, axis]) < _LARGE
    i, j, k, w = rows[:, 3], rows[:, 4], rows[:, 5], rows[:, 6]
    # Overflow and NaN are found by the comparison.
    with np.errstate(over="ignore", invalid="ignore"):
        square = i * i + j * j + k * k + w * w
        even = np.abs(square - 1.0) <= ROUNDING
        if not even.all():
            norm = np.sqrt(square)
            valid &= np.abs(norm - 1.0) <= NORM_TOLERANCE
            rows = rows.copy()
            uneven = valid & ~even
            rows[uneven, 3:] /= norm[uneven, None]
    seconds = times[:, 0].view(np.int32 if signed else np.uint32).astype(np.int64)
    if not signed:
        valid &= seconds < 2**31
    return _Values(seconds * SECOND + nanoseconds, rows, valid)


def _merge(parts: list[Columns]) -> Columns:
    """Several columns of one frame as one; they differ only in their samples."""
    first = parts[0]
    if len(parts) == 1:
        return first
    order = np.concatenate([part.order for part in parts])
    by_message = np.argsort(order, kind="stable")
    joined: Iterator[Any] = (np.concatenate([part[at] for part in parts])[by_message] for at in range(4, 8))
    return Columns(*first[:4], *joined)
