"""Conversion of messages between CDR and the encoding of ROS 1, by the definitions of their types."""

from functools import cache
from typing import Any, Final

from tfbus.recording.formats._storage import Channel

_HEADER: Final = "std_msgs/msg/Header"
_HEADER_OF_ROS1: Final = "uint32 seq\ntime stamp\nstring frame_id\n"


class MessageTypes:
    """The types of the messages of some channels: those of ROS 2 Humble, and those that files define."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        self._known: set[Channel] = set()

    @staticmethod
    def name(kind: str) -> str:
        """The name of a type in ROS 2; raises `ValueError` if it has no package."""
        package, _, last = kind.rpartition("/")
        if not package:
            raise ValueError(f"{kind!r} is no name of a type of ROS")
        return f"{package.removesuffix('/msg')}/msg/{last}"

    def convert(self, channel: Channel, payload: bytes) -> bytes:
        """A payload in the other of the two encodings.

        Raises
        ------
        ValueError
            If the type is not known, or the payload is none of that type.
        """
        self._register(channel)
        kind = self.name(channel.type)
        try:
            convert = self._store.ros1_to_cdr if channel.encoding == "ros1" else self._store.cdr_to_ros1
            return bytes(convert(payload, kind))
        # For damaged bytes and definitions, rosbags raises more than its own errors.
        except Exception as error:  # noqa: BLE001
            raise ValueError(f"a message of type {channel.type} cannot be converted: {error!r}"[:200]) from None

    def ros1_definition(self, channel: Channel) -> tuple[str, str]:
        """The definition of a channel's type in ROS 1, and its MD5 sum; raises `ValueError` if it is not known."""
        digest = channel.metadata.get("md5sum")
        if channel.schema_encoding == "ros1msg" and digest:
            return channel.schema.decode(errors="replace"), digest
        self._register(channel)
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store: Any = get_typestore(Stores.EMPTY)
        # The payloads that `convert` gives have the number too.
        store.fielddefs.update(self._store.fielddefs, **get_types_from_msg(_HEADER_OF_ROS1, _HEADER))
        try:
            definition, digest = store.generate_msgdef(self.name(channel.type), ros_version=1)
        except Exception as error:  # noqa: BLE001
            raise ValueError(f"the type {channel.type} has no definition: {error!r}"[:200]) from None
        return definition, digest

    def _register(self, channel: Channel) -> None:
        """Add the types that the definition of a channel has and the store does not."""
        if channel in self._known:
            return
        self._known.add(channel)
        if channel.schema_encoding in ("ros1msg", "ros2msg") and channel.schema:
            from rosbags.typesys import get_types_from_msg

            try:
                found = get_types_from_msg(channel.schema.decode(errors="replace"), self.name(channel.type))
                self._store.register({name: each for name, each in found.items() if name not in self._store.fielddefs})
            except Exception as error:  # noqa: BLE001
                raise ValueError(f"the definition of {channel.type} cannot be read: {error!r}"[:200]) from None


@cache
def types_with_header() -> frozenset[str]:
    """The types of ROS 2 Humble that begin with a header."""
    from rosbags.typesys import Stores, get_typestore

    definitions = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    return frozenset(kind for kind, (_, fields) in definitions.items() if fields and _HEADER in str(fields[0]))
