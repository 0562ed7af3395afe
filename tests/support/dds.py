"""Programs in a DDS domain: a node of ROS 2 in this process, and one with Cyclone DDS in a process of its own."""

import sys
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from support import both_sides

from tfbus import TransformStamped
from tfbus.links.dds.dds_link import configuration, domain
from tfbus.links.dds.types import Gid, NodeEntitiesInfo, ParticipantEntitiesInfo, RawTFMessage
from tfbus.tf_message import encode

CONFIG = configuration("localhost")
_RELIABLE = Policy.Reliability.Reliable(duration(seconds=10)), Policy.DataRepresentation(use_cdrv0_representation=True)
MOVING = Qos(*_RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(100))
LATCHED = Qos(*_RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
"""The qualities of tf2's broadcasters."""


def cyclone_node(domain_number: int) -> AbstractContextManager[both_sides.Node]:
    """A node of another program, in a process of its own."""
    peer = Path(__file__).with_name("cyclone_peer.py")
    variables = {"ROS_DOMAIN_ID": f"{domain_number}", "CYCLONEDDS_URI": CONFIG}
    return both_sides.node([sys.executable, str(peer)], variables, 60.0)


class DdsNode:
    """A participant that may say anything, in this process.

    Parameters
    ----------
    number : int
        The domain.
    user_data : bytes
        ROS 2 gives ``enclave=...``.
    name : str
        Of the participant; none if it is empty.
    """

    def __init__(self, number: int, user_data: bytes = b"", name: str = "") -> None:
        self._stack = ExitStack()
        self._stack.enter_context(domain(number, CONFIG))
        named = [Policy.EntityName(name)] if name else []
        self.participant = DomainParticipant(number, Qos(Policy.Userdata(user_data), *named))
        self._stack.callback(self.participant.__del__)
        self.id: str = self.participant.guid.hex
        self._writers: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def writer(self, topic: str, kind: Any = RawTFMessage) -> Any:
        """The writer of a topic, as it is called in DDS."""
        if topic not in self._writers:
            latched = topic.endswith("/tf_static") or topic in ("rt/robot_description", "ros_discovery_info")
            made = DataWriter(self.participant, Topic(self.participant, topic, kind), LATCHED if latched else MOVING)
            self._writers[topic] = made
            self._stack.callback(self.silence, topic)
        return self._writers[topic]

    def silence(self, topic: str) -> None:
        """Delete the writer of a topic."""
        writer = self._writers.pop(topic, None)
        if writer is not None:
            writer.__del__()

    def reader(self, topic: str, kind: Any = RawTFMessage, qos: Qos = LATCHED) -> DataReader[Any]:
        reader: DataReader[Any] = DataReader(self.participant, Topic(self.participant, topic, kind), qos)
        self._stack.callback(reader.__del__)
        return reader

    def say(self, *samples: TransformStamped, topic: str = "rt/tf") -> None:
        self.writer(topic).write(RawTFMessage.of(encode(samples)))

    def names(self, namespace: str, name: str) -> ParticipantEntitiesInfo:
        """The message that all of these writers belong to one node."""
        gid: Any = Gid
        make: Any = NodeEntitiesInfo
        told = [gid(list(writer.guid.bytes)) for writer in self._writers.values()]
        nodes: Any = [make(namespace, name, [], told)]
        return ParticipantEntitiesInfo(gid(list(self.participant.guid.bytes)), nodes)

    def tell_name(self, namespace: str, name: str) -> None:
        self.writer("ros_discovery_info", ParticipantEntitiesInfo).write(self.names(namespace, name))
