"""The messages of the rosbridge protocol, version 2, as far as transforms need them.

``cbor-raw`` gives a message of ROS as its bytes, ``cbor`` its fields in CBOR, and anything else JSON. A server that
does not know an encoding uses another, so the answer is read as it comes.

Nothing that a server sends may keep the event loop, and the decoders of JSON and CBOR keep it until they are done, in a
thread too. So they are given at most `MAX_VALUE` bytes: a message that is larger is taken apart here, and each of its
transforms is decoded for itself. Of CBOR, only what JSON has too is taken. A map of other keys than text could be made
so that all keys have one hash, and the values of most tags are worth a decoder of their own: numbers of any size,
regular expressions, references.
"""

import json
import re
from collections.abc import Awaitable, Callable, Iterator, Sequence
from io import BytesIO
from typing import Any, Final, NamedTuple, NoReturn, TypeVar

import cbor2

from tfbus.geometry.stamped import TransformStamped
from tfbus.links.replica import FromLink, ReceivedTransform
from tfbus.links.ros.messages import (
    as_mapping,
    decode_mapping,
    decode_odometry,
    decode_ros1,
    decode_ros1_in_parts,
    stamp_of,
)
from tfbus.links.ros.ros_link import AT_ONCE, MAX_SIZE, PART
from tfbus.links.ros.settings import Other
from tfbus.robot.joint_state_message import decode_joint_state
from tfbus.tf_message import Decoded, MalformedMessageError, decode, decode_in_parts

TYPE: Final = "tf2_msgs/TFMessage"
"""ROS 2 takes this name too."""
OTHER_TYPES: Final[dict[Other, str]] = {
    "joints": "sensor_msgs/JointState",
    "clock": "rosgraph_msgs/Clock",
    "description": "std_msgs/String",
    "odometry": "nav_msgs/Odometry",
}
QUEUE: Final = 100
_CDR: Final = b"\0\1\0\0"
_DOUBLES: Final = 86
"""The tag of little endian float64 (RFC 8746)."""
MOST_TRANSFORMS: Final = MAX_SIZE // 128
"""More of them in one message are no transforms."""
_MOST_FIELDS: Final = 100
MAX_VALUE: Final = 2**14
"""The largest value in a large message, in bytes or characters, other than text and bytes."""
MAX_TEXT: Final = 3 * 2**20
"""The longest text in a large message of JSON, in characters as it is written: all escapes take less than 5 ms."""
_DEPTH: Final = 20
_MAP, _ARRAY, _TEXT, _BYTES = 5, 4, 3, 2
"""Major types of CBOR (RFC 8949, section 3.1)."""

GiveWay = Callable[[], Awaitable[None]]


def _refuse_tag(_decoder: Any, _immutable: bool) -> NoReturn:
    raise ValueError("a tag that no message of ROS has")


_NO_TAGS: Final = dict.fromkeys(
    (*range(6), 25, 28, 29, 30, 35, 36, 37, 52, 54, 100, 256, 258, 260, 261, 1004, 43000, 55799), _refuse_tag
)
"""All tags that the library decodes itself."""


class Incoming(NamedTuple):
    """A message of the server."""

    topic: str
    """Empty if the server only tells of its status."""
    content: Any
    """The argument of `decode_content`, or the text of the status."""
    encoding: str
    """``"cbor-raw"``, ``"cbor"`` or ``"none"``, for a message in JSON."""


def subscribe(topic: str, encoding: str, type_: str = TYPE) -> str:
    """The request for all messages of a topic."""
    return _request("subscribe", topic, type=type_, queue_length=0, compression=encoding)


def unsubscribe(topic: str) -> str:
    """The request for no more messages of a topic."""
    return _request("unsubscribe", topic)


def advertise(topic: str, static: bool) -> str:
    """The announcement of messages on a topic; the last one is kept for late joiners if they are static."""
    return _request("advertise", topic, type=TYPE, latch=static, queue_size=1 if static else QUEUE)


