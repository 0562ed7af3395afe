import pytest
from support.wires import size_of

from tfbus.links.dds import readers
from tfbus.links.dds.readers import MOST_BYTES, MOST_WAITING, NODE_PATIENCE, PATIENCE, Publishers


class Hall:
    """Publishers in a time of their own, and what they have delivered."""

    def __init__(self) -> None:
        self.time = 0.0
        self.delivered: list[tuple[str, str, bytes, bool]] = []
        self.publishers = Publishers(
            lambda *message: self.delivered.append(message),
            lambda participant: participant == "ros",
            lambda: self.time,
        )

    def say(self, publisher: str, payload: bytes = b"x", static: bool = False) -> None:
        self.publishers.message(publisher, "p", payload, static)


def test_a_message_waits_for_the_name_of_its_node_and_later_ones_do_not() -> None:
    hall = Hall()
    hall.say("w1", b"1", static=True)
    hall.say("w1", b"2")
    hall.say("w2", b"3")
    assert hall.delivered == []
    hall.publishers.nodes("p", [("/a", ["w1", "other"]), ("/b", [])])
    expected = [("p", "/a", b"1", True), ("p", "/a", b"2", False)]
    assert hall.delivered == expected
    hall.say("w1", b"4")
    assert hall.delivered == [*expected, ("p", "/a", b"4", False)]


def test_a_name_that_comes_before_the_first_message_is_known() -> None:
    hall = Hall()
    hall.publishers.nodes("p", [("/a", ["w1"])])
    hall.say("w1")
    assert hall.delivered == [("p", "/a", b"x", False)]


def test_without_a_name_the_participant_is_named_after_a_while_and_stays_so() -> None:
    hall = Hall()
    hall.say("w1")
    hall.time = PATIENCE - 0.01
    hall.publishers.expire()
    assert hall.delivered == []
    hall.time = PATIENCE
    hall.publishers.expire()
    hall.publishers.nodes("p", [("/a", ["w1"])])
    hall.say("w1")
    assert hall.delivered == [("p", "p", b"x", False)] * 2


def test_a_message_of_ros_waits_longer_for_a_name_that_was_lost_on_the_way() -> None:
    hall = Hall()
    for publisher in ("w1", "w2"):
        hall.publishers.message(publisher, "ros", b"x", True)
    hall.time = NODE_PATIENCE - 0.01
    hall.publishers.expire()
    assert hall.delivered == []
    hall.publishers.nodes("ros", [("/a", ["w1"])])
    hall.time = NODE_PATIENCE
    hall.publishers.expire()
    assert hall.delivered == [("ros", "/a", b"x", True), ("ros", "ros", b"x", True)]


def test_so_many_messages_wait_and_then_none_does() -> None:
    hall = Hall()
    for _ in range(MOST_WAITING):
        hall.say("w1")
    assert hall.delivered == []
    hall.say("w1")
    assert len(hall.delivered) == MOST_WAITING + 1


def test_so_many_bytes_of_all_publishers_wait_and_then_no_more() -> None:
    hall = Hall()
    large = bytes(MOST_BYTES // 4)
    for number in range(10):
        hall.say(f"w{number}", large)
    assert 10 - len(hall.delivered) == 4
    hall.publishers.nodes("p", [("/a", [f"w{number}" for number in range(4)])])
    assert [name for _, name, _, _ in hall.delivered[6:]] == ["/a"] * 4
    hall.say("w20", large)
    assert len(hall.delivered) == 10, "there is room again"


def test_publishers_that_have_gone_are_forgotten_and_what_waits_is_delivered() -> None:
    hall = Hall()
    hall.say("w1")
    hall.publishers.message("w2", "q", b"y", False)
    hall.publishers.nodes("p", [])
    hall.publishers.nodes("q", [("/b", ["w9"])])
    hall.publishers.keep_only({"q"})
    assert hall.delivered == [("p", "p", b"x", False)]
    hall.publishers.nodes("q", [])
    hall.publishers.keep_only(set())
    assert hall.delivered[1:] == [("q", "q", b"y", False)]
    assert size_of(hall.publishers) == 0


def test_of_too_many_publishers_the_first_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readers, "_MOST_PUBLISHERS", 3)
    hall = Hall()
    for name in ("w1", "w2", "w3"):
        hall.say(name)
    hall.time = PATIENCE
    hall.publishers.expire()
    hall.delivered.clear()

    def delivered_at_once(name: str) -> bool:
        before = len(hall.delivered)
        hall.say(name)
        return len(hall.delivered) > before

    assert [delivered_at_once(name) for name in ("w1", "w2", "w3")] == [True] * 3
    assert [delivered_at_once(name) for name in ("w4", "w2", "w3", "w1")] == [False, True, True, False]


def test_what_waits_of_a_publisher_that_is_forgotten_is_delivered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readers, "_MOST_PUBLISHERS", 1)
    hall = Hall()
    hall.say("w1")
    assert hall.delivered == []
    hall.say("w2")
    assert len(hall.delivered) == 1


def test_the_names_of_so_many_participants_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readers, "_MOST_PUBLISHERS", 3)
    hall = Hall()
    for name in "abcd":
        hall.publishers.nodes(name, [(f"/{name}", [f"{name}1"])])
    for name in "abcd":
        hall.publishers.message(f"{name}1", name, b"x", False)
    names = {participant: node for participant, node, _, _ in hall.delivered}
    assert names == {"a": "a", "b": "/b", "c": "/c", "d": "/d"}


def test_one_participant_may_name_as_many_publishers_as_all_may(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readers, "_MOST_PUBLISHERS", 3)
    hall = Hall()
    for _ in range(2):
        hall.publishers.nodes("p", [("/a", ["w1", "w2"])])
        hall.publishers.nodes("q", [("/b", [f"w{number}" for number in range(4)])])
    hall.say("w1")
    assert hall.delivered == [], "none is remembered"
    hall.publishers.nodes("p", [("/a", ["w1", "w2"])])
    hall.say("w2")
    assert hall.delivered == [("p", "/a", b"x", False)] * 2


@pytest.mark.thorough
def test_the_memory_of_publishers_is_bounded() -> None:
    hall = Hall()
    for number in range(11_000):
        hall.publishers.nodes(f"p{number}", [("/a", [f"w{number}"])])
        hall.say(f"w{number}")
    assert size_of(hall.publishers) == 20_000
