"""The covariances of recorded transforms, in messages of their own that other readers skip.

A message of transforms has no place for them. So a message with the covariances of some of its transforms comes right
before it, with the same log time, on its topic with ``_covariance`` behind, such as ``/tf_covariance``. Its type is our
own. Each covariance names parent, child and stamp of its transform, and a reader gives it to the next transform with
these. So a message that is lost, damaged or hostile takes covariances away, and no transform.
"""

import struct
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from tfbus.geometry.covariance import KINDS, Covariance
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.uncertain import Belief, UncertainSample
from tfbus.recording.formats.storage import Channel
from tfbus.stamps import SECOND
from tfbus.tf_message import MAX_NAME, FieldReader, MalformedMessageError

SUFFIX: Final = "_covariance"
TYPE: Final = "tfbus_msgs/msg/TransformCovariances"
MAX_COVARIANCES: Final = 2_000
"""The most covariances that are written into one message, so that a reader never refuses it for its size."""
_SEPARATOR = f"\n{'=' * 80}\n"
SCHEMA: Final = _SEPARATOR.join(
    (
        "# The errors of transforms in the next message on the topic without _covariance\n"
        "tfbus_msgs/TransformCovariance[] covariances",
        "MSG: tfbus_msgs/TransformCovariance\n"
        "# Stamp and frames of the transform\nstd_msgs/Header header\nstring child_frame_id\n"
        "# The relation of the errors at two stamps: independent, drift or constant\nstring kind\n"
        "# As in geometry_msgs/PoseWithCovariance, along the axes of header.frame_id\nfloat64[36] covariance",
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
    )
).encode()

Key = tuple[str, str, int]
"""Parent, child and stamp of a transform."""


class RawCovariance(NamedTuple):
    """The covariance of one transform, as it is in a message."""

    stamp: int
    parent: bytes
    child: bytes
    kind: bytes
    numbers: tuple[float, ...]
    """36, row by row."""


def holds_covariances(channel: Channel) -> bool:
    """Whether the messages of a channel hold covariances."""
    known = channel.type in (TYPE, TYPE.replace("/msg/", "/")) and channel.encoding in ("cdr", "ros1")
    return known and channel.topic.endswith(SUFFIX)


def covariance_channel(topic: str, metadata: dict[str, str]) -> Channel:
    """The channel of covariances on a topic that ends in `SUFFIX`."""
    return Channel(topic, TYPE, "cdr", "ros2msg", SCHEMA, metadata)


def covariances_of(samples: Iterable[TransformStamped]) -> list[RawCovariance]:
    """The covariances of samples that have one."""
    return [
        RawCovariance(
            sample.stamp,
            sample.parent.encode(),
            sample.child.encode(),
            sample.kind.encode(),
            tuple(sample.covariance.to_dict()),
        )
        for sample in samples
        if isinstance(sample, UncertainSample)
    ]


def write_covariances(covariances: Sequence[RawCovariance]) -> bytes:
    """A message in little endian CDR; raises `MalformedMessageError` if a stamp does not fit."""
    body = bytearray(struct.pack("<I", len(covariances)))
    for stamp, parent, child, kind, numbers in covariances:
        try:
            body += struct.pack("<iI", *divmod(stamp, SECOND))
        except struct.error:
            raise MalformedMessageError("stamp", f"{stamp} ns does not fit the stamp of a message") from None
        for text in (parent, child, kind):
            body += struct.pack("<I", len(text) + 1) + text + b"\0"
            body += bytes(-len(body) % 4)
        body += bytes(-len(body) % 8) + struct.pack("<36d", *numbers)
    return b"\0\1\0\0" + body


def read_covariances(payload: bytes, ros1: bool) -> list[RawCovariance]:
    """The covariances in a message; raises `MalformedMessageError`."""
    try:
        fields = FieldReader(payload, ros1)
        # The reader takes the first number in ROS 1 for that of a header.
        count = struct.unpack_from("<I", payload)[0] if ros1 else fields.count()
        found = []
        for _ in range(count):
            if ros1:
                fields.count()
            stamp, parent = fields.header()
            found.append(RawCovariance(stamp, parent, fields.text(), fields.text(), fields.doubles(36)))
    except struct.error:
        raise MalformedMessageError("covariance", f"{len(payload)} bytes end inside of a covariance") from None
    return found


def beliefs_in(payload: bytes, ros1: bool, prefix: str) -> dict[Key, Belief]:
    """The covariances in a message, by names with a prefix; raises `MalformedMessageError` if one is none."""
    found = {}
    for each in read_covariances(payload, ros1):
        try:
            parent, child, kind = each.parent.decode(), each.child.decode(), each.kind.decode()
            if kind not in KINDS or len(each.parent) > MAX_NAME or len(each.child) > MAX_NAME:
                raise ValueError(f"of an unknown kind {kind[:40]!r}, or of a name of more than {MAX_NAME} bytes")
            belief = Belief(Covariance(each.numbers), kind)
        except ValueError as error:
            raise MalformedMessageError("covariance", f"the covariance of a transform is none: {error}") from None
        found[prefix + parent.lstrip("/"), prefix + child.lstrip("/"), each.stamp] = belief
    return found