def publish(topic: str, samples: Sequence[TransformStamped], static: bool = False) -> str:
    """A message of transforms for a topic, which is advertised with the same `static`."""
    request = {"op": "publish", "topic": topic, "msg": {"transforms": list(map(as_mapping, samples))}}
    # A server of ROS 2 would else warn at each message, and if its logger fails, refuse it.
    return json.dumps({**request, "latch": True, "queue_size": 1} if static else request)


def read(message: str | bytes) -> Incoming:
    """A message of the server that is not `is_large`.

    Raises
    ------
    MalformedMessageError
        If it is none.
    """
    try:
        content = json.loads(message) if isinstance(message, str) else _loads(message)
    # For deep or huge messages, the two decoders raise errors of several kinds.
    except Exception as error:  # noqa: BLE001
        raise MalformedMessageError("encoding", f"it is neither JSON nor CBOR: {error!r}"[:200]) from None
    return _incoming(content, isinstance(message, str))


def is_large(message: str | bytes) -> bool:
    """Whether a message is for `read_large`."""
    return len(message) > AT_ONCE


class LargeMessage:
    """The transforms of a large message.

    Attributes
    ----------
    parts : list of Decoded
        At most `PART` transforms in each.
    of_ros2 : bool
        Whether it comes from ROS 2.
    """

    __slots__ = ("of_ros2", "parts")

    def __init__(self) -> None:
        self.parts: list[Decoded[ReceivedTransform]] = []
        self.of_ros2: bool = False


async def read_large(message: str | bytes, give_way: GiveWay) -> Incoming:
    """A message of the server of any size, read a piece at a time; its transforms are decoded as `LargeMessage`.

    Parameters
    ----------
    message : str or bytes
    give_way : callable
        Awaited after each piece.

    Raises
    ------
    MalformedMessageError
        If it is none; or has a field of JSON's text of more than `MAX_TEXT` characters, or one other than text, bytes
        and the transforms of more than `MAX_VALUE` bytes.
    """
    source = _Json(message) if isinstance(message, str) else _Cbor(message)
    transforms = LargeMessage()
    try:
        envelope: dict[str, Any] = {}
        for name in _few(source.fields()):
            fields = source.fields() if name == "msg" else None
            if fields is None:
                envelope[name] = source.value()
            else:
                envelope[name] = inner = {}
                for field in _few(fields):
                    items = source.items() if field == "transforms" else None
                    if items is None:
                        inner[field] = source.value()
                    else:
                        await _read_transforms(source, items, transforms, give_way)
                        inner[field] = transforms
                    await give_way()
            await give_way()
        source.end()
        return _incoming(envelope, isinstance(message, str))
    except Exception as error:
        # To free all of them takes long, too.
        while transforms.parts:
            del transforms.parts[-1]
            await give_way()
        if isinstance(error, MalformedMessageError):
            raise
        detail = f"it is neither JSON nor CBOR, or has too long a value: {error!r}"
        raise MalformedMessageError("encoding", detail[:200]) from None


async def _read_transforms(
    source: "_Json | _Cbor", items: Iterator[None], message: LargeMessage, give_way: GiveWay
) -> None:
    rows: list[Any] = []
    for number, _ in enumerate(items, 1):
        if number > MOST_TRANSFORMS:
            raise MalformedMessageError("oversized", f"it has more than {MOST_TRANSFORMS} transforms")
        rows.append(source.value())
        if number == 1:
            message.of_ros2 = is_of_ros2({"transforms": rows})
        if len(rows) == PART:
            message.parts.append(decode_mapping({"transforms": rows}))
            rows = []
        await give_way()
    message.parts.append(decode_mapping({"transforms": rows}))


def _few(names: Iterator[str] | None) -> Iterator[str]:
    if names is None:
        raise MalformedMessageError("encoding", "it is no message of rosbridge")
    for number, name in enumerate(names):
        if number == _MOST_FIELDS:
            raise MalformedMessageError("oversized", f"it has more than {_MOST_FIELDS} fields")
        yield name


