import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from support.both_sides import node

from tfbus.links.dds import readers
from tfbus.links.dds.dds_link import _STATICS, configuration, domain
from tfbus.links.dds.readers import (
    ANSWER_TIME,
    GREETING_TIME,
    QUIET_TIME,
    WRITERS_TIME,
    Greeting,
    delete,
    is_of_ros,
    join,
    read,
)
from tfbus.links.dds.types import RawTFMessage

CONFIG = configuration("localhost", (), None)
CYCLONE_PEER = Path(__file__).parents[2] / "support" / "cyclone_peer.py"


@pytest.mark.parametrize(("user_data", "of_ros"), [(b"enclave=/robot;\0", True), (b"other", False), (b"", False)])
def test_a_participant_of_ros_is_known_by_its_user_data(
    domain_number: int, user_data: bytes, of_ros: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It has no writers.
    monkeypatch.setattr(readers, "WRITERS_TIME", 0.05)
    with domain(domain_number, CONFIG), ExitStack() as stack:
        other = DomainParticipant(domain_number, Qos(Policy.Userdata(user_data)))
        stack.callback(delete, other)
        participant = join(domain_number, stack)
        reader = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
        stack.callback(delete, reader)
        found = {each.key.hex: is_of_ros(each) for each in read(reader)}
        assert found[other.guid.hex] is of_ros
        assert not found[participant.guid.hex]


def test_an_entity_is_deleted_now() -> None:
    deleted: list[bool] = []
    entity: Any = SimpleNamespace(__del__=lambda: deleted.append(True))
    delete(entity)
    assert deleted == [True]


class Times:
    """A time that passes only while somebody sleeps, and what a reader finds at which."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, found: list[tuple[float, Any]]) -> None:
        self.now = 0.0
        self.deleted: list[Any] = []
        self.found = found
        monkeypatch.setattr(readers, "monotonic", lambda: self.now)
        monkeypatch.setattr(readers, "sleep", self._sleep)
        monkeypatch.setattr(readers, "BuiltinDataReader", lambda *_: "reader")
        monkeypatch.setattr(readers, "read", lambda _: [each for when, each in self.found if when <= self.now])
        monkeypatch.setattr(readers, "delete", self.deleted.append)

    def _sleep(self, seconds: float) -> None:
        self.now += seconds


def program(name: str, of_ros: bool = True) -> Any:
    data = SimpleNamespace(data=b"enclave=/;" if of_ros else b"")
    return SimpleNamespace(key=SimpleNamespace(hex=name), guid=SimpleNamespace(hex=name), qos={Policy.Userdata: data})


def test_programs_of_ros_are_waited_for_until_no_more_of_them_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    own, first, second = program("own"), ANSWER_TIME - 0.005, ANSWER_TIME + 0.01
    others = [(first, program("other", of_ros=False)), (first, program("a")), (second, program("b"))]
    times = Times(monkeypatch, [(0.0, own), *others, (second + QUIET_TIME + 0.01, program("late"))])
    assert readers._answering(own) == {"a", "b"}
    assert second + QUIET_TIME <= times.now <= second + QUIET_TIME + 0.005
    assert times.deleted == ["reader"]
    times.now, times.found = 0.0, [(0.0, own)]
    assert readers._answering(own) == set()
    assert ANSWER_TIME <= times.now <= ANSWER_TIME + 0.005, "nobody is there"


@pytest.mark.parametrize(("known_at", "until"), [(0.3, 0.3), (99.0, WRITERS_TIME)])
def test_who_joins_waits_until_a_writer_of_each_program_is_known(
    known_at: float, until: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    writers = [(when, SimpleNamespace(participant_key=SimpleNamespace(hex=name))) for when, name in [(0.1, "a")] * 2]
    writers.append((known_at, SimpleNamespace(participant_key=SimpleNamespace(hex="b"))))
    times = Times(monkeypatch, writers)
    made: Iterator[Any] = iter(["first", "second"])
    monkeypatch.setattr(readers, "DomainParticipant", lambda _: next(made))
    monkeypatch.setattr(readers, "_answering", lambda _: {"a", "b"})
    with ExitStack() as stack:
        joined: Any = join(5, stack)
        assert joined == "second"
        assert until <= times.now <= until + 0.005
        assert times.deleted == ["reader"]
    assert times.deleted == ["reader", "second", "first"], "the first one stays as long as the other"


@pytest.mark.thorough
def test_whoever_joins_knows_the_writers_of_ros_at_once(domain_number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # However busy the machine is.
    monkeypatch.setattr(readers, "ANSWER_TIME", 20.0)
    monkeypatch.setattr(readers, "WRITERS_TIME", 20.0)
    variables = {"ROS_DOMAIN_ID": f"{domain_number}", "CYCLONEDDS_URI": CONFIG}
    with (
        node([sys.executable, str(CYCLONE_PEER)], variables, 60.0),
        domain(domain_number, CONFIG),
        ExitStack() as stack,
    ):
        participant = join(domain_number, stack)
        reader: DataReader[Any] = DataReader(participant, Topic(participant, "rt/tf_static", RawTFMessage), _STATICS)
        stack.callback(delete, reader)
        assert len(reader.get_matched_publications()) == 1


def test_new_writers_of_other_vendors_greet_a_second_reader_that_stays_a_while() -> None:
    now = 0.0
    readers: list[list[str]] = []

    def make() -> Any:
        events = ["made"]
        readers.append(events)
        return SimpleNamespace(__del__=lambda: events.append("deleted"))

    greeting = Greeting(make, lambda: now)
    cyclone, fast, late = "0110" + "a" * 28, "010f" + "b" * 28, "010f" + "c" * 28
    assert greeting.update(frozenset({cyclone})) is None
    assert greeting.update(frozenset({cyclone, fast})) == GREETING_TIME
    now = 0.1
    # It may have come too late for the reader that is there.
    assert greeting.update(frozenset({cyclone, fast, late})) == pytest.approx(GREETING_TIME - 0.1)
    assert readers == [["made"]]
    now = GREETING_TIME
    assert greeting.update(frozenset({cyclone, fast, late})) == GREETING_TIME
    assert readers == [["made", "deleted"], ["made"]]
    now = 2 * GREETING_TIME
    assert greeting.update(frozenset({cyclone, late})) is None
    greeting.update(frozenset({fast}))
    greeting.close()
    greeting.close()
    assert readers == [["made", "deleted"]] * 3


def test_a_participant_whose_name_is_no_text_keeps_nobody_from_joining() -> None:
    def fail(**_: object) -> Any:
        raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")

    reader: Any = SimpleNamespace(read=fail)
    assert read(reader) == []
