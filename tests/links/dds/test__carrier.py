import struct
from threading import Event
from threading import enumerate as enumerate_threads
from types import SimpleNamespace
from typing import Any, Unpack

import anyio
import pytest

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from cyclonedds.core import Entity, ReadCondition
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from hypothesis import given, settings
from hypothesis import strategies as st
from support.joint_messages import joint_state
from support.processes import until
from support.samples import moving, static

from tfbus import Bus, SimulatedClock
from tfbus.links._carrier import Carrier, SendReport
from tfbus.links._clock_follower import ClockFollower
from tfbus.links._endpoint import Endpoint
from tfbus.links._entries import OutgoingBatch
from tfbus.links._outbox import Turn
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.dds import dds_link
from tfbus.links.dds.dds_link import _MOVING, _STATIC, _STATICS, DdsCarrier, configuration, domain
from tfbus.links.dds.readers import PATIENCE, Publishers
from tfbus.links.dds.types import (
    Gid,
    Header,
    NodeEntitiesInfo,
    ParticipantEntitiesInfo,
    RawClock,
    RawEntitiesInfo,
    RawJointState,
    RawString,
    RawTFMessage,
    Time,
)
from tfbus.links.ros.ros_link import RosMessage
from tfbus.links.ros.settings import RosOptions, settings_of
from tfbus.tf_message import MalformedMessageError, encode

AS_A_CARRIER: type[Carrier] = DdsCarrier
"""That it fits the protocol, mypy says."""

CONFIG = configuration("localhost", (), None)

pytestmark = pytest.mark.anyio


class Node:
    """A participant with a broadcaster, as a ROS 2 node has it."""

    def __init__(self, number: int, user_data: bytes = b"") -> None:
        self._open = domain(number, CONFIG)
        self._open.__enter__()
        self.participant = DomainParticipant(number, Qos(Policy.Userdata(user_data)))
        self.writers = {
            name: DataWriter(self.participant, Topic(self.participant, f"rt/{name}", RawTFMessage), qos)
            for name, qos in (("tf", _MOVING), ("tf_static", _STATIC))
        }
        self.info: Any = DataWriter(
            self.participant, Topic(self.participant, "ros_discovery_info", ParticipantEntitiesInfo), _STATIC
        )

    @property
    def id(self) -> str:
        return self.participant.guid.hex

    def say(self, payload: bytes, topic: str = "tf") -> None:
        self.writers[topic].write(RawTFMessage.of(payload))

    def tell_name(self, namespace: str, name: str) -> None:
        gids: Any = [list(writer.guid.bytes) for writer in self.writers.values()]
        writers: Any = list(map(Gid, gids))
        nothing: Any = []
        make: Any = NodeEntitiesInfo
        nodes: Any = [make(namespace, name, nothing, writers)]
        own: Any = list(self.participant.guid.bytes)
        self.info.write(ParticipantEntitiesInfo(Gid(own), nodes))

    def end(self) -> None:
        for entity in (*self.writers.values(), self.info, self.participant):
            entity.__del__()
        self._open.__exit__(None, None, None)


async def test_messages_come_with_the_name_of_their_node(domain_number: int) -> None:
    items: list[Received] = []
    carrier = DdsCarrier(domain_number, CONFIG, settings_of({}))
    await carrier.open(items.append, SendReport(print))
    node = Node(domain_number)
    payload = encode([moving("map", "base", 5)])
    node.say(encode([static("map", "lidar")]), "tf_static")
    await until(lambda: [item.content for item in items] == [Presence.JOINED])
    node.tell_name("/robot1", "driver")
    await until(lambda: len(items) == 2)
    node.say(payload)
    await until(lambda: len(items) == 3)
    node.end()
    await until(lambda: len(items) == 4)
    await carrier.close()
    first, second = items[1:3]
    assert isinstance(first.content, RosMessage)
    assert (first.content.static, first.content.authority, first.moving) == (True, "/robot1/driver", False)
    assert second == Received(
        items[0].sender, RosMessage(payload, static=False, authority="/robot1/driver"), len(payload), moving=True
    )
    assert items[3] == Received(items[0].sender, Presence.LEFT)


