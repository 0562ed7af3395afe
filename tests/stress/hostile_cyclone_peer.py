"""A DDS program that is met as a node of ROS 2 and sends what it likes: ``SEED CASES`` are its arguments.

It prints ``up`` when a link reads all of its topics, sends mutated messages, and prints how many it sent by topic. Then
it sends ``map:last`` until its input ends. Cyclone DDS writes nothing without the layout of the type. So such bytes
go out as UDP packets in the name of a writer that Cyclone DDS has announced.
"""

import json
import os
import socket
import struct
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from random import Random
from typing import Any

from cyclone_peer import COMMON, Header, NodeEntitiesInfo, ParticipantEntitiesInfo, TFMessage, Time, gid, message  # type: ignore[import-not-found]
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, sequence
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic

LARGE = 20_000


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Clock(IdlStruct, typename="rosgraph_msgs::msg::dds_::Clock_"):
    clock: Time


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


MOVING = Qos(*COMMON, Policy.Durability.Volatile, Policy.History.KeepAll)
LATCHED = Qos(*COMMON, Policy.Durability.TransientLocal, Policy.History.KeepLast(100))
NUMBERS = [0, 1, 2, 7, 2**8, 2**15, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1]


def transforms(count: int, start: int = 0) -> Any:
    rows = [message("map", f"frame{number}", number, 1.5).transforms[0] for number in range(start, start + count)]
    return TFMessage(rows)


def mutated(random: Random, good: bytes) -> bytes:
    data = bytearray(good)
    for _ in range(random.choice([1, 1, 1, 2, 5])):
        at = random.randrange(len(data) + 1)
        match random.randrange(6):
            case 0:
                aligned = at - at % 4
                data[aligned : aligned + 4] = struct.pack("<I", random.choice(NUMBERS))
            case 1:
                del data[at : at + random.choice([1, 4, 8, 100, len(data)])]
            case 2:
                # A number, at its place: the layout of the message stays.
                place = data.find(struct.pack("<d", 1.5))
                if place >= 0:
                    number = random.choice([float("nan"), float("inf"), -1e308, 1e13, 1e-320])
                    data[place : place + 8] = struct.pack("<d", number)
            case 3:
                # Names keep their length, and are no text, have an end inside, or are none.
                place = data.find(random.choice([b"frame", b"map", b"joint", b"<robot", b"cyclone"]))
                if place >= 0:
                    wrong = [b"\xff\xfe\xfd", b"a\0b", b"///", b"\n\x1b[", b"\xed\xa0\x80"]
                    data[place : place + 3] = random.choice(wrong)
            case 4:
                data[at : at + 1] = random.randbytes(1)
            case _:
                data[at:at] = random.randbytes(random.choice([1, 4, 8, 1_000]))
    return bytes(data)


class Forged:
    """Packets in the name of a writer that itself writes nothing, to all ports of DDS of this machine."""

    def __init__(self, participant: DomainParticipant, topic: Any, qos: Qos) -> None:
        self.writer: DataWriter[Any] = DataWriter(participant, topic, qos)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._number = 0

    def send(self, payload: bytes) -> None:
        self._number += 1
        guid = self.writer.guid.bytes
        # DDSI-RTPS 2.5, 9.4: the header, and a DATA submessage to the end of the packet, little endian with data.
        head = (
            b"RTPS\2\1\1\x10" + guid[:12] + struct.pack("<BBHHH4x4siI", 0x15, 5, 0, 0, 16, guid[12:], 0, self._number)
        )
        packet = head + payload + bytes(-len(payload) % 4)
        domain = int(os.environ["ROS_DOMAIN_ID"])
        for port in range(7410 + 250 * domain, 7410 + 250 * domain + 8):
            with suppress(OSError):
                self._socket.sendto(packet, ("127.0.0.1", port))


def main() -> None:
    seed, cases = map(int, sys.argv[1:])
    random, make = Random(seed), Time
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]), Qos(Policy.Userdata(b"enclave=/;")))
    kinds = {
        "rt/tf": TFMessage,
        "rt/tf_static": TFMessage,
        "rt/joint_states": JointState,
        "rt/clock": Clock,
        "rt/robot_description": String,
        "ros_discovery_info": ParticipantEntitiesInfo,
    }
    topics = {name: Topic(participant, name, kind) for name, kind in kinds.items()}
    latched = {"rt/tf_static", "rt/robot_description", "ros_discovery_info"}
    writers = {
        name: DataWriter(participant, topic, LATCHED if name in latched else MOVING) for name, topic in topics.items()
    }
    node: Any = NodeEntitiesInfo("/", "cyclone", [], [gid(writers["rt/tf"]), gid(writers["rt/tf_static"])])
    joints: Any = JointState
    header: Any = Header(make(1, 2), "frame")
    good: dict[str, list[Any]] = {
        "rt/tf": [transforms(1), transforms(3), transforms(200)],
        "rt/tf_static": [transforms(1, 1_000), transforms(20, 1_000)],
        "rt/joint_states": [joints(header, ["joint1", "joint2"], [1.5, 2.5], [], [])],
        "rt/clock": [Clock(make(5, 6))],
        "rt/robot_description": [String("<robot/>")],
        "ros_discovery_info": [ParticipantEntitiesInfo(gid(participant), [node])],
    }
    forged = {
        name: Forged(participant, topic, LATCHED if name in latched else MOVING) for name, topic in topics.items()
    }
    # A link with an authority of its own does not read the names of nodes.
    read = [writer for name in kinds if name != "ros_discovery_info" for writer in (writers[name], forged[name].writer)]
    while not all(writer.get_matched_subscriptions() for writer in read):
        time.sleep(0.01)
    # Until then, the link does not know where the messages of the writer begin.
    time.sleep(1.0)
    print(json.dumps({"event": "up"}), flush=True)
    sent: Counter[str] = Counter()

    def say(name: str, payload: bytes) -> None:
        sample: Any = good[name][0]
        sample.serialize = lambda **_: payload
        writers[name].write(sample)
        sent[name] += 1

    names = ["rt/tf"] * 5 + list(kinds)
    bytes_of = {name: [each.serialize() for each in all_] for name, all_ in good.items()}
    for _ in range(cases):
        name = random.choice(names)
        forged[name].send(mutated(random, random.choice(bytes_of[name])))
        sent[name] += 1
        # The buffers of UDP hold some hundred packets.
        time.sleep(0.0005)
    # Large ones whose layout is right: as many as fit, with all refused, with none, and beyond the bound.
    large = transforms(LARGE).serialize()
    beyond = transforms(2 * LARGE + 10_000).serialize()
    for payload in (large, large.replace(struct.pack("<d", 1.5), struct.pack("<d", float("nan"))), beyond):
        say("rt/tf", payload)
        say("rt/tf_static", payload)
    text = b"x" * 5_000_000
    say("rt/robot_description", b"\0\1\0\0" + struct.pack("<I", len(text) + 1) + text + b"\0")
    # Bursts.
    for _ in range(10):
        say("rt/tf", beyond)
    small = transforms(1).serialize()
    for _ in range(3_000):
        say("rt/tf", small)
    print(json.dumps({"event": "sent", **sent}), flush=True)
    ended = threading.Event()

    def wait_for_the_end() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait_for_the_end, daemon=True).start()
    stamp = 10**9
    while not ended.wait(0.1):
        stamp += 10**8
        say("rt/tf", message("map", "last", stamp, 1.0).serialize())


if __name__ == "__main__":
    main()
