import os
import subprocess
import sys
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Event, Thread
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
from cyclonedds.core import DDSStatus, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from support.dds import CONFIG, LATCHED, DdsNode, cyclone_node

from tfbus.links.dds import readers
from tfbus.links.dds.dds_link import domain
from tfbus.links.dds.readers import (
    ANSWER_TIME,
    GREETING_TIME,
    MOST_BYTES,
    MOST_PUBLISHERS,
    MOST_WAITING,
    NODE_PATIENCE,
    PATIENCE,
    QUIET_TIME,
    WRITERS_TIME,
    Greeting,
    Publishers,
    ReaderThread,
    delete,
    is_of_ros,
    join,
    publication,
    read,
)
from tfbus.links.dds.types import RawString, RawTFMessage
from tfbus.links.ros.messages import decode_text

# Joining


@pytest.mark.parametrize(("user_data", "of_ros"), [(b"enclave=/robot;\0", True), (b"other", False), (b"", False)])
def test_a_participant_of_ros_is_known_by_its_user_data(domain_number: int, user_data: bytes, of_ros: bool) -> None:
    with DdsNode(domain_number, user_data) as other, DdsNode(domain_number) as participant:
        reader = BuiltinDataReader(participant.participant, BuiltinTopicDcpsParticipant)
        found = {each.key.hex: is_of_ros(each) for each in read(reader)}
        delete(reader)
        assert found == {other.id: of_ros, participant.id: False}


def test_one_thread_at_a_time_reads_what_the_library_tells_of_others() -> None:
    order = list[Any]()

    def participants(**_: int) -> list[Any]:
        other.start()
        # It must not come in between.
        other.join(0.05)
        order.append("participants")
        return []

    writers: Any = SimpleNamespace(get_matched_publication_data=order.append)
    other = Thread(target=publication, args=(writers, 7))
    library: Any = SimpleNamespace(read=participants)
    assert read(library) == []
    other.join()
    assert order == ["participants", 7]


def program(name: str, of_ros: bool = True) -> Any:
    """A participant, as the library tells of it, or a writer of it."""
    data = SimpleNamespace(data=b"enclave=/;" if of_ros else b"")
    key = SimpleNamespace(hex=name)
    return SimpleNamespace(key=key, guid=key, participant_key=key, qos={Policy.Userdata: data})