@pytest.mark.thorough
async def test_without_a_name_a_message_waits_only_a_while(domain_number: int) -> None:
    items: list[Received] = []
    carrier = DdsCarrier(domain_number, CONFIG, settings_of({"send": False}))
    await carrier.open(items.append, SendReport(print))
    node = Node(domain_number)
    node.say(encode([static("map", "lidar")]), "tf_static")
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(carrier.run)
        await until(lambda: len(items) == 2)
        tasks.cancel_scope.cancel()
    node.end()
    await carrier.close()
    assert items[1].content.authority == items[0].sender


@pytest.mark.parametrize(("user_data", "of_ros"), [(b"enclave=/robot;\0", True), (b"", False)])
async def test_who_has_sent_a_message_is_known_to_be_of_ros_or_not(
    domain_number: int, user_data: bytes, of_ros: bool
) -> None:
    items: list[Received] = []
    carrier = DdsCarrier(domain_number, CONFIG, settings_of({"send": False}))
    await carrier.open(items.append, SendReport(print))
    node = Node(domain_number, user_data)
    await until(lambda: len(items) == 1)
    assert carrier._is_of_ros(items[0].sender) is of_ros
    node.end()
    await carrier.close()


def _kind(item: Received) -> tuple[bool, bool, bool]:
    return item.content.joints, item.content.clock, item.content.description


async def test_joints_the_time_and_a_description_come_from_topics_of_their_own(domain_number: int) -> None:
    items: list[Received] = []
    takers: RosOptions = {"joint_states": print, "clock": SimulatedClock(), "robot_description": print, "send": False}
    carrier = DdsCarrier(domain_number, CONFIG, settings_of(takers))
    await carrier.open(items.append, SendReport(print))
    node = Node(domain_number)
    make: Any = SimpleNamespace(joints=RawJointState, clock=RawClock)
    stamp: Any = Time(100, 5)
    said: list[tuple[str, Any, Any]] = [
        ("joint_states", RawJointState, make.joints(Header(stamp, ""), ["a"], [0.5], [], [])),
        ("clock", RawClock, make.clock(stamp)),
        ("robot_description", RawString, RawString("<robot/>")),
    ]
    writers: list[tuple[Any, Any]] = [
        (DataWriter(node.participant, Topic(node.participant, f"rt/{name}", kind), _STATIC), message)
        for name, kind, message in said
    ]
    with anyio.fail_after(20):
        while len(kinds := {_kind(item): item for item in items if isinstance(item.content, RosMessage)}) < 3:
            # The two that are not latched may be lost while the two meet.
            for writer, message in writers:
                writer.write(message)
            await anyio.sleep(0.01)
    for writer, _ in writers:
        writer.__del__()
    node.end()
    await carrier.close()
    assert {kind: (item.sender, item.moving) for kind, item in kinds.items()} == {
        (True, False, False): ("other topics", True),
        (False, True, False): ("other topics", True),
        (False, False, True): ("other topics", False),
    }


async def test_a_burst_of_many_writers_loses_no_message(domain_number: int) -> None:
    items: list[Received] = []
    carrier = DdsCarrier(domain_number, CONFIG, settings_of({"send": False, "authority": "ros"}))
    await carrier.open(items.append, SendReport(print))
    node = Node(domain_number)
    await until(lambda: len(items) == 1)
    payloads = [encode([moving("map", f"f{number}", 5)]) for number in range(2_000)]
    for payload in payloads:
        # It keeps the interpreter lock, so the thread of the readers takes nothing meanwhile but every few ms.
        node.say(payload)
    await until(lambda: len(items) == 2_001)
    node.end()
    await carrier.close()
    assert [item.content.payload for item in items[1:2_001]] == payloads


class Reader:
    """A reader as the thread of the readers has it: its messages, and the writers that it knows."""

    def __init__(self, *messages: Any) -> None:
        self.messages = list(messages)
        self.writers: dict[int, tuple[str, str]] = {}
        self.asked: list[int] = []

    def take(self, N: int) -> list[Any]:  # noqa: N803 - the library calls it so
        taken, self.messages = self.messages[:N], self.messages[N:]
        return taken

    def get_matched_publications(self) -> list[int]:
        return list(self.writers)

    def get_matched_publication_data(self, handle: int) -> Any:
        self.asked.append(handle)
        if handle not in self.writers:
            return None
        key, participant = (SimpleNamespace(hex=name) for name in self.writers[handle])
        return SimpleNamespace(key=key, participant_key=participant)


GONE = InvalidSample.__new__(InvalidSample)
"""The library gives this in place of a message when a writer has gone."""


def said(payload: bytes, writer: int = 1) -> Any:
    return SimpleNamespace(payload=payload, sample_info=SimpleNamespace(publication_handle=writer))