class _Json:
    """Takes a message in JSON apart."""

    _SPACE = re.compile(r"[ \t\n\r]{0,100}")
    _DECODER = json.JSONDecoder()

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0

    def fields(self) -> Iterator[str] | None:
        """The names of the fields of a map; take the `value` of each. None if there is something else."""
        return self._names() if self._opens("{") else None

    def items(self) -> Iterator[None] | None:
        """Something for each item of an array; take the `value` of each. None if there is something else."""
        return self._places() if self._opens("[") else None

    def value(self) -> Any:
        """The next value: text of at most `MAX_TEXT` characters, or something else of at most `MAX_VALUE`."""
        self._skip()
        if self._text.startswith('"', self._at):
            value, end = self._DECODER.raw_decode(self._text[self._at : self._at + MAX_TEXT])
            self._at += end
            return value
        window = self._text[self._at : self._at + MAX_VALUE]
        value, end = self._DECODER.raw_decode(window)
        if end == MAX_VALUE:
            # A number may go on.
            raise ValueError("cut off")
        self._at += end
        return value

    def end(self) -> None:
        """Nothing may follow."""
        self._skip()
        if self._at < len(self._text):
            raise ValueError("something follows")

    def _names(self) -> Iterator[str]:
        if self._opens("}"):
            return
        while True:
            name = self.value()
            if not isinstance(name, str):
                raise TypeError("a name that is no text")
            self._take(":")
            yield name
            if self._take(",}") == "}":
                return

    def _places(self) -> Iterator[None]:
        if self._opens("]"):
            return
        while True:
            yield
            if self._take(",]") == "]":
                return

    def _skip(self) -> None:
        space = self._SPACE.match(self._text, self._at)
        if space is not None:
            self._at = space.end()

    def _opens(self, bracket: str) -> bool:
        self._skip()
        opens = self._text.startswith(bracket, self._at)
        self._at += opens
        return opens

    def _take(self, characters: str) -> str:
        self._skip()
        character = self._text[self._at]
        if character not in characters:
            raise ValueError(f"{character!r} at {self._at}")
        self._at += 1
        return character