@pytest.mark.parametrize(
    ("answers", "writer_at", "until"),
    [
        # Nobody is there, or only a program that is not of ROS, whose writers are not waited for.
        ({}, 0.0, ANSWER_TIME),
        ({"other": ANSWER_TIME - 0.005}, 99.0, ANSWER_TIME - 0.005 + QUIET_TIME),
        # The second one answers while the first one is waited for.
        ({"a": ANSWER_TIME - 0.005, "b": ANSWER_TIME + 0.01}, 0.3, 0.3),
        ({"a": ANSWER_TIME - 0.005, "b": ANSWER_TIME + 0.01}, 99.0, ANSWER_TIME + 0.01 + QUIET_TIME + WRITERS_TIME),
        # The second one answers too late, and is met later.
        ({"a": 0.01, "b": 0.01 + ANSWER_TIME + 0.01}, 0.05, 0.01 + QUIET_TIME),
    ],
)
def test_who_joins_waits_for_the_programs_of_ros_that_answer_and_for_a_writer_of_each(
    answers: dict[str, float], writer_at: float, until: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, deleted = 0.0, list[Any]()

    def sleep(seconds: float) -> None:
        nonlocal now
        now += seconds

    def found(topic: object) -> list[Any]:
        if topic is BuiltinTopicDcpsParticipant:
            return [program("own"), *(program(name, name != "other") for name, at in answers.items() if at <= now)]
        return [program("a"), *([program("b")] if writer_at <= now else [])]

    made: Iterator[Any] = iter([program("own"), program("second")])
    for name, fake in (
        ("monotonic", lambda: now),
        ("sleep", sleep),
        ("BuiltinDataReader", lambda _, topic: topic),
        ("read", found),
        ("delete", deleted.append),
        ("DomainParticipant", lambda *_: next(made)),
    ):
        monkeypatch.setattr(readers, name, fake)
    with ExitStack() as stack:
        joined: Any = join(5, stack)
        assert joined.guid.hex == "second"
        assert until <= now <= until + 0.01
        assert len(deleted) == 2, "the two readers that were needed for this"
    assert [each.guid.hex for each in deleted[2:]] == ["second", "own"]


@pytest.mark.thorough
def test_who_joins_knows_the_writers_of_ros_at_once(domain_number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # However busy the machine is.
    monkeypatch.setattr(readers, "ANSWER_TIME", 20.0)
    monkeypatch.setattr(readers, "WRITERS_TIME", 20.0)
    with cyclone_node(domain_number), domain(domain_number, CONFIG), ExitStack() as stack:
        participant = join(domain_number, stack)
        reader: DataReader[Any] = DataReader(participant, Topic(participant, "rt/tf_static", RawTFMessage), LATCHED)
        stack.callback(delete, reader)
        assert len(reader.get_matched_publications()) == 1


def test_new_writers_of_other_vendors_greet_a_second_reader_that_stays_a_while() -> None:
    now = 0.0
    made: list[list[str]] = []

    def make() -> Any:
        events = ["made"]
        made.append(events)
        return SimpleNamespace(__del__=lambda: events.append("deleted"))

    greeting = Greeting(make, lambda: now)
    cyclone, fast, late = "0110" + "a" * 28, "010f" + "b" * 28, "010f" + "c" * 28
    assert greeting.update({cyclone}) is None
    assert greeting.update({cyclone, fast}) == GREETING_TIME
    now = 0.1
    # It may have come too late for the reader that is there.
    assert greeting.update({cyclone, fast, late}) == pytest.approx(GREETING_TIME - 0.1)
    assert made == [["made"]]
    now = GREETING_TIME
    assert greeting.update({cyclone, fast, late}) == GREETING_TIME
    assert made == [["made", "deleted"], ["made"]]
    now = 2 * GREETING_TIME
    assert greeting.update({cyclone, late}) is None
    greeting.update({fast})
    greeting.close()
    greeting.close()
    assert made == [["made", "deleted"]] * 3


def test_a_participant_whose_name_is_no_text_keeps_nobody_from_joining() -> None:
    def fail(**_: object) -> Any:
        raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")

    reader: Any = SimpleNamespace(read=fail)
    assert read(reader) == []


# The thread


class Watched(NamedTuple):
    """A reader, a writer to it, and the thread that is to serve the reader."""

    reader: DataReader[Any]
    writer: DataWriter[Any]
    thread: ReaderThread
    errors: list[str]


@contextmanager
def watched(number: int) -> Iterator[Watched]:
    keep_all = Qos(Policy.History.KeepAll)
    errors: list[str] = []
    with domain(number, CONFIG), ExitStack() as stack:
        participant = DomainParticipant(number)
        stack.callback(delete, participant)
        topic = Topic(participant, "rt/text", RawString)
        # The traceback of an error would keep the reader.
        thread = ReaderThread(participant, lambda error: errors.append(str(error)))
        reader: DataReader[Any] = DataReader(participant, topic, keep_all)
        writer: DataWriter[Any] = DataWriter(participant, topic, keep_all)
        yield Watched(reader, writer, thread, errors)
        delete(writer)
        delete(reader)


def texts(reader: DataReader[Any], most: int) -> list[str]:
    # A sample without data tells of a writer that has gone.
    return [decode_text(each.payload) for each in reader.take(N=most) if not isinstance(each, InvalidSample)]


class Turns:
    """Counts, for a thread that waits for a number."""

    def __init__(self) -> None:
        self.told: list[Any] = []
        self._woken = Event()

    def add(self, *told: object) -> None:
        self.told += told
        self._woken.set()

    def wait_for(self, count: int) -> None:
        while len(self.told) < count:
            assert self._woken.wait(30.0)
            self._woken.clear()


def test_data_and_new_writers_are_told_in_the_thread_and_no_error_ends_it(
    domain_number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    turns, rounds, wait = Turns(), list[None](), WaitSet.wait

    def count(waiting: WaitSet, timeout: int) -> int:
        rounds.append(None)
        return wait(waiting, timeout)

    monkeypatch.setattr(WaitSet, "wait", count)

    def take(reader: DataReader[Any]) -> bool:
        new = texts(reader, 10)
        turns.add(*new)
        if "bad" in new:
            raise ValueError(*new)
        return False

    with watched(domain_number) as end:
        # Before it is watched: told all the same.
        end.writer.write(RawString("first"))
        end.thread.watch(end.reader, take, lambda reader: turns.add(len(reader.get_matched_publications())))
        end.thread.start()
        turns.wait_for(2)
        for number, text in enumerate(("bad", "last"), 3):
            end.writer.write(RawString(text))
            turns.wait_for(number)
        delete(end.writer)
        turns.wait_for(5)
        end.thread.stop()
        assert end.errors == ["bad"]
        assert len(rounds) < 30, "it rests while nothing comes"
    assert turns.told == [1, "first", "bad", "last", 0]


def test_a_thread_that_has_ended_has_let_go_of_its_readers_and_of_what_it_made(domain_number: int) -> None:
    with domain(domain_number, CONFIG), ExitStack() as stack:
        participant = DomainParticipant(domain_number)
        stack.callback(delete, participant)
        reader: DataReader[Any] = DataReader(participant, Topic(participant, "rt/text", RawString))
        before = len(participant.get_children())
        thread = ReaderThread(participant, print)
        thread.watch(reader, bool, lambda _: None)
        thread.start()
        thread.stop()
        assert len(participant.get_children()) == before
        delete(reader)
        gone = weakref.ref(reader)
        del reader
        assert gone() is None


def test_only_what_is_served_wakes_the_thread(domain_number: int) -> None:
    with watched(domain_number) as end:
        end.thread.watch(end.reader, bool)
        assert end.reader.get_status_mask() == DDSStatus.DataAvailable
        end.thread.watch(end.reader, bool, print)
        assert end.reader.get_status_mask() == DDSStatus.DataAvailable | DDSStatus.SubscriptionMatched
        end.thread.start()
        end.thread.stop()


TWO_LINKS = """
import anyio, sys
from tfbus import Bus, Transform, TransformStamped
from tfbus.links.dds import DdsLink

async def main():
    number = int(sys.argv[1])
    with Bus(max_behind=None) as near, Bus(max_behind=None) as far:
        async with DdsLink(near, number) as here, DdsLink(far, number) as there:
            for stamp in range(4_000):
                near.publish(TransformStamped("map", "near", stamp, Transform()))
                far.publish(TransformStamped("map", "far", stamp, Transform()))
                await anyio.sleep(0.001)
            # Each has heard the other, and the third program.
            assert min(here.statistics().received_samples, there.statistics().received_samples) > 4_100

anyio.run(main)
"""


@pytest.mark.thorough
def test_two_links_of_a_process_and_another_program_do_not_wait_for_each_other_for_ever(domain_number: int) -> None:
    with cyclone_node(domain_number):
        command = [sys.executable, "-P", "-c", TWO_LINKS, f"{domain_number}"]
        # They would keep the interpreter lock: only another process can tell.
        done = subprocess.run(command, timeout=60.0, capture_output=True, text=True, env=os.environ, check=False)
    assert (done.returncode, done.stderr) == (0, "")


# The names of nodes


class Hall:
    """Publishers in a time of their own, and what they have delivered."""

    def __init__(self) -> None:
        self.time = 0.0
        self.delivered: list[tuple[str, str, bytes, bool]] = []
        self.publishers = Publishers(self, lambda: self.time)

    def deliver(self, *message: Any) -> None:
        self.delivered.append(message)

    def is_of_ros(self, participant: str) -> bool:
        return participant == "ros"

    def name_of(self, participant: str) -> str:
        return participant

    def say(self, publisher: str, payload: bytes = b"x", static: bool = False, participant: str = "p") -> None:
        self.publishers.message(publisher, participant, payload, static)

    def expire(self, now: float) -> None:
        self.time = now
        self.publishers.expire()


@pytest.fixture
def hall() -> Hall:
    return Hall()


def test_a_message_waits_for_the_name_of_its_node_and_later_ones_do_not(hall: Hall) -> None:
    hall.say("w1", b"1", static=True)
    hall.say("w1", b"2")
    hall.say("w2", b"3")
    assert hall.delivered == []
    hall.publishers.nodes("p", [("/a", ["w1", "other"]), ("/b", [])])
    expected = [("p", "/a", b"1", True), ("p", "/a", b"2", False)]
    assert hall.delivered == expected
    for publisher in ("w1", "other"):
        hall.say(publisher, b"4")
        expected.append(("p", "/a", b"4", False))
        assert hall.delivered == expected


def test_without_a_name_the_participant_is_named_after_a_while_and_stays_so(hall: Hall) -> None:
    hall.say("w1")
    hall.expire(PATIENCE - 0.01)
    assert hall.delivered == []
    hall.expire(PATIENCE)
    hall.publishers.nodes("p", [("/a", ["w1"])])
    hall.say("w1")
    assert hall.delivered == [("p", "p", b"x", False)] * 2


def test_a_message_of_ros_waits_longer_for_a_name_that_was_lost_on_the_way(hall: Hall) -> None:
    for publisher in ("w1", "w2"):
        hall.say(publisher, static=True, participant="ros")
    hall.expire(NODE_PATIENCE - 0.01)
    assert hall.delivered == []
    hall.publishers.nodes("ros", [("/a", ["w1"])])
    hall.expire(NODE_PATIENCE)
    assert hall.delivered == [("ros", "/a", b"x", True), ("ros", "ros", b"x", True)]


def test_so_many_messages_wait_and_then_none_does(hall: Hall) -> None:
    for _ in range(MOST_WAITING):
        hall.say("w1")
    assert hall.delivered == []
    hall.say("w1")
    assert len(hall.delivered) == MOST_WAITING + 1


def test_so_many_bytes_of_all_publishers_wait_and_then_no_more(hall: Hall) -> None:
    large = bytes(MOST_BYTES // 4)
    for number in range(10):
        hall.say(f"w{number}", large)
    assert 10 - len(hall.delivered) == 4
    hall.publishers.nodes("p", [("/a", [f"w{number}" for number in range(4)])])
    assert [name for _, name, _, _ in hall.delivered[6:]] == ["/a"] * 4
    hall.say("w20", large)
    assert len(hall.delivered) == 10, "there is room again"


def test_publishers_that_have_gone_are_forgotten_and_what_waits_is_delivered(hall: Hall) -> None:
    hall.say("w1")
    hall.say("w2", b"y", participant="q")
    hall.publishers.nodes("p", [])
    hall.publishers.nodes("q", [("/b", ["w9"])])
    hall.publishers.keep_only({"q"})
    assert hall.delivered == [("p", "p", b"x", False)]
    hall.publishers.nodes("q", [])
    hall.publishers.keep_only(set())
    assert hall.delivered[1:] == [("q", "q", b"y", False)]
    assert len(hall.publishers) == 0


def test_of_too_many_publishers_the_first_is_forgotten_and_what_waits_of_it_is_delivered(hall: Hall) -> None:
    names = [f"w{number}" for number in range(MOST_PUBLISHERS)]
    for name in names:
        hall.say(name)
    assert hall.delivered == []
    hall.say("one more")
    assert len(hall.delivered) == 1
    hall.expire(PATIENCE)
    # Two that are remembered have their names, and one that is not waits again.
    hall.delivered.clear()
    for name in (names[1], names[-1]):
        hall.say(name)
    assert len(hall.delivered) == 2
    hall.say(names[0])
    assert len(hall.delivered) == 2


def test_the_names_of_so_many_publishers_are_remembered_whoever_tells_them(hall: Hall) -> None:
    for number in range(MOST_PUBLISHERS + 1):
        hall.publishers.nodes(f"p{number}", [(f"/{number}", [f"w{number}"])])
    for number in (0, 1, MOST_PUBLISHERS):
        hall.say(f"w{number}", participant=f"p{number}")
    assert [node for _, node, _, _ in hall.delivered] == ["/1", f"/{MOST_PUBLISHERS}"]
    for _ in range(2):
        hall.publishers.nodes("q", [("/q", [f"q{number}" for number in range(MOST_PUBLISHERS + 1)])])
    hall.say("q1", participant="q")
    hall.say("w2", participant="p2")
    assert len(hall.delivered) == 2, "none is remembered"