def unopened(**options: Unpack[RosOptions]) -> tuple[Any, list[Received]]:
    """A carrier that has not joined, and what it has received."""
    items: list[Received] = []
    carrier = DdsCarrier(0, CONFIG, settings_of(options))
    carrier._receive, carrier._report = items.append, SendReport(print)
    return carrier, items


def test_all_messages_that_wait_are_taken_and_the_library_is_asked_once_for_each_writer() -> None:
    carrier, items = unopened(authority="ros")
    payloads = [b"%d" % number for number in range(250)]
    reader = Reader(*(each for payload in payloads for each in (GONE, said(payload))))
    reader.writers[1] = ("writer", "driver")
    turns = 1
    while carrier._take(False, reader):
        turns += 1
    assert turns > 2, "other readers have their turn"
    assert [item.content.payload for item in items] == payloads
    assert {(item.sender, item.moving) for item in items} == {("driver", True)}
    assert reader.asked == [1]
    # One that has gone since then, and is not remembered.
    reader.messages = [said(b"last", 2), said(b"last", 2)]
    carrier._take(True, reader)
    assert [(item.sender, item.moving, item.content.authority) for item in items[250:]] == [("", False, "")] * 2
    assert reader.asked == [1, 2, 2]


def test_without_an_authority_messages_wait_for_the_names_of_their_nodes() -> None:
    carrier, items = unopened()
    reader = Reader(said(b"first"))
    reader.writers[1] = ("1" * 32, "0" * 32)
    carrier._take(False, reader)
    assert items == []
    info = "0" * 32, [("/robot/a", ["1" * 32])]
    carrier._take_nodes(Reader(GONE, SimpleNamespace(payload=b"", read=lambda: info)))
    assert items[0].content == RosMessage(b"first", static=False, authority="/robot/a")


def test_a_participant_is_there_while_it_publishes_on_any_topic() -> None:
    carrier, items = unopened()
    static_frames, moving_frames = Reader(), Reader()

    def told(*participants: str, reader: Reader) -> list[tuple[str, object]]:
        items.clear()
        reader.writers = {number: (f"{number}", name) for number, name in enumerate(participants)}
        carrier._match(0 if reader is static_frames else 1, reader)
        return [(item.sender, item.content) for item in items]

    assert told("b", "a", reader=static_frames) == [("a", Presence.JOINED), ("b", Presence.JOINED)]
    assert told("b", "b", "c", reader=moving_frames) == [("c", Presence.JOINED)]
    # What still waits for the name of its node comes before the end of its participant.
    static_frames.messages = [said(b"waits", 1)]
    carrier._take(True, static_frames)
    assert told("c", reader=static_frames) == [
        ("a", RosMessage(b"waits", static=True, authority="a")),
        ("a", Presence.LEFT),
    ]
    assert told(reader=moving_frames) == [("b", Presence.LEFT)]
    assert told(reader=static_frames) == [("c", Presence.LEFT)]


def test_a_writer_is_asked_for_anew_when_the_writers_have_changed() -> None:
    carrier, items = unopened(authority="ros")
    reader = Reader(said(b"first"))
    reader.writers[1] = ("writer", "driver")
    carrier._take(False, reader)
    reader.writers[1] = ("writer", "another")
    carrier._match(0, reader)
    reader.messages = [said(b"second")]
    carrier._take(False, reader)
    assert [item.sender for item in items if isinstance(item.content, RosMessage)] == ["driver", "another"]


def test_a_list_of_writers_that_grew_while_it_was_read_is_read_again() -> None:
    carrier, items = unopened()

    class Growing(Reader):
        def get_matched_publications(self) -> list[int]:
            if not self.asked:
                self.asked.append(0)
                # As the library does when another writer comes between its two calls.
                raise IndexError("invalid index")
            return super().get_matched_publications()

    reader = Growing()
    reader.writers[1] = ("writer", "driver")
    again = carrier._match(0, reader)
    assert again is not None
    assert items == [], "nothing is told as malformed"
    assert carrier._match(0, reader) is None
    assert items == [Received("driver", Presence.JOINED)]