class _Cbor:
    """Takes a message in CBOR apart; what `_Json` says holds here too."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def fields(self) -> Iterator[str] | None:
        return self._names(self._head()) if self._data[self._at] >> 5 == _MAP else None

    def items(self) -> Iterator[None] | None:
        return iter([None] * min(self._head(), MOST_TRANSFORMS + 1)) if self._data[self._at] >> 5 == _ARRAY else None

    def value(self) -> Any:
        kind = self._data[self._at] >> 5
        if kind in (_TEXT, _BYTES):
            size = self._head()
            held = self._data[self._at : self._at + size]
            if len(held) < size:
                raise ValueError("cut off")
            self._at += size
            return held.decode() if kind == _TEXT else held
        window = BytesIO(self._data[self._at : self._at + MAX_VALUE])
        value = _decoder(window).decode()
        self._at += window.tell()
        return value

    def end(self) -> None:
        if self._at < len(self._data):
            raise ValueError("something follows")

    def _names(self, count: int) -> Iterator[str]:
        for _ in range(count):
            name = self.value()
            if not isinstance(name, str):
                raise TypeError("a name that is no text")
            yield name

    def _head(self) -> int:
        """The length of the next item (RFC 8949, section 3)."""
        info = self._data[self._at] & 31
        self._at += 1
        if info < 24:
            return info
        size = 1 << (info - 24)
        if size > 8:
            raise ValueError("a length that is not told")
        length = self._data[self._at : self._at + size]
        self._at += size
        return int.from_bytes(length)


def _decoder(source: BytesIO) -> cbor2.CBORDecoder:
    return cbor2.CBORDecoder(source, semantic_decoders=_NO_TAGS, strict_hashable_types=True, max_depth=_DEPTH)


def _loads(message: bytes) -> Any:
    source = BytesIO(message)
    content = _decoder(source).decode()
    if source.tell() < len(message):
        raise ValueError("something follows")
    return content


def _incoming(content: Any, is_text: bool) -> Incoming:
    operation = content.get("op") if isinstance(content, dict) else None
    if not isinstance(operation, str):
        raise MalformedMessageError("encoding", f"a {type(content).__name__} without an operation is no message")
    topic, inner = content.get("topic"), content.get("msg")
    if operation == "publish" and isinstance(topic, str):
        encoding = "none" if is_text else "cbor"
        if isinstance(inner, dict):
            raw, transforms = inner.get("bytes"), inner.get("transforms")
            if isinstance(transforms, LargeMessage):
                return Incoming(topic, transforms, encoding)
            if isinstance(raw, bytes):
                return Incoming(topic, raw, "cbor-raw")
        return Incoming(topic, inner, encoding)
    said = inner if isinstance(inner, str) else ""
    return Incoming("", f"{operation}: {said}"[:200], "none")


def decode_content(content: Any) -> Decoded[ReceivedTransform]:
    """The transforms of a message, in bytes of either ROS or as a mapping.

    Raises
    ------
    MalformedMessageError
        If it holds none.
    """
    if not isinstance(content, bytes):
        return decode_mapping(content)
    if content[:2] in (b"\0\0", b"\0\1"):
        try:
            return decode(content, kind=ReceivedTransform, bare_names=True)
        except MalformedMessageError:
            # 256 transforms of ROS 1 begin like that.
            return decode_ros1(content)
    return decode_ros1(content)


def decode_content_in_parts(content: Any) -> Iterator[Decoded[ReceivedTransform]]:
    """The transforms of a large message, at most `PART` of them at a time.

    Raises
    ------
    MalformedMessageError
        At the first fault.
    """
    if isinstance(content, LargeMessage):
        content.parts.reverse()
        while content.parts:
            yield content.parts.pop()
        return
    if content[:2] in (b"\0\0", b"\0\1"):
        parts = decode_in_parts(content, PART, ReceivedTransform, bare_names=True)
        try:
            first = next(parts, None)
        except MalformedMessageError:
            # As in `decode_content`.
            pass
        else:
            if first is not None:
                yield first
            yield from parts
            return
    yield from decode_ros1_in_parts(content, PART)


def is_of_ros2(content: Any) -> bool:
    """Whether the content of a message of transforms tells that it comes from ROS 2."""
    if isinstance(content, LargeMessage):
        return content.of_ros2
    if isinstance(content, bytes):
        return len(content) > len(_CDR) and content.startswith(_CDR)
    try:
        return "sec" in content["transforms"][0]["header"]["stamp"]
    except (LookupError, TypeError):
        return False


T = TypeVar("T")


def _of_either(content: bytes, decode_bytes: Callable[[bytes, bool], T]) -> T:
    """Decode bytes of either ROS."""
    if content.startswith(_CDR):
        try:
            return decode_bytes(content, False)
        except MalformedMessageError:
            # The message with the number 256 of ROS 1 begins like that.
            return decode_bytes(content, True)
    return decode_bytes(content, True)


def decode_odometry_of(content: Any) -> Decoded[FromLink]:
    """The transform of odometry, in bytes of either ROS or as a mapping; raises `MalformedMessageError`."""
    if isinstance(content, bytes):
        return _of_either(content, decode_odometry)
    return decode_odometry(content, ros1=False, doubles=_doubles)


def _doubles(array: Any) -> Any:
    """The numbers of an array of float64 in CBOR; any other value itself."""
    if isinstance(array, cbor2.CBORTag) and array.tag == _DOUBLES:
        return memoryview(array.value).cast("B").cast("d")
    return array


def decode_joints(content: Any) -> tuple[int, dict[str, float]]:
    """The stamp and the positions of joints of a message, in bytes of either ROS or as a mapping.

    Raises
    ------
    MalformedMessageError
        If it holds none.
    """
    if isinstance(content, bytes):
        return _of_either(content, decode_joint_state)
    try:
        stamp, names = stamp_of(content["header"]["stamp"]), content["name"]
        positions = _doubles(content["position"])
        if len(positions) < len(names):
            raise MalformedMessageError("positions", f"there are {len(names)} names, and {len(positions)} positions")
        return stamp, {str(name): float(position) for name, position in zip(names, positions, strict=False)}
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, MalformedMessageError):
            raise
        raise MalformedMessageError("encoding", f"it has not the fields of a JointState: {error!r}"[:200]) from None


def _request(operation: str, topic: str, **arguments: Any) -> str:
    return json.dumps({"op": operation, "id": f"tfbus:{topic}", "topic": topic, **arguments})
