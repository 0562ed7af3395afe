"""A node of ROS 2 with Cyclone DDS: what rmw_cyclonedds_cpp writes and reads, by a program that has no ROS.

It does what `ros_driver.py` says, sends the static ``base:laser``, x = 0.5, and tells that its node is ``/cyclone``. It
shares no code with tfbus; ``CYCLONEDDS_URI`` and ``ROS_DOMAIN_ID`` are its settings.
"""

import os
import time
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Listener
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, bounded_str, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from ros_driver import Chain, Driver  # type: ignore[import-not-found]


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    data: array[uint8, 16]


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    node_namespace: bounded_str[256]
    node_name: bounded_str[256]
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]


# As rmw_cyclonedds_cpp makes them of the profiles of tf2's broadcasters and listeners, but that a program does not hear
# itself: in Python, a listener and a write would wait for each other.
COMMON = (
    Policy.Reliability.Reliable(duration(infinite=True)),
    Policy.WriterDataLifecycle(autodispose=False),
    Policy.IgnoreLocal.Participant,
)
MOVING = Qos(*COMMON, Policy.Durability.Volatile, Policy.History.KeepLast(100))


def static(depth: int) -> Qos:
    service = Policy.DurabilityService(0, Policy.History.KeepLast(depth), -1, -1, -1)
    latched = Policy.Durability.TransientLocal
    return Qos(*COMMON, latched, Policy.History.KeepLast(depth), service)


def gid(entity: Any) -> Any:
    data: Any = list(entity.guid.bytes)
    return Gid(data)


def message(parent: str, child: str, stamp: int, x: float) -> Any:
    make: Any = Time
    transform: Any = Transform(Vector3(x, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
    row: Any = [TransformStamped(Header(make(*divmod(stamp, 10**9)), parent), child, transform)]
    return TFMessage(row)


def main() -> None:
    driver, chain = Driver(), Chain()
    enclave = Policy.Userdata(b"enclave=/;")
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]), Qos(enclave))
    topics = {name: Topic(participant, f"rt/{name}", TFMessage) for name in ("tf", "tf_static")}
    moving, latched = (
        DataWriter(participant, topics["tf"], MOVING),
        DataWriter(participant, topics["tf_static"], static(1)),
    )

    def hear(name: str) -> DataReader[TFMessage]:
        def take(_: object) -> None:
            for each in readers[name].take(N=100):
                # A sample without data tells of a writer that has gone.
                for row in getattr(each, "transforms", ()):
                    stamp = row.header.stamp.sec * 10**9 + row.header.stamp.nanosec
                    x = row.transform.translation.x
                    chain.take(row.header.frame_id, row.child_frame_id, stamp, x, static=name == "tf_static")
                    driver.hear(row.child_frame_id, stamp)

        readers[name] = DataReader(participant, topics[name], MOVING if name == "tf" else static(100))
        readers[name].set_listener(Listener(on_data_available=take))
        take(None)
        return readers[name]

    readers: dict[str, DataReader[TFMessage]] = {}
    subscriptions: Any = [gid(hear(name)) for name in topics]
    publishers: Any = [gid(moving), gid(latched)]
    make: Any = NodeEntitiesInfo
    nodes: Any = [make("/", "cyclone", subscriptions, publishers)]
    told = Topic(participant, "ros_discovery_info", ParticipantEntitiesInfo)
    info = DataWriter(participant, told, static(1))
    info.write(ParticipantEntitiesInfo(gid(participant), nodes))
    latched.write(message("base", "laser", time.time_ns(), driver.x))

    def send(stamp: int, x: float) -> None:
        moving.write(message("odom", "base", stamp, x))
        chain.take("odom", "base", stamp, x, static=False)

    driver.run(send, chain.ask)
    for reader in readers.values():
        reader.set_listener(None)


if __name__ == "__main__":
    main()