def test_one_message_that_cannot_be_taken_keeps_no_other_from_being_taken() -> None:
    carrier, items = unopened(authority="ros")
    reader = Reader(said(b"first", 1), said(b"second", 2))
    reader.writers[2] = ("writer", "driver")
    named = reader.get_matched_publication_data

    def publication(handle: int) -> Any:
        if handle == 1:
            raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "a stranger's name")
        return named(handle)

    reader.get_matched_publication_data = publication  # type: ignore[method-assign]
    carrier._take(False, reader)
    assert [(item.sender, item.content.payload) for item in items if isinstance(item.content, RosMessage)] == [
        ("", b"first"),
        ("driver", b"second"),
    ]
    reader.writers[1] = ("other", "stranger")
    carrier._match(0, reader)
    assert items[-1] == Received("driver", Presence.JOINED)


def test_names_of_nodes_that_cannot_be_read_are_malformed_and_spoil_no_others() -> None:
    carrier, items = unopened()
    bad, large = RawEntitiesInfo.deserialize(b"\0\1\0\0" + b"\xff" * 40), RawEntitiesInfo.deserialize(bytes(2**22 + 1))
    one: Any = Gid([1] * 16)  # type: ignore[arg-type]
    make: Any = NodeEntitiesInfo
    good = RawEntitiesInfo.deserialize(
        bytes(ParticipantEntitiesInfo(one, [make("/", "a", [], [Gid([2] * 16)])]).serialize())  # type: ignore[arg-type]
    )
    reader = Reader(said(b"waits"))
    reader.writers[1] = ("02" * 16, "01" * 16)
    carrier._take(False, reader)
    carrier._take_nodes(Reader(bad, large, good))
    *refused, message = items
    assert [item.content.reason for item in refused] == ["encoding", "oversized"]
    assert message.content.authority == "/a"


def _check_garbage(payload: bytes) -> None:
    """Any bytes on any topic are handed on or refused, and the messages behind them are taken."""
    clock = SimulatedClock()
    with Bus(clock) as bus:
        options: RosOptions = {"joint_states": print, "robot_description": len, "clock": clock, "authority": "ros"}
        carrier: Any = DdsCarrier(0, CONFIG, settings_of(options))
        endpoint = Endpoint(bus, "dds", carrier, lambda: None, follower=ClockFollower(clock))
        carrier._receive, carrier._report = endpoint.handle, SendReport(print)
        endpoint.attach()
        last = encode([moving("end", "last", 9)])
        carrier._take_nodes(Reader(RawEntitiesInfo.deserialize(payload)))
        for kind in ("joints", "clock", "description"):
            carrier._take_other(kind, Reader(said(payload)))
        for static_frames in (True, False):
            carrier._take(static_frames, Reader(said(payload), said(last)))
        assert bus.statistics().frames >= 1
        assert "not read" not in endpoint.peers.rejected
        assert "not published" not in endpoint.peers.rejected


_GOOD = (
    encode([moving("map", "base", 5, 1.0), moving("base", "arm", 6)]),
    joint_state(5, {"a": 0.5, "b": 1.5}),
    b"\0\1\0\0" + struct.pack("<iI", 100, 5),
    b"\0\1\0\0" + struct.pack("<I", 9) + b"<robot/>\0",
    b"\0\1\0\0" + bytes(16) + struct.pack("<III", 1, 2, 0x2F) + struct.pack("<II", 0, 0),
)
_garbage = st.one_of(
    st.binary(max_size=200),
    st.sampled_from(_GOOD).flatmap(
        lambda good: st.builds(
            lambda at, bytes_, cut: (good[:at] + bytes_ + good[at + len(bytes_) :])[: len(good) - cut],
            st.integers(0, len(good)),
            st.binary(min_size=1, max_size=8),
            st.integers(0, 8),
        )
    ),
)


@settings(max_examples=25, deadline=None)
@given(_garbage)
def test_garbage_on_any_topic_is_refused_and_what_comes_behind_it_is_taken(payload: bytes) -> None:
    _check_garbage(payload)


@pytest.mark.thorough
@settings(max_examples=2_000, deadline=None)
@given(_garbage)
def test_much_garbage_on_any_topic_is_refused_and_what_comes_behind_it_is_taken(payload: bytes) -> None:
    _check_garbage(payload)


def test_as_many_messages_in_a_row_as_dds_keeps_are_told_as_an_overrun() -> None:
    carrier, items = unopened(joint_states=print)
    reader = Reader(*(said(b"x") for _ in range(dds_link._DEPTH)))
    reader.topic = SimpleNamespace(name="rt/joint_states")  # type: ignore[attr-defined]
    while carrier._take_other("joints", reader):
        assert items
    told = [str(item.content) for item in items if isinstance(item.content, MalformedMessageError)]
    assert told == ["messages of /joint_states come faster than they are taken, some may be lost"]


def test_what_keeps_messages_from_being_read_is_counted_and_not_called_malformed() -> None:
    carrier, items = unopened()
    carrier._failed(ValueError("x" * 1_000))
    (item,) = items
    assert item.content.reason == "not read"
    assert "no message" not in str(item.content)
    assert 100 < str(item.content).count("x") < 200


async def test_while_it_runs_messages_are_delivered_whose_nodes_told_no_name(monkeypatch: pytest.MonkeyPatch) -> None:
    carrier, items = unopened()
    now, pauses = 100.0, list[float]()
    carrier._publishers = Publishers(carrier._deliver, lambda _: False, lambda: now)
    reader = Reader(said(b"waits"))
    reader.writers[1] = ("writer", "driver")
    carrier._take(False, reader)

    async def sleep(seconds: float) -> None:
        nonlocal now
        if items:
            raise EOFError
        pauses.append(seconds)
        now += seconds

    monkeypatch.setattr(anyio, "sleep", sleep)
    with pytest.raises(EOFError):
        await carrier.run()
    assert sum(pauses) == PATIENCE
    assert items[0].content == RosMessage(b"waits", static=False, authority="driver")


async def test_what_is_sent_is_counted_and_of_the_static_frames_the_last_message_is_latched(domain_number: int) -> None:
    report = SendReport(print)
    carrier = DdsCarrier(domain_number, CONFIG, settings_of({}))
    await carrier.open(print, report)
    for stamp in (1, 2):
        moved = OutgoingBatch(bytes(16), stamp, [moving("map", "base", stamp)])
        carrier.send(Turn([moved], {"lidar": OutgoingBatch(bytes(16), stamp, [static("map", "lidar", stamp=stamp)])}))
    assert (report.messages, report.samples) == (4, 4)
    node = Node(domain_number)
    reader: DataReader[Any] = DataReader(
        node.participant, Topic(node.participant, "rt/tf_static", RawTFMessage), _STATICS
    )
    latched: list[bytes] = []

    def received() -> bool:
        messages: list[Any] = reader.take(N=10)
        latched.extend(message.payload for message in messages)
        return bool(latched)

    await until(received)
    reader.__del__()
    node.end()
    await carrier.close()
    assert latched == [encode([static("map", "lidar", stamp=2)])]


async def test_what_dds_does_not_take_is_reported(domain_number: int) -> None:
    errors: list[Exception] = []
    report = SendReport(errors.append)
    carrier = DdsCarrier(domain_number, CONFIG, settings_of({}))
    await carrier.open(print, report)
    writer = carrier._moving_writer
    await carrier.close()
    writer._ref = 0
    carrier.send(Turn([OutgoingBatch(bytes(16), 1, [moving("map", "base", 1)])], {}))
    assert (len(errors), report.messages) == (1, 0)


async def test_all_that_a_carrier_has_made_is_deleted_at_its_end_though_somebody_still_has_it(
    domain_number: int,
) -> None:
    before = {*Entity._entities.values()}
    takers: RosOptions = {"joint_states": print, "clock": SimulatedClock(), "robot_description": print}
    carrier = DdsCarrier(domain_number, CONFIG, settings_of(takers))
    await carrier.open(print, SendReport(print))
    # Topics and read conditions go with what they belong to.
    made = [
        each for each in Entity._entities.values() if each not in before and not isinstance(each, Topic | ReadCondition)
    ]
    await carrier.close()
    assert len(made) > 10
    assert [each for each in made if each in Entity._entities.values()] == []


async def test_a_domain_that_cannot_be_left_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dds_link, "_CLOSING_TIME", 0.01)
    carrier, _ = unopened()
    going_on, left = Event(), Event()
    carrier._open.callback(left.set)
    carrier._open.callback(going_on.wait, 20.0)
    await carrier.close()
    (closing,) = [thread for thread in enumerate_threads() if thread.name == "tfbus dds close"]
    ended_before = left.is_set()
    going_on.set()
    closing.join(20.0)
    assert (ended_before, left.is_set()) == (False, True)
    assert closing.daemon, "nor at the end of the program"


async def test_a_carrier_that_never_opened_closes(domain_number: int) -> None:
    await DdsCarrier(domain_number, CONFIG, settings_of({})).close()
